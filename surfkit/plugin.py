"""What plugins are written with: the kinds of components, what their methods take and give, and the marks.

One name, one import: `from surfkit.plugin import Loss, Target, hookimpl`. `surfkit.testing` checks what is written.
"""

from __future__ import annotations

from surfkit.appearance.base import Appearance, PhotoLight
from surfkit.appearance.exposure import Exposure
from surfkit.apps.sfm.base import FeatureExtractor, FeatureMatcher, Features, Find, MatchInput
from surfkit.compress.base import Compressor, Plan
from surfkit.compress.encoding import ColumnType, Encoding
from surfkit.compress.kmeans import kmeans, nearest
from surfkit.compress.levels.base import LevelsOfDetail, LodInput
from surfkit.compress.levels.hierarchy import Hierarchy
from surfkit.compress.levels.lod_tree import LodBlock, LodBlocks, LodTree
from surfkit.compress.octree import Leaf
from surfkit.compress.streams import Stored
from surfkit.compress.vectree import Vectree
from surfkit.core.check import BadInput, Fault, expect, leaving_out, reject, require_within
from surfkit.core.codec import dump, load, read_json, write_json
from surfkit.core.events import (
    FileWritten,
    Measured,
    MemoryTaken,
    PhotoSkipped,
    PointsEdited,
    Progress,
    StageBegan,
    StageEnded,
    StepDone,
    Warned,
    emit,
)
from surfkit.core.files import replacing
from surfkit.core.hooks import LazyCommand, hookimpl
from surfkit.core.registry import Component, choice, components, find, name_of
from surfkit.core.schedule import Interval, LearningRate, StepCount, Steps, log_linear, rescale
from surfkit.core.tree import evolve
from surfkit.densify.adc import ADC
from surfkit.densify.base import (
    ComparedView,
    Contribution,
    Densify,
    Filter,
    Policy,
    Prune,
    Signal,
    Step,
    Views,
    ViewStatistics,
    admitted,
)
from surfkit.densify.filters import CountCap
from surfkit.densify.matched import MatchedADC
from surfkit.densify.prune import PruneByOpacity
from surfkit.densify.signal import AbsGradient
from surfkit.depth.base import DepthEstimator, DepthInput, Estimate, KnownSurface, KnownSurfaces
from surfkit.depth.fill_base import Fill, FillInput
from surfkit.depth.filled import Filled
from surfkit.depth.patch_match import PatchMatch
from surfkit.io.datasets.base import Reader
from surfkit.io.datasets.data import Data
from surfkit.io.datasets.depth_files import DepthFile
from surfkit.io.datasets.depth_layout import DepthLayout, DepthQuery
from surfkit.io.datasets.depth_prior import DepthPrior
from surfkit.io.datasets.raw_dataset import RawDataset, RawImage, Tracks, camera_of
from surfkit.io.datasets.split import Split
from surfkit.io.splats.base import Format
from surfkit.io.splats.file_axes import FileAxes
from surfkit.io.splats.sog import SOG
from surfkit.io.splats.splat_table import SplatTable, Tile
from surfkit.losses.base import Loss, Neighbour, Regularizer, RegularizerInput, Target
from surfkit.losses.depth import DepthRegression
from surfkit.losses.frequency import Frequency
from surfkit.losses.normal_prior import NormalPrior
from surfkit.losses.patch_depth import PatchDepth
from surfkit.losses.photometric import L1, SSIM
from surfkit.losses.regularizers import MeanOpacity, MeanScale
from surfkit.losses.reprojection import Reprojection
from surfkit.losses.surface import Distortion, NormalConsistency
from surfkit.losses.transients import Transients
from surfkit.losses.warped_patches import WarpedPatches
from surfkit.mesh.base import Mesh, Mesher, MeshInput
from surfkit.mesh.delaunay import tetrahedralised
from surfkit.mesh.field import vertex_colors
from surfkit.mesh.isosurface import isosurface
from surfkit.mesh.overlap import Depths
from surfkit.mesh.poisson import Poisson
from surfkit.mesh.shade import draw_faces
from surfkit.mesh.tetra import crossed_edges, oriented, triangles
from surfkit.mesh.trust import Trust
from surfkit.mesh.tsdf import TSDF
from surfkit.partition.assign import Assign
from surfkit.partition.base import Cells, CoarseModel, Contraction, Ground, Partition
from surfkit.partition.grid import QuantileGrid
from surfkit.partition.sparse_points import SparsePointShare
from surfkit.partition.square_grid import SquareGrid
from surfkit.primitives.base import Primitive, harmonics, rotated
from surfkit.primitives.columns import EXP, IDENTITY, SIGMOID, Activation, Column, standard_columns
from surfkit.primitives.edit import Edit, NewPoints
from surfkit.primitives.flat3d import Flat3D
from surfkit.primitives.gaussian3d import Gaussian3D
from surfkit.primitives.init import SH_C0, facing, seeds
from surfkit.primitives.model import SplatModel
from surfkit.primitives.points import Columns, Points
from surfkit.primitives.storage import Storage
from surfkit.primitives.surfel2d import Surfel2D
from surfkit.raster.api import Derived, Gradients, Maps, Render, Splats
from surfkit.raster.autograd import AutogradRender, DerivedRender
from surfkit.raster.base import Rasterizer
from surfkit.raster.normals import normals_of
from surfkit.raster.splat_boxes import SplatBoxes
from surfkit.raster.ssim import ssim_map
from surfkit.runs.execute.base import Executor, Job, JobResult
from surfkit.runs.methods.base import Method, MethodInput, Reconstruction
from surfkit.runs.recipe import Recipe, refuse_unfit_stage
from surfkit.scene.camera import Camera
from surfkit.scene.observations import Observations, Observations2D
from surfkit.scene.pixels import Pixels
from surfkit.scene.scene import Frame, Lens, Mask, Scene, SparsePoints, View
from surfkit.start.base import InitialModel, Start, StartInput
from surfkit.study.ablation import Row, Table
from surfkit.study.recipes import SURFELS
from surfkit.train import checkpoint
from surfkit.train.adam import Adam, AdamInView
from surfkit.train.faults import Diverged
from surfkit.train.interrupt import graceful
from surfkit.train.optimizer import Optimizer, OptimizerInput
from surfkit.train.refine.base import Refine
from surfkit.train.refine.rendered_depth import RenderedDepth
from surfkit.train.stage import Stage
from surfkit.train.state import StageState
from surfkit.train.trainer import CompletedStep, Trainer

__all__ = [
    "ADC",
    "AbsGradient",
    "Activation",
    "Adam",
    "AdamInView",
    "Appearance",
    "Assign",
    "AutogradRender",
    "BadInput",
    "Camera",
    "RawDataset",
    "Cells",
    "SparsePoints",
    "SparsePointShare",
    "CoarseModel",
    "Column",
    "ColumnType",
    "Columns",
    "ComparedView",
    "Component",
    "CompletedStep",
    "Compressor",
    "Contraction",
    "Contribution",
    "CountCap",
    "Data",
    "Densify",
    "DepthEstimator",
    "DepthFile",
    "DepthInput",
    "DepthLayout",
    "DepthPrior",
    "DepthQuery",
    "DepthRegression",
    "Depths",
    "Derived",
    "DerivedRender",
    "Distortion",
    "Diverged",
    "EXP",
    "Edit",
    "Encoding",
    "Estimate",
    "Executor",
    "Exposure",
    "Fault",
    "FeatureExtractor",
    "FeatureMatcher",
    "Features",
    "FileAxes",
    "FileWritten",
    "Fill",
    "FillInput",
    "Filled",
    "Filter",
    "Find",
    "Flat3D",
    "Format",
    "Frame",
    "Frequency",
    "Gaussian3D",
    "Gradients",
    "Ground",
    "Hierarchy",
    "IDENTITY",
    "InitialModel",
    "Interval",
    "Job",
    "JobResult",
    "KnownSurface",
    "KnownSurfaces",
    "L1",
    "LazyCommand",
    "Leaf",
    "LearningRate",
    "Lens",
    "LevelsOfDetail",
    "LodBlock",
    "LodBlocks",
    "LodInput",
    "LodTree",
    "Loss",
    "Maps",
    "Mask",
    "MatchInput",
    "MatchedADC",
    "MeanOpacity",
    "MeanScale",
    "Measured",
    "MemoryTaken",
    "Mesh",
    "MeshInput",
    "Mesher",
    "Method",
    "MethodInput",
    "Neighbour",
    "NewPoints",
    "NormalConsistency",
    "NormalPrior",
    "Observations",
    "Optimizer",
    "OptimizerInput",
    "Partition",
    "PatchDepth",
    "PatchMatch",
    "PhotoLight",
    "PhotoSkipped",
    "Pixels",
    "Plan",
    "Points",
    "PointsEdited",
    "Poisson",
    "Policy",
    "Primitive",
    "Progress",
    "Prune",
    "PruneByOpacity",
    "QuantileGrid",
    "Rasterizer",
    "Reader",
    "Recipe",
    "Reconstruction",
    "Refine",
    "RenderedDepth",
    "Regularizer",
    "RegularizerInput",
    "Render",
    "Reprojection",
    "Row",
    "SH_C0",
    "SIGMOID",
    "SOG",
    "SSIM",
    "SURFELS",
    "Scene",
    "Observations2D",
    "RawImage",
    "Signal",
    "SplatBoxes",
    "SplatModel",
    "SplatTable",
    "Splats",
    "Split",
    "SquareGrid",
    "Stage",
    "StageBegan",
    "StageEnded",
    "StageState",
    "Start",
    "StartInput",
    "Step",
    "StepCount",
    "StepDone",
    "Steps",
    "Storage",
    "Stored",
    "Surfel2D",
    "TSDF",
    "Table",
    "Target",
    "Tile",
    "Tracks",
    "Trainer",
    "Transients",
    "Trust",
    "Vectree",
    "View",
    "ViewStatistics",
    "Views",
    "Warned",
    "WarpedPatches",
    "admitted",
    "camera_of",
    "checkpoint",
    "crossed_edges",
    "choice",
    "components",
    "draw_faces",
    "dump",
    "emit",
    "evolve",
    "expect",
    "facing",
    "find",
    "graceful",
    "harmonics",
    "hookimpl",
    "isosurface",
    "kmeans",
    "leaving_out",
    "load",
    "log_linear",
    "name_of",
    "nearest",
    "normals_of",
    "oriented",
    "read_json",
    "refuse_unfit_stage",
    "reject",
    "replacing",
    "require_within",
    "rescale",
    "rotated",
    "seeds",
    "ssim_map",
    "standard_columns",
    "tetrahedralised",
    "triangles",
    "vertex_colors",
    "write_json",
]
