"""Layers of GeoPackages, in the version that all programs in use read."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

GEOPACKAGE_VERSION = "1.2"
"""GDAL from 3.7 on writes 1.4 by itself, of which GDAL 3.6 and QGIS 3.22 warn that they may not read all of it; nothing
of what is newer is used here."""


def write_layer(
    path: Path,
    layer: str,
    geometry_type: str,
    crs: Any,
    shapes: np.ndarray,
    columns: Sequence[np.ndarray],
    names: Sequence[str],
) -> None:
    """Write a layer of a GeoPackage, which is made if it is not there; add to those of the same name if it is.

    Args:
        path: Of the file.
        layer: Name of the layer.
        geometry_type: Such as LineString.
        crs: Coordinate reference system, of rasterio.
        shapes: (n,) objects, WKB.
        columns: (n,) each, values of fields; NaN becomes NULL.
        names: Of the fields.
    """
    from pyogrio.raw import write

    kind = {"layer": layer, "geometry_type": geometry_type, "crs": crs.to_wkt()}
    options = {} if path.exists() else {"VERSION": GEOPACKAGE_VERSION}
    write(path, shapes, columns, names, driver="GPKG", append=path.exists(), dataset_options=options, **kind)
