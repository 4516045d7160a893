"""What of a delivery cannot be made here, or not of this scene: found before anything long begins."""

from __future__ import annotations

from dataclasses import dataclass, replace

from surfkit.apps.maps.map_grid import map_crs
from surfkit.apps.maps.map_settings import USUAL_PRODUCTS, Product
from surfkit.apps.maps.map_settings import MapSettings as Maps
from surfkit.apps.quality.pdf_writer import require_reportlab
from surfkit.apps.texture.texture_mesh import TextureSettings, refuse_unplaced
from surfkit.core.check import BadInput
from surfkit.mesh.simplify import require_simplification
from surfkit.scene.scene import Frame

INSTALL_LATER = "the same command adds what is missing, once it is installed"


@dataclass(frozen=True)
class Wanted:
    """What is made of the mesh, and what is left out, with the reason.

    Attributes:
        texture: How the mesh is textured; None where it is not.
        maps: Which maps are drawn; None where none are.
        left_out: Reasons, by what is left out.
        pdf: Whether the quality report is written as PDF too.
    """

    texture: TextureSettings | None
    maps: Maps | None
    left_out: dict[str, str]
    pdf: bool = True

    def on(self, frame: Frame) -> Wanted:
        """What can be made of a scene in this frame: its coordinate reference system may have no place for some."""
        texture, maps, left_out = self.texture, self.maps, dict(self.left_out)
        if texture is not None:
            try:
                refuse_unplaced(frame, texture.geoid)
            except BadInput as error:
                left_out["3D Tiles"] = str(error)
                texture = TextureSettings(formats=("obj", "glb"))
        if maps is not None:
            try:
                map_crs(frame)
            except BadInput as error:
                left_out["maps"] = str(error)
                maps = None
        return Wanted(texture, maps, left_out, self.pdf)


def wanted() -> Wanted:
    """What can be made with the packages that are installed."""
    left_out: dict[str, str] = {}
    texture: TextureSettings | None = TextureSettings()
    try:
        require_simplification("surfkit texture")
    except BadInput as error:
        left_out["texture"], texture = f"{error}; {INSTALL_LATER}", None
    pdf = True
    try:
        require_reportlab()
    except BadInput as error:
        left_out["quality report as PDF"], pdf = f"{error}; {INSTALL_LATER}", False
    try:
        Maps(products=()).refuse_missing()
    except BadInput as error:
        left_out["maps"] = f"{error}; {INSTALL_LATER}"
        return Wanted(texture, None, left_out, pdf)
    products: list[Product] = []
    for name in (*USUAL_PRODUCTS, "precision"):  # which the depth maps tell that each of the recipes makes
        try:
            Maps(products=(name,)).refuse_missing()
        except BadInput as error:
            left_out[name] = f"{error}; {INSTALL_LATER}"
        else:
            products.append(name)
    maps = Maps(products=tuple(products))
    if "orthophoto" in products:
        photographic = replace(maps, colors="photographs")
        try:
            photographic.refuse_missing()
        except BadInput as error:
            left_out["orthophoto from the photographs"] = f"{error}; {INSTALL_LATER}; it has colours of the mesh"
        else:
            maps = photographic
    return Wanted(texture, maps, left_out, pdf)
