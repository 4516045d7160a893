"""Recipes by name."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from surfkit.compress.vectree import Vectree
from surfkit.core.hooks import hookimpl
from surfkit.core.schedule import LearningRate
from surfkit.densify.adc import ADC
from surfkit.densify.prune import PruneByImportance
from surfkit.densify.signal import AbsGradient
from surfkit.densify.trim import Trim
from surfkit.losses.consensus import Consensus
from surfkit.losses.frequency import Frequency
from surfkit.losses.photometric import L1, SSIM
from surfkit.losses.surface import Distortion, NormalConsistency
from surfkit.mesh.tsdf import TSDF
from surfkit.partition.balanced import Balanced
from surfkit.primitives.columns import RATES
from surfkit.primitives.flat3d import Flat3D
from surfkit.primitives.gaussian3d import Gaussian3D
from surfkit.primitives.surfel2d import Surfel2D
from surfkit.runs.methods.imported import SplatImport
from surfkit.runs.recipe import Recipe
from surfkit.study.recipes import city, city_datasets
from surfkit.study.recipes.surface_recipes import STEREO, SURFACE, SURFACE_BLOCKS, SURFACE_SHORT
from surfkit.train.refine.light_gaussian import DistilSH, PruneAndRecover, slowing
from surfkit.train.stage import Stage

GAUSSIANS = Recipe(
    about="3D Gaussian splatting (Kerbl et al. 2023): the sharpest pictures, no usable surface",
    primitive=Gaussian3D(),
)

SURFELS = Recipe(
    about="2D Gaussian splatting (Huang et al. 2024): flat discs that make clean surfaces",
    primitive=Surfel2D(),
    pretrain=Stage(
        losses={
            "l1": L1(),
            "ssim": SSIM(),
            "normal": NormalConsistency(weight=0.05, start=7_000, depth="expected"),
            "distortion": Distortion(weight=0.0, start=3_000),
        },
        densify=ADC(cull_opacity=0.05),
    ),
    mesh=TSDF(),
)

# "2DGS*" of the paper: what CityGaussian does with 3DGS, without anything that CityGaussianV2 changes in 2DGS.
SURFELS_IN_BLOCKS = replace(
    SURFELS,
    about="2DGS in blocks that are tuned separately as those of CityGaussian (2DGS* of the paper of CityGaussianV2)",
    partition=city.CITY_FIRST.partition,
    tune=replace(SURFELS.pretrain, rates=city.CITY_FIRST.tune.rates),
)

FLAT_GAUSSIANS = Recipe(
    about="3D Gaussians with one axis pinned to almost nothing: between 3dgs and 2dgs",
    primitive=Flat3D(),
    pretrain=Stage(losses={"l1": L1(), "ssim": SSIM(), "normal": NormalConsistency()}),
    mesh=TSDF(),
)

MIP_GAUSSIANS = Recipe(
    about="3DGS with a 3D smoothing and a 2D filter, for views from nearer or further away (Mip-Splatting, 2024)",
    primitive=Gaussian3D(antialias=True, dilation=0.1, smoothing=0.2),
)

ABSOLUTE_GAUSSIANS = Recipe(
    about="3DGS that splits by the sizes of the pixels' gradients, which signs do not cancel (AbsGS, Ye et al. 2024)",
    primitive=Gaussian3D(),
    pretrain=Stage(signal=AbsGradient(), densify=ADC(split_threshold=4e-4, small=0.001)),
)

BY_FREQUENCY = Recipe(
    about="3DGS that learns spectra too, low frequencies first, and splits what lacks the high ones (FreGS, 2024)",
    primitive=Gaussian3D(),
    pretrain=Stage(losses={"l1": L1(), "ssim": SSIM(), "frequency": Frequency()}),
    tune=Stage(losses={"l1": L1(), "ssim": SSIM(), "frequency": Frequency()}),
)

TRIMMED = Recipe(
    about="2DGS, then 7,000 steps that trim a tenth of the points every 500 (Trim2DGS, Fan et al. 2024)",
    primitive=Surfel2D(),
    pretrain=Stage(
        steps=37_000,
        losses={
            "l1": L1(),
            "ssim": SSIM(),
            "normal": NormalConsistency(weight=0.05, start=7_000, depth="expected"),
            "distortion": Distortion(weight=100.0, start=30_000),
        },
        densify=ADC(cull_opacity=0.05),
        prune=(Trim(ratio=0.1, start=31_000, until=37_000),),
    ),
    mesh=TSDF(),
)

# Rates fall by 5 % every 400 of the 5,000 steps of recovery; positions go on at the rate that they ended with.
LIGHT_RATES = slowing({name: rate.start for name, rate in RATES.items()}, 0.95**12.5) | {"means": LearningRate(1.6e-6)}
LIGHT_GAUSSIANS = Recipe(
    about="3DGS, then two thirds of the points dropped, simpler colours, most of them codes (LightGaussian, 2023)",
    primitive=Gaussian3D(),
    refine=(
        PruneAndRecover(
            Stage(
                5_000,
                densify=None,
                prune=(PruneByImportance(at=(0,), ratio=0.66, score="significance"),),
                rates=LIGHT_RATES,
            )
        ),
        DistilSH(Stage(5_000, densify=None, rates=LIGHT_RATES | {"opacities": LearningRate(0.0)})),
    ),
    compress=Vectree(ratio=0.6),
)

# 80,000 steps; points are added and dropped up to 30,000, and from then on the blocks agree. In print the first part is
# in blocks too, each from its sparse points; the mean of copies is weighted by visibility; and a term of the product of
# scales counts, which is nothing where a scene has a size of 1.
CONSENSUS_STEPS, GROWING_STEPS = 80_000, 30_000
BLOCKS_AGREE = Recipe(
    about="3DGS, then blocks of equal work that agree on the points they have in common (DOGS, Chen and Lee 2024)",
    primitive=Gaussian3D(),
    pretrain=city.cut_short(
        Stage(
            CONSENSUS_STEPS,
            densify=ADC(until=GROWING_STEPS),
            prune=(PruneByImportance(at=(29_800,), ratio=0.25),),
        ),
        GROWING_STEPS,
    ),
    partition=Balanced(),
    tune=Stage(
        CONSENSUS_STEPS - GROWING_STEPS,
        densify=None,
        regularizers={"consensus": Consensus()},
        rates={
            name: replace(rate, start=rate.at(GROWING_STEPS, CONSENSUS_STEPS))
            for name, rate in RATES.items()
            if rate.end is not None
        },
    ),
    context="tuned",
)

IMPORTED = Recipe(
    about="The splats of a file as they are (--method.file, or `surfkit import FILE`), measured and meshed",
    method=SplatImport(),
    mesh=TSDF(),
)


RECIPES = {
    "2dgs": SURFELS,
    "2dgs-blocks": SURFELS_IN_BLOCKS,
    "3dgs": GAUSSIANS,
    "flat3dgs": FLAT_GAUSSIANS,
    "mip-splatting": MIP_GAUSSIANS,
    "absgs": ABSOLUTE_GAUSSIANS,
    "fregs": BY_FREQUENCY,
    "trim2dgs": TRIMMED,
    "lightgaussian": LIGHT_GAUSSIANS,
    "dogs": BLOCKS_AGREE,
    "surface": SURFACE,
    "surface-blocks": SURFACE_BLOCKS,
    "surface-short": SURFACE_SHORT,
    "stereo": STEREO,
    "import": IMPORTED,
    "citygs": city.CITY_FIRST,
    "citygs2-coarse": city.CITY_COARSE,
    "citygs2": city.CITY,
    "citygs2-short": city.CITY_SHORT,
    "citygs2-s": city.CITY_SMALL,
    "citygs2-t": city.CITY_TINY,
    "citygs2-residence": city_datasets.RESIDENCE,
    "citygs2-russian": city_datasets.RUSSIAN,
    "citygs2-modern": city_datasets.MODERN,
    "citygs2-aerial": city_datasets.AERIAL,
    "citygs2-street": city_datasets.STREET,
    "citygs2-released": city_datasets.RELEASED,
    "citygs2-released-aerial": city_datasets.RELEASED_AERIAL,
    "citygs2-released-street": city_datasets.RELEASED_STREET,
}
"""The recipes of surfkit, by name."""


@hookimpl
def surfkit_recipes() -> Mapping[str, Recipe]:
    """The recipes of surfkit."""
    return RECIPES


@hookimpl
def surfkit_tables() -> Mapping[str, Any]:
    """The ablation tables of surfkit."""
    from surfkit.study.recipes.ablations import TABLES

    return TABLES
