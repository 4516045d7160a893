"""Features of kornia in torch: SIFT, and two that networks have learnt to find, DISK and ALIKED."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Literal

import numpy as np
import torch
from torch import Tensor

from surfkit.apps.sfm.base import FeatureExtractor, Features, Find
from surfkit.apps.sfm.weights import load_kornia, network_of
from surfkit.core.check import require_within

HALF_PIXEL = 0.5
"""From kornia's pixels, whose middles are whole numbers, to COLMAP's."""
FRAME_SIGMAS = 6.0
"""Times the standard deviation of a blob is the size of its frame in kornia."""


@dataclass(frozen=True)
class KorniaSIFT(FeatureExtractor):
    """SIFT by kornia in torch, for a GPU: scale-space extrema, with the same descriptors as `sift` (RootSIFT).

    Needs `pip install surfkit[features]`. Extrema along edges are kept, and each has one orientation, other than by
    `sift`. On a CPU it takes many times as long.
    """

    descriptors: ClassVar[str] = "sift"

    contrast: float = 0.0067
    """Least difference of Gaussians of a feature, of white; that of COLMAP. Lower it for dim photographs."""

    def __post_init__(self) -> None:
        require_within({"contrast": (0.0, 1.0)}, self)

    def refuse_missing(self) -> None:
        """See `FeatureExtractor.refuse_missing`."""
        load_kornia("features:kornia-sift")

    def opened(self, most: int, device: torch.device) -> Find:
        """See `FeatureExtractor.opened`."""
        kornia = load_kornia("features:kornia-sift")
        network = kornia.SIFTFeatureScaleSpace(
            most, device=device, descriptor_backend="pyramid", descriptor_layout="opencv"
        ).eval()

        def find(photo: Tensor) -> Features:
            grey = photo.to(device, torch.float32).mean(0)[None, None] / 255
            with torch.inference_mode():
                frames, strength, descriptors = network(grey)
                kept = kornia.laf_is_filled(frames)[0] & (strength[0] >= self.contrast)
                frames = frames[:, kept]
                size = kornia.get_laf_scale(frames)[0, :, 0] / FRAME_SIGMAS
                turn = -kornia.get_laf_orientation(frames)[0] * (math.pi / 180)
                keypoints = torch.cat([frames[0, :, :, 2] + HALF_PIXEL, size, turn], 1)
                small = (512 * descriptors[0, kept]).round().clamp(0, 255).byte()  # as COLMAP does
            return Features(keypoints.float().cpu().numpy(), small.cpu().numpy())

        return find


@dataclass(frozen=True)
class DISK(FeatureExtractor):
    """Features that a network has learnt by reinforcement (DISK; Tyszkiewicz et al., NeurIPS 2020), by kornia.

    Needs `pip install surfkit[features]`, and weights, which their authors publish under Apache-2.0.
    """

    descriptors: ClassVar[str] = "disk"

    weights: Path | None = None
    """File of weights, depth-save.pth or epipolar-save.pth; without it kornia downloads depth-save.pth once."""

    def refuse_missing(self) -> None:
        """See `FeatureExtractor.refuse_missing`."""
        self.network()

    def network(self) -> Any:
        """The network with its weights; BadInput without."""
        kornia = load_kornia("features:disk")
        source = "https://huggingface.co/kornia/disk/resolve/main/depth-save.pth"
        return network_of(
            "features:disk", "--features.weights", self.weights, kornia.DISK.from_pretrained, kornia.DISK, source
        )

    def opened(self, most: int, device: torch.device) -> Find:
        """See `FeatureExtractor.opened`."""
        network = self.network().to(device)

        def find(photo: Tensor) -> Features:
            with torch.inference_mode():
                rgb = photo.to(device, torch.float32)[None] / 255
                found = network(rgb, most, pad_if_not_divisible=True)[0]
            return _features(found)

        return find


@dataclass(frozen=True)
class ALIKED(FeatureExtractor):
    """Features of a network with deformable convolutions (ALIKED; Zhao et al. 2023), by kornia.

    Needs `pip install surfkit[features]`, and weights, which their authors publish under the BSD 3-clause licence.
    """

    descriptors: ClassVar[str] = "aliked"

    model: Literal["aliked-n16", "aliked-n16rot", "aliked-n32"] = "aliked-n16"
    """Which network: n16, n16rot (trained with turned photographs) or n32 (more exact, slower)."""

    weights: Path | None = None
    """File of weights of the model, such as aliked-n16.pth; without it kornia downloads it once."""

    threshold: float = 0.2
    """Least score of a feature, from 0 to 1."""

    def __post_init__(self) -> None:
        require_within({"threshold": (0.001, 1.0)}, self)

    def refuse_missing(self) -> None:
        """See `FeatureExtractor.refuse_missing`."""
        self.network(1)

    def network(self, most: int) -> Any:
        """The network for up to `most` features, with its weights; BadInput without."""
        kornia = load_kornia("features:aliked")
        given = {"model_name": self.model, "max_num_keypoints": most, "detection_threshold": self.threshold}
        return network_of(
            "features:aliked", "--features.weights", self.weights,
            lambda: kornia.ALIKED.from_pretrained(**given), lambda: kornia.ALIKED(**given),
            f"https://github.com/Shiaoming/ALIKED/raw/main/models/{self.model}.pth",
        )  # fmt: skip

    def opened(self, most: int, device: torch.device) -> Find:
        """See `FeatureExtractor.opened`."""
        network = self.network(most).to(device)

        def find(photo: Tensor) -> Features:
            with torch.inference_mode():
                found = network(photo.to(device, torch.float32)[None] / 255)[0]
            return _features(found)

        return find


def _features(found: Any) -> Features:
    """Features without scale and orientation, as COLMAP counts pixels."""
    at = found.keypoints.float().cpu().numpy().reshape(-1, 2) + HALF_PIXEL
    keypoints = np.column_stack([at, np.ones(len(at)), np.zeros(len(at))]).astype(np.float32)
    return Features(keypoints, found.descriptors.half().cpu().numpy())
