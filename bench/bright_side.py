"""How well exposures are found where every photograph has a bright side: `python bench/bright_side.py --data SCENE`.

Ground is brighter where it is seen with the sun behind the camera. Colours of sparse points are given such a slope,
and exposures of a known spread, and `fit_light` finds the exposures again: with the slope, and as it was without one
and with nothing that holds exposures near 0 (`before`). Two sets of points: those of a scene whose photographs have
one light, such as the synthetic Shibuya, and made-up flights over flat ground of (lines, photographs in a line), of
which three quarters of a picture overlap along a line and half across. Errors are stops, the largest less the least
over all photographs for a flight, and the root mean square for the scene.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from machine import save

from surfkit.io.datasets.data import Data
from surfkit.io.datasets.read import observations, read
from surfkit.scene import track_light
from surfkit.scene.srgb import from_linear, linear
from surfkit.scene.track_colors import TrackColors, axes_of, rows_of, sensor_axes, track_colors
from surfkit.scene.track_light import fit_light

FLIGHTS = ((1, 10), (1, 20), (1, 60), (1, 160), (6, 20))
SIZE, STEP = np.array([1.2, 0.9]), np.array([0.3, 0.45])
"""Of a picture on the ground, and from one to the next along and across the line, in heights of the camera."""
NOISE = 0.01
"""Standard deviation of colours."""
LIGHTS = {"a slope": (0.25, 0.0), "exposures": (0.0, 0.5), "both": (0.25, 0.5)}
"""Stops for each unit aside of the axis, and the standard deviation of exposures, stops."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, required=True, help="a scene in one light")
    parser.add_argument("--keep", action="store_true", help="write bench/results/bright_side.json")
    asked = parser.parse_args()
    scene = read(Data(asked.data))
    colors, taken_by, axes = (
        track_colors(scene.train, observations(Data(asked.data), scene)),
        rows_of(scene.train),
        axes_of(scene.train),
    )
    centres = np.stack([view.camera.centre.numpy() for view in scene.train])
    along = np.linalg.svd(centres - centres.mean(0))[2][0]
    figures = {}
    for name, (slope, spread) in LIGHTS.items():
        stops = np.random.default_rng(1).normal(0, spread, len(scene.train)) if spread else np.zeros(len(scene.train))
        changed = lit(colors, axes, slope * along, stops - 1)  # a stop darker, so that little is cut off
        off = errors(changed, taken_by, axes, stops)
        figures[f"{asked.data.name}, {name}"] = {key: float(value.std()) for key, value in off.items()}
        for lines, photographs in FLIGHTS:
            made, stops, made_axes = flight(lines, photographs, slope, spread)
            off = errors(made, np.zeros(len(stops), np.int64), made_axes, stops)
            figures[f"{lines} x {photographs}, {name}"] = {key: float(np.ptp(value)) for key, value in off.items()}
    for name, found in figures.items():
        print(f"{name:32} " + "  ".join(f"{key} {value:.3f}" for key, value in found.items()))
    if asked.keep:
        print(save("bright_side", figures))


def lit(colors: TrackColors, axes: np.ndarray, slope: np.ndarray, stops: np.ndarray) -> TrackColors:
    """Colours with (V,) stops, and a (3,) slope in the world."""
    aside = (axes[colors.photo] @ colors.place[:, :, None])[..., 0]
    light = linear(colors.color) * 2 ** (stops[colors.photo] + aside @ slope)[:, None]
    return TrackColors(colors.photo, colors.point, colors.place, from_linear(light.clip(0, 1)))


def errors(colors: TrackColors, taken_by: np.ndarray, axes: np.ndarray, stops: np.ndarray) -> dict[str, np.ndarray]:
    """(V,) what is found less the truth, the mean of the three colours, without a mean."""
    found, held = {"now": fit_light(colors, taken_by, axes).stops}, track_light.HELD
    track_light.HELD = 0.0
    found["before"] = fit_light(colors, taken_by, 0 * axes).stops
    track_light.HELD = held
    off = {name: value.mean(1) - stops for name, value in found.items()}
    return {name: value - value.mean() for name, value in off.items()}


def flight(lines: int, photographs: int, slope: float, spread: float) -> tuple[TrackColors, np.ndarray, np.ndarray]:
    """Colours, (V,) true stops and axes of a flight in lines there and back, with the sun along them."""
    draw, parts, axes = np.random.default_rng(0), [], []
    ground = draw.uniform(0, STEP * [photographs, lines] + SIZE, (75 * lines * photographs, 2))
    light = linear(draw.uniform(0.25, 0.6, (len(ground), 3)))
    stops = draw.normal(0, spread, lines * photographs) if spread else np.zeros(lines * photographs)
    for number, change in enumerate(stops):
        line, at = divmod(number, photographs)
        there = 1 if line % 2 == 0 else -1
        away = ground - (SIZE / 2 + STEP * [at, line])
        rows = np.flatnonzero((np.abs(away) < SIZE / 2).all(1))
        color = from_linear((light[rows] * 2 ** (change + slope * away[rows, :1])).clip(0, 1))
        color = (color + draw.normal(0, NOISE, color.shape)).clip(0, 1)
        parts.append((np.full(len(rows), number), rows, there * away[rows] * 2 / np.hypot(*SIZE), color))
        axes.append(sensor_axes(np.diag([there, there, 1.0]), (1.0, 1.0), 2 / float(np.hypot(*SIZE))))
    return TrackColors(*(np.concatenate(each) for each in zip(*parts, strict=True))), stops, np.stack(axes)


if __name__ == "__main__":
    main()
