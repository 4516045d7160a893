"""Checks of what finds features and of what compares them, on made photographs and descriptors."""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np
import torch

from surfkit.apps.sfm.base import FeatureExtractor, FeatureMatcher, Features, MatchInput
from surfkit.apps.sfm.colmap_database import write_features
from surfkit.apps.sfm.engine import load_engine
from surfkit.testing.equality import assert_same, unchanged

CPU = torch.device("cpu")
PHOTO_SIZE_PX = (240, 180)
MAX_FEATURES = 200
DETERMINISM_HINT = "it may depend on its inputs and settings only"


def check_feature_extractor(extractor: FeatureExtractor) -> None:
    """An extractor finds features inside a photograph, about as many as it may at most, with descriptors; the same ones
    again.

    Args:
        extractor: With settings for a photograph of 240 x 180 pixels.

    Raises:
        BadInput: The extractor cannot work on this machine.
    """
    name = type(extractor).__name__
    extractor.refuse_missing()
    kind = extractor.descriptors
    assert kind and isinstance(kind, str), f"{name}.descriptors must name what the descriptors are, not {kind!r}"
    threads = extractor.at_once(PHOTO_SIZE_PX[0] * PHOTO_SIZE_PX[1])
    assert threads >= 1, f"{name}.at_once is {threads}; it must be 1 or more"
    photo, find = _photograph(), extractor.opened(MAX_FEATURES, CPU)
    with unchanged(f"{name}.opened", photo=photo):
        found = find(photo)
    keypoints, descriptors = found.keypoints, found.descriptors
    count = len(keypoints)
    assert keypoints.shape == (count, 4) and keypoints.dtype == np.float32, (
        f"{name}: keypoints are {keypoints.dtype} of shape {keypoints.shape}, not float32 of (K, 4)"
    )
    assert np.isfinite(keypoints).all(), f"{name}: a keypoint is not finite"
    assert count, f"{name} finds no features in a photograph of blobs"
    assert count <= 2 * MAX_FEATURES, f"{name} finds {count} features where {MAX_FEATURES} are the most"
    inside = (keypoints[:, :2] >= 0) & (keypoints[:, :2] <= PHOTO_SIZE_PX)
    assert inside.all(), f"{name}: a keypoint lies outside of the photograph"
    assert (keypoints[:, 2] > 0).all(), f"{name}: a scale is not above 0; write 1 where there is none"
    known = descriptors.dtype in (np.uint8, np.float16)
    assert known and descriptors.ndim == 2 and len(descriptors) == count, (
        f"{name}: descriptors are {descriptors.dtype} of shape {descriptors.shape}, not uint8 or float16 of (K, D)"
    )
    assert np.isfinite(descriptors).all(), f"{name}: a descriptor is not finite"
    if kind == "sift":
        right = descriptors.dtype == np.uint8 and descriptors.shape[1] == 128
        assert right, f"{name}: descriptors named sift must be 128 bytes"
    for other in (find, extractor.opened(MAX_FEATURES, CPU)):
        again = other(photo)
        assert_same(f"{name}: keypoints", keypoints, again.keypoints, DETERMINISM_HINT)
        assert_same(f"{name}: descriptors", descriptors, again.descriptors, DETERMINISM_HINT)


def check_feature_matcher(matcher: FeatureMatcher, descriptors: str = "sift") -> None:
    """A matcher gives positions of features, each once, for every pair in turn; the same ones again.

    Args:
        matcher: To check.
        descriptors: Kind of the descriptors, such as disk: other than of sift these are random numbers of length 1.

    Raises:
        BadInput: The matcher cannot work on this machine.
    """
    name = type(matcher).__name__
    matcher.refuse_missing(descriptors)
    features = _features(descriptors)
    pairs = [("a", "b"), ("b", "c"), ("a", "c")]
    answers = []
    for _ in range(2):
        with tempfile.TemporaryDirectory() as place:
            given = _match_input(Path(place), features, pairs, descriptors)
            answers.append(list(matcher.match(given)))
    found, again = answers
    assert len(found) == len(pairs), f"{name}.match gives {len(found)} answers for {len(pairs)} pairs"
    for (one, two), matches in zip(pairs, found, strict=True):
        assert matches.dtype == np.uint32 and matches.shape == (len(matches), 2), (
            f"{name}: matches are {matches.dtype} of shape {matches.shape}, not uint32 of (M, 2)"
        )
        for at, side in enumerate((one, two)):
            most = len(features[side].keypoints)
            assert (matches[:, at] < most).all(), f"{name}: a match is with feature {matches[:, at].max()} of {most}"
            assert len(np.unique(matches[:, at])) == len(matches), f"{name}: a feature is in two matches of a pair"
    for first, second in zip(found, again, strict=True):
        assert_same(f"{name}.match", first, second, DETERMINISM_HINT)


def _photograph() -> torch.Tensor:
    """(3, H, W) uint8 of blobs of several sizes and colours."""
    rng = np.random.default_rng(0)
    x, y = np.meshgrid(np.arange(PHOTO_SIZE_PX[0]), np.arange(PHOTO_SIZE_PX[1]))
    shown = np.full((3, PHOTO_SIZE_PX[1], PHOTO_SIZE_PX[0]), 128.0)
    for _ in range(150):
        away = (x - rng.uniform(0, PHOTO_SIZE_PX[0])) ** 2 + (y - rng.uniform(0, PHOTO_SIZE_PX[1])) ** 2
        shown += rng.uniform(-70, 70, (3, 1, 1)) * np.exp(-away / (2 * rng.uniform(1.5, 6) ** 2))
    return torch.from_numpy(shown.clip(0, 255).round().astype(np.uint8))


def _features(kind: str) -> dict[str, Features]:
    """Features of three photographs, most of them alike, in another order each."""
    rng = np.random.default_rng(0)
    codes, found = np.abs(rng.normal(0, 1, (200, 128))), {}
    at = rng.uniform(5, np.array(PHOTO_SIZE_PX) - 5, (200, 2))
    for name, count in (("a", 180), ("b", 160), ("c", 150)):
        chosen = rng.permutation(200)[:count]
        seen = codes[chosen] + rng.normal(0, 0.05, (count, 128))
        seen /= np.linalg.norm(seen, axis=1, keepdims=True)
        stored = (512 * seen).round().clip(0, 255).astype(np.uint8) if kind == "sift" else seen.astype(np.float16)
        places = at[chosen] + rng.normal(0, 0.2, (count, 2))
        found[name] = Features(np.column_stack([places, np.ones(count), np.zeros(count)]).astype(np.float32), stored)
    return found


def _match_input(place: Path, features: dict[str, Features], pairs: list[tuple[str, str]], kind: str) -> MatchInput:
    """What a matcher is given, with a database of the features."""
    engine, database, listed = load_engine(), place / "database.db", place / "pairs.txt"
    listed.write_text("".join(f"{one} {two}\n" for one, two in pairs))
    opened = engine.Database.open(database)
    try:
        width, height = PHOTO_SIZE_PX
        params = [float(width), width / 2, height / 2, 0.0]
        lens = opened.write_camera(engine.Camera(model="SIMPLE_RADIAL", width=width, height=height, params=params))
        for name, found in features.items():
            write_features(engine, opened, opened.write_image(engine.Image(name=name, camera_id=lens)), found, kind)
    finally:
        opened.close()
    return MatchInput(pairs, features.__getitem__, dict.fromkeys(features, PHOTO_SIZE_PX), kind, CPU, database, listed)
