#!/usr/bin/env bash
# SIFT of pycolmap finds nearly nothing in a photograph of little contrast, where the same one stretched has thousands.
#
# pycolmap 4.2.1. SIFT is known to be invariant to gain and offset of the brightness, and its descriptors are. But
# peak_threshold, 0.0067 by default, is a share of the full range of grey: of the same texture at an eighth of the
# contrast, as under water, in haze, at dusk or of a thermal camera, few keypoints are left, without a warning. Of
# the same texture stretched to the full range as many are found as in the original, at the same places.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet pycolmap==4.2.1 numpy==2.4.6 scipy==1.17.1
"$folder/venv/bin/python" - <<'PYTHON'
import numpy as np
import pycolmap
from scipy.ndimage import gaussian_filter
from scipy.spatial import cKDTree

print("pycolmap", pycolmap.__version__)
draw = np.random.default_rng(0)
texture = sum(gaussian_filter(draw.normal(size=(480, 640)), s, mode="wrap") * s for s in (1.5, 3, 6, 12))
low, high = np.quantile(texture, [0.001, 0.999])
whole = ((texture - low) / (high - low)).clip(0, 1)
sift = pycolmap.Sift(device=pycolmap.Device.cpu)


def keypoints(grey: np.ndarray) -> np.ndarray:
    found, _ = sift.extract(grey.round().astype(np.uint8))
    return np.asarray(found)[:, :2]


found = {}
for share in (1, 1 / 2, 1 / 4, 1 / 8, 1 / 16):
    found[share] = keypoints(128 + 255 * share * (whole - 0.5))
    print(f"contrast {share:6.4f}: {len(found[share]):5} keypoints")
faint = (128 + 255 / 8 * (whole - 0.5)).round()
stretched = keypoints(((faint - 128) * 8 + 127.5).clip(0, 255))
same = (cKDTree(found[1]).query(stretched)[0] < 1).mean()
print(f"contrast 0.1250, stretched: {len(stretched):5} keypoints, {same:.0%} within a pixel of those of the original")
assert len(found[1]) > 1000 and len(found[1 / 8]) < 0.1 * len(found[1]), "the behaviour has changed"
assert len(stretched) > 0.8 * len(found[1]) and same > 0.7, "the behaviour has changed"
PYTHON
