"""What a delivery, a run or a prepared scene tells of a survey: its files, cameras, tie points and map."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from surfkit.apps.maps.owned_files import MAPS_RECORD
from surfkit.apps.quality.sparse_model import SparseModel
from surfkit.apps.report.json_values import mapping, value_at
from surfkit.apps.sfm.engine import load_engine
from surfkit.apps.sfm.exif import read_exif
from surfkit.apps.sfm.inspect_photos import PHOTOGRAPHS_FILE, Photo, known_photographs
from surfkit.apps.sfm.mapping import read_model
from surfkit.apps.sfm.settings import REPORT_FILE, WORK_FOLDER
from surfkit.core.check import BadInput
from surfkit.core.codec import read_json
from surfkit.io.datasets.data import Data
from surfkit.io.datasets.read import model_folder, read
from surfkit.runs.folder import Run
from surfkit.runs.pipeline import opened
from surfkit.runs.resume import read_noting_changes
from surfkit.scene.lengths import unit_of
from surfkit.scene.photos import open_header
from surfkit.scene.scene import Scene, View
from surfkit.scene.up_direction import map_axes, up_direction

DELIVERY_RECORD = "make.json"
"""In the folder of a delivery."""
CALIBRATED = ("controlled", "held", "adjusted", "weighed", "rolling", "models")
"""Folders of a prepared scene that may hold the model with the calibrated lenses; the last adjustment first."""


@dataclass(frozen=True)
class Survey:
    """A survey.

    Attributes:
        target: The folder that was named.
        data: The data set.
        scene: The same as it was read.
        delivery: make.json; this and the following ones are empty where there is no such file.
        prepared: report.json of `surfkit prepare photos`.
        record: run.json.
        metrics: metrics.json.
        mesh: mesh.json.
        maps: maps.json.
        run: The run; None where there is only a scene.
        maps_folder: Where maps are, or would be.
        photos: What was found in each photograph of a prepared scene.
    """

    target: Path
    data: Data
    scene: Scene
    delivery: dict[str, Any]
    prepared: dict[str, Any]
    record: dict[str, Any]
    metrics: dict[str, Any]
    mesh: dict[str, Any]
    maps: dict[str, Any]
    run: Run | None
    maps_folder: Path
    photos: Sequence[Photo]

    @property
    def name(self) -> str:
        """That of the folder, as it was named."""
        return os.path.basename(os.path.abspath(self.target))

    @cached_property
    def views(self) -> tuple[View, ...]:
        """All photographs that have a camera, in the order of their names."""
        return tuple(sorted((*self.scene.train, *self.scene.held_out), key=lambda view: view.name))

    @property
    def unit(self) -> str:
        """Of lengths on the map."""
        return unit_of(self.scene.frame)

    @cached_property
    def axes(self) -> np.ndarray:
        """(3, 3) unit vectors in rows: east, north and up, frame of the input."""
        if (told := np.array(self.maps.get("axes", ()), np.float64)).shape == (3, 3):
            return told
        return map_axes(up_direction(None, self.scene.train, self.scene.frame, np.eye(4)).direction)

    def on_map(self, local: np.ndarray) -> np.ndarray:
        """(..., 3) east, north and up of (..., 3) local positions."""
        return self.scene.frame.to_input(local) @ self.axes.T

    def to_local(self, placed: np.ndarray) -> np.ndarray:
        """(..., 3) local positions of (..., 3) east, north and up."""
        return self.scene.frame.to_local(np.asarray(placed, np.float64) @ self.axes)

    @cached_property
    def centres(self) -> np.ndarray:
        """(V, 3) east, north and up of the cameras of `views`."""
        return self.on_map(np.stack([view.camera.centre.numpy() for view in self.views]))

    @cached_property
    def sparse_points(self) -> np.ndarray:
        """(P, 3) east, north and up of the sparse points; none where they were drawn at random."""
        cloud = self.scene.cloud
        return self.on_map(cloud.xyz.numpy()) if not cloud.drawn else np.zeros((0, 3))

    @cached_property
    def model_facts(self) -> dict[str, Any]:
        """What report.json says of the model that the run uses."""
        models = self.prepared.get("models")
        at = self._model_number
        found = models[at] if isinstance(models, list) and at < len(models) else {}
        return found if isinstance(found, dict) else {}

    @property
    def georeference(self) -> dict[str, Any]:
        """Residuals of the positions of the photographs."""
        return mapping(self.model_facts, "georeference")

    @property
    def ground_control(self) -> dict[str, Any]:
        """Residuals of control and check points."""
        return mapping(self.model_facts, "ground_control")

    @property
    def _model_number(self) -> int:
        name = model_folder(self.data).name
        return int(name) if name.isdecimal() else 0

    @cached_property
    def calibrated(self) -> Path | None:
        """Folder of the model of a prepared scene with the lenses as they were calibrated; None where it is gone."""
        wanted = value_at(self.model_facts, "cameras")
        if not isinstance(wanted, list):
            return None
        for name in CALIBRATED:
            folder = self.data.path / WORK_FOLDER / name / str(self._model_number)
            if not (folder / "cameras.bin").is_file():
                continue
            cameras = [camera for _, camera in sorted(read_model(folder).cameras.items())]
            if _same_lenses(cameras, wanted):
                return folder
        return None

    @cached_property
    def tie_points(self) -> SparseModel | None:
        """Tie points with calibrated lenses, else those of the data set; None where it keeps no observations."""
        if self.calibrated is not None:
            return SparseModel.of(read_model(self.calibrated))
        folder = model_folder(self.data)
        if not any((folder / f"images.{ending}").is_file() for ending in ("bin", "txt")):
            return None
        try:
            model = SparseModel.of(load_engine().Reconstruction(folder))
        except (RuntimeError, ValueError) as error:
            raise BadInput(f"{folder}: not a COLMAP model: {' '.join(str(error).split())[:200]}") from error
        return model if len(model.xy) else None

    @cached_property
    def taken(self) -> tuple[str, ...]:
        """Times of the photographs that state one, "2024:05:01 12:00:00", in their order."""
        if self.photos:
            found = [photo.exif.taken for photo in self.photos if photo.usable]
        else:
            found = [_taken(view.path) for view in self.views]
        return tuple(sorted(time for time in found if time))

    def map_file(self, name: str) -> Path | None:
        """One of the maps, if maps.json lists it and it is there."""
        files = self.maps.get("files")
        path = self.maps_folder / name
        return path if isinstance(files, list) and name in files and path.is_file() else None


def open_survey(target: Path) -> Survey:
    """What a folder tells.

    Raises:
        BadInput: It is no delivery, run or prepared scene, a file is damaged, or the data set is gone.
    """
    if not target.is_dir():
        raise BadInput(f"{target}: {'a file' if target.exists() else 'no such folder'}; name a delivery or a run")
    delivery = _object(target / DELIVERY_RECORD)
    folder = target / "run" if delivery else target
    if (folder / "recipe.json").is_file():
        run: Run | None = opened(folder)
        assert run is not None
        data, scene = run.data, read_noting_changes(run)
    elif (found := _prepared_folder(target)) is not None:
        run, data = None, Data(found, test_every=0)
        scene = read(data)
    else:
        raise BadInput(
            f"{target}: no delivery ({DELIVERY_RECORD}), no run (recipe.json) and no prepared scene ({REPORT_FILE} and "
            f"{WORK_FOLDER}/) whose cameras are known; name a folder that surfkit make, train or prepare photos made"
        )
    maps_folder = (target if delivery else folder) / "maps"
    prepared = _prepared_folder(data.path)
    return Survey(
        target, data, scene, delivery, _object(prepared / REPORT_FILE) if prepared is not None else {},
        _object(folder / "run.json"), _object(folder / "metrics.json"), _object(folder / "mesh.json"),
        _object(maps_folder / MAPS_RECORD), run, maps_folder,
        () if prepared is None else known_photographs(prepared / WORK_FOLDER / PHOTOGRAPHS_FILE),
    )  # fmt: skip


def _prepared_folder(folder: Path) -> Path | None:
    """The scene that `surfkit prepare photos` has completed in a folder, or in scene/ of it; None if there is none."""
    for path in (folder, folder / "scene"):
        if (path / REPORT_FILE).is_file() and (path / WORK_FOLDER).is_dir():
            return path
    return None


def _object(path: Path) -> dict[str, Any]:
    return read_json(path, dict[str, Any]) if path.is_file() else {}


def _same_lenses(cameras: Sequence[Any], wanted: Sequence[Any]) -> bool:
    """Whether pycolmap's cameras are those that report.json lists."""
    if len(cameras) != len(wanted):
        return False
    return all(
        camera.model.name == value_at(told, "model")
        and np.shape(value_at(told, "params")) == np.shape(camera.params)
        and np.allclose(value_at(told, "params"), camera.params, rtol=1e-9, atol=1e-12)
        for camera, told in zip(cameras, wanted, strict=True)
    )


def _taken(path: Path) -> str | None:
    """When a photograph was taken, by its EXIF; None where it does not say, or cannot be read."""
    try:
        return open_header(path, lambda image: read_exif(image, image.size).taken)
    except BadInput:
        return None
