"""CompGS, also called Compact3D: splats that are trained with the codes of k-means (Navaneet et al. ECCV 2024)."""

from __future__ import annotations

from collections.abc import Mapping

from surfkit.plugin import Component, Gaussian3D, PruneByOpacity, Recipe, Row, Stage, Vectree, hookimpl
from surfkit_compgs.codes import CodedAdam
from surfkit_compgs.opacity import OpacitySum

COMPGS = Recipe(
    about="3DGS with ever fewer points, trained as codes of k-means from step 20,000 on (CompGS, Navaneet et al. 2024)",
    primitive=Gaussian3D(),
    pretrain=Stage(
        regularizers={"opacity": OpacitySum()},
        prune=(PruneByOpacity(start=15_000, until=20_000, every=1_000),),
        optimizer=CodedAdam(),
    ),
    tune=Stage(optimizer=CodedAdam()),  # where the scene is cut
    # All colours are codes already: these codebooks are the codes themselves, in float16.
    compress=Vectree(ratio=1.0, codes=CodedAdam().colors, codebooks="by-degree"),
)


@hookimpl
def surfkit_components() -> Mapping[str, type[Component]]:
    """Its parts, by the names that recipes use."""
    return {"coded-adam": CodedAdam, "opacity-sum": OpacitySum}


@hookimpl
def surfkit_recipes() -> Mapping[str, Recipe]:
    """The method, with the sizes of CompGS 16K."""
    return {"compgs": COMPGS}


@hookimpl
def surfkit_rows() -> Mapping[str, tuple[Row, ...]]:
    """Its row among methods."""
    return {"methods": (Row("CompGS", recipe=COMPGS, kept=False),)}
