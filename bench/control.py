"""Control points in the bundle adjustment: a simulated flight over a rendered city whose surface is exact.

    python bench/control.py SHIBUYA

SHIBUYA is the folder shibuya-synth, of which the exact cameras (sparse/0) and the exact mesh (gt/) are used, and no
photographs: once all cameras, once those that look straight down. Samples of the mesh are projected by a lens with
distortion where depth maps of the mesh show them: tie points with noise of 0.5 px, eight control points and eight
checkpoints with marks of 0.3 px. One mark is 15 px off. Positions of the photographs have a common error and noise.
Cameras are found by pycolmap's adjustment from poses that are off, and the focal length of EXIF, which is wrong by 2 %.
Then the functions of `surfkit prepare photos` place the model: by positions, by the similarity of the control points,
and by the adjustment with them.

Judged are residuals of the checkpoints, to the exact places. GSD is the mean distance of the ground over the focal
length. Results go to bench/results/control.json.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from machine import save

from surfkit.apps.maps.map_grid import Window
from surfkit.apps.maps.zbuffer import ZBuffer
from surfkit.apps.sfm.bundle_adjustment import adjust
from surfkit.apps.sfm.control_adjustment import adjust_to_points_once, clean_marks
from surfkit.apps.sfm.control_list import GroundControl, read_ground
from surfkit.apps.sfm.control_marks import images_of
from surfkit.apps.sfm.engine import load_engine
from surfkit.apps.sfm.exif import Exif
from surfkit.apps.sfm.focal import height_above_ground
from surfkit.apps.sfm.georeference import NoSimilarity, centres_of, chart_of, place
from surfkit.apps.sfm.ground_control import ControlResiduals, place_by_points
from surfkit.apps.sfm.inspect_photos import Photo
from surfkit.apps.sfm.settings import Settings
from surfkit.core.check import BadInput
from surfkit.evaluate.geometry.surface_file import read_surface
from surfkit.io.datasets.topocentric import Similarity
from surfkit.scene.earth import from_utm

ORIGIN = np.array([382_000.0, 3_947_000.0, 30.0])
"""Of the city, on UTM 54 N."""
ZONE = 54
LENS = np.array([550.0, 323.0, 211.0, -0.08])
"""SIMPLE_RADIAL: focal length and principal point, pixels, and the radial term."""
EXIF_ERROR = 1.02
TIE_PX, MARK_PX, WRONG_PX = 0.5, 0.3, 15.0
GPS_NOISE = np.array([1.5, 1.5, 3.0])
GPS_BIAS = np.array([1.2, -0.9, 2.5])
TIES, CONTROL, CHECKS = 6000, 8, 8
SEEN_M = 0.3
"""A point is seen that is no farther behind what the depth map shows."""


@dataclass(frozen=True)
class Flight:
    """Cameras of the flight, and the surface.

    Attributes:
        names: Of the photographs.
        turns: (V, 3, 3) world to camera.
        centres: (V, 3) metres.
        size: Width and height, pixels.
        samples: (N, 3) points of the surface.
        depths: (H, W) of each camera without distortion.
    """

    names: list[str]
    turns: np.ndarray
    centres: np.ndarray
    size: tuple[int, int]
    samples: np.ndarray
    depths: list[np.ndarray]

    @classmethod
    def over(cls, folder: Path, names: str) -> Flight:
        """The flight of a folder, of photographs in whose names a text is."""
        model = load_engine().Reconstruction(folder / "sparse" / "0")
        images = [model.image(number) for number in sorted(model.reg_image_ids())]
        images = [image for image in images if names in image.name]
        camera = images[0].camera
        mesh = read_surface(folder / "gt" / "mesh.ply")
        corners = mesh.vertices(np.asarray(mesh.triangles[:]).ravel())
        poses = [(image.cam_from_world().rotation.matrix(), image.projection_center()) for image in images]
        return cls(
            [image.name for image in images],
            np.stack([turn for turn, _ in poses]),
            np.stack([centre for _, centre in poses]),
            (camera.width, camera.height),
            read_surface(folder / "gt" / "points.ply").vertices(),
            [depth_map((corners - centre) @ turn.T, camera.width, camera.height) for turn, centre in poses],
        )

    def seen(self, view: int, xyz: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(N,) which of (N, 3) points a camera sees, and their (N, 2) exact pixels."""
        ray = (xyz - self.centres[view]) @ self.turns[view].T
        flat = ray[:, :2] / np.maximum(ray[:, 2:], 1e-9)
        pixels = LENS[0] * flat * (1 + LENS[3] * (flat**2).sum(1, keepdims=True)) + LENS[1:3]
        good = (ray[:, 2] > 1) & (pixels > 0).all(1) & (pixels < self.size).all(1)
        at = np.floor(LENS[0] * flat + LENS[1:3]).astype(int)
        good &= (at >= 0).all(1) & (at < self.size).all(1)
        column, row = np.where(good[:, None], at, 0).T
        return good & (ray[:, 2] < self.depths[view][row, column] + SEEN_M), pixels


def depth_map(corners: np.ndarray, width: int, height: int) -> np.ndarray:
    """(H, W) depths of (3 F, 3) corners of triangles in a camera's frame; infinite where there is none."""
    triangles = corners.reshape(-1, 3, 3)
    triangles = triangles[(triangles[:, :, 2] > 1).all(1)]
    pixels = LENS[0] * triangles[:, :, :2] / triangles[:, :, 2:] + LENS[1:3]
    buffer = ZBuffer(Window(0, 0, width, height))  # the inverse of depth is linear in a picture
    buffer.draw(np.concatenate([pixels, 1 / triangles[:, :, 2:]], 2), np.arange(len(triangles)))
    return 1 / np.where(buffer.covered, buffer.height, 1e-12)


def reconstructed(flight: Flight, ties: np.ndarray, rng: np.random.Generator) -> Any:
    """The flight as structure from motion finds it: triangulated from poses that are off, and adjusted."""
    engine = load_engine()
    model, config = engine.Reconstruction(), engine.BundleAdjustmentConfig()
    width, height = flight.size
    params = [LENS[0] * EXIF_ERROR, width / 2, height / 2, 0.0]
    lens = engine.Camera(model="SIMPLE_RADIAL", width=width, height=height, params=params, camera_id=1)
    model.add_camera_with_trivial_rig(lens)
    tracks: dict[int, Any] = {}
    for view, name in enumerate(flight.names):
        good, pixels = flight.seen(view, ties)
        rows = np.flatnonzero(good)
        keypoints = pixels[rows] + rng.normal(0, TIE_PX, (len(rows), 2))
        image = engine.Image(name=name, keypoints=keypoints, camera_id=1, image_id=view + 1)
        turn = engine.Rotation3d(rng.normal(0, 0.003, 3)).matrix() @ flight.turns[view]
        centre = flight.centres[view] + rng.normal(0, 0.5, 3)
        model.add_image_with_trivial_frame(image, engine.Rigid3d(engine.Rotation3d(turn), -turn @ centre))
        config.add_image(view + 1)
        for at, row in enumerate(rows):
            tracks.setdefault(int(row), engine.Track()).add_element(view + 1, at)
    for row, track in sorted(tracks.items()):
        if track.length() > 2:
            model.add_point3D(ties[row] + rng.normal(0, 1, 3), track, np.zeros(3, np.uint8))
    options = engine.BundleAdjustmentOptions()
    options.print_summary = False
    options.ceres.solver_options.num_threads = 1
    config.fix_gauge(engine.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    engine.create_default_bundle_adjuster(options, config, model).solve()
    return model


def listed(flight: Flight, places: np.ndarray, rng: np.random.Generator, path: Path) -> tuple[str, str]:
    """Write a list of places with marks; the point and the photograph of the wrong one."""
    marks = []
    for at, view in ((at, view) for view in range(len(flight.names)) for at in range(len(places))):
        good, pixels = flight.seen(view, places[at : at + 1])
        if good[0]:
            marks.append((at, view, pixels[0] + rng.normal(0, MARK_PX, 2)))
    control = [row for row, (at, *_) in enumerate(marks) if at == 2]
    wrong = control[len(control) // 2]
    at, view, pixel = marks[wrong]
    marks[wrong] = at, view, pixel + WRONG_PX * np.array([0.6, -0.8])
    lines = [f"EPSG:326{ZONE}"]
    for row, column, pixel in marks:
        x, y, z = places[row] + ORIGIN
        lines.append(f"{x:.4f} {y:.4f} {z:.4f} {pixel[0]:.3f} {pixel[1]:.3f} {flight.names[column]} {named(row)}")
    path.write_text("\n".join(lines) + "\n")
    return named(at), flight.names[view]


def named(at: int) -> str:
    """The name of a point: control points first, then checkpoints."""
    return f"G{at + 1}" if at < CONTROL else f"C{at - CONTROL + 1}"


def spread(flight: Flight, count: int, rng: np.random.Generator) -> np.ndarray:
    """(count, 3) points of the surface, far from one another, each in four photographs and more."""
    many = flight.samples[rng.choice(len(flight.samples), 3000, replace=False)]
    views = sum(flight.seen(view, many)[0].astype(int) for view in range(len(flight.names)))
    good = many[(views >= 4) & (np.abs(many[:, :2]) < 105).all(1)]
    chosen = [good[0]]
    while len(chosen) < count:
        away = np.min([np.linalg.norm(good - xyz, axis=1) for xyz in chosen], axis=0)
        chosen.append(good[int(np.argmax(away))])
    return np.array(chosen)[rng.permutation(count)]


def moved(model: Any, similarity: Similarity) -> Any:
    """A copy of a model on the map."""
    engine = load_engine()
    new = engine.Reconstruction(model)
    new.transform(engine.Sim3d(similarity.scale, engine.Rotation3d(similarity.turn), similarity.move))
    return new


def figures(where: ControlResiduals, gsd: float) -> dict[str, float]:
    """Of the checkpoints: root mean square in plan and height, metres and GSD, and the mean."""
    left = np.array([where.residuals[name] for name in where.checkpoints])
    plan, up = float(np.sqrt((left[:, :2] ** 2).sum(1).mean())), float(np.sqrt((left[:, 2] ** 2).mean()))
    mean = left.mean(0)
    return {"plan, m": plan, "height, m": up, "plan, GSD": plan / gsd, "height, GSD": up / gsd} | {
        f"mean {axis}, m": float(value) for axis, value in zip(("east", "north", "up"), mean, strict=True)
    }


def main() -> None:
    """Print the figures and keep them."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    found: dict[str, Any] = {}
    for flown, names in (("all", ""), ("nadir only", "nadir")):
        rows = simulated(Flight.over(options.folder, names), np.random.default_rng(options.seed))
        for key, value in rows.items():
            print(f"{flown}: {key}: {value:.4g}" if isinstance(value, float) else f"{flown}: {key}: {value}")
        found[flown] = rows
    save("control", found)


def simulated(flight: Flight, rng: np.random.Generator) -> dict[str, Any]:
    """The figures of a flight."""
    model = reconstructed(flight, flight.samples[rng.choice(len(flight.samples), TIES, replace=False)], rng)
    model.update_point_3d_errors()
    places = spread(flight, CONTROL + CHECKS, rng)
    positions = flight.centres + ORIGIN + GPS_BIAS + rng.normal(0, GPS_NOISE, flight.centres.shape)
    latitudes, longitudes = from_utm(positions[:, 0], positions[:, 1], ZONE, False)
    photos = {}
    for at, name in enumerate(flight.names):
        where = (float(latitudes[at]), float(longitudes[at]), float(positions[at, 2]))
        exif = Exif(focal_px=LENS[0] * EXIF_ERROR, position=where)
        photos[name] = Photo(name, (0, 0), size=flight.size, exif=exif)
    settings = Settings(
        gcp=Path("gcp_list.txt"),
        mark_sigma=MARK_PX,
        checkpoint_names=tuple(map(named, range(CONTROL, CONTROL + CHECKS))),
    )
    found: dict[str, Any] = {"photographs": len(flight.names), "tie points": model.num_points3D()}
    with tempfile.TemporaryDirectory() as scratch:
        path = Path(scratch) / "gcp_list.txt"
        wrong = listed(flight, places, rng, path)
        ground = read_ground(path, "auto", dict.fromkeys(flight.names, flight.size), 0, settings.checkpoint_names)
        model = adjust(model, None, photos, settings)
        found |= measured(model, ground, photos, settings, Path(scratch), wrong)
    return found


def measured(
    model: Any,
    ground: GroundControl,
    photos: dict[str, Photo],
    settings: Settings,
    scratch: Path,
    wrong: tuple[str, str],
) -> dict[str, Any]:
    """The figures of the three ways to place a model."""
    seed = settings.seed
    given = np.array([photo.exif.position for photo in photos.values()], np.float64)
    by_gps = place(
        centres_of(model), list(photos.values()), replace(chart_of(given, "auto"), offset=ground.chart.offset), seed
    )
    if isinstance(by_gps, NoSimilarity):
        raise BadInput(by_gps.reason)
    placed = moved(model, by_gps.similarity)
    clean, marks = clean_marks(model, ground, settings)
    where = place_by_points(model, clean, 0, settings.checkpoint_names)
    if isinstance(where, NoSimilarity):
        raise BadInput(where.reason)
    where = replace(where, wrong_marks=tuple(marks))
    by_points = moved(model, where.similarity)
    gsd = float(height_above_ground(by_points) / LENS[0])
    found: dict[str, Any] = {"GSD, m": gsd, "marks": sum(len(point.marks) for point in ground.points)}
    tried = adjust(placed, by_gps, photos, settings)
    if tried is None:
        raise BadInput("the adjustment to the positions did not converge")
    ways = {
        "positions alone": where.measured(images_of(tried), clean),
        "similarity of control points": where.measured(images_of(by_points), clean),
    }
    began = time.process_time()
    model, final = adjust_to_points_once(by_points, where, clean, photos, settings, scratch / "controlled")
    found["adjustment, CPU s"] = time.process_time() - began
    if model is None:
        raise BadInput("the adjustment to the control points did not converge")
    ways["adjustment with control points"] = final
    for way, residuals in ways.items():
        found |= {f"{way}: {key}": value for key, value in figures(residuals, gsd).items()}
    found["focal length, px"] = float(model.cameras[1].mean_focal_length())
    found["wrong mark"] = " in ".join(wrong)
    found["named"] = [f"{mark.point} in {mark.photograph}, {mark.pixels:.1f} px" for mark in final.wrong_marks]
    found["points left out"] = list(final.wrong)
    found["adjustment"] = dict(final.adjustment)
    return found


if __name__ == "__main__":
    main()
