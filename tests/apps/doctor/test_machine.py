"""`surfkit doctor` without a data set: what a report of a bug needs to know of a machine."""

import importlib.metadata
import json
import os
import re
import socket
import sys
from pathlib import Path

import hidden
import psutil
import pytest
import torch
from needs import needs_native

from surfkit.apps.doctor.machine import Native, machine
from surfkit.cli import main
from surfkit.raster import native


def test_for_programs(capsys):
    assert main(["doctor", "--json"]) == 0
    text = capsys.readouterr().out
    told = json.loads(text)
    assert told["python"] == sys.version.split()[0] and told["surfkit"] == importlib.metadata.version("surfkit")
    assert told["packages"]["torch"] == importlib.metadata.version("torch") and "pytest" in told["packages"]
    assert told["memory_bytes"] == psutil.virtual_memory().total and told["processors"] == os.cpu_count()
    assert told["cuda"] == torch.version.cuda and len(told["gpus"]) == torch.cuda.device_count()
    assert told["rasterizers"].keys() >= {"native", "nvidia", "reference"}
    assert str(Path.home()) + os.sep not in text and socket.gethostname() not in text, "people show it to others"


def test_for_people(capsys):
    assert main(["doctor"]) == 0
    rows = dict(re.split(" {2,}", line, maxsplit=1) for line in capsys.readouterr().out.splitlines()[1:])
    assert f"torch {importlib.metadata.version('torch')}" in rows["packages"] and rows["rasterizer reference"]
    assert rows["compiled kernels"]


@needs_native
def test_the_compiled_kernels():
    """What the linker left in the file, of the compilers of all its parts, says the same."""
    found, module = machine().native, native.module()
    file = Path(module.__file__)
    assert found.file == file.name and found.lacking is None
    assert found.in_use in found.kernels and found.kernels[-1] == "baseline"
    compilers = re.findall(rb"GCC: \([^)\0]*\) ([\d.]+)|clang version ([\d.]+)", file.read_bytes())
    if not compilers:
        pytest.skip("this file does not name its compilers")
    assert any((gcc or clang).decode() in found.compiler for gcc, clang in compilers)


@pytest.mark.parametrize(
    ("fault", "said"),
    [
        (
            ImportError("/lib/libstdc++.so.6: version\n`GLIBCXX_3.4.30' not found"),
            "loaded (/lib/libstdc++.so.6: version `G",
        ),
        (ModuleNotFoundError("none"), "installed without its compiled kernels"),
    ],
    ids=["does not load", "missing"],
)
def test_why_there_are_no_compiled_kernels(monkeypatch, capsys, fault, said):
    """A module that is there and does not load is not said to be missing, and a compiler is not blamed."""
    monkeypatch.delitem(sys.modules, hidden.NATIVE, raising=False)
    monkeypatch.delattr(native, "_native", raising=False)
    monkeypatch.setattr(sys, "meta_path", [hidden.Broken([hidden.NATIVE], fault), *sys.meta_path])
    monkeypatch.setattr(native, "module", native.module.__wrapped__)
    found = machine()
    assert found.native == Native(lacking=native.lacking()) and said in native.lacking()
    assert "\n" not in native.lacking() and "; install" in native.lacking()
    assert found.rasterizers["native"] == native.lacking()
    assert main(["doctor"]) == 0
    assert said in capsys.readouterr().out


@pytest.mark.parametrize("words", [["--quick"], ["recipe:surface"], ["--json", "--probe", "0"], ["--device", "cpu"]])
def test_what_is_about_a_data_set_is_refused_without_one(capsys, words):
    assert main(["doctor", *words]) == 2
    said = capsys.readouterr()
    word = next(word for word in words if word != "--json")
    assert said.err.startswith(f"surfkit: {word} is ") and said.err.endswith(": surfkit doctor DATA\n") and not said.out
