"""Which maps are drawn, and how: what a user sets."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from surfkit.apps.maps.terrain import TerrainSettings
from surfkit.apps.maps.volume_base import BaseKind
from surfkit.core.check import BadInput
from surfkit.core.optional import needed
from surfkit.io.area import require_area
from surfkit.io.polygon_file import require_polygons
from surfkit.scene.available_memory import cache_bytes
from surfkit.scene.crop import Axis
from surfkit.scene.lengths import Length

Product = Literal["orthophoto", "hillshade", "contours", "points", "precision", "terrain"]
PRODUCTS: tuple[Product, ...] = ("orthophoto", "hillshade", "contours", "points", "precision", "terrain")
USUAL_PRODUCTS: tuple[Product, ...] = PRODUCTS[:4]
"""All but the terrain, which is a guess with settings of its own, and the precision, which needs depth maps."""
SEVERAL_FILES = {"precision": ("precision", "rays"), "terrain": ("terrain", "above", "ground")}
"""Files of products that are more than one."""
TERRAIN_CONTOURS = "terrain-contours"
"""File of the contour lines of the terrain, which are drawn where both are."""
COMPARISON_FILES = ("other", "difference", "picture")
"""Files of a comparison."""
SHORTEST_CELLS = 30
"""Length of the shortest contour line that is written without being asked for others, cells."""
VOLUME_FILES = ("volumes", "volumes-table", "volumes-types")
"""Files of volumes."""
PRODUCT_PACKAGES = {"contours": ("pyogrio", "shapely"), "points": ("laspy", "lazrs")}
VOLUME_OPTION = "--volume"
"""What products need beside rasterio."""


@dataclass(frozen=True)
class MapSettings:
    """What is drawn, and how."""

    products: tuple[Product, ...] = USUAL_PRODUCTS
    """What to write beside the surface model (dsm.tif). `terrain` is the ground without buildings and trees, heights
    above it, classes of the points, and contour lines of the ground where `contours` is named too; `precision` is the
    expected error of each height, and needs the depth maps that the run was trained with."""

    gsd: Length = "auto"
    """Side of a cell (ground sampling distance), metres; in units of the data set where it does not say how long these
    are. `auto` is what a pixel of the photographs covers at its median depth."""

    bounds: tuple[float, float, float, float] | None = None
    """Draw only this part: west south east north, in coordinates of the map. Default: the whole mesh."""

    area: Path | None = None
    """Draw only what lies within the polygons of this file, GeoJSON, GPKG or SHP, by the centres of cells. The maps
    reach as far as the polygons."""

    interval: Length = "auto"
    """Between contour lines, like --gsd. `auto` is 1, 2 or 5 times a power of ten that gives at most 20 levels."""

    shortest: Length = "auto"
    """Length of the shortest contour line that is written, like --gsd, or 0 for all: crumbs on trees and at edges are
    shorter. `auto` is 30 cells; how many were left out is printed."""

    spacing: Length = "auto"
    """Between points of the cloud, like --gsd: one point for each square of this side on the surface. `auto` is that
    of --gsd."""

    up: Axis | None = None
    """Axis of the data set that points up. Default: z if it is georeferenced, else what the cameras tell."""

    tile: int = 2048
    """Side of the tiles that are drawn at once, pixels. Maps do not depend on it, but for the order of contour lines
    and the place where closed ones begin."""

    colors: Literal["photographs", "mesh"] = "mesh"
    """Of the orthophoto: those of the photographs, a mosaic of large parts of them, or those of the vertices of the
    mesh, which are means of photographs or of renders."""

    memory: str = "auto"
    """Memory for photographs, such as 4GB, with --colors photographs, and for depth maps, with `--products precision`;
    auto is half of the free memory."""

    terrain: TerrainSettings = TerrainSettings()
    """How the ground is found, with `--products terrain`."""

    volume: Path | None = None
    """Measure volumes within the polygons of this file, GeoJSON, GPKG or SHP: of the surface above a base (fill) and
    below it (cut). With --against, also those by which heights changed."""

    base: BaseKind | float = "triangulated"
    """What --volume measures from: `triangulated`, a surface between the heights along the outline of the polygon;
    `plane`, their plane of least squares; `lowest`, a level plane at the lowest of them; or a level plane at this
    height, in coordinates of the map."""

    least_difference: float = 0.0
    """With --against, the least detectable difference of heights, like --gsd: volumes leave out cells that differ by
    less."""

    def __post_init__(self) -> None:
        if not isinstance(self.base, str) and not abs(self.base) < float("inf"):
            raise BadInput(f"--base {self.base:g}: give a height, triangulated, plane or lowest")
        if self.volume is None and self.base != "triangulated":
            raise BadInput(f"--base {self.base}: it is of volumes; name the file of polygons too, --volume FILE")
        if not 0 <= self.least_difference < float("inf"):
            raise BadInput(f"--least-difference {self.least_difference:g}: it must be 0 or more")
        cache_bytes(self.memory, "--memory")
        if self.colors == "photographs" and "orthophoto" not in self.products:
            raise BadInput("--colors photographs: --products leaves the orthophoto out; add it, or leave --colors out")
        if self.shortest != "auto" and not 0 <= self.shortest < float("inf"):
            raise BadInput(f"--shortest {self.shortest:g}: it is a length, so it must be 0 or more, or auto")
        for name in ("gsd", "interval", "spacing"):
            value = getattr(self, name)
            if value != "auto" and not 0 < value < float("inf"):
                raise BadInput(f"--{name} {value:g}: it is a length, so it must be above 0, or auto")
        if not 16 <= self.tile <= 16384:
            raise BadInput(f"--tile {self.tile}: give 16 to 16384 pixels")
        if self.bounds is not None and not (self.bounds[0] < self.bounds[2] and self.bounds[1] < self.bounds[3]):
            raise BadInput("--bounds: give west south east north, with west below east and south below north")

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the files in PRODUCT_FILES, the surface model first."""
        chosen = (SEVERAL_FILES.get(name, (name,)) for name in PRODUCTS if name in self.products)
        both = {"contours", "terrain"} <= {*self.products}
        return ("dsm", *(name for names in chosen for name in names), *([TERRAIN_CONTOURS] if both else []))

    def refuse_missing(self) -> None:
        """BadInput if a package is missing, before anything is done."""
        for name in self.names:
            for package in ("rasterio", *PRODUCT_PACKAGES.get(name, ())):
                with needed(package, "surfkit maps" if package == "rasterio" else f"--products {name}"):
                    __import__(package)
        if self.volume is not None:
            require_polygons(VOLUME_OPTION)
        if self.area is not None:
            require_area()
        if self.colors == "photographs":
            with needed("cv2", "--colors photographs"):
                __import__("cv2")
