#!/usr/bin/env bash
# Pillow keeps the high byte alone of 16-bit RGB pictures, so that pictures of 12-bit cameras keep 4 bits.
#
# Pillow 13.0.0, files written by OpenCV 4.14.0. RGB PNG and TIFF of 16 bits open in mode RGB, of 8 bits, without a
# warning. Cameras that store 12 bits in them have values up to 4095: the high byte is 0 to 15, nearly black. Grey
# pictures of 16 bits keep all their bits.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet pillow==13.0.0 opencv-python-headless==4.14.0.94 numpy==2.4.6
"$folder/venv/bin/python" -W error - "$folder" <<'PYTHON'
import sys
from pathlib import Path

import cv2
import numpy as np
import PIL
from PIL import Image

folder = Path(sys.argv[1])
values = np.random.default_rng(0).integers(0, 4096, (6, 8, 3)).astype(np.uint16)
print("Pillow", PIL.__version__, "OpenCV", cv2.__version__)
for end in ("png", "tif"):
    assert cv2.imwrite(str(folder / f"rgb.{end}"), values[..., ::-1])
    assert cv2.imwrite(str(folder / f"grey.{end}"), values[..., 0])
    rgb = Image.open(folder / f"rgb.{end}")
    got, grey = np.asarray(rgb), np.asarray(Image.open(folder / f"grey.{end}"))
    print(f"{end}: mode {rgb.mode}, written {values[0, 0].tolist()}, read {got[0, 0].tolist()}, distinct {len(np.unique(got))}")
    assert rgb.mode == "RGB" and np.array_equal(got, values >> 8), "the behaviour has changed"
    assert np.array_equal(grey, values[..., 0]), "the behaviour has changed"
PYTHON
