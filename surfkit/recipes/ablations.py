"""Ablation tables as lists of changes: two of CityGaussianV2 (Liu et al. 2024), with the published figures beside them,
and what each part of `recipe:surface` brings.

All published figures are of the scene Residence of GauU-Scene.
"""

from __future__ import annotations

from dataclasses import replace

from surfkit.densify.adc import ADC
from surfkit.densify.filters import Elongation
from surfkit.densify.signal import LossGradient
from surfkit.losses.depth import DepthRegression
from surfkit.losses.normal_prior import NormalPrior
from surfkit.losses.photometric import L1, SSIM
from surfkit.losses.reprojection import Reprojection
from surfkit.losses.surface import NormalConsistency
from surfkit.losses.warped_patches import WarpedPatches
from surfkit.mesh.tsdf import TSDF
from surfkit.primitives.surfel2d import Surfel2D
from surfkit.recipe import Recipe
from surfkit.recipes import surface
from surfkit.recipes.surface import STEREO
from surfkit.report.ablation import Row, Table
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
    ),
)


def published(psnr: float, ssim: float, f1: float, millions: float) -> dict[str, float]:
    """The figures of a row in print."""
    return {"psnr": psnr, "ssim": ssim, "f1": f1, "points": round(millions * 1e6)}


FILTER = {"pretrain.densify.filters": (Elongation(),)}
DEPTH = {"pretrain.losses.depth": DepthRegression(start=0.5, end=0.0025)}

MODEL = Table(
    "model",
    "What each component brings in pretraining (CityGaussianV2, ablation on model components, upper part)",
    COARSE_BASELINE,
    (
        Row("baseline", paper=published(21.12, 0.637, 0.410, 9.54)),
        Row("+ elongation filter", FILTER, paper=published(21.18, 0.636, 0.411, 9.36)),
        Row(
            "+ DGD",
            {"pretrain.signal": LossGradient(terms=("ssim",), boost=0.9)},
            paper=published(22.24, 0.674, 0.429, 9.51),
        ),
        Row("+ depth regression", DEPTH, paper=published(22.22, 0.674, 0.438, 9.67)),
    ),
)

# The table in print has the heads of PSNR and SSIM swapped. Its gradients are not scaled, so there is no boost. Leaving
# a loss out of the gradient is tried on top of all of them; SSIM alone is what the paper goes on with.
GRADIENT = Table(
    "gradient",
    "Which losses should drive densification (CityGaussianV2, ablation on gradient source of densification)",
    COARSE_BASELINE,
    (
        Row(
            "SSIM + RGB + normal",
            FILTER | {"pretrain.signal": LossGradient()},
            paper=published(21.18, 0.636, 0.401, 9.56),
        ),
        Row(
            "SSIM + RGB",
            {"pretrain.signal": LossGradient(terms=("ssim", "l1"))},
            kept=False,
            paper=published(21.13, 0.635, 0.399, 9.54),
        ),
        Row(
            "SSIM + normal",
            {"pretrain.signal": LossGradient(terms=("ssim", "normal"))},
            kept=False,
            paper=published(22.21, 0.673, 0.417, 9.44),
        ),
        Row(
            "SSIM",
            {"pretrain.signal": LossGradient(terms=("ssim",))},
            paper=published(22.24, 0.674, 0.419, 9.51),
        ),
        Row("SSIM, depth as a loss", DEPTH, paper=published(22.22, 0.674, 0.429, 9.67)),
        Row(
            "SSIM + depth",
            {"pretrain.signal": LossGradient(terms=("ssim", "depth"))},
            kept=False,
            paper=published(22.21, 0.674, 0.428, 9.43),
        ),
    ),
)

NORMALS = NormalConsistency(weight=0.05, start=3_000, depth="median")
# What is kept is what recipe:surface has, so that its last kept row is that recipe. Stereo alone is fused in the same
# way; it has no splats, and so no PSNR.
SURFACE = Table(
    "surface",
    "What each part of recipe:surface brings, from 2DGS on sparse points to splats that stay with stereo depth",
    replace(COARSE_BASELINE, mesh=TSDF()),
    (
        Row("2DGS, sparse points"),
        Row("+ stereo depth as a loss", DEPTH | {"depth": surface.SURFACE.depth}),
        Row("+ dense start", {"start": surface.SURFACE.start, "pretrain.densify": surface.SURFACE.pretrain.densify}),
        Row("+ stronger depth loss", {"pretrain.losses.depth": surface.SURFACE.pretrain.losses["depth"]}),
        Row("+ no normal consistency", {"pretrain.losses": surface.SURFACE.pretrain.losses}),
        Row("+ fusion by agreement", {"mesh": surface.SURFACE.mesh}),
        Row("+ constant depth weight", {"pretrain.losses.depth": DepthRegression(start=10.0, end=10.0)}, kept=False),
        Row("+ normal consistency", {"pretrain.losses.normal": NORMALS}, kept=False),
        Row("+ stereo normals", {"pretrain.losses.prior": NormalPrior(start=0.05, end=0.05)}, kept=False),
        Row("+ reprojection", {"pretrain.losses.reprojection": Reprojection()}, kept=False),
        Row("+ warped patches", {"pretrain.losses.patches": WarpedPatches()}, kept=False),
        Row("stereo alone (recipe:stereo)", {"method": STEREO.method}, kept=False),
    ),
)

TABLES = {table.name: table for table in (MODEL, GRADIENT, SURFACE)}
"""The tables that `surfkit ablate table:NAME` accepts."""
