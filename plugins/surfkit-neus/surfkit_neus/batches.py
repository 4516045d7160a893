"""Random pixels of random photographs, one batch for each optimisation step."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from surfkit.plugin import MethodInput
from surfkit_neus.box import Rays, SceneBox, camera_rays, joined


@dataclass(frozen=True)
class Batch:
    """R pixels.

    Attributes:
        rays: Through them.
        color: (R, 3) of the photographs, in [0, 1].
        weight: (R,) 0 where a mask says that the photograph is to be ignored, else 1.
        depth: (R,) camera z of the depth priors, local units; 0 where there is none.
        confidence: (R,) of them.
        points: (K, 3) sparse points, frame of the box.
    """

    rays: Rays
    color: Tensor
    weight: Tensor
    depth: Tensor
    confidence: Tensor
    points: Tensor


class Batches:
    """Draws the batch of a step, the same for the same seed and step.

    Args:
        given: Photographs, masks, priors and sparse points.
        box: The frame of the rays.
        rays: In a batch.
        photos: Photographs that share them.
    """

    def __init__(self, given: MethodInput, box: SceneBox, rays: int, photos: int) -> None:
        self.given, self.box, self.rays = given, box, rays
        self.photos = min(photos, rays)
        points = box.inward(given.scene.cloud.xyz)
        self.points = points[box.holds(points)].float()

    def draw(self, index: int) -> torch.Generator:
        """The generator of random numbers of a step."""
        return torch.Generator().manual_seed((self.given.seed * 0x9E3779B1 + index) % 2**63)

    def __call__(self, draw: torch.Generator) -> Batch:
        """The next batch that a generator gives, on the device."""
        views = torch.randint(len(self.given.scene.train), (self.photos,), generator=draw).tolist()
        shares = [self.rays * (at + 1) // self.photos - self.rays * at // self.photos for at in range(self.photos)]
        parts = [self._pixels(view, share, draw) for view, share in zip(views, shares, strict=True)]
        rays = joined([part[0] for part in parts])
        color, weight, depth, confidence = (torch.cat([part[1][at] for part in parts]) for at in range(4))
        chosen = self.points[torch.randint(max(1, len(self.points)), (self.rays,), generator=draw)]
        values = (color, weight, depth, confidence, chosen)
        return Batch(rays.to(self.given.device), *(value.to(self.given.device) for value in values))

    def _pixels(self, at: int, count: int, draw: torch.Generator) -> tuple[Rays, tuple[Tensor, ...]]:
        camera = self.given.scene.train[at].camera
        pixels = torch.randint(camera.width * camera.height, (count,), generator=draw)
        color = self.given.photo(at).flatten(1)[:, pixels].T.float() / 255
        mask = self.given.mask(at)
        weight = torch.ones(count) if mask is None else mask.flatten()[pixels].float()
        prior = None if self.given.priors is None else self.given.priors[at]
        depth = confidence = torch.zeros(count)
        if prior is not None:
            inverse, confidence = prior.inverse.flatten()[pixels], prior.confidence.flatten()[pixels]
            depth = torch.where(inverse > 0, 1 / inverse.clamp_min(1e-9), 0.0)
        return camera_rays(camera, self.box, pixels), (color, weight, depth, confidence)
