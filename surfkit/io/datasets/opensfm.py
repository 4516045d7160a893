"""OpenDroneMap projects: photographs in images/, and OpenSfM's reconstruction of them, on the map if it was."""

from __future__ import annotations

from array import array
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from surfkit.core.check import BadInput, leaving_out
from surfkit.core.codec import read_json
from surfkit.core.events import Warned, emit
from surfkit.io.datasets.base import Reader
from surfkit.io.datasets.camera_files import MAX_CAMERA_NUMBER, read_lines, tracks_of
from surfkit.io.datasets.data import Data
from surfkit.io.datasets.geocentric import topocentric_to_utm, warn_of_bend
from surfkit.io.datasets.panoramas import panorama
from surfkit.io.datasets.raw_dataset import RawDataset, RawImage, Tracks, camera_of
from surfkit.io.datasets.topocentric import place_on_earth
from surfkit.scene.photo_names import find_files

RECONSTRUCTION_FILES = ("opensfm/reconstruction.topocentric.json", "opensfm/reconstruction.json", "reconstruction.json")
"""Where the reconstruction may lie, the first that is there wins. OpenDroneMap puts one on the map in the place of the
second, by an affine map that no pose can follow: cameras and points no longer fit. So the topocentric one is moved."""
TRACKS = "tracks.csv"
"""Beside the reconstruction: which photograph shows which point where."""
FULL_MODEL, FISHEYE_MODEL = "FULL_OPENCV", "OPENCV_FISHEYE"
PROJECTION_MODELS = {
    "perspective": ("RADIAL", ("k1", "k2")),
    "simple_radial": ("SIMPLE_RADIAL", ("k1",)),
    "radial": ("RADIAL", ("k1", "k2")),
    "brown": (FULL_MODEL, ("k1", "k2", "p1", "p2", "k3", "", "", "")),
    "fisheye": ("RADIAL_FISHEYE", ("k1", "k2")),
    "fisheye_opencv": (FISHEYE_MODEL, ("k1", "k2", "k3", "k4")),
}
"""COLMAP's name of each projection, and the coefficients that it takes."""
SPHERICAL_PROJECTIONS = ("spherical", "equirectangular")
TWO_FOCAL_MODELS = {
    "RADIAL": (FULL_MODEL, ("k1", "k2", *[""] * 6)),
    "SIMPLE_RADIAL": (FULL_MODEL, ("k1", *[""] * 7)),
    "RADIAL_FISHEYE": (FISHEYE_MODEL, ("k1", "k2", "", "")),
}
"""The same for those of one focal length, where a camera has two."""


@dataclass(frozen=True)
class ODM(Reader):
    """OpenDroneMap: images/ and opensfm/reconstruction.json; with GPS in UTM and metres if it chose a zone, z up."""

    def recognises(self, root: Path) -> bool:
        return any((root / place).is_file() for place in RECONSTRUCTION_FILES)

    def read(self, data: Data) -> RawDataset:
        return _read(data)[0]

    def tracks(self, data: Data) -> Tracks | None:
        capture, rows, folder = _read(data)
        path = folder / TRACKS
        return tracks_of(capture.shots, capture.xyz, _seen(path, capture, rows)) if path.is_file() else None


def _read(data: Data) -> tuple[RawDataset, dict[str, int], Path]:
    """What is in a project, the row of each point by its number, and the folder of the reconstruction."""
    path = next(
        (data.path / place for place in RECONSTRUCTION_FILES if (data.path / place).is_file()),
        data.path / RECONSTRUCTION_FILES[1],
    )
    model = _largest(path, read_json(path, Any))
    names = sorted(model["shots"])
    folder = data.path / (data.images or "images")
    found = find_files(folder, names)
    data.lack(folder, [name for name in names if name not in found], len(names), "; put them there")
    names = [name for name in names if name in found or data.missing == "refuse"]
    try:
        cameras = {name: _camera(f"{path}: camera {name!r}", lens) for name, lens in model["cameras"].items()}
        shots = []
        for name in names:
            with leaving_out():
                shots.append(_shot(name, model["shots"][name], cameras, found.get(name, folder / name)))
        listed = model.get("points", {})
        points = list(listed.values())
        xyz = np.array([point["coordinates"] for point in points], np.float64).reshape(-1, 3)
        rgb = np.array([point["color"] for point in points], np.float64).reshape(-1, 3).clip(0, 255)
    except BadInput:
        raise
    except (KeyError, TypeError, ValueError, AttributeError, OverflowError) as error:
        raise BadInput(f"{path}: damaged, or not of OpenSfM: {type(error).__name__} {error}") from error
    good = (np.abs(xyz) < MAX_CAMERA_NUMBER).all(1) & np.isfinite(rgb).all(1)
    rows = {number: row for row, number in enumerate(number for number, fine in zip(listed, good, strict=True) if fine)}
    capture = RawDataset(shots, xyz[good], rgb[good].astype(np.uint8))
    return _on_earth(capture, data.path, path.parent, model), rows, path.parent


def _seen(path: Path, capture: RawDataset, rows: Mapping[str, int]) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Rows of the points of each photograph, and their pixels, from OpenSfM's table of tracks.

    Its columns are photograph, track, feature, x and y, with tabs between; x and y are counted from the middle, as
    shares of the longer side.
    """
    sizes = {shot.name: (shot.camera.width, shot.camera.height) for shot in capture.shots}
    seen = {name: (array("q"), array("d")) for name in sizes}
    for line in read_lines(path):  # there are thousands for each photograph
        words = line.split("\t", 5)
        if len(words) > 4 and words[0] in seen and words[1] in rows:
            seen[words[0]][0].append(rows[words[1]])
            try:
                seen[words[0]][1].extend((float(words[3]), float(words[4])))
            except ValueError as error:
                raise BadInput(
                    f"{path}: a place in {words[0]!r} is no number; run OpenSfM again, or delete the file"
                ) from error
    found = {}
    for name, (at, places) in seen.items():
        shares = np.array(places, np.float64).reshape(-1, 2)
        good = np.isfinite(shares).all(1)
        pixels = shares * max(sizes[name]) + np.array(sizes[name]) / 2
        found[name] = (np.array(at, np.int64)[good], pixels[good])
    return found


def _on_earth(capture: RawDataset, root: Path, folder: Path, model: Mapping[str, Any]) -> RawDataset:
    """A topocentric capture where it lies on Earth; the same one if the photographs had no GPS."""
    height = float(np.median(capture.xyz[:, 2])) if len(capture.xyz) else 0.0
    place = place_on_earth(root, folder, model, height)
    if place is None:
        return capture
    capture = replace(capture, metres=1.0, crs=place.crs, shift=place.shift)
    if (move := place.moved) is None:
        return capture
    if place.local is not None and capture.shots:
        centres = np.stack([-shot.pose[:3, :3].T @ shot.pose[:3, 3] for shot in capture.shots])
        warn_of_bend(str(folder), place.crs, move, 1.0, topocentric_to_utm(place.local, place.crs), centres)
    shots = [replace(shot, pose=move.pose(shot.pose)) for shot in capture.shots]
    return replace(capture, shots=shots, xyz=move.points(capture.xyz))


def _largest(path: Path, models: Any) -> Mapping[str, Any]:
    """The reconstruction with most photographs."""
    listed = [model for model in models if isinstance(model, dict)] if isinstance(models, list) else []
    whole = [model for model in listed if isinstance(model.get("shots"), dict) and model["shots"]]
    if not whole:
        raise BadInput(f"{path}: no reconstruction with shots in it; run ODM's OpenSfM stage again")
    best = max(whole, key=lambda model: len(model["shots"]))
    if len(whole) > 1:
        count = len(best["shots"])
        emit(Warned(f"{path} has {len(whole)} reconstructions; the largest is used, of {count} photographs"))
    return best


def _camera(where: str, lens: Mapping[str, Any]) -> Any:
    """The pycolmap camera of OpenSfM's normalised intrinsics: lengths are shares of the longer side."""
    kind = str(lens.get("projection_type"))
    if kind in SPHERICAL_PROJECTIONS:
        return panorama(where, (int(lens["width"]), int(lens["height"])))
    if kind not in PROJECTION_MODELS:
        raise BadInput(f"{where}: projection {kind}; known: {', '.join((*PROJECTION_MODELS, *SPHERICAL_PROJECTIONS))}")
    model, names = PROJECTION_MODELS[kind]
    width, height = int(lens["width"]), int(lens["height"])
    longer = max(width, height)
    focal = [float(lens[f"focal_{axis}"] if f"focal_{axis}" in lens else lens["focal"]) * longer for axis in "xy"]
    centre = [float(lens.get("c_x", 0)) * longer + width / 2, float(lens.get("c_y", 0)) * longer + height / 2]
    if model in TWO_FOCAL_MODELS and abs(focal[0] - focal[1]) > 1e-6 * abs(focal[0]):
        model, names = TWO_FOCAL_MODELS[model]
    elif model in TWO_FOCAL_MODELS:
        focal = focal[:1]
    extra = [float(lens.get(name, 0)) for name in names]
    return camera_of(where, model, (width, height), [*focal, *centre, *extra])


def _shot(name: str, shot: Mapping[str, Any], cameras: Mapping[str, Any], photo: Path) -> RawImage:
    from scipy.spatial.transform import Rotation

    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_rotvec(np.array(shot["rotation"], np.float64)).as_matrix()
    pose[:3, 3] = np.array(shot["translation"], np.float64)
    if not np.isfinite(pose).all():
        raise BadInput(f"the pose of {name!r} is not finite; delete the shot from reconstruction.json")
    return RawImage(name, pose, cameras[shot["camera"]], photo)
