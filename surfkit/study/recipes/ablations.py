"""Ablation tables as lists of changes: those of CityGaussianV2 (Liu et al. 2024), with the published figures beside
them, and what each part of `recipe:surface` brings.

Published figures are of the scene Residence of GauU-Scene, where nothing else is said.
"""

from __future__ import annotations

from dataclasses import replace

from surfkit.appearance.camera_response import CameraResponse
from surfkit.appearance.exposure import Exposure
from surfkit.compress.vectree import Vectree
from surfkit.densify.adc import ADC
from surfkit.densify.filters import Elongation
from surfkit.densify.prune import PruneByImportance
from surfkit.densify.signal import LossGradient
from surfkit.densify.trim import Trim
from surfkit.depth.filled import Filled
from surfkit.losses.consensus import Consensus
from surfkit.losses.depth import DepthRegression
from surfkit.losses.normal_prior import NormalPrior
from surfkit.losses.patch_depth import PatchDepth
from surfkit.losses.photometric import L1, SSIM
from surfkit.losses.reprojection import Reprojection
from surfkit.losses.surface import NormalConsistency
from surfkit.losses.warped_patches import WarpedPatches
from surfkit.mesh.geometric_consistency import GeometricConsistency
from surfkit.mesh.tsdf import TSDF
from surfkit.partition.airspace import Airspace
from surfkit.partition.assign import SSIMDifference
from surfkit.partition.balanced import Balanced
from surfkit.partition.camera_grid import CameraGrid
from surfkit.partition.grid import ContractedGrid, QuantileGrid
from surfkit.partition.sparse_points import SparsePointShare
from surfkit.partition.square_grid import SquareGrid
from surfkit.primitives.surfel2d import Surfel2D
from surfkit.runs.recipe import Recipe
from surfkit.start.stereo_start import StereoStart
from surfkit.study.ablation import BASELINE, Row, Table
from surfkit.study.metric_columns import MESH_COLUMNS
from surfkit.study.recipes import RECIPES, city
from surfkit.study.recipes import surface_recipes as surface
from surfkit.study.recipes.surface_recipes import STEREO
from surfkit.train.stage import Stage

COARSE_BASELINE = Recipe(
    about="2D Gaussian splatting as CityGaussianV2 starts from it: weaker normals, median depth, softer culling",
    primitive=Surfel2D(sh_degree=3),
    pretrain=Stage(
        losses={
            "l1": L1(),
            "ssim": SSIM(),
            "normal": NormalConsistency(weight=0.0125, start=7_000, depth="median"),
        },
        densify=ADC(cull_opacity=0.005),
        appearance=city.LIGHT,
    ),
)


def compared(ssim: float, psnr: float, lpips: float, precision: float, recall: float, f1: float) -> dict[str, float]:
    """The quality of a row in print, in the order of its columns."""
    return {"ssim": ssim, "psnr": psnr, "lpips": lpips, "precision": precision, "recall": recall, "f1": f1}


def published(*quality: float, millions: float, minutes: float) -> dict[str, float]:
    """The quality of a row in print, and its points and training time."""
    return compared(*quality) | {"points": round(millions * 1e6), "seconds": 60 * minutes}


def costs(gigabytes: float, memory: float, fps: float) -> dict[str, float]:
    """The last three figures of a row of the model table: size and memory in gigabytes, and frames per second."""
    return {"bytes": gigabytes * 1e9, "peak_memory_bytes": memory * 1e9, "fps": fps}


FILTER = {"pretrain.densify.filters": (Elongation(),)}
DEPTH = {"pretrain.losses.depth": DepthRegression(start=0.5, end=0.0025)}


def stereo_alone(on: str) -> Row:
    """The last row of a table: depth maps of stereo alone, fused, which any optimised surface has to beat."""
    return Row("stereo alone", recipe=RECIPES["stereo"], kept=False, on=on, group=BASELINE)


# What the second stage of CityGaussianV2 adds to its pretraining. Its losses and its densification are those of
# pretraining, but for the normal loss, which counts from the beginning.
PARALLEL_TUNING = {
    "partition": city.CITY.partition,
    "tune": replace(city.CITY.tune, prune=()),
    "context": city.CITY.context,
}

# In print, "indented rows exclude each other": trim and prune are both added to parallel tuning, and trim is kept. The
# control is not in print: the same second stage on the whole scene tells what the stage brings, and what the cut does.
# How many points LightGaussian's pruning drops is not in print: 10.3 of 19.3 million points are left, so half.
MODEL_TABLE = Table(
    "model",
    "What each component brings (CityGaussianV2, ablation on model components; published on Residence of GauU-Scene)",
    COARSE_BASELINE,
    (
        Row(
            "baseline",
            group="Pretraining",
            paper=published(0.637, 21.12, 0.401, 0.474, 0.362, 0.410, millions=9.54, minutes=78)
            | costs(2.26, 20.8, 28.0),
        ),
        Row(
            "+ elongation filter",
            FILTER,
            paper=published(0.636, 21.18, 0.401, 0.477, 0.362, 0.411, millions=9.36, minutes=78)
            | costs(2.26, 20.8, 28.6),
        ),
        Row(
            "+ DGD",
            {"pretrain.signal": LossGradient(terms=("ssim",), boost=0.9)},
            paper=published(0.674, 22.24, 0.345, 0.480, 0.387, 0.429, millions=9.51, minutes=84)
            | costs(2.25, 20.7, 30.3),
        ),
        Row(
            "+ depth regression",
            DEPTH,
            paper=published(0.674, 22.22, 0.345, 0.501, 0.390, 0.438, millions=9.67, minutes=89)
            | costs(2.29, 25.3, 29.4),
        ),
        Row(
            "+ parallel tuning",
            PARALLEL_TUNING,
            group="Fine-tuning",
            paper=published(0.742, 23.50, 0.237, 0.538, 0.419, 0.471, millions=19.3, minutes=195)
            | costs(4.57, 31.5, 21.3),
        ),
        Row("control: one block", {"partition": ContractedGrid(blocks=(1, 1))}, kept=False),
        Row(
            "+ trim (Ours-b)",
            {"tune.prune": (Trim(ratio=0.1),)},
            paper=published(0.742, 23.57, 0.243, 0.534, 0.430, 0.477, millions=8.07, minutes=179)
            | costs(1.90, 19.0, 31.3),
        ),
        Row(
            "+ prune (LightGaussian)",
            {"tune.prune": (PruneByImportance(at=(15_000,), ratio=0.5),)},
            kept=False,
            on="+ parallel tuning",
            paper=published(0.738, 23.46, 0.246, 0.538, 0.420, 0.472, millions=10.3, minutes=168)
            | costs(1.90, 24.3, 30.3),
        ),
        Row(
            "+ SH degree 2",
            {"primitive.sh_degree": 2},
            paper=published(0.742, 23.49, 0.245, 0.540, 0.423, 0.474, millions=8.06, minutes=176)
            | costs(1.29, 14.2, 34.5),
        ),
        Row(
            "+ VQ (Ours-s)",
            {"compress": Vectree()},
            paper=published(0.740, 23.46, 0.248, 0.530, 0.414, 0.465, millions=8.06, minutes=181)
            | costs(0.44, 14.2, 34.5),
        ),
        Row(
            "+ 7k pretrain (Ours-t)",
            {"pretrain": city.CITY_TINY.pretrain},
            paper=published(0.721, 23.17, 0.281, 0.517, 0.416, 0.461, millions=5.31, minutes=115)
            | costs(0.29, 11.5, 41.7),
        ),
        Row(
            "+ partition of 2DGS",
            {"partition_pretrain": city.cut_short(COARSE_BASELINE.pretrain, 7_000)},
            kept=False,
            paper=published(0.704, 22.68, 0.296, 0.508, 0.414, 0.456, millions=4.71, minutes=112)
            | costs(0.25, 11.3, 43.5),
        ),
        Row(
            "CityGaussian",
            recipe=RECIPES["citygs"],
            kept=False,
            on="+ VQ (Ours-s)",
            group="First version",
            paper=published(0.727, 23.17, 0.266, 0.519, 0.402, 0.453, millions=8.05, minutes=235)
            | costs(0.44, 31.5, 66.7),
        ),
        stereo_alone(on="baseline"),
    ),
)

# The table in print has the heads of PSNR and SSIM swapped. Its gradients are not scaled, so there is no boost. Leaving
# a loss out of the gradient is tried on top of all of them; SSIM alone is what the paper goes on with. It is a smaller
# gradient, which adds fewer points; raised as in DGD, it adds about as many as all of them.
GRADIENT_TABLE = Table(
    "gradient",
    "Which losses should drive densification (CityGaussianV2, ablation on gradient source of densification)",
    COARSE_BASELINE,
    (
        Row(
            "SSIM + RGB + normal",
            FILTER | {"pretrain.signal": LossGradient()},
            paper=published(0.636, 21.18, 0.401, 0.464, 0.353, 0.401, millions=9.56, minutes=78),
        ),
        Row(
            "SSIM + RGB",
            {"pretrain.signal": LossGradient(terms=("ssim", "l1"))},
            kept=False,
            paper=published(0.635, 21.13, 0.403, 0.463, 0.350, 0.399, millions=9.54, minutes=85),
        ),
        Row(
            "SSIM + normal",
            {"pretrain.signal": LossGradient(terms=("ssim", "normal"))},
            kept=False,
            paper=published(0.673, 22.21, 0.347, 0.466, 0.377, 0.417, millions=9.44, minutes=85),
        ),
        Row(
            "SSIM",
            {"pretrain.signal": LossGradient(terms=("ssim",))},
            paper=published(0.674, 22.24, 0.345, 0.470, 0.378, 0.419, millions=9.51, minutes=84),
        ),
        Row(
            "control: SSIM, raised",
            {"pretrain.signal": LossGradient(terms=("ssim",), boost=0.9)},
            kept=False,
            on="SSIM + RGB + normal",
        ),
        Row(
            "SSIM, depth as a loss",
            DEPTH,
            paper=published(0.674, 22.22, 0.345, 0.490, 0.381, 0.429, millions=9.67, minutes=89),
        ),
        Row(
            "SSIM + depth",
            {"pretrain.signal": LossGradient(terms=("ssim", "depth"))},
            kept=False,
            paper=published(0.674, 22.21, 0.347, 0.490, 0.380, 0.428, millions=9.43, minutes=90),
        ),
        stereo_alone(on="SSIM + RGB + normal"),
    ),
)

NORMALS = NormalConsistency(weight=0.05, start=3_000, depth="median")
WITHOUT_NORMALS = {name: loss for name, loss in surface.SURFACE.pretrain.losses.items() if name != "normal"}
WITH_SKY = replace(surface.SURFACE_MESH, sky=True)
PIXEL_MAPS = replace(WITH_SKY, oversampling=1.0)
PIXEL_VOXELS = replace(PIXEL_MAPS, voxel_px=1.0)
CONFIRMED = replace(PIXEL_VOXELS, least_views=0.1, trust=GeometricConsistency(alone=0.1))
SHORT_TRUNCATION = replace(TSDF(), truncation_voxels=CONFIRMED.truncation_voxels, largest_px=CONFIRMED.largest_px)
# What is kept is what recipe:surface has, so that its last kept row is that recipe. Stereo alone is fused in the same
# way; it has no splats, and so no PSNR.
SURFACE_TABLE = Table(
    "surface",
    "What each part of recipe:surface brings, from 2DGS on sparse points to splats that stay with stereo depth",
    replace(COARSE_BASELINE, mesh=TSDF()),
    (
        Row("2DGS, sparse points"),
        Row("+ stereo depth as a loss", DEPTH | {"depth": surface.SURFACE.depth}),
        Row("+ dense start", {"start": StereoStart(), "pretrain.densify": surface.SURFACE.pretrain.densify}),
        Row("+ stronger depth loss", {"pretrain.losses.depth": surface.SURFACE.pretrain.losses["depth"]}),
        Row("+ no normal consistency", {"pretrain.losses": WITHOUT_NORMALS}),
        Row("+ shorter truncation, no splats above 64 pixels", {"mesh": SHORT_TRUNCATION}),
        Row("+ fusion by agreement", {"mesh": CONFIRMED}),
        Row("+ start where no depth is trusted", {"start": surface.SURFACE.start}),
        Row("+ steps for the points in view", {"pretrain.optimizer": surface.SURFACE.pretrain.optimizer}),
        Row("+ higher learning rates, lower ones of positions", {"pretrain.rates": surface.SURFACE.pretrain.rates}),
        Row("+ harmonics of degree 1", {"primitive": surface.SURFACE.primitive}),
        Row("+ mesh ends at the rim, depth that nobody confirms counts within", {"mesh": PIXEL_VOXELS}),
        Row("+ voxels smaller than a pixel", {"mesh": PIXEL_MAPS}),
        Row("+ depth maps of 1.5 times the size", {"mesh": WITH_SKY}),
        Row("+ sky left out", {"mesh": surface.SURFACE.mesh}),
        Row("+ normal consistency where stereo knows nothing", {"pretrain.losses": surface.SURFACE.pretrain.losses}),
        Row("+ constant depth weight", {"pretrain.losses.depth": DepthRegression(start=10.0, end=10.0)}, kept=False),
        Row("+ normal consistency everywhere", {"pretrain.losses.normal": NORMALS}, kept=False),
        Row("+ depth patch by patch (GeoSVR)", {"pretrain.losses.patch-depth": PatchDepth()}, kept=False),
        Row("+ stereo normals", {"pretrain.losses.prior": NormalPrior(start=0.05, end=0.05)}, kept=False),
        Row("+ reprojection", {"pretrain.losses.reprojection": Reprojection()}, kept=False),
        Row("+ warped patches", {"pretrain.losses.patches": WarpedPatches()}, kept=False),
        Row(
            "+ planes where stereo knows nothing",
            {"depth": Filled(), "depth.stereo": surface.SURFACE.depth},
            kept=False,
        ),
        Row("stereo alone", {"method": STEREO.method}, kept=False),
    ),
    columns=MESH_COLUMNS,
)

# Figures of GauU-Scene, means of three scenes. Plugin packages add the other methods (`surfkit_rows`). Differences are
# to 2DGS, which the paper starts from.
METHODS_TABLE = Table(
    "methods",
    "Whole methods on the same data (CityGaussianV2, comparison with SOTA reconstruction methods, GauU-Scene)",
    RECIPES["2dgs"],
    (
        Row("2DGS", paper=compared(0.756, 23.93, 0.232, 0.553, 0.446, 0.491)),
        Row("3DGS", recipe=RECIPES["3dgs"], kept=False),
        Row("AbsGS", recipe=RECIPES["absgs"], kept=False),
        Row("FreGS", recipe=RECIPES["fregs"], kept=False),
        Row("Trim2DGS", recipe=RECIPES["trim2dgs"], kept=False),
        Row(
            "CityGaussian",
            recipe=RECIPES["citygs"],
            kept=False,
            paper=compared(0.789, 24.75, 0.176, 0.522, 0.405, 0.453),
        ),
        Row(
            "CityGaussianV2",
            {"pretrain.appearance": None, "tune.appearance": None},  # as published, and as the rows above
            recipe=RECIPES["citygs2"],
            kept=False,
            paper=compared(0.765, 24.51, 0.215, 0.576, 0.450, 0.501),
        ),
        Row("DOGS", recipe=RECIPES["dogs"], kept=False),
        Row("surface (ours)", recipe=RECIPES["surface"], kept=False),
        Row("stereo alone", recipe=RECIPES["stereo"], kept=False),
        Row("Mip-Splatting", recipe=RECIPES["mip-splatting"], kept=False),
    ),
)

# The paper trims a fortieth, and on Residence a tenth; its released code a twentieth by another score.
TRIM_TABLE = Table(
    "trim",
    "How much is trimmed while blocks are tuned, and by which contribution",
    replace(city.CITY, tune=replace(city.CITY.tune, prune=())),
    (
        Row("no trim"),
        Row("ratio 0.025", {"tune.prune": (Trim(ratio=0.025),)}, kept=False),
        Row("ratio 0.05", {"tune.prune": (Trim(ratio=0.05),)}, kept=False),
        Row("ratio 0.1", {"tune.prune": (Trim(ratio=0.1),)}),
        Row("ratio 0.1, by the best view", {"tune.prune.0.score": "peak"}, kept=False),
        Row("ratio 0.1, by the sum", {"tune.prune.0.score": "sum"}, kept=False),
        Row("ratio 0.1, as released", {"tune.prune.0": Trim(ratio=0.1, score="released", recovery=0)}, kept=False),
        stereo_alone(on="no trim"),
    ),
)

# DOGS has its blocks agree once points are neither added nor removed any more.
STILL = {"tune.densify": None, "tune.prune": ()}
PARTITION_TABLE = Table(
    "partition",
    "How the scene is cut, which views a block gets, and what becomes of the points around it",
    city.CITY,
    (
        Row("contracted grid, 2 x 2"),
        Row("one block", {"partition": ContractedGrid(blocks=(1, 1))}, kept=False),
        Row("quantile grid", {"partition": QuantileGrid(blocks=(2, 2))}, kept=False),
        Row("grid of cameras", {"partition": CameraGrid(blocks=(2, 2))}, kept=False),
        Row("grid of squares", {"partition": SquareGrid()}, kept=False),
        Row("balanced", {"partition": Balanced(count=4)}, kept=False),
        Row("SSIM threshold 0.1", {"assign": SSIMDifference(threshold=0.1)}, kept=False),
        Row("views by airspace", {"assign": Airspace()}, kept=False),
        Row("chunks (Hierarchical 3DGS)", {"partition": SquareGrid(), "assign": SparsePointShare()}, kept=False),
        Row("surroundings densified", {"context": "densified"}, kept=False),
        Row("surroundings frozen", {"context": "frozen"}, kept=False),
        Row("blocks add no points", STILL, kept=False),
        Row("blocks agree (DOGS)", STILL | {"tune.regularizers.consensus": Consensus()}, kept=False),
        stereo_alone(on="contracted grid, 2 x 2"),
    ),
)

# Give it a data set of one light and one whose light changes. Plugin packages add rows.
APPEARANCE_TABLE = Table(
    "appearance",
    "How light that changes from photograph to photograph is made up for",
    RECIPES["2dgs"],
    (
        Row("colours as they are"),
        Row("exposure", {"pretrain.appearance": Exposure()}, kept=False),
        Row("camera response", {"pretrain.appearance": CameraResponse()}, kept=False),
    ),
    columns=("psnr_aligned", "ssim_aligned"),
)

ABSOLUTE = RECIPES["absgs"].pretrain
# Give it --max-points, so that rows differ in where points are, and not in their number. Plugin packages add rows.
DENSIFY_TABLE = Table(
    "densify",
    "What decides where points are added, in 3DGS",
    RECIPES["3dgs"],
    (
        Row("ADC"),
        Row(
            "absolute gradient (AbsGS)",
            {"pretrain.signal": ABSOLUTE.signal, "pretrain.densify": ABSOLUTE.densify},
            kept=False,
        ),
        stereo_alone(on="ADC"),
    ),
)

TABLES = {
    table.name: table
    for table in (
        MODEL_TABLE,
        GRADIENT_TABLE,
        SURFACE_TABLE,
        METHODS_TABLE,
        TRIM_TABLE,
        PARTITION_TABLE,
        APPEARANCE_TABLE,
        DENSIFY_TABLE,
    )
}
"""The tables that `surfkit ablate table:NAME` accepts."""
