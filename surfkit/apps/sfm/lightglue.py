"""LightGlue by kornia: a network that compares the features of two photographs."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from surfkit.apps.sfm.base import FeatureExtractor, FeatureMatcher, MatchInput
from surfkit.apps.sfm.mutual import unit
from surfkit.apps.sfm.weights import load_kornia, network_of
from surfkit.core.check import BadInput, require_within
from surfkit.core.registry import name_of

FITS = ("aliked", "disk", "sift")
"""Descriptors that there are weights for."""


@dataclass(frozen=True)
class LightGlue(FeatureMatcher):
    """Matches by a network that looks at all features of both photographs (LightGlue; Lindenberger et al., ICCV 2023).

    For `sift`, `kornia-sift`, `disk` and `aliked`, by kornia. Needs `pip install surfkit[features]`, and weights, which
    their authors publish under Apache-2.0. Memory grows with the square of the features: 8192 take some GB.
    """

    weights: Path | None = None
    """File of the weights for the features, such as disk_lightglue.pth; without it kornia downloads them once."""

    threshold: float = 0.1
    """Least score of a match, from 0 to 1."""

    def __post_init__(self) -> None:
        require_within({"threshold": (0.0, 1.0)}, self)

    def refuse_unfit(self, extractor: FeatureExtractor) -> None:
        """See `FeatureMatcher.refuse_unfit`."""
        if extractor.descriptors not in FITS:
            raise BadInput(
                f"matcher:lightglue has no weights for features:{name_of(extractor)}, only for {', '.join(FITS)}; add "
                "matcher:mutual"
            )

    def refuse_missing(self, descriptors: str) -> None:
        """See `FeatureMatcher.refuse_missing`."""
        self.network(descriptors)

    def network(self, descriptors: str) -> Any:
        """The network with its weights for a kind of descriptors; BadInput without."""
        kornia = load_kornia("matcher:lightglue")
        built = {**kornia.LightGlue.features[descriptors], "weights": None, "filter_threshold": self.threshold}
        return network_of(
            f"matcher:lightglue for {descriptors}", "--matcher.weights", self.weights,
            lambda: kornia.LightGlue(descriptors, filter_threshold=self.threshold),
            lambda: kornia.LightGlue(None, **built),
            f"https://github.com/cvg/LightGlue/releases/download/v0.1_arxiv/{descriptors}_lightglue.pth",
        )  # fmt: skip

    def match(self, given: MatchInput) -> Iterator[np.ndarray]:
        """See `FeatureMatcher.match`."""
        network = self.network(given.descriptors).to(given.device)
        for names in given.pairs:
            one, two = (_shown(given, name) for name in names)
            with torch.inference_mode():
                found = network({"image0": one, "image1": two})["matches"][0]
            yield found.cpu().numpy().astype(np.uint32).reshape(-1, 2)


def _shown(given: MatchInput, name: str) -> dict[str, torch.Tensor]:
    """The features of a photograph as the network takes them."""
    found, size = given.features(name), torch.tensor(given.sizes[name], device=given.device)
    keypoints = torch.from_numpy(found.keypoints).to(given.device)
    return {
        "keypoints": keypoints[None, :, :2].clamp_min(0).minimum(size.float()),
        "scales": keypoints[None, :, 2],
        "oris": keypoints[None, :, 3],
        "descriptors": unit(found.descriptors, given.device)[None],
        "image_size": size[None],
    }
