"""Surveyed places, marks and positions in a bundle adjustment, as observations of cameras that nobody has.

pycolmap's bundle adjustment knows photographs only. So a surveyed place is what two cameras far away see that do not
move: one looks down, one to the north, with focal lengths by which one pixel is one standard deviation. The position of
a photograph is that of a point which such cameras see, and which two sensors that are fixed to the photograph's
camera see in its centre. All of that is in one least squares problem with the tie points, weighed by their errors.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from surfkit.apps.sfm.engine import load_engine, run
from surfkit.apps.sfm.focal import add_marks

FAR_EXTENTS = 1e6
"""Distance of cameras that see surveyed places, in extents of the survey: perspective bends less than 1e-6 of that."""
CENTRE_SIGMA_M = 0.001
"""Standard deviation by which the point that stands for a camera is in its centre."""
CENTRE_DISTANCE_M = 100.0
"""How far behind it the sensors are that see it there."""
SIGMA_STEP = 1.05
"""Standard deviations of positions are rounded to powers of it, so that those alike share two cameras."""
BLACK = np.zeros(3, np.uint8)
SOUTH, ABOVE = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]), np.diag([1.0, -1, -1])
"""Turns of cameras that look to the north and down: rows are right, down and forward on the map."""


@dataclass(frozen=True)
class SurveyedPoint:
    """A place that was surveyed, or that is marked only.

    Attributes:
        start: (3,) where it is about, on the map.
        place: (3,) where it was surveyed; None says nothing of that.
        sigma: (3,) standard deviations of that, units of the map.
        marks: By name of the photograph, the pixel.
    """

    start: np.ndarray
    place: np.ndarray | None
    sigma: np.ndarray
    marks: Mapping[str, tuple[float, float]]


@dataclass(frozen=True)
class CameraPositions:
    """Positions of photographs.

    Attributes:
        names: Of the photographs.
        onto: (P, 3) on the map.
        sigma: (P, 3) standard deviations, units of the map.
    """

    names: Sequence[str]
    onto: np.ndarray
    sigma: np.ndarray


@dataclass(frozen=True)
class Weights:
    """How exact observations are.

    Attributes:
        tie: Standard deviation of a coordinate of tie points in photographs, pixels.
        mark: That of marks; it acts in whole repetitions of a mark, one at least: a mark weighs no less than a tie
            point.
        metres: Per unit of the map.
        focals: Pixels and standard deviation as a share, by number of the camera.
    """

    tie: float
    mark: float
    metres: float
    focals: Mapping[int, tuple[float, float]]

    @property
    def copies(self) -> int:
        """How often a mark counts."""
        return max(1, round((self.tie / self.mark) ** 2))


@dataclass(frozen=True)
class Adjusted:
    """What an adjustment came to.

    Attributes:
        model: pycolmap.Reconstruction, with what was added.
        chi2: Weighted sum of squares; differences of two of them are those of a chi-square test.
        usable: Whether it converged.
    """

    model: Any
    chi2: float
    usable: bool


def adjust_together(
    model: Any, points: Sequence[SurveyedPoint], positions: CameraPositions | None, weights: Weights
) -> Adjusted:
    """Bundle adjustment of a pycolmap.Reconstruction on the map, which is not changed, with all that is given."""
    engine = load_engine()
    new, config = engine.Reconstruction(model), engine.BundleAdjustmentConfig()
    for number in new.reg_image_ids():
        config.add_image(number)
    add_marks(new, config, {number: (focal, share / weights.tie) for number, (focal, share) in weights.focals.items()})
    extra = _Extra(engine, new, config, weights, {image.name: image.image_id for image in model.images.values()})
    extra.add_points(points)
    if positions is not None:
        extra.add_positions(positions)
    options = engine.BundleAdjustmentOptions()
    options.print_summary = False
    options.refine_sensor_from_rig = False
    ceres = options.ceres
    ceres.solver_options.num_threads = 1  # several add up in another order each time, and come to other bits
    few = model.num_reg_images() <= ceres.max_num_images_direct_dense_cpu_solver
    if model.num_reg_images() <= ceres.max_num_images_direct_sparse_cpu_solver:  # our cameras count as photographs
        ceres.auto_select_solver_type = False
        kinds = type(ceres.solver_options.linear_solver_type)
        ceres.solver_options.linear_solver_type = kinds.DENSE_SCHUR if few else kinds.SPARSE_SCHUR
    adjuster = engine.create_default_bundle_adjuster(options, config, new)
    summary = run("adjusting cameras to control points", lambda _: adjuster.solve())
    cost = 2 * float(summary.ceres_summary.final_cost) / weights.tie**2
    return Adjusted(new, cost, bool(summary.is_solution_usable()))


class _Extra:
    """Adds cameras, photographs and points to a reconstruction and to what is adjusted."""

    def __init__(self, engine: Any, model: Any, config: Any, weights: Weights, names: Mapping[str, int]) -> None:
        self.engine, self.model, self.config, self.weights, self.names = engine, model, config, weights, names
        self.sensors: dict[int, list[int]] = {}

    def add_points(self, points: Sequence[SurveyedPoint]) -> None:
        """Points that photographs show, each mark as often as it counts."""
        tracks = []
        for point in points:
            track = self.engine.Track()
            for name, pixel in point.marks.items():
                image = self.model.image(self.names[name])
                for _ in range(self.weights.copies):
                    image.points2D.append(self.engine.Point2D(np.array(pixel, np.float64)))
                    track.add_element(image.image_id, image.num_points2D() - 1)
            tracks.append(track)
        surveyed = [at for at, point in enumerate(points) if point.place is not None]
        sigma = np.array([points[at].sigma for at in surveyed]).reshape(-1, 3)
        self._see(
            [tracks[at] for at in surveyed], np.array([points[at].place for at in surveyed]).reshape(-1, 3), sigma
        )
        for point, track in zip(points, tracks, strict=True):
            self.model.add_point3D(np.asarray(point.start, np.float64), track, BLACK)

    def add_positions(self, positions: CameraPositions) -> None:
        """Positions of photographs, by a point in the centre of each."""
        tracks, centres = [], []
        for name in positions.names:
            image = self.model.image(self.names[name])
            track = self.engine.Track()
            for camera in self._centre_sensors(image):
                seen = self.engine.Image(
                    name=f"centre {camera} {name}",
                    keypoints=np.zeros((1, 2)),
                    camera_id=camera,
                    image_id=max(self.model.images) + 1,
                )
                self.model.frames[image.frame_id].add_data_id(seen.data_id)
                seen.frame_id = image.frame_id
                self.model.add_image(seen)
                self.config.add_image(seen.image_id)
                track.add_element(seen.image_id, 0)
            tracks.append(track)
            centres.append(np.array(image.projection_center()))
        self._see(tracks, positions.onto, SIGMA_STEP ** np.round(np.log(positions.sigma) / math.log(SIGMA_STEP)))
        for centre, track in zip(centres, tracks, strict=True):
            self.model.add_point3D(centre, track, BLACK)

    def _centre_sensors(self, image: Any) -> list[int]:
        """Cameras of two sensors of a photograph's rig that look, along two axes, at the centre of its camera."""
        number = image.camera_id
        if number not in self.sensors:
            distance = CENTRE_DISTANCE_M / self.weights.metres
            focal = distance * self.weights.tie / (CENTRE_SIGMA_M / self.weights.metres)
            rig = self.model.rigs[image.frame.rig_id]
            own = image.cam_from_world() * image.frame.rig_from_world.inverse()
            self.sensors[number] = []
            for turn in (np.eye(3), SOUTH):
                camera = self._camera((focal, focal))
                pose = self.engine.Rigid3d(self.engine.Rotation3d(turn), np.array([0, 0, distance])) * own
                rig.add_sensor(self.model.cameras[camera].sensor_id, pose)
                self.sensors[number].append(camera)
        return self.sensors[number]

    def _see(self, tracks: Sequence[Any], places: np.ndarray, sigma: np.ndarray) -> None:
        """Let cameras far away see (K, 3) places, with (K, 3) standard deviations, as points with these tracks."""
        if not len(places):
            return
        middle = places.mean(0)
        distance = FAR_EXTENTS * max(float(np.abs(places - middle).max()), float(sigma.max()), 1.0)
        for row in np.unique(sigma, axis=0):
            same = np.flatnonzero((sigma == row).all(1))
            for turn, (across, down) in ((ABOVE, (row[0], row[1])), (SOUTH, (np.inf, row[2]))):
                scale = distance * self.weights.tie
                focal = np.array([scale / across if np.isfinite(across) else 1e-6 * scale / down, scale / down])
                pose = self.engine.Rigid3d(self.engine.Rotation3d(turn), np.array([0, 0, distance]) - turn @ middle)
                ray = (places[same] - middle) @ turn.T + (0, 0, distance)
                image = self._fixed(focal, pose, ray[:, :2] / ray[:, 2:] * focal)
                for at, row_at in enumerate(same.tolist()):
                    tracks[row_at].add_element(image, at)

    def _camera(self, focal: Sequence[float] | np.ndarray) -> int:
        number = max(self.model.cameras) + 1
        params = [*map(float, focal), 0.0, 0.0]
        self.model.add_camera(self.engine.Camera(model="PINHOLE", width=1, height=1, params=params, camera_id=number))
        self.config.set_constant_cam_intrinsics(number)
        return number

    def _fixed(self, focal: np.ndarray, pose: Any, pixels: np.ndarray) -> int:
        """The number of an image of a camera that does not move."""
        camera = self._camera(focal)
        rig = self.engine.Rig(rig_id=max(self.model.rigs) + 1)
        rig.add_ref_sensor(self.model.cameras[camera].sensor_id)
        self.model.add_rig(rig)
        number = max(self.model.images) + 1
        image = self.engine.Image(name=f"survey {number}", keypoints=pixels, camera_id=camera, image_id=number)
        frame = self.engine.Frame(rig_id=rig.rig_id, frame_id=max(self.model.frames) + 1)
        frame.add_data_id(image.data_id)
        frame.rig_from_world = pose
        self.model.add_frame(frame)
        image.frame_id = frame.frame_id
        self.model.add_image(image)
        self.model.register_frame(frame.frame_id)
        self.config.add_image(number)
        self.config.set_constant_rig_from_world_pose(frame.frame_id)
        return number
