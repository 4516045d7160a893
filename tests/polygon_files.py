"""Files of polygons, as a surveyor draws them."""

import numpy as np
from needs import needs


def write_polygons(path, *shapes, crs="EPSG:32633", drawn_in="EPSG:32633"):
    """A GeoPackage, Shapefile or GeoJSON file of polygons of shapely, named a, b, c.

    Args:
        path: Its suffix says the format.
        shapes: In `drawn_in`.
        crs: System of the file; None for none.
        drawn_in: System of the shapes.
    """
    shapely, raw, pyproj = needs("shapely"), needs("pyogrio.raw"), needs("pyproj")
    if crs is not None and crs != drawn_in:
        move = pyproj.Transformer.from_crs(drawn_in, crs, always_xy=True).transform
        shapes = [shapely.transform(each, lambda at: np.stack(move(*at.T), 1)) for each in shapes]
    driver = {".gpkg": "GPKG", ".shp": "ESRI Shapefile", ".geojson": "GeoJSON"}[path.suffix]
    kind = shapes[0].geom_type if len(shapes) == 1 else "Unknown"
    names = np.array(list("abcdef"[: len(shapes)]), object)
    raw.write(path, shapely.to_wkb(np.array(shapes, object)), [names], ["name"], driver=driver, geometry_type=kind,
              crs=crs)  # fmt: skip
    return path
