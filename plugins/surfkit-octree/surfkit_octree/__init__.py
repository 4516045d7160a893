"""Anchors decoded into Gaussians for each view, with levels of detail: Scaffold-GS and Octree-GS."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from surfkit.plugin import L1, SSIM, TSDF, Component, LearningRate, Recipe, Row, Stage, hookimpl
from surfkit_octree.anchors import Anchors
from surfkit_octree.growth import AnchorGrowth
from surfkit_octree.start import AnchorVoxels
from surfkit_octree.volume import AnchorVolume

__all__ = ["OCTREE", "SCAFFOLD", "AnchorGrowth", "AnchorVolume", "AnchorVoxels", "Anchors"]


def _stage(steps: int, until: int) -> Stage:
    """The opacity factor of anchors is not trained: the published methods have none."""
    return Stage(
        steps=steps,
        losses={"l1": L1(), "ssim": SSIM()},
        regularizers={"volume": AnchorVolume()},
        densify=AnchorGrowth(until=until),
        rates={"opacities": LearningRate(0.0)},
    )


SCAFFOLD = Recipe(
    about="Anchors that networks decode into Gaussians for each view (Scaffold-GS, Lu et al. 2024)",
    primitive=Anchors(),
    start=AnchorVoxels(levels=1),
    pretrain=_stage(30_000, 15_000),
    mesh=TSDF(),
)
OCTREE = Recipe(
    about="Anchors on an octree, with levels of detail by the distance to the camera (Octree-GS, Ren et al. 2024)",
    primitive=Anchors(),
    start=AnchorVoxels(),
    pretrain=_stage(40_000, 25_000),
    mesh=TSDF(),
)


@hookimpl
def surfkit_components() -> Mapping[str, type[Component]]:
    """The parts by the names that users type."""
    return {
        "anchors": Anchors,
        "anchor-voxels": AnchorVoxels,
        "anchor-growth": AnchorGrowth,
        "anchor-volume": AnchorVolume,
    }


@hookimpl
def surfkit_recipes() -> Mapping[str, Recipe]:
    """Octree-GS, and Scaffold-GS, of which it is made."""
    return {"octree": OCTREE, "scaffold": SCAFFOLD}


@hookimpl
def surfkit_rows() -> Mapping[str, Sequence[Row]]:
    """Both in the comparison of methods; CityGaussianV2 has no figures of them."""
    return {
        "methods": (
            Row("Scaffold-GS", recipe=SCAFFOLD, kept=False),
            Row("Octree-GS", recipe=OCTREE, kept=False),
        )
    }
