#!/usr/bin/env bash
# A fourth band of a TIFF of OpenCV, as of infrared, is taken as opacity by Pillow.
#
# OpenCV 4.14.0 and Pillow 13.0.0. `imwrite` of four channels leaves out the tag ExtraSamples (338), which TIFF 6.0 asks
# for where a pixel has more samples than its colours, and says nothing of what the fourth is. Pillow then opens the file
# in mode RGBA. With the tag, of value 0 ("unspecified"), it opens as RGB.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet pillow==13.0.0 opencv-python-headless==4.14.0.94 numpy==2.4.6 tifffile==2025.5.10
"$folder/venv/bin/python" - "$folder" <<'PYTHON'
import sys
from pathlib import Path

import cv2
import numpy as np
import PIL
import tifffile
from PIL import Image

folder = Path(sys.argv[1])
bands = np.random.default_rng(0).integers(0, 256, (6, 8, 4)).astype(np.uint8)
assert cv2.imwrite(str(folder / "opencv.tif"), bands)
tifffile.imwrite(folder / "told.tif", bands, photometric="rgb", extrasamples=["unspecified"])
print("OpenCV", cv2.__version__, "Pillow", PIL.__version__)
found = {}
for name in ("opencv", "told"):
    with tifffile.TiffFile(folder / f"{name}.tif") as file:
        extra = 338 in file.pages[0].tags
    found[name] = (extra, Image.open(folder / f"{name}.tif").mode)
    print(f"{name}.tif: ExtraSamples {'there' if extra else 'missing'}, mode {found[name][1]}")
assert found == {"opencv": (False, "RGBA"), "told": (True, "RGB")}, "the behaviour has changed"
PYTHON
