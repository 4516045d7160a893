"""What is said where an optional package does not load."""

import importlib.metadata
import re

import pytest

from surfkit.core import optional
from surfkit.core.check import BadInput
from surfkit.core.optional import EXTRAS, INSTALLED_AS, needed

LIBGL = "libGL.so.1: cannot open shared object file: No such file or directory"


def reason(package, error):
    with pytest.raises(BadInput) as caught, needed(package, "mesh:poisson"):
        raise error
    assert caught.value.__cause__ is error
    return str(caught.value).removeprefix(f"mesh:poisson needs the package {package}, which ")


def test_what_is_not_installed():
    with pytest.raises(BadInput) as caught, needed("surfkit_nowhere", "--x"):
        import surfkit_nowhere  # noqa: F401
    install = "pip install surfkit_nowhere"
    assert str(caught.value) == f"--x needs the package surfkit_nowhere, which is not installed: {install}"
    assert reason("ray", ModuleNotFoundError("", name="ray")) == "is not installed: pip install 'surfkit[ray]'"
    assert reason("ray", ModuleNotFoundError("", name="msgpack")).startswith("cannot be loaded without msgpack: pip ")


@pytest.mark.parametrize("kind", [ImportError, OSError])
def test_all_system_libraries_that_are_missing_are_told_at_once(monkeypatch, kind):
    """The linker stops at the first; without the rest it would be asked again and again."""
    monkeypatch.setattr(optional, "_loads", lambda name: name not in ("libGL.so.1", "libEGL.so.1"))
    remedy = "(Debian, Ubuntu: apt install libegl1 libgl1)"
    told = f"cannot be loaded: the system libraries libEGL.so.1, libGL.so.1 are missing {remedy}"
    assert reason("open3d", kind(LIBGL)) == told
    told = "cannot be loaded: the system library libGL.so.1 is missing (install the system's package of it)"
    assert reason("pillow", kind(LIBGL)) == told


def test_libraries_are_looked_for_on_this_machine():
    assert optional._loads("libc.so.6") and not optional._loads("libsurfkit-nowhere.so.1")


@pytest.mark.parametrize("error", [OSError("no\nsuch device"), AttributeError("_ARRAY_API"), RuntimeError("x" * 999)])
def test_whatever_else_stops_it_is_one_line(error):
    said = reason("ray", error)
    assert said.startswith(f"cannot be loaded ({type(error).__name__}: ") and "\n" not in said and len(said) < 300
    assert said.endswith("): pip install --force-reinstall ray")


def test_memory_that_gives_out_is_no_fault_of_the_package():
    with pytest.raises(MemoryError), needed("ray", "executor:ray"):
        raise MemoryError


def test_the_extras_bring_what_is_said():
    found = [re.match(r"([\w-]+).*extra == ['\"](\w+)['\"]", line) for line in importlib.metadata.requires("surfkit")]
    assert {(match[1], match[2]) for match in found if match} >= {
        (INSTALLED_AS.get(name, name), extra) for name, extra in EXTRAS.items()
    }
