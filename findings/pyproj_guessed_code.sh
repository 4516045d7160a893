#!/usr/bin/env bash
# pyproj names a datum for a system that names none: to_epsg() of a PROJ string with an ellipsoid alone gives a code.
#
# pyproj 3.7.2. "+proj=utm +zone=33 +ellps=intl" has no datum. Its name is "unknown", and to_epsg() gives 23033, ED50 / UTM
# zone 33N, whose coordinates lie some 100 m from those of WGS 84; there is no warning. to_epsg(100) gives none: the
# default asks for a confidence of 70.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet pyproj==3.7.2
"$folder/venv/bin/python" -W error - <<'PYTHON'
from pyproj import CRS

crs = CRS("+proj=utm +zone=33 +ellps=intl")
found = crs.name, crs.datum.name, crs.to_epsg(), crs.to_epsg(100)
print(f"name {found[0]!r}, datum {found[1]!r}, to_epsg() {found[2]}, to_epsg(100) {found[3]}")
assert found[0] == "unknown" and found[2] == 23033 and found[3] is None, "the behaviour has changed"
PYTHON
