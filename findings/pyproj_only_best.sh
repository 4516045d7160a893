#!/usr/bin/env bash
# `only_best=True` of pyproj does not keep heights from being passed through where the grid of a geoid is missing.
#
# pyproj 3.7.2 (PROJ 9.5.1), without further grids. German heights above sea level (EPSG:7837) lie some 40 m below
# ellipsoidal ones. Without the grid, `Transformer.from_crs(..., only_best=True)` to EPSG:4979 gives the height back as it
# came, and no error; `allow_ballpark=False` fails. A good engineer would guess that "only best" refuses what is not.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet pyproj==3.7.2
PROJ_NETWORK=OFF "$folder/venv/bin/python" <<'PYTHON'
import warnings

import pyproj
from pyproj import Transformer
from pyproj.exceptions import ProjError

warnings.simplefilter("ignore")
source, target = "EPSG:25832+7837", "EPSG:4979"
height = Transformer.from_crs(source, target, always_xy=True, only_best=True).transform(500_000, 5_700_000, 100.0)[2]
print("pyproj", pyproj.__version__, "PROJ", pyproj.proj_version_str)
print("only_best=True: 100 m above sea level become", height, "m above the ellipsoid")
try:
    strict = Transformer.from_crs(source, target, always_xy=True, allow_ballpark=False).transform(500_000, 5_700_000, 100.0)
except ProjError as error:
    strict = str(error)
print("allow_ballpark=False:", strict)
assert abs(height - 100.0) < 1e-6 and isinstance(strict, str), "the behaviour has changed"
PYTHON
