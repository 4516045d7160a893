"""Packages that surfkit can do without, and what to install where one of them does not load."""

from __future__ import annotations

import ctypes
import re
from collections.abc import Iterator
from contextlib import contextmanager

from surfkit.core.check import BadInput
from surfkit.core.memory import is_out_of_memory

EXTRAS = {
    "OpenEXR": "exr", "cv2": "video", "fast_simplification": "texture", "kornia": "features", "laspy": "maps",
    "lazrs": "maps", "lpips": "lpips", "open3d": "mesh", "pillow_heif": "heic", "pxr": "usd", "pyogrio": "maps",
    "rasterio": "maps", "ray": "ray", "reportlab": "report", "shapely": "maps", "submitit": "slurm",
    "tensorboard": "tensorboard",
    "transformers": "depth", "trimesh": "mesh", "viser": "view",
}  # fmt: skip
"""By package, which extra of surfkit brings it; any other is installed by its own name."""
INSTALLED_AS = {
    "cv2": "opencv-python-headless",
    "fast_simplification": "fast-simplification",
    "pillow_heif": "pillow-heif",
    "pxr": "usd-core",
}
"""By package, the name that it is installed by, where that is another one."""
LIBRARIES = {
    "open3d": {
        "libEGL.so.1": "libegl1", "libGL.so.1": "libgl1", "libX11.so.6": "libx11-6", "libgomp.so.1": "libgomp1",
        "libidn2.so.0": "libidn2-0", "libudev.so.1": "libudev1", "libusb-1.0.so.0": "libusb-1.0-0",
    },
}  # fmt: skip
"""By package, the system libraries that its wheels expect, and the package of Debian and Ubuntu that has each."""
NOT_FOUND = re.compile(r"([^\s/:]+\.so[.\d]*): cannot open shared object file")
"""How the dynamic linker of Linux says that there is no such library."""


@contextmanager
def needed(package: str, what: str) -> Iterator[None]:
    """Within, a package is imported that not everybody has.

    Args:
        package: Its name, as `import` takes it.
        what: What it is needed for, to begin the message with: a component, an option or a file.

    Raises:
        BadInput: The import failed: the package or a package of its own is not installed, a system library is missing,
            or it does not work here. Says which, and what to install.
    """
    try:
        yield
    except Exception as error:  # a package that does not suit the machine raises anything: OSError, AttributeError
        if is_out_of_memory(error):
            raise
        raise BadInput(f"{what} needs the package {package}, {_reason(package, error)}") from error


def _reason(package: str, error: Exception) -> str:
    own_name = INSTALLED_AS.get(package, package)
    pip = f"pip install 'surfkit[{EXTRAS[package]}]'" if package in EXTRAS else f"pip install {own_name}"
    if isinstance(error, ModuleNotFoundError):
        lacks = error.name or package
        own = "which is not installed" if lacks == package else f"which cannot be loaded without {lacks}"
        return f"{own}: {pip}"
    if missing := _missing(package, str(error)):
        known = LIBRARIES.get(package, {})
        system = " ".join(known[name] for name in missing if name in known)
        remedy = f"Debian, Ubuntu: apt install {system}" if system else "install the system's package of it"
        few = "libraries {} are" if len(missing) > 1 else "library {} is"
        return f"which cannot be loaded: the system {few.format(', '.join(missing))} missing ({remedy})"
    said = " ".join(f"{type(error).__name__}: {error}".split())[:200]
    return f"which cannot be loaded ({said}): pip install --force-reinstall {own_name}"


def _missing(package: str, said: str) -> list[str]:
    """System libraries that are not on this machine: the one that the linker gave up at, and what it would ask next."""
    if (found := NOT_FOUND.search(said)) is None:
        return []
    return sorted({found[1], *(name for name in LIBRARIES.get(package, ()) if not _loads(name))})


def _loads(library: str) -> bool:
    try:
        ctypes.CDLL(library)
    except OSError:
        return False
    return True
