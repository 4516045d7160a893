#!/usr/bin/env bash
# A GeoJSON file that says that it has no coordinate reference system is read as longitude and latitude.
#
# pyogrio 0.13.0, GDAL 3.12.4. In GeoJSON of 2008 (section 3), a member "crs" that is null means that no coordinate
# reference system can be assumed; one that is left out means WGS 84. GDAL tells the two apart nowhere: both come as
# EPSG:4326, without a warning, so that a plan in local metres lies in degrees. A good engineer would guess that a
# system that is given as null is none.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet pyogrio==0.13.0 numpy==2.4.6
"$folder/venv/bin/python" - "$folder" <<'PYTHON'
import json
import sys
from pathlib import Path

import pyogrio
from pyogrio.raw import read

folder = Path(sys.argv[1])
area = {"type": "Polygon", "coordinates": [[[0, 0], [250, 0], [250, 400], [0, 400], [0, 0]]]}
plan = {"type": "FeatureCollection", "features": [{"type": "Feature", "properties": {}, "geometry": area}]}
local = {"type": "name", "properties": {"name": "urn:ogc:def:crs:EPSG::32633"}}
found = {}
for name, member in {"left out": {}, "null": {"crs": None}, "named": {"crs": local}}.items():
    path = folder / f"{name.replace(' ', '-')}.geojson"
    path.write_text(json.dumps(plan | member))
    found[name] = read(path)[0]["crs"]
print("pyogrio", pyogrio.__version__, "GDAL", pyogrio.__gdal_version_string__)
print("coordinate reference system, by the member crs:", found)
assert found == {"left out": "EPSG:4326", "null": "EPSG:4326", "named": "EPSG:32633"}, "the behaviour has changed"
PYTHON
