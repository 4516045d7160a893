"""Decoupled appearance modelling (VastGaussian, Lin et al., CVPR 2024, section 4.2)."""

from __future__ import annotations

from collections.abc import Mapping

from surfkit.plugin import Component, Row, hookimpl
from surfkit_decoupled.appearance import Decoupled


@hookimpl
def surfkit_components() -> Mapping[str, type[Component]]:
    """Its part, by the name that recipes use."""
    return {"decoupled": Decoupled}


@hookimpl
def surfkit_rows() -> Mapping[str, tuple[Row, ...]]:
    """A row of the comparison of appearances."""
    return {"appearance": (Row("decoupled (VastGaussian)", {"pretrain.appearance": Decoupled()}, kept=False),)}
