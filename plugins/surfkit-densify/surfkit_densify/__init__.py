"""Densification after ADC: by the error of pixels (Revising Densification), and to a budget (Taming 3DGS)."""

from __future__ import annotations

from collections.abc import Mapping

from surfkit.plugin import AdamInView, Component, Gaussian3D, Recipe, Row, Stage, hookimpl
from surfkit_densify.budget import Budget
from surfkit_densify.error import ByError

REVISED = Recipe(
    about="3DGS that adds points where pixels are wrong, not where gradients are large (Rota Bulò et al. 2024)",
    primitive=Gaussian3D(),
    pretrain=Stage(densify=ByError()),
)

TAMING = Recipe(
    about="3DGS up to a number of points that is set, drawn where a score of many terms is high (Taming 3DGS, 2024)",
    primitive=Gaussian3D(),
    pretrain=Stage(densify=Budget(), optimizer=AdamInView()),
)


@hookimpl
def surfkit_components() -> Mapping[str, type[Component]]:
    """The densifiers under the names that recipes use."""
    return {"error": ByError, "budget": Budget}


@hookimpl
def surfkit_recipes() -> Mapping[str, Recipe]:
    """The methods, with 3D Gaussians as published."""
    return {"revised-densification": REVISED, "taming-3dgs": TAMING}


@hookimpl
def surfkit_rows() -> Mapping[str, tuple[Row, ...]]:
    """Their rows in the comparisons of methods and of densifiers."""
    return {
        "methods": (
            Row("Revising Densification", recipe=REVISED, kept=False),
            Row("Taming 3DGS", recipe=TAMING, kept=False),
        ),
        "densify": (
            Row("error of pixels", {"pretrain.densify": ByError()}, kept=False),
            Row("budget (Taming 3DGS)", {"pretrain.densify": Budget()}, kept=False),
        ),
    }
