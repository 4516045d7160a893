"""Depth maps with more pixels than the photographs have."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from torch import Tensor
from torch.nn.functional import interpolate

from surfkit.core.check import BadInput
from surfkit.core.events import Warned, emit
from surfkit.io.datasets.depth_prior import DepthPrior, resized
from surfkit.mesh.base import MeshInput
from surfkit.scene.camera import Camera

MAX_MAGNIFIED_PX = 4096
"""Side up to which pictures are magnified, pixels: twice the size takes four times the memory."""


def oversampled(subject: MeshInput, factor: float) -> MeshInput:
    """What is to be meshed, drawn with `factor` times as many pixels in a row and in a column, without photographs.

    Splats have no pixels: more of them follow edges, and surfaces that are seen from the side, more closely. Pictures
    get no longer than `MAX_MAGNIFIED_PX` pixels by it.

    Raises:
        BadInput: What is drawn are no splats.
    """
    if factor == 1:
        return subject
    if subject.draw_of is None:
        raise BadInput(
            "mesh.oversampling draws splats with more pixels, and what is drawn here is not made of splats; give 1"
        )
    views = [replace(view, camera=magnified(view.camera, factor)) for view in subject.views]
    capped = sum(factor > 1 and factor * max(v.camera.width, v.camera.height) > MAX_MAGNIFIED_PX for v in subject.views)
    if capped:
        emit(
            Warned(
                f"mesh.oversampling {factor:g} would make {capped:,} of {len(views):,} depth maps longer than "
                f"{MAX_MAGNIFIED_PX:,} pixels: they are drawn at that size, or at that of the photograph if it is "
                f"larger"
            )
        )

    def keep(at: int) -> Tensor | None:
        mask = subject.keep(at)
        return None if mask is None else nearest(mask, views[at].camera)

    priors = None if subject.priors is None else ResizedPriors(subject.priors, [view.camera for view in views])
    return replace(subject, views=views, keep=keep, priors=priors, photo=None)


def magnified(camera: Camera, factor: float) -> Camera:
    """The same camera with a picture that is `factor` times as large, or of `MAX_MAGNIFIED_PX` pixels if that would be
    more."""
    factor = min(factor, max(1.0, MAX_MAGNIFIED_PX / max(camera.width, camera.height)))
    return camera.resized(max(1, round(factor * camera.width)), max(1, round(factor * camera.height)))


def nearest(values: Tensor, camera: Camera) -> Tensor:
    """(..., H, W) of (..., h, w) at the size of a camera: of each pixel, the value of the one that it lies in."""
    flat = values.reshape(1, -1, *values.shape[-2:]).float()
    found = interpolate(flat, (camera.height, camera.width), mode="nearest-exact")
    return found.reshape(*values.shape[:-2], camera.height, camera.width).to(values.dtype)


@dataclass(frozen=True)
class ResizedPriors(Sequence[DepthPrior | None]):
    """Depth priors at the sizes of cameras, resized when they are asked for.

    Attributes:
        priors: As they are.
        cameras: By position.
    """

    priors: Sequence[DepthPrior | None]
    cameras: Sequence[Camera]

    def __len__(self) -> int:
        return len(self.priors)

    def __getitem__(self, at: int) -> DepthPrior | None:  # type: ignore[override]
        prior, camera = self.priors[at], self.cameras[at]
        if prior is None:
            return None
        inverse = resized(prior.inverse, (camera.height, camera.width))
        confidence = nearest(prior.confidence, camera) * (inverse > 0)
        normal = None if prior.normal is None else nearest(prior.normal, camera)
        return replace(prior, inverse=inverse, confidence=confidence, normal=normal)
