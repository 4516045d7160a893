"""SIFT by pycolmap (Lowe, IJCV 2004; RootSIFT), and its matcher."""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass
from typing import ClassVar
from urllib.parse import unquote

import numpy as np
import torch
from torch import Tensor

from surfkit.apps.sfm.base import FeatureExtractor, FeatureMatcher, Features, Find, MatchInput
from surfkit.apps.sfm.engine import load_engine, run
from surfkit.core.check import BadInput
from surfkit.core.registry import name_of

BYTES_PER_PIXEL = 160
"""That SIFT takes with the photograph doubled in size first: five levels of an octave and as many differences."""
MAX_SIFT_BYTES = 2 << 30
"""Of all threads together."""
FAINT_RANGE = 128.0
"""Grey levels, of 256, between the darkest and the brightest thousandth of a picture, below which it is stretched."""
DARKEST, BRIGHTEST = 0.001, 0.999
"""Shares of the pixels that are darker than the two."""
MOST_STRETCH = 8.0
"""Beyond, the steps of 8 bits would pass for features."""


@dataclass(frozen=True)
class SIFT(FeatureExtractor):
    """SIFT by pycolmap (Lowe, IJCV 2004; RootSIFT), on the CPU; on a GPU if pycolmap was built with CUDA.

    Faint photographs, as those under water, in haze or at dusk, are stretched to the full range of grey first: what
    SIFT takes for a feature must have a contrast that is a share of that range.
    """

    descriptors: ClassVar[str] = "sift"
    in_torch: ClassVar[bool] = False
    version: ClassVar[int] = 2

    def at_once(self, pixels: int) -> int:
        """See `FeatureExtractor.at_once`."""
        threads = min(os.cpu_count() or 1, MAX_SIFT_BYTES // (BYTES_PER_PIXEL * pixels))
        return 1 if load_engine().has_cuda else max(1, threads)

    def opened(self, most: int, device: torch.device) -> Find:
        """See `FeatureExtractor.opened`."""
        engine = load_engine()

        def find(photo: Tensor) -> Features:
            options = engine.FeatureExtractionOptions()
            options.use_gpu = engine.has_cuda
            options.num_threads = 1
            options.max_image_size = max(photo.shape)
            options.sift.max_num_features = most
            extractor = engine.FeatureExtractor.create(options, engine.Device.auto)
            grey = stretched(photo.float().mean(0).numpy()).round().astype(np.uint8)
            found, descriptors = extractor.extract_from_uint8_array(np.ascontiguousarray(grey))
            keypoints = np.array(engine.keypoints_to_matrix(found), np.float32).reshape(-1, 4)
            return Features(keypoints, np.array(descriptors.data, np.uint8).reshape(-1, 128))

        return find


def stretched(grey: np.ndarray) -> np.ndarray:
    """(H, W) float32 grey levels in [0, 255]: over the full range where they fill less than half of it, else as they
    are; by one gain and offset, so that features keep their places and their order."""
    low, high = (float(level) for level in np.quantile(grey, (DARKEST, BRIGHTEST)))
    if high - low >= FAINT_RANGE:
        return grey
    gain = min(255 / max(high - low, 1.0), MOST_STRETCH)
    return ((grey - (low + high) / 2) * gain + 127.5).clip(0, 255)


@dataclass(frozen=True)
class PyCOLMAP(FeatureMatcher):
    """Mutual nearest neighbours by pycolmap, nearer than the next by a ratio of 0.8: for SIFT alone, on the CPU; on a
    GPU if pycolmap was built with CUDA."""

    in_torch: ClassVar[bool] = False

    def refuse_unfit(self, extractor: FeatureExtractor) -> None:
        """See `FeatureMatcher.refuse_unfit`."""
        if extractor.descriptors != "sift":
            raise BadInput(
                f"matcher:pycolmap compares descriptors of SIFT only, not those of features:{name_of(extractor)}; add "
                "matcher:mutual or matcher:lightglue"
            )

    def match(self, given: MatchInput) -> Iterator[np.ndarray]:
        """See `FeatureMatcher.match`; pycolmap reads and writes the database itself, which takes a 30th of the time."""
        engine = load_engine()
        matching = engine.FeatureMatchingOptions()
        matching.use_gpu = engine.has_cuda
        matching.skip_geometric_verification = True
        pairing = engine.ImportedPairingOptions()
        pairing.match_list_path = given.listed

        def compare(token: object) -> None:
            engine.match_image_pairs(
                given.database, matching, pairing, device=engine.Device.auto, cancellation_token=token
            )

        run("comparing photographs", compare)
        opened = engine.Database.open(given.database)
        try:
            numbers = {unquote(image.name): image.image_id for image in opened.read_all_images()}
            for one, two in given.pairs:
                yield opened.read_matches(numbers[one], numbers[two])
        finally:
            opened.close()
