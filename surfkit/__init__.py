"""Surface reconstruction of large scenes with Gaussian splatting, out of parts that plugins can add to.

The names below are the public surface. Each is imported when it is first used, so `import surfkit` loads no torch.
"""

from __future__ import annotations

import importlib
from types import ModuleType
from typing import Any

_HOME = {
    "surfkit.api": ("Dataset", "Figures", "TrainedRun", "get_recipe", "open_run", "read"),
    "surfkit.core.check": ("BadInput", "Fault", "expect", "leaving_out", "reject"),
    "surfkit.core.codec": ("dump", "load", "read_json", "write_json"),
    "surfkit.core.hooks": ("LazyCommand", "hookimpl"),
    "surfkit.core.registry": ("Component", "choice", "components", "find"),
    "surfkit.core.schedule": ("Interval", "LearningRate", "StepCount", "Steps", "log_linear", "rescale"),
    "surfkit.core.tree": ("evolve",),
    "surfkit.core.events": (
        "FileWritten",
        "Measured",
        "MemoryTaken",
        "PhotoSkipped",
        "PointsEdited",
        "Progress",
        "StageBegan",
        "StageEnded",
        "StepDone",
        "Warned",
        "emit",
    ),
    "surfkit.scene.camera": ("Camera",),
    "surfkit.scene.observations": ("Observations", "Seen"),
    "surfkit.scene.pixels": ("Pixels",),
    "surfkit.scene.scene": ("Cloud", "Frame", "Lens", "Mask", "Scene", "View"),
    "surfkit.io.splats.axes": ("FileAxes",),
    "surfkit.io.splats.base": ("Format",),
    "surfkit.io.splats.table": ("SplatTable", "Tile"),
    "surfkit.io.datasets.base": ("Reader",),
    "surfkit.io.datasets.capture": ("Capture", "Shot", "Tracks", "camera_of"),
    "surfkit.io.datasets.data": ("Data",),
    "surfkit.io.datasets.depth_files": ("DepthFile",),
    "surfkit.io.datasets.depth_layout": ("DepthLayout", "DepthQuery"),
    "surfkit.io.datasets.split": ("Split",),
    "surfkit.io.datasets.depth_prior": ("DepthPrior",),
    "surfkit.raster.api": ("Derived", "Gradients", "Maps", "Rasterizer", "Render", "Splats"),
    "surfkit.compress.base": ("Compressor", "Plan"),
    "surfkit.compress.encoding": ("ColumnType", "Encoding"),
    "surfkit.compress.octree": ("Leaf",),
    "surfkit.compress.streams": ("Stored",),
    "surfkit.primitives.base": ("Primitive", "harmonics", "rotated"),
    "surfkit.primitives.columns": ("EXP", "IDENTITY", "SIGMOID", "Activation", "Column", "standard_columns"),
    "surfkit.primitives.edit": ("Edit", "NewPoints"),
    "surfkit.primitives.init": ("facing", "seeds"),
    "surfkit.primitives.model": ("SplatModel",),
    "surfkit.primitives.points": ("Columns", "Points"),
    "surfkit.raster.autograd": ("AutogradRender", "DerivedRender"),
    "surfkit.losses.base": ("Loss", "Neighbour", "Regularizer", "RegularizerInput", "Target"),
    "surfkit.apps.sfm.base": ("FeatureExtractor", "FeatureMatcher", "Features", "Find", "MatchInput"),
    "surfkit.depth.base": ("DepthEstimator", "DepthInput", "Estimate"),
    "surfkit.appearance.base": ("Appearance",),
    "surfkit.start.base": ("InitialModel", "Start", "StartInput"),
    "surfkit.densify.base": (
        "Contribution",
        "Densify",
        "Filter",
        "Policy",
        "Prune",
        "Signal",
        "Step",
        "Views",
        "admitted",
    ),
    "surfkit.mesh.base": ("Mesh", "Mesher", "MeshInput"),
    "surfkit.mesh.isosurface": ("isosurface",),
    "surfkit.runs.methods.base": ("Method", "MethodInput", "Reconstruction"),
    "surfkit.train.interrupt": ("graceful",),
    "surfkit.mesh.overlap": ("Depths",),
    "surfkit.mesh.trust": ("Trust",),
    "surfkit.partition.assign": ("Assign",),
    "surfkit.partition.base": ("Cells", "CoarseModel", "Contraction", "Ground", "Partition"),
    "surfkit.runs.execute.base": ("Executor", "Job", "JobResult"),
    "surfkit.train.stage": ("Stage",),
    "surfkit.train.refine.base": ("Refine",),
    "surfkit.compress.levels.base": ("LevelsOfDetail", "LodInput"),
    "surfkit.compress.levels.tree": ("LodBlock", "LodBlocks", "LodTree"),
    "surfkit.runs.recipe": ("Recipe",),
    "surfkit.study.ablation": ("Row", "Table"),
}
_OTHER_NAMES = {"open": "open_run"}
_MODULE_OF = {name: module for module, names in _HOME.items() for name in names}

__all__ = ["__version__", "train", *_OTHER_NAMES, *_MODULE_OF]  # noqa: PLE0604


class TrainFolder(ModuleType):
    """The folder `surfkit.train`, which is the function `surfkit.api.train` too."""

    def __call__(self, *words: Any, **settings: Any) -> Any:
        """See `surfkit.api.train`."""
        return importlib.import_module("surfkit.api").train(*words, **settings)


def __getattr__(name: str) -> Any:
    if name == "train":
        return importlib.import_module("surfkit.train")
    name = _OTHER_NAMES.get(name, name)
    if name == "__version__":
        from surfkit.core.version import own_version

        return own_version()
    if name not in _MODULE_OF:
        raise AttributeError(f"module 'surfkit' has no attribute {name!r}")
    return getattr(importlib.import_module(_MODULE_OF[name]), name)


def __dir__() -> list[str]:
    return sorted(__all__)
