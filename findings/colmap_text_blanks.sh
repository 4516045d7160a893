#!/usr/bin/env bash
# COLMAP's text models lose names of photographs at the first blank.
#
# pycolmap 4.2.1. `Reconstruction.write_text` writes the name of an image unquoted at the end of its line, and the reader
# of the same library takes it up to the first blank: "block 7.jpg" comes back as "block". Binary models keep it. A good
# engineer would guess that a model that is written and read again has the same names.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet pycolmap==4.2.1 numpy==2.4.6
"$folder/venv/bin/python" - "$folder" <<'PYTHON'
import sys
from pathlib import Path

import numpy as np
import pycolmap

folder = Path(sys.argv[1])
text = folder / "text"
text.mkdir()
(text / "cameras.txt").write_text("1 PINHOLE 40 30 36 36 20 15\n")
(text / "images.txt").write_text("1 1 0 0 0 0 0 0 1 plain.jpg\n\n")
(text / "points3D.txt").write_text("")
model = pycolmap.Reconstruction(str(text))
model.image(1).name = "block 7.jpg"
found = {}
for form in ("text", "binary"):
    place = folder / f"again-{form}"
    place.mkdir()
    getattr(model, f"write_{form}")(str(place))
    found[form] = pycolmap.Reconstruction(str(place)).image(1).name
line = next(line for line in (folder / "again-text/images.txt").read_text().splitlines() if "block" in line)
print("pycolmap", pycolmap.__version__)
print("written as text:", repr(line))
print("read again:", found)
assert line.endswith(" block 7.jpg")
assert found == {"text": "block", "binary": "block 7.jpg"}, "the behaviour has changed"
PYTHON
