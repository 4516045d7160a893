#!/usr/bin/env bash
# OpenCV's multi-band blender darkens a picture whose mask has low weights, to black where it is 1, and calls it valid.
#
# OpenCV 4.14.0, `cv2.detail_MultiBandBlender`. Masks act as weights, so that soft ones are of use.
# A good engineer would guess that the sum is divided by the weights, so that a single picture comes back as it is. An even
# grey of 200 comes back as 199 with a mask of 255, 191 with 16, 127 with 2 and 0 with 1, whatever the number of bands, and
# with 255 in the mask of the result: pixels are cut to whole numbers after the weight is applied, before they are divided by
# it, as it seems. With the distance from the border as weight, in pixels, the first pixel inside is black without bands, and with five
# the border is 181. The blender of feathers, which takes the same masks, gives 199 everywhere.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet opencv-python-headless==4.14.0.94 numpy==2.4.6
"$folder/venv/bin/python" -W error - <<'PYTHON'
import cv2
import numpy as np

ROWS, COLUMNS, BORDER = 64, 128, 8
picture = np.full((ROWS, COLUMNS, 3), 200, np.int16)


def blended(blender, mask):
    """The row in the middle of the one picture blended, (COLUMNS,), where the mask of the result is the mask's."""
    blender.prepare((0, 0, COLUMNS, ROWS))
    blender.feed(picture, mask, (0, 0))
    found, valid = blender.blend(None, None)
    assert np.array_equal(valid, np.where(mask > 0, 255, 0))
    return found[ROWS // 2, :, 0]


print("OpenCV", cv2.__version__)
greys = {}
for weight in (1, 2, 16, 255):
    mask = np.full((ROWS, COLUMNS), weight, np.uint8)
    rows = [blended(cv2.detail_MultiBandBlender(0, bands), mask) for bands in (0, 1, 5)]
    feather = blended(cv2.detail_FeatherBlender(), mask)
    greys[weight] = np.unique(rows).tolist(), np.unique(feather).tolist()
    print(f"mask of {weight}: 200 becomes {greys[weight][0]}, with feathers {greys[weight][1]}")
inside = np.zeros((ROWS, COLUMNS), np.uint8)
inside[BORDER:-BORDER, BORDER:-BORDER] = 1
distance = cv2.distanceTransform(inside, cv2.DIST_L2, cv2.DIST_MASK_PRECISE).astype(np.uint8)
first = {}
for bands in (0, 5):
    row = blended(cv2.detail_MultiBandBlender(0, bands), distance)
    first[bands] = row[BORDER : BORDER + 4].tolist()
    print(f"weights {distance[ROWS // 2, BORDER : BORDER + 4].tolist()} at the border, {bands} bands: {row[BORDER:BORDER + 4]}")
assert greys == {1: ([0], [199]), 2: ([127], [199]), 16: ([191], [199]), 255: ([199], [199])}, "the behaviour has changed"
assert first[0][0] == 0 and max(first[5]) < 190, "the behaviour has changed"
PYTHON
