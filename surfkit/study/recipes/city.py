"""CityGaussian in its two versions (Liu et al. 2024): pretraining, blocks that are tuned separately, and refinement."""

from __future__ import annotations

from dataclasses import replace

from surfkit.appearance.camera_response import CameraResponse
from surfkit.compress.levels.pruned_levels import PrunedLevels
from surfkit.compress.vectree import Vectree
from surfkit.core.schedule import LearningRate
from surfkit.densify.adc import ADC
from surfkit.densify.filters import Elongation
from surfkit.densify.signal import LossGradient
from surfkit.densify.trim import Trim
from surfkit.losses.depth import DepthRegression
from surfkit.losses.photometric import L1, SSIM
from surfkit.losses.surface import NormalConsistency
from surfkit.mesh.tsdf import TSDF
from surfkit.partition.grid import ContractedGrid
from surfkit.primitives.columns import RATES
from surfkit.primitives.gaussian3d import Gaussian3D
from surfkit.primitives.surfel2d import Surfel2D
from surfkit.runs.recipe import Recipe
from surfkit.train.refine.light_gaussian import DistilSH, PruneAndRecover
from surfkit.train.stage import Stage

ELONGATION_FILTERS = (Elongation(min_ratio=0.01),)
LOSSES = {
    "l1": L1(),
    "ssim": SSIM(),
    "normal": NormalConsistency(weight=0.0125, start=7_000, depth="median"),
    "depth": DepthRegression(start=0.5, end=0.0025),
}
# The paper takes colours as they are, and names light that changes as a limit of its method.
LIGHT = CameraResponse("uneven")
TUNED_LOSSES = LOSSES | {"normal": NormalConsistency(weight=0.0125, start=0, depth="median")}


def cut_short(stage: Stage, steps: int) -> Stage:
    """The first steps of a stage: rates and weights end where they have come to by then."""
    rates = {
        n: rate if rate.end is None else replace(rate, end=rate.at(steps, stage.steps)) for n, rate in RATES.items()
    }
    fading = {name: loss for name, loss in stage.losses.items() if isinstance(loss, DepthRegression)}
    losses = {name: replace(loss, end=loss.weight_at(steps, stage.steps)) for name, loss in fading.items()}
    return replace(stage, steps=steps, rates=rates, losses=stage.losses | losses)


# The upper half of the paper's ablation table, from `recipes.ablations.COARSE_BASELINE` to here.
CITY_COARSE = Recipe(
    about="Pretraining of CityGaussianV2 (Liu et al. 2024): densified by the gradient of SSIM, depth from priors",
    primitive=Surfel2D(),
    pretrain=Stage(
        losses=LOSSES,
        signal=LossGradient(terms=("ssim",), boost=0.9),
        densify=ADC(cull_opacity=0.005, filters=ELONGATION_FILTERS),
        appearance=LIGHT,
    ),
    mesh=TSDF(),
)

CITY = replace(
    CITY_COARSE,
    about="CityGaussianV2 (Liu et al. 2024): pretraining, then blocks tuned separately and trimmed, then merged",
    partition=ContractedGrid(blocks=(2, 2)),
    tune=replace(
        CITY_COARSE.pretrain,
        losses=TUNED_LOSSES,
        prune=(Trim(ratio=0.025),),
        rates={"means": LearningRate(6.4e-5, 6.4e-7), "scales": LearningRate(4e-3)},
    ),
    # The paper does not say what becomes of points around a block. On shibuya-synth at an eighth of the size, two
    # blocks, 300 steps each stage, two seeds: densified 17.75 and 17.57 dB, tuned 18.13 and 18.22, frozen 17.94 and
    # 18.06; frozen takes a tenth less CPU time and memory than tuned (bench/log/blocks_and_methods.md has more steps:
    # 2 % at 3,000).
    context="tuned",
)

# After 4,000 steps, blocks at reduced rates lag behind; after 12,000, the two had come to the same.
CITY_SHORT = replace(
    CITY,
    about="CityGaussianV2 for runs of a few thousand steps: blocks keep the rates of pretraining and are not trimmed",
    tune=replace(CITY.tune, prune=(), rates={}),
)

CITY_SMALL = replace(
    CITY,
    about="CityGaussianV2, small: colours of degree 2, those that matter least as codes, a quarter of the bytes",
    primitive=Surfel2D(sh_degree=2),
    compress=Vectree(),
)

CITY_TINY = replace(
    CITY_SMALL,
    about="CityGaussianV2, tiny: as small, and the blocks begin from the first 7,000 steps of pretraining",
    pretrain=cut_short(CITY_SMALL.pretrain, 7_000),
)

# The first version: no surface, but the pipeline that the second goes on from.
CITY_FIRST = Recipe(
    about="CityGaussian (Liu et al. 2024): 3DGS in blocks, half of the points dropped, codes, levels of detail",
    primitive=Gaussian3D(),
    partition=ContractedGrid(blocks=(2, 2)),
    tune=Stage(rates=CITY.tune.rates),
    refine=(PruneAndRecover(), DistilSH()),
    compress=Vectree(),
    lod=PrunedLevels(),
)
