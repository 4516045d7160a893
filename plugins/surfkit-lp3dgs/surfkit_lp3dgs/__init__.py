"""LP-3DGS: which points to prune, and how many, is learned (Zhang et al. NeurIPS 2024)."""

from __future__ import annotations

from collections.abc import Mapping

from surfkit.plugin import Component, Gaussian3D, Recipe, Row, Stage, hookimpl
from surfkit_lp3dgs.mask import MaskedAdam
from surfkit_lp3dgs.prune import PruneByMask

LP3DGS = Recipe(
    about="3DGS that learns which points to prune, and how many (LP-3DGS, Zhang et al. 2024)",
    primitive=Gaussian3D(),
    pretrain=Stage(prune=(PruneByMask(),), optimizer=MaskedAdam()),
    tune=Stage(densify=None),  # where the scene is cut: what was pruned does not come back
)


@hookimpl
def surfkit_components() -> Mapping[str, type[Component]]:
    """Its parts, by the names that recipes use."""
    return {"learned-mask": PruneByMask, "masked-adam": MaskedAdam}


@hookimpl
def surfkit_recipes() -> Mapping[str, Recipe]:
    """The method, with the importance of RadSplat."""
    return {"lp-3dgs": LP3DGS}


@hookimpl
def surfkit_rows() -> Mapping[str, tuple[Row, ...]]:
    """Its row among methods."""
    return {"methods": (Row("LP-3DGS", recipe=LP3DGS, kept=False),)}
