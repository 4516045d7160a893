"""Bundle adjustment with ground control points: tie points, marks, surveyed places, positions of the photographs and
focal lengths in one least squares problem, and which of the points contradict it.

A point is wrong where the sum of squares falls by far more than chance without its surveyed place (data snooping;
Baarda, 1968); its marks, which agree with each other, stay. Positions of photographs keep the block in shape. They do
not place it: a receiver is off by a metre or more as a whole, and counts heights from elsewhere. So their mean
difference from the cameras that control points place is taken away.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from surfkit.apps.sfm.bundle_adjustment import MAX_ERROR_RATIO, mean_error, taken_over
from surfkit.apps.sfm.control_list import MIN_CONTROL_POINTS, GroundControl
from surfkit.apps.sfm.control_marks import WrongMark, images_of, located, size_ratio, triangulate, without_wrong_marks
from surfkit.apps.sfm.engine import load_engine
from surfkit.apps.sfm.focal import known_focals
from surfkit.apps.sfm.georeference import NEAR_M, MapProjection, NoSimilarity, centres_of, place
from surfkit.apps.sfm.ground_control import ControlResiduals
from surfkit.apps.sfm.inspect_photos import Photo
from surfkit.apps.sfm.mapping import read_model
from surfkit.apps.sfm.settings import Settings
from surfkit.apps.sfm.similarity import MIN_AGREEING_POSITIONS
from surfkit.apps.sfm.survey_observations import Adjusted, CameraPositions, SurveyedPoint, Weights, adjust_together
from surfkit.core.check import BadInput, few
from surfkit.core.codec import load, read_json, write_json
from surfkit.core.files import replacing_folder

CACHE_VERSION = "1"
"""Changes when the same model would be adjusted otherwise."""
MAX_CHI2 = 25.0
"""By which the sum of squares may fall without a surveyed place: that of chance falls by more in 1 of 60,000 cases."""
RMS_FACTOR = 3.0
"""A surveyed place is wrong only where it is off by so many times as much as the others, each against how exactly its
marks tell where it is: what a lens does beyond its model shows in all of them."""
MAX_ADJUSTMENTS = 12
"""To find wrong points: each takes one."""
MIN_TIE_SIGMA = 0.05
"""No tie point is more exact, pixels."""
MAX_MARK_SIGMA_PX = 30.0
"""Nobody marks a point so inaccurately: farther off, it is another point."""
MEAN_OF_RAYLEIGH = math.sqrt(math.pi / 2)
"""Mean length of residuals whose two coordinates have a standard deviation of 1."""


@dataclass(frozen=True)
class Outcome:
    """What an adjustment found out, beside the model.

    Attributes:
        control: Names of the points whose surveyed places are part of it.
        wrong: Names of those whose are not.
        wrong_marks: Marks that are not part of it.
        facts: For the report.
    """

    control: tuple[str, ...]
    wrong: tuple[str, ...]
    wrong_marks: tuple[WrongMark, ...]
    facts: dict[str, Any]


def tie_sigma(model: Any) -> float:
    """Standard deviation of a coordinate of the tie points of a pycolmap.Reconstruction, pixels, by its residuals."""
    count = model.compute_num_observations()
    free = 2 * count - 3 * model.num_points3D() - 6 * model.num_reg_images()
    return max(mean_error(model) / MEAN_OF_RAYLEIGH * math.sqrt(2 * count / max(free, count / 2)), MIN_TIE_SIGMA)


def clean_marks(model: Any, ground: GroundControl, settings: Settings) -> tuple[GroundControl, list[WrongMark]]:
    """The points without marks that contradict the others of their point in a model, and these marks.

    Raises:
        BadInput: The marks are those of photographs of another size.
    """
    sigma, images = float(np.hypot(settings.mark_sigma, tie_sigma(model))), images_of(model)
    if (ratio := size_ratio(images, ground.points)) is not None:
        width, height = max((image.camera.width, image.camera.height) for image in images.values())
        raise BadInput(
            f"--gcp {settings.gcp}: its pixels fit photographs of about {ratio * width:.0f} x {ratio * height:.0f}, "
            f"and those of the folder have {width} x {height}; were they resized? Multiply the pixels by "
            f"{1 / ratio:.4g}, or prepare the photographs in which the points were marked"
        )
    points, wrong = without_wrong_marks(images, ground.points, sigma)
    return replace(ground, points=points), wrong


def said_of(wrong: Sequence[WrongMark]) -> str:
    """Which points have marks that contradict the others, as the end of a message; nothing where none has.

    Pairs that contradict each other by little may be as good as their marks are; one mark against others is a mistake.
    """
    if not wrong:
        return ""
    names = list(dict.fromkeys(mark.point for mark in wrong))
    away = [mark.pixels for mark in wrong if mark.pixels is not None and not mark.certain]
    sigma = float(np.median(away)) if away else math.inf
    less = f"; if they are no more accurate, add --mark-sigma {sigma:.2g}" if sigma <= MAX_MARK_SIGMA_PX else ""
    return f". Marks that contradict each other are left out of {few(names)}{less}"


def adjust_to_points_once(
    model: Any,
    where: ControlResiduals,
    ground: GroundControl,
    photos: Mapping[str, Photo],
    settings: Settings,
    folder: Path,
) -> tuple[Any | None, ControlResiduals]:
    """What `adjust_to_points` gives, from the folder where an earlier call has kept it for the same of all."""
    cameras = [list(camera.params) for camera in model.cameras.values()], model.num_points3D(), centres_of(model)
    listed = [(point, row) for point, row in zip(ground.points, ground.onto.tolist(), strict=True)]
    exif = [(name, photo.exif) for name, photo in sorted(photos.items())]
    key = hashlib.sha256(repr([CACHE_VERSION, settings, cameras, listed, where, exif]).encode()).hexdigest()[:24]
    record = folder / "adjusted.json"
    if record.is_file() and (kept := read_json(record, dict[str, Any])).get("key") == key:
        found = read_model(folder) if (folder / "images.bin").is_file() else None
        return found, _told(found or model, where, ground, load(Outcome, kept["outcome"]))
    found, outcome = adjust_to_points(model, where, ground, photos, settings)
    with replacing_folder(folder) as made:
        if found is not None:
            found.write_binary(made)
        write_json(made / record.name, {"key": key, "outcome": outcome})
    return found, _told(found or model, where, ground, outcome)


def adjust_to_points(
    model: Any, where: ControlResiduals, ground: GroundControl, photos: Mapping[str, Photo], settings: Settings
) -> tuple[Any | None, Outcome]:
    """A model adjusted to control points, and what that found out; None for one that does not converge, or fits the
    photographs far worse.

    Args:
        model: pycolmap.Reconstruction on the map; it is not changed.
        where: Which points are control, by the similarity.
        ground: The points, without wrong marks.
        photos: By name.
        settings: For standard deviations, and whether positions are used.
    """
    tie = tie_sigma(model)
    weights = Weights(tie, settings.mark_sigma, ground.chart.metres, known_focals(model, photos, True))
    block = _Block(model, ground, weights, settings, list(where.control), list(where.wrong), {*where.checkpoints})
    said: str | None = "--no-gps"
    block.solve()
    if settings.gps and block.last.usable:
        said = block.take_positions(photos)
        block.solve()
    marks = block.drop_marks()
    if block.last.usable:
        block.readmit()
        block.leave_out()
    found = taken_over(load_engine(), model, block.last.model)
    good = block.last.usable and mean_error(found) <= MAX_ERROR_RATIO * mean_error(load_engine().Reconstruction(model))
    facts = {
        "kept": good,
        "tie_sigma_px": round(tie, 3),
        "mark_sigma_px": round(tie / math.sqrt(weights.copies), 3),
        "positions": 0 if block.positions is None else len(block.positions.names),
        "no_positions": said,
        "positions_offset_m": None if block.offset is None else [round(float(v), 3) for v in block.offset],
        "adjustments": block.count,
    }
    if not good:
        return None, Outcome(where.control, where.wrong, tuple(marks), facts)
    return found, Outcome(tuple(block.inside), tuple(block.outside), tuple(marks), facts)


def _told(model: Any, where: ControlResiduals, ground: GroundControl, outcome: Outcome) -> ControlResiduals:
    """The points as the adjustment left them, with residuals in the model."""
    gone = {(mark.point, mark.photograph) for mark in outcome.wrong_marks}
    points = [
        replace(p, marks={name: at for name, at in p.marks.items() if (p.name, name) not in gone})
        for p in ground.points
    ]
    new = replace(where, wrong_marks=where.wrong_marks + outcome.wrong_marks, adjustment=outcome.facts)
    new = new.measured(images_of(model), replace(ground, points=points))
    there = new.residuals
    return replace(
        new,
        control=tuple(name for name in outcome.control if name in there),
        wrong=tuple(name for name in outcome.wrong if name in there),
        checkpoints=tuple(name for name in where.checkpoints if name in there),
        unseen=tuple(point.name for point in points if point.name not in there),
    )


@dataclass(frozen=True)
class _Off:
    """How far a surveyed place is from its point in a model: metres, and squared in standard deviations of both."""

    metres: float
    chi2: float


class _Block:
    """A model that is adjusted again and again, and the points that are part of it."""

    def __init__(
        self,
        model: Any,
        ground: GroundControl,
        weights: Weights,
        settings: Settings,
        inside: list[str],
        outside: list[str],
        checkpoints: set[str],
    ) -> None:
        self.model, self.ground, self.weights, self.settings = model, ground, weights, settings
        self.inside, self.outside, self.checkpoints = inside, outside, checkpoints
        self.positions: CameraPositions | None = None
        self.offset: np.ndarray | None = None
        self.count = 0
        self.last: Adjusted
        up = settings.gcp_sigma if settings.gcp_sigma_up is None else settings.gcp_sigma_up
        self._sigma = np.array([settings.gcp_sigma, settings.gcp_sigma, up]) / weights.metres

    def solve(self) -> None:
        """Adjust with the points inside."""
        self.last = self._solved(self.inside)
        if self.last.usable:  # what follows begins near its end
            self.model = self._adjusted()

    def take_positions(self, photos: Mapping[str, Photo]) -> str | None:
        """Take positions of photographs, less their mean difference from the cameras; why not, where not."""
        signed = [photo for photo in photos.values() if not photo.exif.unsigned]
        metres = self.ground.chart.metres
        found = positions_of(self._adjusted(), signed, self.ground.chart, self.settings.seed)
        if isinstance(found, NoSimilarity):
            return found.reason
        self.positions, offset = found
        self.offset = offset * metres
        return None

    def drop_marks(self) -> list[WrongMark]:
        """Leave out marks that contradict the adjusted cameras, and adjust again if there are some; none where too few
        points would be left."""
        ground, wrong = clean_marks(self._adjusted(), self.ground, self.settings)
        before, self.ground = self.ground, ground
        seen = {name for name, *_ in self._points(())}
        inside = [name for name in self.inside if name in seen]
        if not wrong or not self.last.usable or len(inside) < MIN_CONTROL_POINTS:
            self.ground = before
            return []
        self.inside, self.outside = inside, [name for name in self.outside if name in seen]
        self.solve()
        return wrong

    def readmit(self) -> None:
        """Take in the surveyed places that the similarity did not fit, one after the other, while they fit now."""
        while self.outside and self.count < MAX_ADJUSTMENTS:
            off = self._off()
            name = min(self.outside, key=lambda one: off[one].chi2)
            trial = self._solved([*self.inside, name])
            if not trial.usable or self._is_wrong(name, trial.chi2 - self.last.chi2, off):
                return
            self.inside, self.outside = [*self.inside, name], [one for one in self.outside if one != name]
            self.last = trial

    def leave_out(self) -> None:
        """Leave out surveyed places that contradict the rest, that which is off most first."""
        while len(self.inside) > MIN_AGREEING_POSITIONS and self.count < MAX_ADJUSTMENTS:
            off = self._off()
            name = max(self.inside, key=lambda one: off[one].chi2)
            before, self.last = self.last, self._solved([one for one in self.inside if one != name])
            if not self.last.usable or not self._is_wrong(name, before.chi2 - self.last.chi2, self._off()):
                self.last = before
                return
            self.inside, self.outside = [one for one in self.inside if one != name], [*self.outside, name]

    def _is_wrong(self, name: str, chi2: float, off: Mapping[str, _Off]) -> bool:
        """Whether a point contradicts, by the difference of the sums of squares with and without its place, and by how
        far it and the others are off without it."""
        others = float(np.mean([off[one].chi2 for one in self.inside if one != name]))
        far = off[name].metres > NEAR_M / 2 and off[name].chi2 > max(MAX_CHI2, RMS_FACTOR**2 * others)
        return far and chi2 > MAX_CHI2

    def _solved(self, inside: Sequence[str]) -> Adjusted:
        self.count += 1
        points = [
            SurveyedPoint(xyz, onto if name in inside else None, self._sigma, marks)
            for name, xyz, onto, marks in self._points(self.checkpoints)
        ]
        return adjust_together(self.model, points, self.positions, self.weights)

    def _points(self, but: Sequence[str] | set[str]) -> list[tuple[str, np.ndarray, np.ndarray, dict[str, Any]]]:
        """Name, place in the model, surveyed place and marks of each point that placed photographs show."""
        images, found = images_of(self.model), []
        for point, onto in zip(self.ground.points, self.ground.onto, strict=True):
            marks = {name: pixel for name, pixel in point.marks.items() if name in images}
            if point.name not in but and (xyz := triangulate(images, marks)) is not None:
                found.append((point.name, xyz, onto, marks))
        return found

    def _off(self) -> dict[str, _Off]:
        """How far each point is off in the adjusted model."""
        images, found = images_of(self._adjusted()), dict[str, _Off]()
        sigma_px = float(np.hypot(self.weights.mark, self.weights.tie))
        for point, onto in zip(self.ground.points, self.ground.onto, strict=True):
            if (there := located(images, point.marks, sigma_px)) is not None:
                xyz, covariance = there
                left = onto - xyz
                chi2 = float(left @ np.linalg.solve(covariance + np.diag(self._sigma**2), left))
                found[point.name] = _Off(float(np.linalg.norm(left)) * self.weights.metres, chi2)
        return found

    def _adjusted(self) -> Any:
        return taken_over(load_engine(), self.model, self.last.model)


def positions_of(
    model: Any, photos: Sequence[Photo], chart: MapProjection, seed: int
) -> tuple[CameraPositions, np.ndarray] | NoSimilarity:
    """Positions of the photographs of a model that agree with its cameras, less their mean difference from these, and
    (3,) that difference, units of the map."""
    centres = centres_of(model)
    found = place(centres, photos, chart, seed)
    if isinstance(found, NoSimilarity):
        return found
    names = [name for name, good in zip(found.names, found.fit.inside, strict=True) if good]
    onto, sigma = found.onto[found.fit.inside], found.sigma[found.fit.inside]
    offset = ((onto - np.stack([centres[name] for name in names])) / sigma**2).sum(0) / (1 / sigma**2).sum(0)
    return CameraPositions(names, onto - offset, sigma), offset
