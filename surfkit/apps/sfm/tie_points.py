"""Points for cameras that are known but came without: features are matched, and triangulated between the cameras.

What comes out is a COLMAP model of the same cameras, in the same coordinates, with points and with who sees them.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np
import torch

from surfkit.apps.sfm.dataset_export import deliver
from surfkit.apps.sfm.engine import load_engine, run
from surfkit.apps.sfm.feature_cache import MIN_FEATURES
from surfkit.apps.sfm.inspect_photos import PHOTOGRAPHS_FILE, Photo, known_photographs, look_at
from surfkit.apps.sfm.mapping import MIN_MODEL_PHOTOS, read_model
from surfkit.apps.sfm.mask_export import deliver_masks
from surfkit.apps.sfm.match_photos import compare
from surfkit.apps.sfm.settings import REPORT_FILE, WORK_FOLDER, Settings
from surfkit.apps.sfm.sfm_report import model_facts
from surfkit.apps.sfm.sources import Sources, with_masks, with_own_masks
from surfkit.core.check import BadInput, few
from surfkit.core.codec import write_json
from surfkit.core.events import Warned, emit
from surfkit.core.files import replacing_folder
from surfkit.core.stages import StageFolder, key_of
from surfkit.io.datasets.data import Data
from surfkit.io.datasets.georeference_file import Georeference
from surfkit.io.datasets.masks import find_masks
from surfkit.io.datasets.panoramas import ALIGNMENT_HINT
from surfkit.io.datasets.raw_dataset import RawDataset, RawImage
from surfkit.io.datasets.read import check_size, read_capture, reader_of
from surfkit.io.datasets.undistort import check_camera, is_panorama
from surfkit.scene.photos import photo_size
from surfkit.scene.scene import Frame


@dataclass(frozen=True)
class TiePoints:
    """A data set with cameras on its way to one with points.

    Attributes:
        data: The data set, and how it is read; nothing is written there.
        scene: The new one.
        settings: How features are found and compared.
        device: Where that is done in torch.
    """

    data: Data
    scene: Path
    settings: Settings
    device: torch.device = torch.device("cpu")

    @property
    def work(self) -> Path:
        """Folder of what the stages keep."""
        return self.scene / WORK_FOLDER

    def run(self) -> dict[str, Any]:
        """Go through all stages that are not complete; the report.

        Raises:
            BadInput: The data set cannot be read, or its photographs share too few features.
        """
        load_engine()
        self.settings.refuse_missing()
        capture = read_capture(self.data, reader_of(self.data))
        if whole := [shot.name for shot in capture.shots if is_panorama(shot.camera)]:
            raise BadInput(
                f"{self.data.path}: {len(whole)} panoramas, {few(whole)}: points are triangulated between perspective "
                f"photographs only; {ALIGNMENT_HINT}"
            )
        root, shots = _by_path(capture)
        self._tell_what_is_lost(capture)
        stages = StageFolder(self.work)
        sources, photos = stages.run("photographs", "", lambda: self._look(root, shots))
        cameras = {photo.name: _camera(shots[photo.name], photo.size) for photo in photos}
        offset = _offset(capture)
        poses = {name: _moved(shots[name].pose, offset) for name in cameras}
        found = compare(stages, photos, sources, self.work, self.settings, self.device, cameras, poses)
        if poor := [name for name, count in found.counts.items() if count < MIN_FEATURES]:
            emit(Warned(f"{len(poor)} of {len(photos)} photographs have hardly any features: {few(poor)} are left out"))
        key = key_of(found.key, [pose.tolist() for pose in poses.values()])
        models = self.work / "points"
        model = stages.run(
            "points", key, lambda: self._triangulate(found.database, poses), lambda: read_model(models / "0")
        )
        if model.num_points3D() == 0:
            raise BadInput(
                f"{self.data.path}: not one point could be triangulated: the photographs share no features that fit "
                "their cameras; are these the cameras of these photographs?"
            )
        placed = None if capture.crs is None else Georeference(capture.crs, tuple(offset.tolist()), capture.metres)
        if placed is None:  # no file to keep an offset in
            model.transform(load_engine().Sim3d(1.0, load_engine().Rotation3d(), offset))
        by_name = {photo.name: photo for photo in photos}
        stages.run("undistortion", "", lambda: self._deliver(model, placed, by_name, sources))
        report = {
            "photographs": len(capture.shots),
            "registered": model.num_reg_images(),
            "models": [model_facts(model, None)],
            "seconds": stages.seconds(),
            "settings": self.settings,
        }
        write_json(self.scene / REPORT_FILE, report)
        return report

    def _tell_what_is_lost(self, capture: RawDataset) -> None:
        """Say what of the data set the new one has not."""
        if capture.held_out:
            named = few(sorted(capture.held_out))
            emit(Warned(f"which photographs the data set keeps from training is not taken over: {named} (--test-list)"))
        if capture.metres and capture.crs is None and capture.metres != 1:
            emit(Warned(f"the unit is not taken over: give --metres-per-unit {capture.metres:g} when you train"))

    def _look(self, root: Path, shots: Mapping[str, RawImage]) -> tuple[Sources, list[Photo]]:
        """The photographs of the data set that can be used, and where they and their masks are."""
        path, data = self.work / PHOTOGRAPHS_FILE, self.data
        paths = [root / name for name in sorted(shots)]
        photos = look_at(root, paths, known_photographs(path), data.alpha, ("--alpha",))
        known = find_masks(data.path, data.masks, list(shots.values()))
        masks = {name: known[shot.name] for name, shot in shots.items() if shot.name in known}
        sources, photos = with_masks(*with_own_masks(Sources(root), photos), masks)
        write_json(path, photos)
        if wrong := [f"{photo.name} ({photo.problem})" for photo in photos if not photo.usable]:
            emit(Warned(f"{len(wrong)} of {len(photos)} photographs cannot be used, and are left out: {few(wrong)}"))
        usable = [photo for photo in photos if photo.usable]
        if len(usable) < MIN_MODEL_PHOTOS:
            raise BadInput(
                f"{root}: {len(usable)} of {len(photos)} photographs can be used; {MIN_MODEL_PHOTOS} or more are needed"
            )
        return sources, usable

    def _deliver(self, model: Any, placed: Georeference | None, photos: dict[str, Photo], sources: Sources) -> None:
        """Write photographs, masks and the model of the data set."""
        deliver_masks([model], photos, sources, self.scene, self.work)
        deliver([(model, placed)], photos, sources, self.scene, self.work)

    def _triangulate(self, database: Path, poses: Mapping[str, np.ndarray]) -> Any:
        """The model with points between the cameras, kept in `points/`."""
        engine = load_engine()
        with replacing_folder(self.work / "points") as folder:
            (folder / "0").mkdir()
            model = _without_points(engine, database, poses)
            options = engine.IncrementalPipelineOptions()
            options.random_seed = self.settings.seed
            options.extract_colors = False  # photographs are read once, when they are undistorted

            def work(token: Any) -> Any:
                return engine.triangulate_points(
                    model, database, self.work, folder / "0", True, options, False, cancellation_token=token
                )

            made = run("triangulating points", work)
            for image in made.images.values():
                image.name = unquote(image.name)
            made.write_binary(folder / "0")
        return read_model(self.work / "points" / "0")


def _by_path(capture: RawDataset) -> tuple[Path, dict[str, RawImage]]:
    """The folder that all photographs of a data set are in, and what is known of each by its path below that."""
    paths = [Path(os.path.abspath(shot.path)) for shot in capture.shots]
    root = Path(os.path.commonpath([path.parent for path in paths]))
    return root, {path.relative_to(root).as_posix(): shot for path, shot in zip(paths, capture.shots, strict=True)}


def _without_points(engine: Any, database: Path, poses: Mapping[str, np.ndarray]) -> Any:
    """A model of the photographs of a database, where their cameras are known to stand."""
    model = engine.Reconstruction()
    opened = engine.Database.open(database)
    try:
        for camera in opened.read_all_cameras():
            model.add_camera_with_trivial_rig(camera)
        for image in opened.read_all_images():
            pose = engine.Rigid3d(np.ascontiguousarray(poses[unquote(image.name)][:3]))
            new = engine.Image(name=image.name, camera_id=image.camera_id, image_id=image.image_id)
            model.add_image_with_trivial_frame(new, pose)
    finally:
        opened.close()
    return model


def _camera(shot: RawImage, size: tuple[int, int]) -> Any:
    """The camera of a photograph of a size, or BadInput where these do not fit."""
    check_camera(shot.camera, shot.name)
    check_size(shot, photo_size(shot.path))
    lens = shot.camera
    made = load_engine().Camera(model=lens.model.name, width=lens.width, height=lens.height, params=list(lens.params))
    made.rescale(*size)
    made.has_prior_focal_length = True
    return made


def _offset(capture: RawDataset) -> np.ndarray:
    """(3,) what coordinates of the model leave out."""
    if capture.shift is not None:
        return np.array(capture.shift, np.float64)
    frame = Frame.around(np.stack([shot.pose for shot in capture.shots]), capture.xyz)
    return np.array(frame.shift, np.float64)


def _moved(pose: np.ndarray, offset: np.ndarray) -> np.ndarray:
    """(4, 4) world_to_camera in coordinates that leave an offset out."""
    new = pose.copy()
    new[:3, 3] += new[:3, :3] @ offset
    return new
