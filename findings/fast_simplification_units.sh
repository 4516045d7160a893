#!/usr/bin/env bash
# fast-simplification takes fewer triangles out of the same mesh in smaller units, and does not say so.
#
# fast-simplification 0.2.0. A twentieth of the triangles of a rough sphere is asked for. With a radius of 1 to 1,000 units
# 1,068 of 21,360 are left, as wanted; with 100,000 (100 m in millimetres) 14,482, and with a million 21,354. Its limits of
# the error are absolute numbers, so the units of the coordinates decide; there is no warning and no error.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet fast-simplification==0.2.0 numpy==2.4.6
"$folder/venv/bin/python" -W error - <<'PYTHON'
import numpy as np
from fast_simplification import simplify


def sphere(rows, columns):
    """Vertices and triangles of a closed sphere of radius 1, a little rough."""
    turn, height = np.arange(columns) / columns * 2 * np.pi, np.cos(np.arange(1, rows) / rows * np.pi)
    across = np.sqrt(1 - height**2)
    body = np.stack([np.outer(across, np.cos(turn)), np.outer(across, np.sin(turn)), np.outer(height, turn * 0 + 1)], -1)
    places = np.concatenate([[[0, 0, 1.0]], body.reshape(-1, 3), [[0, 0, -1.0]]])
    at = 1 + np.arange((rows - 1) * columns).reshape(rows - 1, columns)
    a, b, c, d = at[:-1], at[1:], np.roll(at[1:], -1, 1), np.roll(at[:-1], -1, 1)
    faces = [np.stack(corners, -1).reshape(-1, 3) for corners in ((a, b, c), (a, c, d))]
    top = np.stack([0 * at[0], at[0], np.roll(at[0], -1)], 1)
    bottom = np.stack([0 * at[0] + len(places) - 1, np.roll(at[-1], -1), at[-1]], 1)
    places *= 1 + np.random.default_rng(0).normal(size=(len(places), 1)) * 0.002
    return places, np.concatenate([*faces, top, bottom]).astype(np.int32)


places, faces = sphere(90, 120)
left = {}
for radius in (1, 1_000, 100_000, 1_000_000):
    left[radius] = len(simplify((radius * places).astype(np.float32), faces, target_reduction=0.95)[1])
wanted = len(faces) // 20
print(f"{len(faces)} triangles, {wanted} wanted; left by radius: {left}")
assert abs(left[1] - wanted) < 20 and abs(left[1_000] - wanted) < 20
assert left[100_000] > 4 * wanted and left[1_000_000] > 0.9 * len(faces), "the behaviour has changed"
PYTHON
