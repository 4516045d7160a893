"""Collects the suite as machines would that lack a package, or where one does not load.

    python tests/hidden.py FOLDER [FAULT:PACKAGE[,PACKAGE...]]...

A FAULT is `missing`, or what importing the package raises: `ImportError` or `OSError`. All that is slow to import is
loaded once, and a process is forked from there for every case, which begins with a line `== CASE` and ends with a line
`== EXIT STATUS`.
"""

import gc
import importlib
import importlib.abc
import importlib.machinery
import os
import pkgutil
import sys
from collections.abc import Sequence
from contextlib import suppress
from types import ModuleType

LIBUSB = "libusb-1.0.so.0: cannot open shared object file: No such file or directory"
"""What Open3D says where that library is missing."""
NATIVE = "surfkit.native._native"
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


def main(folder: str, cases: Sequence[str]) -> None:
    """Collect the tests of a folder in each case."""
    import pytest

    import surfkit

    optional = {package for case in cases for package in case.partition(":")[2].split(",")}
    own = {
        module.name for module in pkgutil.walk_packages(surfkit.__path__, "surfkit.") if "__main__" not in module.name
    }
    for name in sorted((own | optional) - {NATIVE}):
        with suppress(ImportError, OSError):
            importlib.import_module(name)
    for case in cases:
        print(f"== {case}", flush=True)
        if (child := os.fork()) == 0:
            fault, _, packages = case.partition(":")
            gc.disable()  # it would walk through all that the parent has loaded
            gc.disable()  # it would walk through all that the parent has loaded
            hide(fault, packages.split(","))
            words = ["--collect-only", "-qq", "--tb=short", "--assert=plain", "-p", "no:cacheprovider", folder]
            status = pytest.main(words)
            sys.stdout.flush()
            os._exit(status)
        print(f"== {os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])}", flush=True)


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2:])
