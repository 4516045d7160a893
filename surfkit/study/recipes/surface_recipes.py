"""Recipes of our own for the most accurate surface: splats that begin at stereo depth, and stay with it."""

from __future__ import annotations

from dataclasses import replace

from surfkit.appearance.camera_response import CameraResponse
from surfkit.core.schedule import LearningRate
from surfkit.densify.adc import ADC
from surfkit.densify.filters import Elongation
from surfkit.depth.patch_match import PatchMatch
from surfkit.losses.depth import DepthRegression
from surfkit.losses.photometric import L1, SSIM
from surfkit.losses.surface import NormalConsistency
from surfkit.mesh.geometric_consistency import GeometricConsistency
from surfkit.mesh.stereo import Stereo
from surfkit.mesh.tsdf import TSDF
from surfkit.partition.grid import ContractedGrid
from surfkit.primitives import columns
from surfkit.primitives.surfel2d import Surfel2D
from surfkit.runs.methods.stereo_fusion import StereoFusion
from surfkit.runs.recipe import Recipe
from surfkit.start.stereo_start import StereoStart
from surfkit.train.adam import AdamInView
from surfkit.train.stage import Stage

# Short runs learn more at higher rates than those of 3DGS, with which they end; four times these are too high for
# boruszyn. Positions have half of theirs: at higher rates points leave the depth of stereo that they begin at.
SURFACE_RATES = {name: replace(rate, start=2 * rate.start, end=rate.start) for name, rate in columns.RATES.items()}
SURFACE_RATES["means"] = LearningRate(0.8e-4, 0.8e-6)

# In alleys, where no depth is trusted, training keeps right points that it has and finds few by itself.
SURFACE_START = StereoStart(closing=0.5)

# Depth that other views confirm is averaged over as little as may be: neither side of a wall takes from the other.
# Splats begin two pixels wide; those that have grown far beyond paint rims and alleys, and are no surface. The mesh
# ends where fewer than three pictures show a place; within, what nobody confirms, as in alleys, is more often right
# than not. Voxels smaller than a pixel, with as short a truncation as they allow, keep the walls of alleys
# apart; so do depth maps of 1.5 times the size. The sky, which photographs from the ground show, is no surface.
SURFACE_TRUST = GeometricConsistency(alone=0.5, covered_by=2)
SURFACE_MESH = TSDF(
    voxel_px=0.8,
    truncation_voxels=1.75,
    oversampling=1.5,
    least_views=0.05,
    largest_px=64.0,
    sky=False,
    trust=SURFACE_TRUST,
)

SURFACE = Recipe(
    about="The most accurate surface: 2DGS that begins at stereo depth, stays near it, and is fused where views agree",
    test_every=0,
    # Harmonics of degree 2 take a tenth more time in training, with the same F1 and 0.1 dB more.
    primitive=Surfel2D(sh_degree=1),
    depth=PatchMatch(),
    start=SURFACE_START,
    pretrain=Stage(
        losses={
            "l1": L1(),
            "ssim": SSIM(),
            "depth": DepthRegression(start=10.0, end=1.0),
            "normal": NormalConsistency(weight=0.015, start=0, where="unknown"),
        },
        # F1 at 0.5 m on shibuya-synth and PSNR on boruszyn, 1,000 steps: 0.787 and 20.6 dB as it is; with a weight that
        # stays 0.781 and 20.7, that falls to 0.1 0.789 and 20.4 (fields and roofs get rough), that stays, with normal
        # consistency, 0.773 and 21.0. What keeps surfaces smooth keeps errors of stereo in place too, so it counts
        # where stereo knows nothing, as on the road that someone walks on, which is in shards without it.
        # Stereo leaves holes, where few views see or nothing has texture: densification fills them. Opacities are never
        # reset: what begins at stereo depth has no floaters to be rid of, and recovers slowly.
        densify=ADC(threshold=4e-4, reset_every=10_000_000, filters=(Elongation(),)),
        rates=SURFACE_RATES,
        optimizer=AdamInView(),
        appearance=CameraResponse("uneven"),
    ),
    mesh=SURFACE_MESH,
)

# The same depth, fused in the same way, without splats: what these bring is the difference. Stereo has holes, where
# nobody would seem to look, and no discs at the rim: the mesh does not end there. Its maps have their own pixels alone.
STEREO_FUSION = replace(
    SURFACE_MESH, largest_px=0.0, oversampling=1.0, sky=True, trust=replace(SURFACE_TRUST, covered_by=0)
)
STEREO = Recipe(
    about="Stereo depth maps alone, fused as recipe:surface fuses but for rims: no splats, the baseline of any surface",
    test_every=0,
    method=StereoFusion(mesher=Stereo(fusion=STEREO_FUSION)),
    depth=SURFACE.depth,
)

SURFACE_BLOCKS = replace(
    SURFACE,
    about="The most accurate surface of a scene that one model cannot hold: blocks tuned separately, then merged",
    partition=ContractedGrid(blocks=(2, 2)),
    context="tuned",
    tune=replace(SURFACE.pretrain, rates={}),
)

# With so few steps, stereo would be most of the work: it is done at half the size, and depth maps are compared once.
# Few steps teach few splats, and their depth is worth fewer voxels.
SURFACE_SHORT = replace(
    SURFACE,
    about="A first look at the surface, for runs of some hundred steps: stereo at half the size, fewer points",
    depth=PatchMatch(scale=2, passes=3, rounds=1),
    start=replace(SURFACE_START, spacing_px=5.0),
    mesh=replace(SURFACE_MESH, voxel_px=1.2, oversampling=1.0),
)
