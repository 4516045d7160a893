"""What EXIF says of the focal length, as strong as that is: nadir photographs alone cannot tell it from the height.

Seen straight down, a scene twice as high through a lens twice as long gives the same pictures. So bundle adjustment
takes the focal length of EXIF for a measurement with a standard deviation: photographs that look in several directions
outweigh it, others do not.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from surfkit.apps.sfm.engine import load_engine
from surfkit.apps.sfm.inspect_photos import Photo

EXIF_FOCAL_SIGMA = 0.03
"""Standard deviation of the focal length of EXIF, as a share: it is rounded, and lenses differ by some percent."""
HELD_FOCAL_SIGMA = 0.001
"""The same where photographs, which cannot tell it, contradict it. Photographs that all look the same way put errors of
other kinds, such as those of a lens with more terms, into the focal length, by tens of per cent and more than their own
standard deviation says; and heights above the ground are as wrong as it is."""
PHOTOGRAMMETRIC_FOCAL_SIGMA = 0.1
"""That of the focal length by photographs alone, where EXIF has none and positions are weighed against it."""
CONTRADICTION_SIGMAS = 3.0
"""From so many standard deviations on, two sources contradict each other."""
EXIF_OBSERVATIONS = 64
"""Observations that stand for the focal length of EXIF: many near the axis, where no distortion bends them."""
MIN_HEIGHT_SPREAD = 0.02
"""Cameras whose heights, less a plane, spread by less than this share of their height above the ground say nothing of
the focal length: bundle adjustment bends a model by up to a tenth of it."""
SAMPLED_CAMERAS = 100
"""Cameras that tell how far away the ground is."""
MAX_START_RATIO = 0.15
"""Share by which heights above the ground and above the start may differ without a word."""
MAX_PARALLEL_SINE = 0.06
"""Root mean square of the sines between the axes of photographs, below which all look the same way."""


@dataclass(frozen=True)
class Focal:
    """The focal length of a lens from three sources, pixels, the mean of both axes.

    Attributes:
        exif: In EXIF; None where it has none.
        alone: By the photographs alone.
        final: By photographs, EXIF and positions together.
        photographs: That were taken with it.
        held: Whether that in EXIF was held.
    """

    exif: float | None
    alone: float
    final: float
    photographs: int
    held: bool = False

    @property
    def contradicts(self) -> bool:
        """Whether the photographs say, beyond doubt, something else than EXIF.

        The weighted mean of two measurements moves away from the first by (alone - exif) s^2 / (s^2 + t^2), with s and
        t their standard deviations. So the product below is (alone - exif)^2 / (s^2 + t^2), without knowing t.
        """
        if self.exif is None:
            return False
        if self.held:
            return True
        alone, final = self.alone / self.exif - 1, self.final / self.exif - 1
        return (
            alone * final > (CONTRADICTION_SIGMAS * EXIF_FOCAL_SIGMA) ** 2
            or abs(final) > CONTRADICTION_SIGMAS * EXIF_FOCAL_SIGMA
        )

    @property
    def drifts(self) -> bool:
        """Whether, without EXIF, positions draw it so far that the photographs cannot know it."""
        return self.exif is None and abs(self.final / self.alone - 1) > CONTRADICTION_SIGMAS * EXIF_FOCAL_SIGMA


def exif_focals(model: Any, photos: Mapping[str, Photo]) -> dict[int, float]:
    """The focal length in EXIF of each placed camera of a pycolmap.Reconstruction, pixels, by its number."""
    found: dict[int, float] = {}
    for number in model.reg_image_ids():
        image = model.image(number)
        if (focal := photos[image.name].exif.focal_px) is not None:
            found.setdefault(image.camera_id, focal)
    return found


def known_focals(model: Any, photos: Mapping[str, Photo], alone: bool) -> dict[int, tuple[float, float]]:
    """What is known of the focal length of cameras: pixels, and the standard deviation as a share, by number.

    Args:
        model: pycolmap.Reconstruction.
        photos: By name.
        alone: Whether that of the model is taken where EXIF has none.
    """
    own = {
        number: (camera.mean_focal_length(), PHOTOGRAMMETRIC_FOCAL_SIGMA)
        for number, camera in model.cameras.items()
        if alone
    }
    held = {model.image(n).camera_id for n in model.reg_image_ids() if photos[model.image(n).name].exif.is_focal_held}
    return own | {
        number: (focal, HELD_FOCAL_SIGMA if number in held else EXIF_FOCAL_SIGMA)
        for number, focal in exif_focals(model, photos).items()
    }


def with_focals_held(photos: Mapping[str, Photo]) -> dict[str, Photo]:
    """The same photographs, whose focal lengths in EXIF are not to be changed."""
    return {name: replace(photo, exif=replace(photo.exif, is_focal_held=True)) for name, photo in photos.items()}


def add_marks(model: Any, config: Any, focals: Mapping[int, tuple[float, float]]) -> None:
    """Add to a reconstruction, and to what is adjusted, observations that stand for known focal lengths.

    For each lens this is an image and points that do not move, at a small angle t from its axis, with the place in the
    image that the focal length f of EXIF gives them. Their residuals are (focal length - f) t pixels; t is such that
    all of a lens together weigh as one measurement of f with its standard deviation, as pixels have one of 1.
    """
    engine = load_engine()
    images = [model.image(number) for number in model.reg_image_ids()]
    number = max(model.images) + 1
    for camera_id, (focal, sigma) in sorted(focals.items()):
        camera = model.cameras[camera_id]
        one = next((image for image in images if image.camera_id == camera_id), None)
        if one is None:
            continue
        pose, depth = one.cam_from_world(), max(_depth(model, one), 1e-9)
        axes = np.eye(2)[: len(camera.focal_length_idxs())]  # one focal length stands for both
        t = 1 / (sigma * focal * np.sqrt(EXIF_OBSERVATIONS))
        rays = np.repeat(axes * t, EXIF_OBSERVATIONS // 2 // len(axes), 0)
        pixels = np.repeat(rays, 2, 0) * focal + (camera.principal_point_x, camera.principal_point_y)
        image = engine.Image(name=f"focal length {camera_id}", keypoints=pixels, camera_id=camera_id, image_id=number)
        frame = engine.Frame(rig_id=one.frame.rig_id, frame_id=max(model.frames) + 1)
        frame.add_data_id(image.data_id)
        frame.rig_from_world = pose
        model.add_frame(frame)
        image.frame_id = frame.frame_id
        model.add_image(image)
        model.register_frame(frame.frame_id)
        places = np.column_stack([rays, np.ones(len(rays))]) * depth
        for at, xyz in enumerate(pose.inverse() * places):
            track = engine.Track()
            for mark in (2 * at, 2 * at + 1):  # bundle adjustment wants two of each point
                track.add_element(number, mark)
            config.add_constant_point(model.add_point3D(xyz, track, np.zeros(3, np.uint8)))
        config.add_image(number)
        config.set_constant_rig_from_world_pose(frame.frame_id)
        number += 1


def _depth(model: Any, image: Any) -> float:
    """Median depth of the points that a photograph shows."""
    xyz = np.array([model.points3D[spot.point3D_id].xyz for spot in image.get_observation_points2D()]).reshape(-1, 3)
    return float(np.median((image.cam_from_world() * xyz)[:, 2])) if len(xyz) else 1.0


@dataclass(frozen=True)
class Weighed:
    """What became of focal lengths and heights when EXIF and positions were weighed against the photographs.

    Attributes:
        focals: Of each lens, that of most photographs first.
        heights: How many times as high the cameras are above the ground as by the photographs alone.
        parallel: Whether all photographs look the same way.
        stretch: How many times as much the heights of the positions differ as those of the cameras, and the standard
            deviation of that number; None without positions, or where these cannot tell.
        above_ground: Median height of the cameras above the ground, metres; None without a scale.
        above_start: The same above the place of the start, by XMP; None where it does not say.
    """

    focals: tuple[Focal, ...]
    heights: float
    parallel: bool
    stretch: tuple[float, float] | None = None
    above_ground: float | None = None
    above_start: float | None = None

    def facts(self) -> dict[str, Any]:
        """For the report."""
        return {
            "focal_lengths_px": [
                {
                    "exif": f.exif,
                    "photographs_alone": f.alone,
                    "final": f.final,
                    "photographs": f.photographs,
                    "held": f.held,
                }
                for f in self.focals
            ],
            "cameras_above_ground_m": self.above_ground and round(self.above_ground, 2),
            "cameras_above_start_m": self.above_start and round(self.above_start, 2),
            "heights_times": round(self.heights, 3),
            "gps_heights_times": None if self.stretch is None else [round(value, 3) for value in self.stretch],
        }

    def doubts(self) -> list[str]:
        """What contradicts each other, or is known from one source only, a line for each."""
        found = []
        for focal in self.focals:
            if focal.drifts:
                found.append(
                    f"EXIF of {focal.photographs} photographs has no focal length; the positions move that by the "
                    f"photographs alone from {focal.alone:.0f} to {focal.final:.0f} px, and heights above the ground "
                    f"{self.heights:.2f} times: write the focal length into EXIF, add oblique photographs, or check "
                    "heights with --gcp"
                )
            if focal.exif is not None and focal.contradicts:
                why = ", as all photographs look the same way and cannot tell it" if focal.held else ""
                found.append(
                    f"the focal length in EXIF of {focal.photographs} photographs is {focal.exif:.0f} px, that by the "
                    f"photographs alone {focal.alone:.0f} px ({focal.alone / focal.exif - 1:+.0%}; EXIF is taken to be "
                    f"within {CONTRADICTION_SIGMAS * EXIF_FOCAL_SIGMA:.0%}); {focal.final:.0f} px are used{why}. If "
                    f"photographs were cropped or EXIF "
                    "is wrong, remove the focal length from EXIF; otherwise try --lens OPENCV"
                )
        if self.above_ground is not None and self.above_start is not None and self.parallel:
            ratio = self.above_ground / max(self.above_start, 1e-9)
            if abs(ratio - 1) > MAX_START_RATIO:
                found.append(
                    f"the cameras are {self.above_ground:.1f} m above the ground, and by XMP {self.above_start:.1f} m "
                    "above the start: if the ground is as high as the start, the focal length is wrong, and heights "
                    f"are {ratio:.2f} times what they should be; check them with --gcp"
                )
        if self.stretch is not None and self.contradicts:
            found.append(
                f"heights by GPS differ {self.stretch[0]:.3g} +- {self.stretch[1]:.1g} times as much as those of the "
                "cameras that were found: the focal length is wrong, and heights of the ground with it, or the "
                "altitudes are; check the focal length in EXIF, add oblique photographs, or give --gcp"
            )
        if self.parallel and not self.knows_heights and not any(focal.contradicts for focal in self.focals):
            has = self.focals[0].exif is not None
            by = f"known from EXIF only, to {EXIF_FOCAL_SIGMA:.0%}" if has else "a guess, as EXIF has none"
            found.append(
                f"all photographs look the same way, so that they do not tell the focal length: it is {by}, and "
                "heights above the ground are as exact as it is; add oblique photographs, or check heights with --gcp"
            )
        return found

    @property
    def contradicts(self) -> bool:
        """Whether heights by GPS contradict those of the cameras, by more than chance and by more than matters."""
        return self.stretch is not None and abs(self.stretch[0] - 1) > max(
            CONTRADICTION_SIGMAS * self.stretch[1], EXIF_FOCAL_SIGMA
        )

    @property
    def knows_heights(self) -> bool:
        """Whether the heights of positions tell the focal length as well as EXIF does."""
        return self.stretch is not None and self.stretch[1] < EXIF_FOCAL_SIGMA


def weighed(
    alone: Any,
    final: Any,
    photos: Mapping[str, Photo],
    stretch: tuple[float, float] | None,
    metres: float | None = None,
) -> Weighed:
    """What became of a model.

    Args:
        alone: pycolmap.Reconstruction by the photographs alone.
        final: The same in the end.
        photos: By name.
        stretch: As `height_stretch` gives it.
        metres: In a unit of the final one; None where it has no scale.
    """
    counts = Counter(final.image(number).camera_id for number in final.reg_image_ids())
    known = exif_focals(final, photos)
    before, after = alone.cameras, final.cameras
    placed = [final.image(number) for number in final.reg_image_ids()]
    held = {image.camera_id for image in placed if photos[image.name].exif.is_focal_held}
    focals = [
        Focal(known.get(at), before[at].mean_focal_length(), after[at].mean_focal_length(), count, at in held)
        for at, count in counts.most_common()
    ]
    starts = [photos[image.name].exif.above_start for image in placed]
    above = [start for start in starts if start is not None]
    heights = _relative_height(final) / max(_relative_height(alone), 1e-9)
    axes = np.stack([final.image(number).cam_from_world().matrix()[2, :3] for number in final.reg_image_ids()])
    middle = axes.mean(0)
    sines = np.linalg.norm(np.cross(axes, middle / max(np.linalg.norm(middle), 1e-9)), axis=1)
    return Weighed(
        tuple(focals), heights, bool(np.sqrt((sines**2).mean()) < MAX_PARALLEL_SINE), stretch,
        None if metres is None else metres * height_above_ground(final), float(np.median(above)) if above else None,
    )  # fmt: skip


def height_stretch(
    placed: np.ndarray, onto: np.ndarray, sigma: np.ndarray, ground: float
) -> tuple[float, float] | None:
    """How many times as much the heights of positions differ as those of cameras, and the standard deviation of that
    number; None where all heights are as good as equal.

    A model with a wrong focal length is too high or too low. That shows in the heights of its cameras, unless these
    follow a plane, which a turn of the model takes for level.

    Args:
        placed: (P, 3) of the cameras, on the map.
        onto: (P, 3) of their positions.
        sigma: (P,) standard deviations of their heights.
        ground: Median height of the cameras above it.
    """
    plane = np.column_stack([np.ones(len(placed)), placed[:, :2] - placed[:, :2].mean(0)]) / sigma[:, None]
    both = np.column_stack([placed[:, 2], onto[:, 2]]) / sigma[:, None]
    ours, theirs = (both - plane @ np.linalg.lstsq(plane, both, rcond=None)[0]).T
    spread = np.sqrt((ours**2).sum() / (1 / sigma**2).sum())
    if len(placed) <= plane.shape[1] + 1 or not spread > MIN_HEIGHT_SPREAD * ground:
        return None
    return float(ours @ theirs / (ours @ ours)), float(1 / np.sqrt(ours @ ours))


def height_above_ground(model: Any) -> float:
    """Median distance of the ground from the cameras, by some of them that are spread over all."""
    numbers = sorted(model.reg_image_ids())
    some = numbers[:: -(-len(numbers) // SAMPLED_CAMERAS)]
    return float(np.median([_depth(model, model.image(number)) for number in some]))


def _relative_height(model: Any) -> float:
    """The same, as a share of how far the cameras are apart."""
    images = [model.image(number) for number in model.reg_image_ids()]
    centres = np.stack([image.projection_center() for image in images])
    apart = float(np.sqrt(((centres - centres.mean(0)) ** 2).sum(1).mean()))
    return height_above_ground(model) / max(apart, 1e-9)
