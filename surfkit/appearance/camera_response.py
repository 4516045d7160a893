"""Exposure and white balance of photographs, vignetting and response curves of cameras."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar, Literal

import numpy as np
import torch
from torch import Tensor

from surfkit.appearance.base import Appearance, PhotoLight
from surfkit.primitives.points import Columns
from surfkit.raster import native
from surfkit.scene.camera import Camera
from surfkit.scene.response import (
    CENTRE,
    CURVE,
    FALLOFF,
    KNEE,
    OF_CAMERA,
    STOPS,
    curve_slope,
    curved,
    falloff,
    sensor_scale,
    uncurved,
)

WHITE = 250 / 255
"""From here on white may have been cut off."""


@dataclass(frozen=True)
class CameraResponse(Appearance):
    """Exposure and white balance of each photograph; vignetting and response curve of each camera.

    For photographs whose light changes: other exposures, dark corners, several cameras.

    The model is that of PPISP (NVIDIA, 2026) with fewer numbers. Light is linear: colours of the scene are decoded by
    the sRGB curve, multiplied by 2^(stops - falloff), encoded, limited to 1, and put through the camera's curve. A
    photograph has the stops of red, green and blue: their mean is its exposure, the rest its white balance. The falloff
    is a r^2 + b r^4 + c r^6 stops, with r = 0 near the principal point and r = 1 half a diagonal away. The curve is the
    identity plus three integrals of Legendre polynomials: smooth, monotone, with both ends fixed.

    The numbers are found before training, from the colours of sparse points in all photographs that show them (after
    Goldman, PAMI 2010), and stay as they are: renders of a model that is still learned tell less, and colours that
    depend on the direction would explain the exposure of photographs that look the same way. So stages, and blocks of a
    scene, have the same numbers. light.json in the run folder lists them.

    Colours are compared in the light of the scene (`of_scene`): in that of each photograph, dark ones would count less
    beside the losses of geometry. Where white was cut off the scene may be brighter.

    The mean stops of all photographs, less the falloff averaged over the picture, and their mean curve are no change.
    So the scene is as bright as the mean photograph, and files of splats have its colours as they are. A curve
    that all photographs share cannot be told from the scene: one camera alone has the sRGB curve.
    """

    when: Literal["always", "uneven"] = "always"
    """uneven: only where the same places look different, by 0.5 stops of exposure or 10 % of white balance (10th to
    90th percentile), by corners with 80 % of the light of the middle, or by 3 % of the range between the curves of
    cameras. Else, and where no sparse points tell, colours stay as they are; light.json says which."""

    needs_light: ClassVar[bool] = True

    @property
    def only_if_uneven(self) -> bool:
        """See `Appearance.only_if_uneven`."""
        return self.when == "uneven"

    def begin(self, count: int) -> Tensor:
        """(V, 11): stops of red, green and blue, and the 8 numbers of the camera; zeros."""
        return torch.zeros(count, STOPS + OF_CAMERA)

    def begin_with(self, light: PhotoLight) -> Tensor:
        """See `Appearance.begin_with`."""
        return torch.cat([light.stops, light.cameras], 1)

    def rate_at(self, index: int, steps: int) -> float:
        """0: the numbers stay as they begin."""
        return 0.0

    def __call__(self, numbers: Tensor, color: Tensor, camera: Camera) -> Tensor:
        """See `Appearance.__call__`; no gradient by the numbers."""
        return _Responded.apply(color, numbers, *sensor_axes(camera, color))  # type: ignore[no-any-return, no-untyped-call]

    @torch.no_grad()
    def of_scene(self, numbers: Tensor, photo: Tensor, camera: Camera) -> tuple[Tensor, Tensor]:
        """See `Appearance.of_scene`; colours are limited to 1, and photographs have 8 bits."""
        stops, of_camera = numbers.split([STOPS, OF_CAMERA])
        back = torch.cat([-stops, -of_camera[FALLOFF], of_camera[CENTRE], torch.zeros_like(of_camera[CURVE])])
        before = photo
        if of_camera[CURVE].any():
            table = uncurved(np.arange(256) / 255, of_camera[CURVE].cpu().double().numpy())
            before = torch.from_numpy(table).to(photo)[(255 * photo).round().long()]
        color = self(back, before, camera)
        return color, (photo >= WHITE) & (color < photo)

    def folded(self, numbers: Tensor, params: Columns) -> Columns:
        """The parameters as they are: the scene has the colours of the mean photograph already."""
        return params


def sensor_axes(camera: Camera, like: Tensor) -> tuple[Tensor, Tensor]:
    """(W,) x and (H,) y of the pixels on the sensor, see `scene.response`."""
    x, y = camera.ray_axes(like.dtype, like.device)
    scale = sensor_scale(camera)
    return x * (camera.fx * scale), y * (camera.fy * scale)


class _Responded(torch.autograd.Function):
    """(3, H, W) colours in a photograph, differentiable in those of the scene; in closed form, for its speed.

    Where a photograph would be brighter than white, a gradient passes that makes it darker, and no other.
    """

    @staticmethod
    def forward(ctx: Any, color: Tensor, numbers: Tensor, x: Tensor, y: Tensor) -> Tensor:
        color = color.detach()
        if _is_native(color):
            color, result, slope = color.contiguous(), torch.empty_like(color), torch.empty_like(color)
            how = native.kernels().kernels_in_use(), torch.get_num_threads()
            native.kernels().respond(color, x, y, numbers.tolist(), result, slope, *how)
        else:
            result, slope = responded(color, numbers.detach(), x, y)
        ctx.slope = slope
        return result

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, None, None, None]:
        slope: Tensor = ctx.slope
        if not _is_native(grad):
            return torch.where((slope < 0) & (grad < 0), 0, grad * slope.abs()), None, None, None
        result, how = torch.empty_like(slope), (native.kernels().kernels_in_use(), torch.get_num_threads())
        native.kernels().respond_backward(grad.contiguous(), slope, result, *how)
        return result, None, None, None


def _is_native(image: Tensor) -> bool:
    return native.module() is not None and image.device.type == "cpu" and image.dtype == torch.float32


def responded(color: Tensor, numbers: Tensor, x: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
    """Colours in a photograph, and their derivatives by those of the scene, negative where they were above 1: both
    (3, H, W), in plain torch, in any precision.

    Args:
        color: (3, H, W) of the scene; values below 0 go on along the straight part of sRGB.
        numbers: (11,) of the photograph and its camera.
        x: (W,), see `sensor_axes`.
        y: (H,).
    """
    stops, camera = numbers.split([STOPS, OF_CAMERA])
    squared = (x - camera[CENTRE][0]).square() + (y - camera[CENTRE][1]).square()[:, None]
    gain = (stops[:, None, None] - falloff(camera, squared)).exp2()
    is_dark, base = color <= KNEE, color.clamp(min=0) + 0.055
    light = torch.where(is_dark, color / 12.92, (base / 1.055) ** 2.4) * gain
    slope = torch.where(is_dark, gain / 12.92, 2.4 * light / base)  # d light / d color
    is_dark, base = light <= KNEE / 12.92, 1.055 * light.clamp(min=KNEE / 12.92) ** (1 / 2.4)
    encoded = torch.where(is_dark, light * 12.92, base - 0.055)
    slope = slope * torch.where(is_dark, 12.92, base / (2.4 * light.clamp(min=KNEE / 12.92)))
    over, encoded = encoded > 1, encoded.clamp(max=1)
    inside, curve = encoded.clamp(min=0), camera[CURVE]
    slope = slope * curve_slope(inside, curve)
    return encoded - inside + curved(inside, curve), torch.where(over, -slope, slope)
