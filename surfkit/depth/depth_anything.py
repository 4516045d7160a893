"""Depth from one photograph, with a network."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import torch
from torch import Tensor
from torch.nn.functional import interpolate

from surfkit.core.check import BadInput
from surfkit.core.optional import needed
from surfkit.depth.base import DepthEstimator, DepthInput, Estimate
from surfkit.scene.camera import Camera
from surfkit.scene.photos import read_photo

LICENCES = {"small": "Apache-2.0", "base": "CC BY-NC 4.0", "large": "CC BY-NC 4.0"}
"""Of the published weights."""
CHANNEL_MEANS, CHANNEL_DEVIATIONS = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
"""Of the colours that the network was trained on."""
PATCH_PX = 14
"""Pixels on a side of the network's patches."""
MAX_SHORTEST_PX = 8400
"""Shortest side that is taken: what the network needs grows with its fourth power."""


@dataclass(frozen=True)
class DepthAnythingV2(DepthEstimator):
    """Relative inverse depth of single photographs by Depth Anything V2 (Yang et al. 2024), aligned to sparse points.

    Needs `pip install surfkit[depth]`, and weights: small is under Apache-2.0, base and large are under CC BY-NC 4.0,
    which forbids commercial use. The paper uses large.
    """

    size: Literal["small", "base", "large"] = "small"
    """Which published weights: small (Apache-2.0), base or large (CC BY-NC 4.0, no commercial use)."""

    weights: str = ""
    """Folder of weights, or their name on the Hugging Face hub; the published ones of `size` if empty."""

    shortest: int = 518
    """Shortest side of the images given to the network, pixels; rounded to patches of 14."""

    def __post_init__(self) -> None:
        if not PATCH_PX <= self.shortest <= MAX_SHORTEST_PX:
            raise BadInput(f"shortest is {self.shortest}; it must be {PATCH_PX} to {MAX_SHORTEST_PX} pixels")

    @property
    def source(self) -> str:
        """Folder or name of the weights."""
        return self.weights or f"depth-anything/Depth-Anything-V2-{self.size.capitalize()}-hf"

    def notice(self) -> str | None:
        """The licence."""
        if self.weights:
            return f"weights from {self.weights}: their licence is that of where they came from"
        use = "" if self.size == "small" else ", which forbids commercial use"
        return f"the weights {self.source} are under {LICENCES[self.size]}{use}"

    def of_map(self, camera: Camera) -> Camera:
        """See `DepthEstimator.of_map`."""
        return camera.fitted(max(self.given_size(camera.height, camera.width)))

    def refuse_missing(self) -> None:
        """See `DepthEstimator.refuse_missing`."""
        self.network()

    def estimate(self, given: DepthInput, wanted: Sequence[int]) -> Iterator[Estimate]:
        network = self.network().to(given.device).eval()
        for at in wanted:
            view, camera = given.views[at], given.views[at].camera
            photo = read_photo(view.path, (camera.width, camera.height), pixels=view.pixels)
            rgb = photo.to(given.device, torch.float32) / 255
            with torch.inference_mode():
                inverse = self.inverse_depth(network, rgb)
            size = camera.fitted(max(inverse.shape))  # patches bend the shape a little
            inverse = interpolate(inverse[None, None], (size.height, size.width), mode="bilinear")[0, 0]
            yield Estimate(at, inverse.cpu(), (inverse > 0).float().cpu())

    def network(self) -> Any:
        """The network with its weights.

        Raises:
            BadInput: transformers is missing or cannot be loaded, or the weights cannot be downloaded.
        """
        with needed("transformers", "estimator:depth-anything-v2"):
            from transformers import AutoModelForDepthEstimation
        try:
            return AutoModelForDepthEstimation.from_pretrained(self.source)
        except (OSError, ValueError, RuntimeError) as error:
            raise BadInput(
                f"the weights {self.source} cannot be loaded: download them on a machine with a network, and give the "
                "folder with --estimator.weights, or --depth.weights in `surfkit prepare photos` "
                f"({type(error).__name__}: {' '.join(str(error).split())[:160]})"
            ) from error

    def inverse_depth(self, network: Any, rgb: Tensor) -> Tensor:
        """(h, w) relative inverse depth of a photograph (3, H, W) in [0, 1]; 0 for what is infinitely far."""
        size = self.given_size(*rgb.shape[1:])
        small = interpolate(rgb[None], size, mode="bicubic", antialias=True, align_corners=False)
        mean, spread = (rgb.new_tensor(values).view(3, 1, 1) for values in (CHANNEL_MEANS, CHANNEL_DEVIATIONS))
        return network(pixel_values=(small - mean) / spread).predicted_depth[0].clamp_min(0)

    def given_size(self, height: int, width: int) -> list[int]:
        """Height and width at which a photograph is given to the network, whole patches."""
        by = self.shortest / min(height, width)
        return [max(1, round(side * by / PATCH_PX)) * PATCH_PX for side in (height, width)]
