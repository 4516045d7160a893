"""Surface reconstruction of large scenes with Gaussian splatting, out of parts that plugins can add to.

The names below read a data set, train and use what came of it (docs/python.md). Each is imported when it is first used,
so `import surfkit` loads no torch. What plugins are written with is in `surfkit.plugin`; its names are found here too.
"""

from __future__ import annotations

import importlib
from types import ModuleType
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from surfkit.api import (
        Dataset,
        Figures,
        TrainedRun,
        compare,
        from_arrays,
        get_recipe,
        open_run,
        read,
        read_splats,
        save_splats,
        train,
    )
    from surfkit.api import open_run as open
    from surfkit.core.check import BadInput, Fault
    from surfkit.core.hooks import LazyCommand, hookimpl
    from surfkit.core.registry import offer
    from surfkit.core.tree import evolve
    from surfkit.runs.recipe import Recipe
    from surfkit.scene.camera import Camera

    __version__: str

__all__ = [
    "BadInput",
    "Camera",
    "Dataset",
    "Fault",
    "Figures",
    "LazyCommand",
    "Recipe",
    "TrainedRun",
    "__version__",
    "compare",
    "evolve",
    "from_arrays",
    "get_recipe",
    "hookimpl",
    "offer",
    "open",
    "open_run",
    "read",
    "read_splats",
    "save_splats",
    "train",
]
_HOME = {
    "BadInput": "surfkit.core.check",
    "Camera": "surfkit.scene.camera",
    "Dataset": "surfkit.api",
    "Fault": "surfkit.core.check",
    "Figures": "surfkit.api",
    "LazyCommand": "surfkit.core.hooks",
    "Recipe": "surfkit.runs.recipe",
    "TrainedRun": "surfkit.api",
    "compare": "surfkit.api",
    "evolve": "surfkit.core.tree",
    "from_arrays": "surfkit.api",
    "get_recipe": "surfkit.api",
    "hookimpl": "surfkit.core.hooks",
    "offer": "surfkit.core.registry",
    "open": "surfkit.api",
    "open_run": "surfkit.api",
    "read": "surfkit.api",
    "read_splats": "surfkit.api",
    "save_splats": "surfkit.api",
}


class TrainFolder(ModuleType):
    """The folder `surfkit.train`, which is the function `surfkit.api.train` too."""

    def __call__(self, *words: Any, **settings: Any) -> Any:
        """See `surfkit.api.train`."""
        return importlib.import_module("surfkit.api").train(*words, **settings)


def __getattr__(name: str) -> Any:
    if name == "train":
        return importlib.import_module("surfkit.train")
    if name == "__version__":
        from surfkit.core.version import own_version

        return own_version()
    if name in _HOME:
        return getattr(importlib.import_module(_HOME[name]), "open_run" if name == "open" else name)
    if name.startswith("_") or name not in (of_plugins := importlib.import_module("surfkit.plugin")).__all__:
        raise AttributeError(f"module 'surfkit' has no attribute {name!r}")
    return getattr(of_plugins, name)


def __dir__() -> list[str]:
    return sorted(__all__)
