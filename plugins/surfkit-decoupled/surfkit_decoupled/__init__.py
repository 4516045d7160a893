"""Decoupled appearance modelling (VastGaussian, Lin et al., CVPR 2024, section 4.2)."""

from __future__ import annotations

from collections.abc import Mapping

from surfkit.plugin import Component, hookimpl
from surfkit_decoupled.appearance import Decoupled


@hookimpl
def surfkit_components() -> Mapping[str, type[Component]]:
    """Its part, by the name that recipes use."""
    return {"decoupled": Decoupled}
