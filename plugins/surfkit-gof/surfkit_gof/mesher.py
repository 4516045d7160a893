"""The mesh of an opacity field (GOF, section 4.3): where the view that sees a place best is half hidden from it."""

from __future__ import annotations

from dataclasses import dataclass

from surfkit.mesh.opacity_surface import OpacitySurface


@dataclass(frozen=True)
class OpacityField(OpacitySurface):
    """Marching tetrahedra on the boxes of the splats, where the least opacity of all views crosses a level (GOF).

    Beside mesh:tetra, a place counts as open as soon as one view sees it so, and the settings are those of the paper.
    """
