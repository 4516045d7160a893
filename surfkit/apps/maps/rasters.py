"""Rasters that are being drawn: a GeoTIFF for each tile that is not empty, and a GDAL virtual raster to join them."""

from __future__ import annotations

import json
import re
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, Literal
from xml.etree import ElementTree

import numpy as np

from surfkit.apps.maps.map_grid import MapGrid, Window
from surfkit.core.codec import from_json
from surfkit.core.files import replacing

TILE_SIDE_CELLS = 512
"""Side of the tiles within a file, cells."""
NODATA = -9999.0
"""Height where there is no surface."""
NO_COUNT = 65535
"""Count where there is no surface: 0 is a count."""
Kind = Literal["heights", "colors", "shades", "numbers", "counts"]
GDAL_TYPES = {"float32": "Float32", "float64": "Float64", "uint8": "Byte", "uint16": "UInt16", "uint32": "UInt32"}
"""Names of types of cells."""
CHANNELS = {
    "heights": ("Gray",),
    "colors": ("Red", "Green", "Blue", "Alpha"),
    "shades": ("Gray",),
    "numbers": ("Gray",),
    "counts": ("Gray",),
}
BANDS = {
    "dsm.tif": ("height of the surface", True),
    "dsm-other.tif": ("height of the other surface", True),
    "difference.tif": ("height less that of the other surface", True),
    "dtm.tif": ("height of the ground", True),
    "ndsm.tif": ("height above ground", True),
    "ground-distance.tif": ("distance to ground that is seen", True),
    "precision.tif": ("expected error of the height", True),
    "rays.tif": ("photographs that confirm the height", False),
    "hillshade.tif": ("shaded relief", False),
    "orthophoto-photographs.tif": ("number of the photograph", False),
}
"""What the band of a file has, and whether it is a length in the unit of the map."""
HEIGHTS = {"dsm.tif", "dsm-other.tif", "dtm.tif"}
"""Files of heights above the datum: no other one names it, as GDAL takes bands without a unit for heights in that of
the datum, and gdalwarp shifts what names it by the geoid, were it a difference or a picture."""
LOCAL_UNIT = re.compile(r'^LOCAL_CS\[.*UNIT\["([^"]+)"', re.DOTALL)
"""Of a local system without a reference; "unit" is one of unknown or odd length."""
UNKNOWN_UNIT = re.compile(r'^LOCAL_CS\[.*UNIT\["unit",1\]', re.DOTALL)
"""Of a local system whose unit is of unknown length."""
FACTS_TAG = "surfkit"
"""Tag of a tile for what was counted when it was drawn."""


@dataclass(frozen=True)
class Raster:
    """A raster on its way.

    Attributes:
        folder: Of the tiles; all that are in it are whole.
        grid: The cells.
        crs: Coordinate reference system of the map, of rasterio.
        kind: What it shows.
        double: Whether heights need 64-bit floats.
        name: Of the finished file, which tells what its band has (`BANDS`).
    """

    folder: Path
    grid: MapGrid
    crs: Any
    kind: Kind
    double: bool
    name: str = ""

    @property
    def dtype(self) -> str:
        """Of the cells."""
        kinds = {"heights": "float64" if self.double else "float32", "numbers": "uint32", "counts": "uint16"}
        return kinds.get(self.kind, "uint8")

    @property
    def nodata(self) -> float | None:
        """What cells without a surface have; None where a channel says it."""
        return {"heights": NODATA, "colors": None, "shades": 0, "numbers": 0, "counts": NO_COUNT}[self.kind]

    @property
    def system(self) -> Any:
        """Coordinate reference system that the file names, of rasterio; None for none."""
        return system_of_file(self.crs, self.name in HEIGHTS)

    def write(self, image: np.ndarray, window: Window, facts: dict[str, Any] | None = None) -> None:
        """Keep a tile, and what was counted when it was drawn; tiles that are not written are empty.

        Args:
            image: (C, H, W), or (H, W) for one channel.
            window: Its place.
            facts: What JSON has.
        """
        from rasterio import Affine
        from rasterio.io import MemoryFile

        gsd, west, north = self.grid.gsd, self.grid.west + window.left, self.grid.north - window.top
        place = {"crs": self.system, "transform": Affine(gsd, 0, west * gsd, 0, -gsd, north * gsd)}
        if self.kind == "counts":
            image = np.where(image == NODATA, NO_COUNT, image.clip(0, NO_COUNT - 1))
        image = image.reshape(-1, window.height, window.width).astype(self.dtype, copy=False)
        inner = {
            "tiled": True,
            "blockxsize": TILE_SIDE_CELLS,
            "blockysize": TILE_SIDE_CELLS,
            "compress": "LZW",
            "interleave": "band",
            "nodata": self.nodata,
        }
        size = {"count": len(image), "height": window.height, "width": window.width, "dtype": self.dtype}
        with MemoryFile() as memory:
            with memory.open(driver="GTiff", **place, **size, **inner) as file:
                file.write(image)
                file.update_tags(**{FACTS_TAG: json.dumps(facts)})
            with replacing(self._file(window)) as file:
                file.write(memory.getbuffer())

    def facts(self, window: Window) -> dict[str, Any] | None:
        """What was counted when a tile was drawn; None for one that is not there."""
        import rasterio

        if not self._file(window).exists():
            return None
        with rasterio.open(self._file(window)) as file:
            return from_json(file.tags()[FACTS_TAG])

    def whole(self) -> Path:
        """Write the file that joins the tiles that are there, and return its path."""
        grid = self.grid
        west, _, _, north = grid.bounds
        root = ElementTree.Element("VRTDataset", rasterXSize=str(grid.width), rasterYSize=str(grid.height))
        if self.system is not None:
            ElementTree.SubElement(root, "SRS").text = self.system.to_wkt()
        place = west, grid.gsd, 0.0, north, 0.0, -grid.gsd
        ElementTree.SubElement(root, "GeoTransform").text = ", ".join(map(repr, place))
        tiles = sorted(self.folder.glob("*.tif"))
        kind = GDAL_TYPES[self.dtype]
        for channel, color in enumerate(CHANNELS[self.kind], 1):
            band = ElementTree.SubElement(root, "VRTRasterBand", dataType=kind, band=str(channel))
            if self.nodata is not None:
                ElementTree.SubElement(band, "NoDataValue").text = repr(self.nodata)
            ElementTree.SubElement(band, "ColorInterp").text = color
            if self.name in BANDS:
                described, is_length = BANDS[self.name]
                ElementTree.SubElement(band, "Description").text = described
                if is_length and (unit := length_unit(self.crs)):
                    ElementTree.SubElement(band, "UnitType").text = unit
            for tile in tiles:
                left, top, width, height = map(int, tile.stem.split("-"))
                source = ElementTree.SubElement(band, "SimpleSource")
                ElementTree.SubElement(source, "SourceFilename", relativeToVRT="1").text = tile.name
                ElementTree.SubElement(source, "SourceBand").text = str(channel)
                size = {"xSize": str(width), "ySize": str(height)}
                facts = {"RasterXSize": str(width), "RasterYSize": str(height), "DataType": kind}
                block = {"BlockXSize": str(TILE_SIDE_CELLS), "BlockYSize": str(TILE_SIDE_CELLS)}
                ElementTree.SubElement(source, "SourceProperties", facts | block)
                ElementTree.SubElement(source, "SrcRect", {"xOff": "0", "yOff": "0"} | size)
                ElementTree.SubElement(source, "DstRect", {"xOff": str(left), "yOff": str(top)} | size)
        path = self.folder / "whole.vrt"
        ElementTree.ElementTree(root).write(path)
        return path

    def _file(self, window: Window) -> Path:
        return self.folder / f"{window.left}-{window.top}-{window.width}-{window.height}.tif"


@lru_cache(maxsize=16)
def system_of_file(crs: Any, has_heights: bool) -> Any:
    """The coordinate reference system that a GeoTIFF on a map names, of rasterio; None for none.

    Without heights, it is that of easting and northing alone. A local system whose unit is of unknown length is left
    out, as the format has no such unit: GDAL reads whatever is written as metres.

    Args:
        crs: Of the map, of rasterio.
        has_heights: Whether the file has heights above the datum.
    """
    from pyproj import CRS

    if UNKNOWN_UNIT.search(crs.to_wkt()):
        return None
    whole = CRS.from_wkt(crs.to_wkt(version="WKT2_2019"))
    if has_heights or len(whole.axis_info) < 3:
        return crs
    plan = whole.sub_crs_list[0] if whole.is_compound else whole  # with its shift of datum, if it has one
    return type(crs).from_wkt(plan.to_2d().to_wkt())


def length_unit(crs: Any) -> str | None:
    """The unit of lengths on a map, as GDAL calls it; None where it is not known. That of a local system is in its text
    alone."""
    if crs.linear_units != "unknown":
        return str(crs.linear_units)
    found = LOCAL_UNIT.search(crs.to_wkt())
    return found[1] if found and found[1] != "unit" else None


def window_of(window: Window) -> Any:
    """The same as rasterio has it."""
    from rasterio.windows import Window as Their

    return Their(window.left, window.top, window.width, window.height)
