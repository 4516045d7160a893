"""What a rolling shutter costs over the exact city (Shibuya, synthetic), and what is left of that with its correction.

    python bench/rolling.py FOLDER

Only what cameras see is simulated, by the exact mesh: no photographs. Six strips 120 m above the streets, a photograph
each 2.3 s at 10 m/s, of 4000 x 2666 px (3.5 cm on the ground); the readout takes 30 ms. The speed varies by 20 %. With
a "fixed heading" photographs are taken in the turns too, and rows point the same way in all of them; else the drone
turns with the strips. Tie points have a noise of 0.3 px, positions one of 1.5 m (3 m in height) or of 2 cm (RTK). EXIF
has a focal length that is 2 % off.

Structure from motion begins with poses that are 0.2 degrees and 0.5 m off and with the focal length of EXIF, and knows
nothing of the shutter. Judged are the mean reprojection error, and the distance of points and cameras from the truth on
the map, and after the best similarity (shape). Results go to bench/results/rolling.json.
"""

from __future__ import annotations

import argparse
import math
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from control import ORIGIN, SEEN_M, ZONE, moved
from machine import save

from surfkit.apps.maps.map_grid import Window
from surfkit.apps.maps.zbuffer import ZBuffer
from surfkit.apps.sfm.bundle_adjustment import adjust
from surfkit.apps.sfm.engine import load_engine
from surfkit.apps.sfm.exif import Exif
from surfkit.apps.sfm.georeference import NoSimilarity, centres_of, chart_of, place
from surfkit.apps.sfm.inspect_photos import Photo
from surfkit.apps.sfm.rolling_shutter import correct
from surfkit.apps.sfm.settings import Settings
from surfkit.apps.sfm.similarity import umeyama
from surfkit.core.check import BadInput
from surfkit.evaluate.geometry.surface_file import read_surface
from surfkit.scene.earth import from_utm

SIZE, LENS = (4000, 2666), np.array([3440.0, 2000.0, 1333.0, -0.06])
"""SIMPLE_RADIAL: focal length, principal point in the middle, as COLMAP takes it, and the radial term."""
COARSE = 8
"""Depth maps, which tell what is hidden, are so many times smaller."""
ABOVE_M, SPEED_M, READOUT_S, EACH_S = 120.0, 10.0, 0.03, 2.3
HALF_M, APART_M, STRIPS = 100.0, 34.0, 6
TIES, TIE_PX, EXIF_ERROR = 1200, 0.3, 1.02
NOISES = {"GPS": (np.array([1.5, 1.5, 3.0]), None), "RTK": (np.full(3, 0.02), (0.02, 0.02, 0.02))}
"""Standard deviations of positions, and those that EXIF states."""
WAYS: tuple[tuple[str, float, str, Any], ...] = (
    ("global shutter", 0.0, "exact", "off"),
    ("rolling shutter, off", READOUT_S, "exact", "off"),
    ("readout given, exact times", READOUT_S, "exact", 1000 * READOUT_S),
    ("readout given, whole seconds", READOUT_S, "whole", 1000 * READOUT_S),
    ("readout given, XMP speeds", READOUT_S, "XMP", 1000 * READOUT_S),
    ("readout estimated, exact times", READOUT_S, "exact", "auto"),
    ("readout estimated, whole seconds", READOUT_S, "whole", "auto"),
    ("global shutter, readout estimated", 0.0, "exact", "auto"),
)
"""What is flown, how the times of photographs are known, and --readout."""


@dataclass(frozen=True)
class Path3D:
    """A serpentine of strips and half circles, at a speed that varies.

    Attributes:
        height: Of the camera, metres.
    """

    height: float

    @property
    def seconds(self) -> float:
        """How long it takes, about."""
        return (STRIPS * 2 * HALF_M + (STRIPS - 1) * math.pi * APART_M / 2) / SPEED_M

    def along(self, seconds: float) -> tuple[float, float, float, int]:
        """East and north, metres; the way along a strip, or -1 beyond its end; and which strip."""
        way = SPEED_M * (seconds + 0.2 / 0.35 * (1 - math.cos(0.35 * seconds)))  # 10 m/s (1 + 0.2 sin 0.35 t)
        turn, strip = math.pi * APART_M / 2, 0
        while way > 2 * HALF_M + turn and strip < STRIPS - 1:
            way, strip = way - 2 * HALF_M - turn, strip + 1
        y, side = (strip - (STRIPS - 1) / 2) * APART_M, 1 - 2 * (strip % 2)
        if way <= 2 * HALF_M:
            return side * (way - HALF_M), y, way, strip
        angle = (way - 2 * HALF_M) / (APART_M / 2)
        radius = APART_M / 2
        return side * (HALF_M + radius * math.sin(angle)), y + radius * (1 - math.cos(angle)), -1.0, strip

    def centre(self, seconds: float) -> np.ndarray:
        """(3,) metres."""
        return np.array([*self.along(seconds)[:2], self.height])


@dataclass(frozen=True)
class City:
    """The mesh, and points on it: (3 F, 3) corners, (N, 3) samples."""

    corners: np.ndarray
    samples: np.ndarray


@dataclass(frozen=True)
class Shot:
    """A photograph: when it was taken, (3, 3) world to camera, and (h, w) depths from its middle row, coarse."""

    name: str
    seconds: float
    turn: np.ndarray
    depths: np.ndarray


def flight(city: City, path: Path3D, fixed: bool) -> list[Shot]:
    """The photographs of a flight."""
    found = []
    for at in range(int(path.seconds / EACH_S)):
        seconds = 0.5 + EACH_S * at
        _, _, way, strip = path.along(seconds)
        if not fixed and way < 0:
            continue
        side = 1.0 if fixed else 1 - 2.0 * (strip % 2)
        turn = np.array([[0, -side, 0], [-side, 0, 0], [0, 0, -1.0]])  # the top of photographs points along the strip
        local = (city.corners - path.centre(seconds)) @ turn.T
        found.append(Shot(f"{at:03}.jpg", seconds, turn, coarse_depths(local)))
    return found


def coarse_depths(corners: np.ndarray) -> np.ndarray:
    """(h, w) depths of (3 F, 3) corners of triangles in a camera's frame; infinite where none is."""
    triangles = corners.reshape(-1, 3, 3)
    triangles = triangles[(triangles[:, :, 2] > 1).all(1)]
    pixels = (LENS[0] * triangles[:, :, :2] / triangles[:, :, 2:] + LENS[1:3]) / COARSE
    buffer = ZBuffer(Window(0, 0, SIZE[0] // COARSE, SIZE[1] // COARSE))
    buffer.draw(np.concatenate([pixels, 1 / triangles[:, :, 2:]], 2), np.arange(len(triangles)))
    return 1 / np.where(buffer.covered, buffer.height, 1e-12)


def pixels_of(shot: Shot, path: Path3D, xyz: np.ndarray, readout: float) -> tuple[np.ndarray, np.ndarray]:
    """(N,) which of (N, 3) points a photograph shows, and their (N, 2) exact pixels, each by its own row."""
    ray = (xyz - path.centre(shot.seconds)) @ shot.turn.T
    flat = ray[:, :2] / np.maximum(ray[:, 2:], 1e-9)
    at = np.floor((LENS[0] * flat + LENS[1:3]) / COARSE).astype(int)
    good = (ray[:, 2] > 1) & (at >= 0).all(1) & (at < (shot.depths.shape[1], shot.depths.shape[0])).all(1)
    column, row = np.where(good[:, None], at, 0).T
    good &= ray[:, 2] < shot.depths[row, column] + SEEN_M
    pixels = projected(ray)
    for index in np.flatnonzero(good) if readout else ():
        for _ in range(5):
            moment = shot.seconds + readout * (pixels[index, 1] / SIZE[1] - 0.5)
            pixels[index] = projected((xyz[index : index + 1] - path.centre(moment)) @ shot.turn.T)[0]
    return good & (pixels > 0).all(1) & (pixels < SIZE).all(1), pixels


def projected(ray: np.ndarray) -> np.ndarray:
    """(N, 2) pixels of (N, 3) points in a camera's frame."""
    flat = ray[:, :2] / np.maximum(ray[:, 2:], 1e-9)
    return LENS[0] * flat * (1 + LENS[3] * (flat**2).sum(1, keepdims=True)) + LENS[1:3]


def reconstructed(
    shots: list[Shot], path: Path3D, ties: np.ndarray, readout: float, seed: int
) -> tuple[Any, list[int]]:
    """The flight as structure from motion finds it without knowing of the shutter; and the tie point of each point."""
    engine, rng = load_engine(), np.random.default_rng(seed)
    model, config = engine.Reconstruction(), engine.BundleAdjustmentConfig()
    params = [LENS[0] * EXIF_ERROR, SIZE[0] / 2, SIZE[1] / 2, 0.0]
    lens = engine.Camera(model="SIMPLE_RADIAL", width=SIZE[0], height=SIZE[1], params=params, camera_id=1)
    model.add_camera_with_trivial_rig(lens)
    tracks: dict[int, Any] = {}
    for view, shot in enumerate(shots):
        good, pixels = pixels_of(shot, path, ties, readout)
        noise = rng.normal(0, TIE_PX, pixels.shape)  # the same for all readout times
        rows = np.flatnonzero(good)
        keypoints = (pixels + noise)[rows]
        image = engine.Image(name=shot.name, keypoints=keypoints, camera_id=1, image_id=view + 1)
        turn = engine.Rotation3d(rng.normal(0, 0.003, 3)).matrix() @ shot.turn
        centre = path.centre(shot.seconds) + rng.normal(0, 0.5, 3)
        model.add_image_with_trivial_frame(image, engine.Rigid3d(engine.Rotation3d(turn), -turn @ centre))
        config.add_image(view + 1)
        for at, row in enumerate(rows):
            tracks.setdefault(int(row), engine.Track()).add_element(view + 1, at)
    of = []
    for row, track in sorted(tracks.items()):
        if track.length() > 2:
            model.add_point3D(ties[row] + rng.normal(0, 1, 3), track, np.zeros(3, np.uint8))
            of.append(row)
    options = engine.BundleAdjustmentOptions()
    options.print_summary = False
    options.ceres.solver_options.num_threads = 1
    config.fix_gauge(engine.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    config.set_constant_cam_intrinsics(1)  # photographs that look straight down do not tell the focal length
    engine.create_default_bundle_adjuster(options, config, model).solve()
    return model, of


def photographs(shots: list[Shot], path: Path3D, kind: str, clock: str, seed: int) -> dict[str, Photo]:
    """What EXIF says: positions, and times to a hundredth of a second, whole seconds, or those and speeds in XMP."""
    noise, stated = NOISES[kind]
    rng, speeds, found = np.random.default_rng(seed + 1), np.random.default_rng(seed + 2), {}
    for shot in shots:
        centre = path.centre(shot.seconds)
        where = centre + ORIGIN + rng.normal(0, noise)
        latitude, longitude = (float(value) for value in from_utm(where[0], where[1], ZONE, False))
        own = (path.centre(shot.seconds + 0.01) - path.centre(shot.seconds - 0.01)) / 0.02
        text = f"{shot.seconds:.2f}" if clock == "exact" else f"{int(shot.seconds)}"
        whole, _, part = text.partition(".")
        taken = f"2024:05:01 12:{int(whole) // 60:02}:{int(whole) % 60:02}" + (f".{part}" if part else "")
        exif = Exif(
            camera="MADE ROLLING",
            taken=taken,
            focal_px=LENS[0] * EXIF_ERROR,
            position=(latitude, longitude, float(where[2])),
            accuracy_m=stated,
            speed=float(np.linalg.norm(own) + speeds.normal(0, 0.1)) if clock == "XMP" else None,
        )
        found[shot.name] = Photo(shot.name, (0, 0), size=SIZE, exif=exif)
    return found


def judged(
    model: Any, of: list[int], ties: np.ndarray, shots: list[Shot], path: Path3D, photos: dict[str, Photo]
) -> dict:
    """Figures of a model that is then placed and adjusted to the positions."""
    model.update_point_3d_errors()
    given = np.array([photo.exif.position for photo in photos.values()], np.float64)
    chart = replace(chart_of(given, "auto"), offset=tuple(ORIGIN))
    found = place(centres_of(model), list(photos.values()), chart, 0)
    if isinstance(found, NoSimilarity):
        raise BadInput(found.reason)
    on_map = moved(model, found.similarity)
    final = adjust(on_map, found, photos, Settings()) or on_map
    numbers = sorted(final.points3D)
    points, truth = np.stack([final.points3D[number].xyz for number in numbers]), ties[of]
    centres = centres_of(final)
    cameras = np.stack([centres[shot.name] - path.centre(shot.seconds) for shot in shots])
    best = umeyama(points, truth, np.ones(len(points)))
    left = points - truth
    shape = best.points(points) - truth
    final.update_point_3d_errors()
    rms = lambda values: float(np.sqrt(np.mean(np.sum(np.square(values), axis=-1))))  # noqa: E731
    return {
        "reprojection error, px": float(final.compute_mean_reprojection_error()),
        "points in plan, m": rms(left[:, :2]),
        "points in height, m": rms(left[:, 2:]),
        "points, shape, m": rms(shape),
        "cameras, m": rms(cameras),
        "focal length, px": float(final.cameras[1].mean_focal_length()),
    }


def main() -> None:
    """Print the figures and keep them."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    mesh = read_surface(options.folder / "gt" / "mesh.ply")
    samples = read_surface(options.folder / "gt" / "points.ply").vertices()
    city = City(mesh.vertices(np.asarray(mesh.triangles[:]).ravel()), samples)
    path = Path3D(float(np.percentile(samples[:, 2], 5)) + ABOVE_M)
    ties = samples[np.random.default_rng(options.seed).choice(len(samples), TIES, replace=False)]
    figures: dict[str, Any] = {}
    for flown, fixed in (("fixed heading", True), ("heading along strips", False)):
        shots = flight(city, path, fixed)
        models = {readout: reconstructed(shots, path, ties, readout, options.seed) for readout in (0.0, READOUT_S)}
        rows: dict[str, Any] = {"photographs": len(shots)}
        for way, seconds, clock, readout in WAYS:
            model, of = models[seconds]
            photos = photographs(shots, path, "GPS", clock, options.seed)
            model = adjust(model, None, photos, Settings()) or model  # to EXIF, as photographs are prepared
            began, corrected = time.process_time(), None
            if readout != "off":
                model, corrected = correct(model, photos, Settings(readout=readout))
            rows[way] = {"CPU s": time.process_time() - began} | ({} if corrected is None else corrected.facts())
            for kind in NOISES:
                photos = photographs(shots, path, kind, clock, options.seed)
                rows[way][kind] = judged(model, of, ties, shots, path, photos)
            print(f"{flown}: {way}: {rows[way]}", flush=True)
        figures[flown] = rows
    save("rolling", figures)


if __name__ == "__main__":
    main()
