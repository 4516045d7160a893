"""Collects the suite as machines would that lack a package, or where one does not load.

    python tests/hidden.py FOLDER[:FOLDER...] [FAULT:PACKAGE[,PACKAGE...]]...

A FAULT is `missing`, or what importing the package raises: `ImportError` or `OSError`. All that is slow to import is
loaded once, and a process is forked from there for every case, which begins with a line `== CASE` and ends with a line
`== EXIT STATUS`. Where a single package is hidden, only the tests that ask for one are collected.
"""

import gc
import importlib
import importlib.abc
import importlib.machinery
import os
import pkgutil
import re
import sys
import tempfile
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from types import ModuleType

LIBUSB = "libusb-1.0.so.0: cannot open shared object file: No such file or directory"
"""What Open3D says where that library is missing."""
NATIVE = "surfkit.raster.native._native"
RAISED = {"ImportError": ImportError, "OSError": OSError}


class Broken(importlib.abc.MetaPathFinder, importlib.abc.Loader):
    """Packages that are found, and raise when they are imported."""

    def __init__(self, packages: Sequence[str], error: Exception) -> None:
        self.packages, self.error = packages, error

    def find_spec(self, name: str, path: object = None, target: object = None) -> importlib.machinery.ModuleSpec | None:
        return importlib.machinery.ModuleSpec(name, self) if name in self.packages else None

    def exec_module(self, module: ModuleType) -> None:
        raise self.error


def hide(fault: str, packages: Sequence[str]) -> None:
    """From now on, packages are not there, or do not load."""
    for name in list(sys.modules):
        if any(f"{name}.".startswith(f"{package}.") for package in packages):
            del sys.modules[name]
    if fault == "missing":
        sys.modules.update(dict.fromkeys(packages))
    else:
        sys.meta_path.insert(0, Broken(packages, RAISED[fault](LIBUSB)))


def asking(folders: Sequence[str], package: str) -> list[str]:
    """The files of tests that ask for an optional package, and one that does not.

    To lack one package more is nothing new to others, which are collected where all are missing.
    """
    paths = sorted(path for folder in folders for path in Path(folder).rglob("test_*.py"))
    asks = re.compile("needs_native" if package == NATIVE else rf'\bneeds\(\s*"{package}\b')
    return [str(path) for path in paths if path.name == "test_check.py" or asks.search(path.read_text())]


def main(folders: Sequence[str], cases: Sequence[str], compiled: str) -> None:
    """Collect the tests of folders in each case; `compiled` is a folder for the files that Python makes of them."""
    import pytest

    import surfkit

    optional = {package for case in cases for package in case.partition(":")[2].split(",")}
    own = {
        module.name for module in pkgutil.walk_packages(surfkit.__path__, "surfkit.") if "__main__" not in module.name
    }
    for name in sorted((own | optional) - {NATIVE}):
        with suppress(ImportError, OSError):
            importlib.import_module(name)
    sys.pycache_prefix, sys.dont_write_bytecode = compiled, False  # the tests are compiled in the first case only
    for case in cases:
        print(f"== {case}", flush=True)
        if (child := os.fork()) == 0:
            fault, _, packages = case.partition(":")
            gc.disable()  # it would walk through all that the parent has loaded
            hide(fault, packages.split(","))
            words = ["--collect-only", "-qq", "--tb=short", "--assert=plain", "-p", "no:cacheprovider"]
            status = pytest.main([*words, *(asking(folders, packages) if packages in optional else folders)])
            sys.stdout.flush()
            os._exit(status)
        print(f"== {os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])}", flush=True)


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as compiled:
        main(sys.argv[1].split(os.pathsep), sys.argv[2:], compiled)
