"""The expected errors of heights against the exact heights of a rendered city.

    surfkit train recipe:surface --data shibuya-synth --out RUN
    surfkit maps RUN --products precision --metres-per-unit 1 --gsd 0.5 --bounds -110 -110 110 110 --out MAPS
    python bench/precision.py TRUTH.ply NAME MAPS [NAME MAPS ...]

TRUTH.ply is the exact mesh (shibuya-synth: gt/mesh.ply). Counted is the share of the cells whose height is within one
and two expected errors of the exact one: 68 % and 95 % if errors are normal and rightly foretold. The eastern half of
the map is what the three weights in `precision.py` were fitted on, the western half is what they are judged by. Results
go to bench/results/precision.json. The map is level, z up.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from holes import read_grid
from machine import save
from terrain import read_heights

from surfkit.apps.maps.map_grid import Window
from surfkit.apps.maps.zbuffer import ZBuffer
from surfkit.evaluate.geometry.surface_file import read_surface

CLASSES = ((0, 0.1), (0.1, 0.2), (0.2, 0.5), (0.5, 1), (1, 2), (2, np.inf))
"""Expected errors, metres."""


def exact(truth: Path, maps: Path) -> np.ndarray:
    """(H, W) exact heights of the cells of a map; NaN where there are none."""
    grid, mesh = read_grid(maps), read_surface(truth)
    corners = mesh.vertices(np.asarray(mesh.triangles[:]).ravel()).reshape(-1, 3, 3)
    buffer = ZBuffer(Window(0, 0, grid.width, grid.height))
    buffer.draw(grid.to_cells(corners), np.arange(len(corners)))
    return np.where(buffer.covered, buffer.height, np.nan)


def measured(maps: Path, truth: Path) -> dict[str, float]:
    """The figures."""
    error = read_heights(maps / "dsm.tif") - exact(truth, maps)
    sigma, rays = read_heights(maps / "precision.tif"), read_heights(maps / "rays.tif")
    covered, half = np.isfinite(error), error.shape[1] // 2
    there, west = covered & np.isfinite(sigma), np.arange(error.shape[1]) < half
    figures = {
        "cells with an expected error": float(there.sum() / covered.sum()),
        "median error where there is none, m": float(np.median(np.abs(error[covered & ~there]))),
        "median error where there is one, m": float(np.median(np.abs(error[there]))),
        "median expected error, m": float(np.median(sigma[there])),
        "rank correlation": rank_correlation(np.abs(error[there]), sigma[there]),
    }
    for name, where in (("west", there & west), ("east", there & ~west)):
        figures |= within(name, error, sigma, where)
    for low, high in CLASSES:
        figures |= within(f"expected {low} to {high} m", error, sigma, there & (sigma >= low) & (sigma < high))
    for low, high in ((2, 5), (5, 10), (10, 20), (20, np.inf)):
        figures |= within(f"{low} to {high} rays", error, sigma, there & (rays >= low) & (rays < high))
    return figures


def within(name: str, error: np.ndarray, sigma: np.ndarray, where: np.ndarray) -> dict[str, float]:
    """Shares of the chosen cells within one and two expected errors, and how many they are."""
    ratio = np.abs(error[where]) / sigma[where]
    shares = {f"{name}: within {times}": float(np.mean(ratio < times)) for times in (1, 2)}
    return shares | {f"{name}: cells": int(where.sum())}


def rank_correlation(one: np.ndarray, other: np.ndarray) -> float:
    """Of Spearman."""
    return float(np.corrcoef(*(np.argsort(np.argsort(each)) for each in (one, other)))[0, 1])


def main(truth: Path, named: list[str]) -> None:
    """Print the figures and keep them."""
    figures = {}
    for name, maps in zip(named[::2], named[1::2], strict=True):
        figures |= {f"{name}: {key}": value for key, value in measured(Path(maps), truth).items()}
    for key, value in figures.items():
        print(f"{key}: {value:.4g}")
    save("precision", figures)


if __name__ == "__main__":
    main(Path(sys.argv[1]), sys.argv[2:])
