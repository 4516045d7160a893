"""Rolling shutters: what is known of the readout time of each lens, and what becomes of a model with it.

The rows of a photograph are seen from different places (`surfkit.apps.sfm.row_adjustment`). Observations are corrected
before the model is placed on the map; so all that follows, control points too, has cameras with global shutters, at the
positions of the middle rows. Photographs are corrected when they are undistorted (`surfkit.apps.sfm.row_motion`).
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from surfkit.apps.sfm.bundle_adjustment import mean_error
from surfkit.apps.sfm.camera_motion import MAX_GAP_S, motion_of, seconds
from surfkit.apps.sfm.control_list import GroundControl
from surfkit.apps.sfm.engine import load_engine
from surfkit.apps.sfm.georeference import centres_of
from surfkit.apps.sfm.inspect_photos import Photo
from surfkit.apps.sfm.mapping import read_model
from surfkit.apps.sfm.readout_times import Readout, known_readout
from surfkit.apps.sfm.row_adjustment import MAX_MS, MIN_MS, Estimate, RowAdjustment
from surfkit.apps.sfm.row_motion import RowMotion
from surfkit.apps.sfm.settings import Settings
from surfkit.core.check import BadInput
from surfkit.core.codec import load, read_json, write_json
from surfkit.core.files import replacing_folder

CACHE_VERSION = "1"
"""Changes when the same model would be corrected otherwise."""
MIN_SIGMAS = 8.0
"""An estimate counts that is so many standard deviations from 0: lenses that are not quite as modelled mimic some."""
DOUBT_SIGMAS = 3.0
"""From so many standard deviations on, speeds taken for what they are, an estimate contradicts a known readout time."""
MIN_GAIN = 0.01
"""An estimate counts that makes the mean reprojection error smaller by this share."""
MAX_SEARCHED = 300
"""Photographs of a lens that its readout time is estimated from: more would take long, and tell the same."""
MIN_SPEED_M = 2.0
"""Cameras whose readout time is not known, and that are slower, m/s, are left alone: people walk."""


@dataclass(frozen=True)
class LensReadout:
    """What was found out of a lens.

    Attributes:
        camera: Make and model; None where EXIF does not say.
        ms: That is used; None for a global shutter, or where it is not known.
        source: Whence it is known.
        estimate_ms: By the photographs alone, with its standard deviation; None where they cannot tell.
    """

    camera: str | None
    ms: float | None
    source: str
    estimate_ms: tuple[float, float] | None = None


@dataclass(frozen=True)
class RollingShutter:
    """What became of a model.

    Attributes:
        lenses: By number of the camera.
        motions: Of each photograph that was corrected, by name.
        why: Why nothing was corrected; empty where something was.
        speeds: Whence speeds are known.
        error_px: Mean reprojection error before and after.
        shift_px: Median length by which the first row is shifted against the last.
    """

    lenses: dict[str, LensReadout] = field(default_factory=dict)
    motions: dict[str, RowMotion] = field(default_factory=dict)
    why: str = ""
    speeds: str = ""
    error_px: tuple[float, float] | None = None
    shift_px: float | None = None

    def facts(self) -> dict[str, Any]:
        """For the report."""
        return {
            "corrected": len(self.motions),
            "why_not": self.why or None,
            "lenses": [asdict(lens) for lens in self.lenses.values()],
            "speeds": self.speeds or None,
            "reprojection_error_px": self.error_px and [round(value, 3) for value in self.error_px],
            "first_to_last_row_px": self.shift_px and round(self.shift_px, 2),
        }

    def doubts(self) -> list[str]:
        """What contradicts the photographs, a line for each."""
        found = []
        for lens in self.lenses.values():
            if lens.ms is None or lens.estimate_ms is None or not lens.source:
                continue
            estimate, sigma = lens.estimate_ms
            if abs(estimate - lens.ms) > max(DOUBT_SIGMAS * sigma, abs(lens.ms) / 4):
                found.append(
                    f"the photographs of {lens.camera} fit a readout time of {estimate:.0f} +- {sigma:.1g} ms better "
                    f"than {lens.ms:g} ms ({lens.source}): give --readout {estimate:.0f} if speeds and times in EXIF "
                    "are right"
                )
        if self.motions and self.error_px is not None and self.error_px[1] > (1 + MIN_GAIN) * self.error_px[0]:
            found.append(
                f"the correction of the rolling shutter makes the reprojection error larger, {self.error_px[0]:.2f} to "
                f"{self.error_px[1]:.2f} px: did the drone stop for each photograph? then give --readout off"
            )
        return found


def correct_once(
    model: Any, photos: Mapping[str, Photo], settings: Settings, folder: Path
) -> tuple[Any, RollingShutter]:
    """What `correct` gives, from the folder where an earlier call has kept it for the same of all."""
    if settings.readout == "off":
        return model, RollingShutter(why="--readout off")
    cameras = [list(camera.params) for camera in model.cameras.values()], model.num_points3D(), centres_of(model)
    exif = [(name, photo.exif) for name, photo in sorted(photos.items())]
    facts = [CACHE_VERSION, settings.readout, settings.seed, cameras, exif]
    key = hashlib.sha256(repr(facts).encode()).hexdigest()[:24]
    record = folder / "corrected.json"
    if record.is_file() and (kept := read_json(record, dict[str, Any])).get("key") == key:
        found = load(RollingShutter, kept["found"])
        return (read_model(folder) if found.motions else model), found
    corrected, found = correct(model, photos, settings)
    with replacing_folder(folder) as made:
        if found.motions:
            corrected.write_binary(made)
        write_json(made / record.name, {"key": key, "found": found})
    return corrected, found


def correct(model: Any, photos: Mapping[str, Photo], settings: Settings) -> tuple[Any, RollingShutter]:
    """A model with observations as a global shutter would have made them, adjusted to these; or the model as it is.

    Args:
        model: pycolmap.Reconstruction, in any coordinates; it is not changed.
        photos: By name.
        settings: For the readout time, and the seed.

    Raises:
        BadInput: A readout time is given, and neither times nor speeds of the photographs are known.
    """
    motion = motion_of(centres_of(model), photos)
    lenses = _lenses(model, photos, settings)
    known = {number: lens for number, lens in lenses.items() if lens.ms is not None}
    listed = {str(number): lens for number, lens in lenses.items()}
    if not motion.velocities:
        if settings.readout != "auto":
            raise BadInput(
                f"--readout {settings.readout:g} needs to know how fast the camera moved, and no two photographs were "
                f"taken within {MAX_GAP_S:g} s of each other; give --readout off"
            )
        why = f"EXIF has no times of photographs within {MAX_GAP_S:g} s of each other"
        return model, RollingShutter(listed, why=why)
    if not known and (motion.speed is None or motion.speed < MIN_SPEED_M):
        slow = "no known speed" if motion.speed is None else f"a speed of {motion.speed:.1f} m/s"
        return model, RollingShutter(listed, why=f"cameras of unknown readout time have {slow}")
    part = searched(model, photos)
    search = RowAdjustment(part, photos, settings)
    times = search.estimate({number: lens.ms for number, lens in lenses.items()})
    lenses = {number: _judged(lens, times[number]) for number, lens in lenses.items()}
    listed = {str(number): lens for number, lens in lenses.items()}
    chosen = {number: lens.ms / 1000 for number, lens in lenses.items() if lens.ms is not None}
    if not chosen:
        return model, RollingShutter(listed, why="the photographs show no rolling shutter")
    if part is not model:
        search = RowAdjustment(model, photos, settings)
    found = search.final(chosen)
    before = mean_error(load_engine().Reconstruction(model))
    after = None if found is None else mean_error(found)
    if after is None or (not known and after > (1 - MIN_GAIN) * before):
        return model, RollingShutter(listed, why="correcting it does not make the photographs agree better")
    if settings.readout == "auto" and after > (1 + MIN_GAIN) * before:
        return model, RollingShutter(listed, why="correcting it makes the photographs agree less")
    motions, shifts = search.motions(found)
    by_xmp = sum(motion.velocities[name].by_xmp for name in motions)
    speeds = f"XMP of {by_xmp} photographs, paths of {len(motions) - by_xmp}"
    return found, RollingShutter(listed, motions, "", speeds, (before, after), float(np.median(shifts)))


def searched(model: Any, photos: Mapping[str, Photo]) -> Any:
    """The model, or of a large one the photographs of each lens that were taken one after another in the middle of the
    flight: strips beside one another, which show the same points in several directions."""
    by_lens: dict[int, list[tuple[float, str, int]]] = {}
    for number in model.reg_image_ids():
        image = model.image(number)
        taken = seconds(photos[image.name].exif.taken)
        by_lens.setdefault(image.camera_id, []).append((math.inf if taken is None else taken, image.name, number))
    kept = set[int]()
    for listed in by_lens.values():
        timed = sorted(one for one in listed if one[0] < math.inf) or sorted(listed)
        first = max(0, (len(timed) - MAX_SEARCHED) // 2)
        kept |= {number for *_, number in timed[first : first + MAX_SEARCHED]}
    if all(len(listed) <= MAX_SEARCHED for listed in by_lens.values()):
        return model
    part = load_engine().Reconstruction(model)
    for frame in {part.image(number).frame_id for number in model.reg_image_ids() if number not in kept}:
        part.deregister_frame(frame)
    return part


def refuse_timeless(photos: Sequence[Photo], settings: Settings) -> None:
    """BadInput if a readout time is given, and EXIF has no times, by which speeds would be known."""
    if not isinstance(settings.readout, str) and not any(seconds(photo.exif.taken) for photo in photos):
        raise BadInput(
            f"--readout {settings.readout:g} needs to know how fast the camera moved, and EXIF has no times of the "
            "photographs; write DateTimeOriginal into them, or give --readout off"
        )


def still(ground: GroundControl, model: Any, rolling: RollingShutter) -> GroundControl:
    """Ground control points whose marks are where the middle rows of photographs would have seen them; `model` is the
    corrected pycolmap.Reconstruction."""
    cameras = {image.name: image.camera for image in model.images.values()}
    points = []
    for point in ground.points:
        marks = dict(point.marks)
        for name, motion in rolling.motions.items():
            if name in marks:
                x, y = motion.seen_at_once(np.array([marks[name]]), cameras[name])[0]
                marks[name] = float(x), float(y)
        points.append(replace(point, marks=marks))
    return replace(ground, points=points) if rolling.motions else ground


def _lenses(model: Any, photos: Mapping[str, Photo], settings: Settings) -> dict[int, LensReadout]:
    """Each lens of a model, with the readout time that is given or known."""
    given = None if isinstance(settings.readout, str) else Readout(settings.readout, "--readout")
    found: dict[int, LensReadout] = {}
    for number in sorted(model.reg_image_ids()):
        image = model.image(number)
        photo = photos[image.name]
        readout = given or known_readout(photo)
        ms, source = (None, "") if readout is None else (readout.ms, readout.source)
        found.setdefault(image.camera_id, LensReadout(photo.exif.camera, ms, source))
    return found


def _judged(lens: LensReadout, found: Estimate | None) -> LensReadout:
    """A lens with the estimate of its readout time, which counts if no other is known and it is beyond doubt: errors of
    speeds make it smaller, and less than all of the motion is better than nothing."""
    if found is None:
        return lens
    ms, use, source = round(1000 * found.time, 3), lens.ms, lens.source
    if use is None and MIN_MS <= abs(ms) <= MAX_MS and abs(found.time) > MIN_SIGMAS * found.sigma:
        use, source = ms, "estimated from the photographs"
    return LensReadout(lens.camera, use, source, (ms, round(1000 * found.total, 3)))
