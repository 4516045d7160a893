"""GS2Mesh (Wolf et al. 2024): depth by stereo on pairs of pictures that are rendered from any trained model."""

from __future__ import annotations

from collections.abc import Mapping

from surfkit.plugin import Component, Gaussian3D, Recipe, Row, hookimpl
from surfkit_gs2mesh.rendered_stereo import RenderedStereo

GS2MESH = Recipe(
    about="3DGS, meshed by stereo on rendered pairs (GS2Mesh, Wolf et al. 2024); PatchMatch in place of its network",
    primitive=Gaussian3D(),
    mesh=RenderedStereo(),
)


@hookimpl
def surfkit_components() -> Mapping[str, type[Component]]:
    """The mesher under the name that recipes use."""
    return {"gs2mesh": RenderedStereo}


@hookimpl
def surfkit_recipes() -> Mapping[str, Recipe]:
    """3DGS with the mesher."""
    return {"gs2mesh": GS2MESH}


@hookimpl
def surfkit_rows() -> Mapping[str, tuple[Row, ...]]:
    """The row of the comparison of methods; its label says that the stereo network of the paper is not used."""
    return {"methods": (Row("GS2Mesh (own stereo)", recipe=GS2MESH, kept=False),)}
