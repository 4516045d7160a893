"""Maps of a run against the exact mesh of its scene: heights, holes, and where the orthophoto has the corners of roofs.

    surfkit maps RUN --bounds WEST SOUTH EAST NORTH --against TRUTH.ply --out MAPS
    python bench/maps.py MAPS DATA TRUTH.ply

Reads dsm.tif, dsm-other.tif (the exact heights) and orthophoto.tif. Corners are found in the exact heights: a vertex
of the truth with a roof in one quarter around it and ground 4 m lower in the rest. The orthophoto is compared there
with an exact one: the mean of the photographs that look down, at the exact heights, where the exact mesh hides
nothing. The shift with the best correlation of 25 x 25 cells is the error; PSNR and sharpness are told too. Frames are
level, z up.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import rasterio
import torch
from scipy import ndimage

from surfkit.evaluate.geometry.surface_file import read_surface
from surfkit.io.datasets.data import Data
from surfkit.io.datasets.read import read
from surfkit.mesh.shade import draw_faces
from surfkit.raster.psnr import psnr
from surfkit.scene.photos import view_photo

HALF, REACH, AROUND = 12, 4, 8
"""Cells: half of what is compared, largest shift, half of what a corner is told by."""
LEVEL, STEP, APART = 0.6, 4.0, 6.0
"""Of a roof, of its edge, and between two corners, metres."""
DOWN = 0.95
"""Least cosine between the axis of a photograph and straight down."""
HIDDEN = 0.5
"""Metres in front of a place, from which on another surface hides it."""


def heights_of(path: Path) -> tuple[np.ndarray, rasterio.Affine]:
    """(H, W) heights, NaN where there are none, and the transform."""
    with rasterio.open(path) as file:
        return file.read(1, masked=True).astype(np.float64).filled(np.nan), file.transform


def corners_of(exact: np.ndarray, place: rasterio.Affine, vertices: np.ndarray) -> list[tuple[int, int]]:
    """Row and column of the corners of roofs, highest first."""
    found, taken = [], []
    rim = AROUND + HALF + REACH
    for x, y, z in vertices[np.argsort(-vertices[:, 2])]:
        row, column = int((y - place.f) / place.e), int((x - place.c) / place.a)
        if not (rim <= row < exact.shape[0] - rim and rim <= column < exact.shape[1] - rim):
            continue
        if any((x - a) ** 2 + (y - b) ** 2 < APART**2 for a, b in taken):
            continue
        near = exact[row - AROUND : row + AROUND + 1, column - AROUND : column + AROUND + 1]
        roof, lower = np.abs(near - z) < LEVEL, near < z - STEP
        if 0.15 < roof.mean() < 0.4 and (roof | lower).mean() > 0.97 and ndimage.label(roof)[1] == 1:
            taken.append((x, y))
            found.append((row, column))
    return found


def exact_orthophoto(exact: np.ndarray, place: rasterio.Affine, data: Path, truth: Path) -> np.ndarray:
    """(H, W) grey; NaN where no photograph that looks down sees the exact surface."""
    scene, mesh = read(Data(data)), read_surface(truth)
    rows, columns = np.indices(exact.shape) + 0.5
    xyz = np.stack([place.c + columns * place.a, place.f + rows * place.e, exact], -1).reshape(-1, 3)
    points = torch.from_numpy(scene.frame.to_local(np.nan_to_num(xyz)))
    corners = torch.from_numpy(scene.frame.to_local(mesh.vertices()))
    total, count = np.zeros(exact.size), np.zeros(exact.size)
    for view in (*scene.train, *scene.held_out):
        camera = view.camera
        if -float(camera.world_to_camera[2, 2]) < DOWN:
            continue
        depth, _ = draw_faces(camera.project(corners).numpy(), np.asarray(mesh.faces), camera.width, camera.height)
        x, y, z = camera.project(points).numpy().T
        inside = (
            (z > 0) & (x >= 1) & (x < camera.width - 1) & (y >= 1) & (y < camera.height - 1) & np.isfinite(xyz[:, 2])
        )
        seen = np.flatnonzero(inside)
        seen = seen[z[seen] < depth[y[seen].astype(int), x[seen].astype(int)] + HIDDEN * scene.frame.scale]
        grey = view_photo(view).float().mean(0).numpy()
        total[seen] += ndimage.map_coordinates(grey, [y[seen] - 0.5, x[seen] - 0.5], order=1)
        count[seen] += 1
    return np.where(count > 0, total / count.clip(1), np.nan).reshape(exact.shape)


def shift_of(ours: np.ndarray, exact: np.ndarray, row: int, column: int) -> float:
    """Cells between a corner of two pictures, by a parabola through the correlations around the best; NaN for none."""
    side = 2 * REACH + 1
    scores = np.full((side, side), -1.0)
    wanted = exact[row - HALF : row + HALF + 1, column - HALF : column + HALF + 1]
    for i, j in np.ndindex(side, side):
        top, left = row - HALF - REACH + i, column - HALF - REACH + j
        found = ours[top : top + 2 * HALF + 1, left : left + 2 * HALF + 1]
        both = np.isfinite(found) & np.isfinite(wanted)
        if both.sum() >= 200:
            scores[i, j] = np.corrcoef(found[both], wanted[both])[0, 1]
    best = np.unravel_index(int(scores.argmax()), scores.shape)
    if scores[best] <= 0:
        return np.nan
    shift = []
    for at, line in zip(best, (scores[:, best[1]], scores[best[0]]), strict=True):
        bend = line[at - 1] - 2 * line[at] + line[at + 1] if 0 < at < side - 1 else 0.0
        shift.append(at - REACH + ((line[at - 1] - line[at + 1]) / (2 * bend) if bend < 0 else 0.0))
    return float(np.hypot(*shift))


def gradient(grey: np.ndarray, where: np.ndarray) -> float:
    """Mean absolute difference of neighbouring cells, a measure of sharpness."""
    down, right = np.abs(np.diff(grey, axis=0)), np.abs(np.diff(grey, axis=1))
    return float(np.mean([down[where[1:] & where[:-1]].mean(), right[where[:, 1:] & where[:, :-1]].mean()]))


def main(maps: Path, data: Path, truth: Path) -> None:
    """Print the figures."""
    ours, place = heights_of(maps / "dsm.tif")
    exact, _ = heights_of(maps / "dsm-other.tif")
    error = np.abs(ours - exact)[np.isfinite(ours - exact)]
    holes = (np.isfinite(exact) & np.isnan(ours)).sum() / np.isfinite(exact).sum()
    print(f"heights: median error {np.median(error):.3f}, 90 % under {np.percentile(error, 90):.3f}, holes {holes:.2%}")
    known = np.isfinite(exact)
    span = ndimage.maximum_filter(np.where(known, exact, -1e9), 7) - ndimage.minimum_filter(
        np.where(known, exact, 1e9), 7
    )
    away = (span < 1.5) & np.isfinite(ours - exact)
    error = np.abs(ours - exact)[away]
    print(
        f"3 cells and more from steps of 1.5 m ({away.mean():.0%} of the cells): median {np.median(error):.3f}, ",
        end="",
    )
    print(f"90 % under {np.percentile(error, 90):.3f}")
    with rasterio.open(maps / "orthophoto.tif") as file:
        *colors, alpha = file.read().astype(np.float64)
    grey, reference = np.where(alpha > 0, np.mean(colors, 0), np.nan), exact_orthophoto(exact, place, data, truth)
    found = corners_of(exact, place, read_surface(truth).vertices())
    both = np.isfinite(grey) & np.isfinite(reference)
    alike = psnr(torch.from_numpy(grey[both] / 255), torch.from_numpy(reference[both] / 255))
    print(f"orthophoto and the mean of the photographs: PSNR {alike:.2f} dB, ", end="")
    print(f"mean gradient {gradient(grey, both):.2f} and {gradient(reference, both):.2f}")
    shifts = np.array([shift_of(grey, reference, row, column) for row, column in found])
    print(f"orthophoto at {len(found)} corners of roofs: {np.isfinite(shifts).sum()} found, within 1 cell ", end="")
    good = shifts[np.isfinite(shifts)]
    print(f"{(good <= 1).sum()}, median {np.median(good):.2f}, 90 % under {np.percentile(good, 90):.2f} cells")


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:]))
