"""MILo: a mesh in the loop of Gaussian splatting (Guédon et al. 2025)."""

from __future__ import annotations

from collections.abc import Mapping

from surfkit.plugin import (
    ADC,
    L1,
    SSIM,
    AbsGradient,
    Component,
    MatchedADC,
    NormalConsistency,
    Recipe,
    Row,
    Stage,
    hookimpl,
)
from surfkit_milo.loop import MeshInTheLoop, PivotValues
from surfkit_milo.mesher import PivotMesh
from surfkit_milo.pivots import Pivoted

# Densification ends where the mesh begins.
MILO = Recipe(
    about="3DGS whose mesh is extracted, drawn and compared in each step of training (MILo, Guédon et al. 2025)",
    primitive=Pivoted(geometry="plane", smoothing=0.2),
    pretrain=Stage(
        steps=18_000,
        losses={
            "l1": L1(),
            "ssim": SSIM(),
            "normal": NormalConsistency(weight=0.02, start=3_000, depth="expected"),
            "normal-median": NormalConsistency(weight=0.03, start=3_000, depth="median"),
        },
        regularizers={"mesh": MeshInTheLoop()},
        signal=AbsGradient(),
        densify=MatchedADC(adc=ADC(until=8_000, cull_opacity=0.05)),
        prune=(PivotValues(),),
    ),
    mesh=PivotMesh(),
)


@hookimpl
def surfkit_components() -> Mapping[str, type[Component]]:
    """Its parts, by the names that recipes use."""
    return {
        "pivoted": Pivoted,
        "mesh-in-the-loop": MeshInTheLoop,
        "pivot-values": PivotValues,
        "pivots": PivotMesh,
    }


@hookimpl
def surfkit_recipes() -> Mapping[str, Recipe]:
    """The method as published, but for what README lists."""
    return {"milo": MILO}


@hookimpl
def surfkit_rows() -> Mapping[str, tuple[Row, ...]]:
    """Its row in the comparison of methods; CityGaussianV2 has no figures of it."""
    return {"methods": (Row("MILo", recipe=MILO, kept=False),)}
