#!/usr/bin/env bash
# A unit of unknown length is read back from GeoTIFF as metres.
#
# rasterio 1.4.4, GDAL 3.10.3. A reconstruction without scale has a local system whose unit nobody knows, such as
# LOCAL_CS["site",UNIT["unit",1]]. Written to GeoTIFF and read again, its unit is "metre", without a warning, and programs
# measure metres. Feet, and a factor that is not 1, come back as they were. The same system stays as it is in GeoPackage.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet rasterio==1.4.4 pyogrio==0.13.0 numpy==2.4.6
"$folder/venv/bin/python" - "$folder" <<'PYTHON'
import re
import sys
import warnings
from pathlib import Path

import numpy as np
import pyogrio
import rasterio
from pyogrio.raw import write

folder = Path(sys.argv[1])
print("rasterio", rasterio.__version__, "GDAL", rasterio.__gdal_version__, "pyogrio", pyogrio.__version__)
facts = dict(driver="GTiff", width=4, height=4, count=1, dtype="uint8", transform=rasterio.Affine(0.5, 0, 7, 0, -0.5, 9))


def unit_of(wkt: str) -> str:
    return re.search(r'UNIT\["([^"]+)",([0-9.]+)', wkt).group(0)[5:]


seen = {}
with warnings.catch_warnings():
    warnings.simplefilter("error")
    for unit in ('"unit",1', '"unknown",1', '"unit",2.5', '"foot",0.3048'):
        path, wkt = folder / "a.tif", f'LOCAL_CS["site",UNIT[{unit}]]'
        with rasterio.open(path, "w", crs=rasterio.CRS.from_wkt(wkt), **facts) as file:
            file.write(np.zeros((1, 4, 4), np.uint8))
        with rasterio.open(path) as file:
            seen[unit] = unit_of(file.crs.to_wkt())
        print("GeoTIFF:", unit, "is read as", seen[unit])
point = np.array([bytes.fromhex("0101000000000000000000f03f0000000000000040")], object)
local = 'LOCAL_CS["site",UNIT["unit",1],AXIS["x",EAST],AXIS["y",NORTH]]'
write(folder / "a.gpkg", point, [np.array([1])], ["a"], geometry_type="Point", crs=local, driver="GPKG")
kept = unit_of(pyogrio.read_info(folder / "a.gpkg")["crs"])
print("GeoPackage:", '"unit",1', "is read as", kept)
assert seen['"unit",1'] == seen['"unknown",1'] == '"metre",1', "the behaviour has changed"
assert seen['"unit",2.5'].endswith("2.5") and seen['"foot",0.3048'] == '"foot",0.3048', "the behaviour has changed"
assert kept == '"unit",1', "the behaviour has changed"
PYTHON
