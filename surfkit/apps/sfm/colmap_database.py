"""COLMAP's database: features, matches of pairs of photographs, and which of them one motion of the camera explains.

A pair is compared once. When photographs or features change, a new database takes over the pairs that did not.
"""

from __future__ import annotations

from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any
from urllib.parse import quote, unquote

import torch

from surfkit.apps.sfm.base import Features, MatchInput
from surfkit.apps.sfm.engine import load_engine, run
from surfkit.apps.sfm.feature_cache import feature_file, read_features, reduced, scaled
from surfkit.apps.sfm.inspect_photos import Photo, lens_groups
from surfkit.apps.sfm.pair_selection import Pair
from surfkit.apps.sfm.settings import Settings
from surfkit.core.check import BadInput
from surfkit.core.codec import dump, read_json, write_json
from surfkit.core.events import Progress, emit
from surfkit.core.files import replacing

MIN_BATCH_PAIRS, MAX_PROGRESS_BATCHES = 40, 200
"""Pairs that are compared at least between two reports of progress; such reports at most, as at each of them pycolmap
begins by reading what the database says of all photographs."""
DEFAULT_FOCAL = 1.2
"""Focal length over the longer side, where EXIF says none."""
CACHED_FEATURES = 64
"""Photographs whose features are kept in memory: those of the pairs of a batch mostly."""
DISTORTION_COEFFICIENTS = {"SIMPLE_RADIAL": 1, "RADIAL": 2, "OPENCV": 4, "FULL_OPENCV": 8, "OPENCV_FISHEYE": 4}
"""Coefficients of distortion; the last three models have two focal lengths."""


def alias(name: str) -> str:
    """The name of a photograph in the database: without spaces, which end a name in COLMAP's lists of pairs."""
    return quote(name)


@dataclass(frozen=True)
class Contents:
    """What a database was made from.

    Attributes:
        features: Name of the file of features of each photograph, by its name.
        lenses: Model, camera, size and focal length of each photograph, by its name.
        seed: Of the geometric verification.
        matcher: How features are compared.
    """

    features: dict[str, str]
    lenses: dict[str, str]
    seed: int
    matcher: str


def contents(
    photos: Sequence[Photo], folder: Path, settings: Settings, cameras: Mapping[str, Any] | None = None
) -> Contents:
    """What the database of photographs is to be made from; `cameras` as for `match`."""
    features = {photo.name: feature_file(folder, photo, settings).name for photo in photos}
    lenses = {photo.name: f"{settings.lens} {photo.exif.which} {photo.size} {photo.exif.focal_px}" for photo in photos}
    if cameras is not None:
        lenses = {photo.name: str(cameras[photo.name]) for photo in photos}
    return Contents(features, lenses, settings.seed, f"{dump(settings.matcher)} {settings.matcher.version}")


def match(
    photos: Sequence[Photo],
    pairs: Sequence[Pair],
    features: Path,
    database: Path,
    settings: Settings,
    device: torch.device,
    cameras: Mapping[str, Any] | None = None,
) -> None:
    """Write the database, with all pairs compared; pairs that an earlier call has compared are not again.

    Args:
        photos: With enough features.
        pairs: Positions of those to compare.
        features: Folder of features.
        database: The file.
        settings: How.
        device: Where torch works.
        cameras: pycolmap.Camera of each photograph, by its name; None where they are still to be found.
    """
    engine, wanted = load_engine(), contents(photos, features, settings, cameras)
    try:
        refuse_other(database, wanted)
    except BadInput:
        _begin(photos, pairs, features, database, settings, cameras)
    named = [(photos[one].name, photos[two].name) for one, two in pairs]
    todo = _not_compared(database, named)
    file, done = database.with_name("pairs.txt"), len(pairs) - len(todo)
    given = _given(photos, features, database, file, settings, device)
    size = max(MIN_BATCH_PAIRS, -(-len(pairs) // MAX_PROGRESS_BATCHES))
    for start in range(0, len(todo), size):
        batch = todo[start : start + size]
        with replacing(file) as opened:
            opened.write("".join(f"{alias(one)} {alias(two)}\n" for one, two in batch).encode())
        _compare(engine, replace(given, pairs=batch), settings)
        emit(Progress("comparing photographs", done + start + len(batch), len(pairs)))
    file.unlink(missing_ok=True)


def refuse_other(database: Path, wanted: Contents) -> None:
    """BadInput unless there is a database that was made from this."""
    if not database.is_file() or read_json(_record(database), Contents) != wanted:
        raise BadInput(f"{database}: of other photographs, features or settings")


def matched(database: Path) -> dict[str, int]:
    """How many other photographs share verified matches with each, by name."""
    engine = load_engine()
    opened = engine.Database.open(database)
    try:
        names = {image.image_id: unquote(image.name) for image in opened.read_all_images()}
        counts = dict.fromkeys(names.values(), 0)
        least = engine.TwoViewGeometryOptions().min_num_inliers
        for number, inliers in zip(*opened.read_two_view_geometry_num_inliers(), strict=True):
            if inliers >= least:
                for image in engine.pair_id_to_image_pair(number):
                    counts[names[image]] += 1
    finally:
        opened.close()
    return counts


def _not_compared(database: Path, pairs: Sequence[tuple[str, str]]) -> list[tuple[str, str]]:
    """Those of the pairs, by name, that the database has no verified matches of."""
    opened = load_engine().Database.open(database)
    try:
        numbers = _numbers(opened)
        return [(one, two) for one, two in pairs if not opened.exists_two_view_geometry(numbers[one], numbers[two])]
    finally:
        opened.close()


def _given(
    photos: Sequence[Photo], features: Path, database: Path, listed: Path, settings: Settings, device: torch.device
) -> MatchInput:
    """What the matcher needs, but for the pairs."""
    by_name = {photo.name: photo for photo in photos}
    sizes = {photo.name: reduced(photo.size, settings.longest) for photo in photos}

    @lru_cache(CACHED_FEATURES)
    def load(name: str) -> Features:
        found = read_features(feature_file(features, by_name[name], settings))
        return replace(found, keypoints=scaled(found.keypoints, by_name[name].size, sizes[name]))

    return MatchInput((), load, sizes, settings.features.descriptors, device, database, listed)


def _compare(engine: Any, given: MatchInput, settings: Settings) -> None:
    """Write matches of pairs, and which of them one motion of the camera explains."""
    opened = engine.Database.open(given.database)
    try:
        numbers = _numbers(opened)
        todo = [(one, two) for one, two in given.pairs if not opened.exists_matches(numbers[one], numbers[two])]
        for (one, two), found in zip(todo, settings.matcher.match(replace(given, pairs=todo)), strict=True):
            if not opened.exists_matches(numbers[one], numbers[two]):  # pycolmap writes its own
                opened.write_matches(numbers[one], numbers[two], found)
    finally:
        opened.close()
    verification = engine.TwoViewGeometryOptions()
    verification.ransac.random_seed = settings.seed
    run(
        "verifying matches",
        lambda token: engine.verify_matches(given.database, given.listed, verification, cancellation_token=token),
    )


def _numbers(opened: Any) -> dict[str, int]:
    """The number of each photograph in a database, by its name."""
    return {unquote(image.name): image.image_id for image in opened.read_all_images()}


def _record(database: Path) -> Path:
    return database.with_suffix(".json")


def _begin(
    photos: Sequence[Photo],
    pairs: Sequence[Pair],
    features: Path,
    database: Path,
    settings: Settings,
    cameras: Mapping[str, Any] | None,
) -> None:
    """Write a database of the photographs and their features, with what the one before knows of unchanged pairs."""
    engine, wanted = load_engine(), contents(photos, features, settings, cameras)
    named = [(photos[one].name, photos[two].name) for one, two in pairs]
    new = database.with_name("new.db")
    for rest in database.parent.glob("new.db*"):
        rest.unlink()
    opened = engine.Database.open(new)
    try:
        with engine.DatabaseTransaction(opened):
            numbers = _write_photos(engine, opened, photos, features, settings, cameras)
            _take_over(opened, numbers, named, database, wanted)
    finally:
        opened.close()
    _record(database).unlink(missing_ok=True)
    for rest in database.parent.glob(f"{database.name}-*"):  # the journal of a database that was interrupted
        rest.unlink()
    new.replace(database)
    write_json(_record(database), wanted)


def _write_photos(
    engine: Any,
    opened: Any,
    photos: Sequence[Photo],
    features: Path,
    settings: Settings,
    cameras: Mapping[str, Any] | None,
) -> dict[str, int]:
    """The number of each photograph in the database, by its name."""
    lenses: dict[Hashable, tuple[int, int]] = {}
    numbers = {}
    camera_type = engine.SensorType.CAMERA
    groups = lens_groups(photos) if cameras is None else [str(cameras[photo.name]) for photo in photos]
    for photo, group in zip(photos, groups, strict=True):
        if group not in lenses:
            camera = _camera(engine, photo, settings.lens) if cameras is None else cameras[photo.name]
            number = opened.write_camera(camera)
            rig = engine.Rig()
            rig.add_ref_sensor(engine.sensor_t(camera_type, number))
            lenses[group] = (number, opened.write_rig(rig))
        camera, rig_number = lenses[group]
        image = opened.write_image(engine.Image(name=alias(photo.name), camera_id=camera))
        frame = engine.Frame(rig_id=rig_number)
        frame.add_data_id(engine.data_t(engine.sensor_t(camera_type, camera), image))
        opened.write_frame(frame)
        found = read_features(feature_file(features, photo, settings))
        write_features(engine, opened, image, found, settings.features.descriptors)
        numbers[photo.name] = image
    return numbers


def write_features(engine: Any, opened: Any, image: int, found: Features, kind: str) -> None:
    """Write the features of a photograph into an open database; descriptors only if pycolmap can compare them."""
    opened.write_keypoints(image, found.keypoints)
    if kind == "sift":
        descriptors = engine.FeatureDescriptors(engine.FeatureExtractorType.SIFT, found.descriptors)
        opened.write_descriptors(image, descriptors)


def _camera(engine: Any, photo: Photo, model: str) -> Any:
    width, height = photo.size
    focal = photo.exif.focal_px or DEFAULT_FOCAL * max(width, height)
    focals = [focal] if model.endswith("RADIAL") else [focal, focal]
    params = [*focals, width / 2, height / 2, *[0.0] * DISTORTION_COEFFICIENTS[model]]
    camera = engine.Camera(model=model, width=width, height=height, params=params)
    camera.has_prior_focal_length = photo.exif.focal_px is not None
    return camera


def _take_over(
    new: Any, numbers: Mapping[str, int], pairs: Sequence[tuple[str, str]], database: Path, wanted: Contents
) -> None:
    """Write the matches of those pairs that have not changed since the database before into a new one."""
    try:
        before = read_json(_record(database), Contents)
    except BadInput:
        return
    if not database.is_file() or (before.seed, before.matcher) != (wanted.seed, wanted.matcher):
        return
    same = {
        name
        for name in numbers
        if before.features.get(name) == wanted.features[name] and before.lenses.get(name) == wanted.lenses[name]
    }
    old = load_engine().Database.open(database)
    try:
        there = _numbers(old)
        for one, two in pairs:
            if one in same and two in same and old.exists_matches(there[one], there[two]):
                new.write_matches(numbers[one], numbers[two], old.read_matches(there[one], there[two]))
                if old.exists_two_view_geometry(there[one], there[two]):
                    found = old.read_two_view_geometry(there[one], there[two])
                    new.write_two_view_geometry(numbers[one], numbers[two], found)
    finally:
        old.close()
