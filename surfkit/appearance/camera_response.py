"""Exposure and white balance of photographs, vignetting and response curves of cameras."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, ClassVar

import torch
from torch import Tensor

from surfkit.appearance.base import Appearance, Looks, Shown
from surfkit.core.check import BadInput
from surfkit.core.schedule import log_linear
from surfkit.primitives.points import Columns
from surfkit.raster import native
from surfkit.scene.camera import Camera

FALLOFF, CENTRE, CURVES = slice(0, 3), slice(3, 5), slice(5, 14)
"""Numbers of a camera: stops of vignetting at r^2, r^4 and r^6; where r is 0; three terms of the curve of each channel."""
OWN, OF_CAMERA = 3, 14
"""How many numbers a photograph and a camera have."""
MAX_SLOPE_CHANGE = 0.9
"""A response curve is nowhere steeper than 1.9 times the standard one, and nowhere flatter than 0.1 times."""
SAMPLES = 1 << 12
"""Pixels of a photograph, about, that its numbers are found from."""
ROUNDS = 2
"""Gauss-Newton steps in a look at a photograph."""
ROBUST = 0.05
"""Differences of colours from which on they count less and less: with a weight of 1 / (1 + difference / ROBUST)."""
MEMORY = 0.98
"""What a camera's earlier photographs count at each further one."""
FIRST_INFORMATION = 1e-2
"""How sure a camera is of its first numbers, in mean squared slopes of a pixel's colour: about that of vignetting."""
KNEE = 0.04045
"""sRGB is straight up to here, and a power of the light above (IEC 61966-2-1)."""
PLACES = torch.tensor([[c, 3, 4, 5, 6, 7, *range(8 + 3 * c, 11 + 3 * c)] for c in range(3)])
"""(3, 9): where the numbers that a channel depends on stand among those of a photograph and its camera."""


@dataclass(frozen=True)
class CameraResponse(Appearance):
    """Exposure and white balance of each photograph; vignetting and response curve of each camera, for photographs whose
    light changes: other exposures, dark corners, several cameras.

    After PPISP (NVIDIA, 2026), with fewer numbers. Light is linear: a scene's colours are decoded by the sRGB curve,
    multiplied by 2^(e - v(r)), encoded, limited to 1 and put through the camera's curve. e has the stops of each
    channel, three per photograph: their mean is the exposure, the rest white balance. v(r) = a r^2 + b r^4 + c r^6 stops,
    with r = 0 at the principal point plus a learned offset, and r = 1 half a diagonal away. A curve is the identity plus
    three integrals of Legendre polynomials: smooth, with both ends fixed, and monotone.

    Numbers are not learned by gradients, which takes more looks than a photograph gets: each look solves a robust
    least-squares problem for a photograph and its camera (Gauss-Newton), in which a camera remembers its last fifty
    photographs or so. What changes is taken from all photographs alike, so that the mean exposure and white balance (in
    stops) and the mean curve of all photographs stay the identity. So the scene has the colours of the mean photograph,
    as in its middle without vignetting, and exports have them as they are. A curve that all cameras share cannot be told
    from the scene, and is none: one camera alone has the sRGB curve.
    """

    is_centred: ClassVar[bool] = True

    start: float = 1.0
    """Share of the way to the best exposure that a photograph goes at a look, at the first step."""

    end: float = 0.2
    """The same at the last step, reached along a straight line in the logarithm."""

    prior: float = 1e-4
    """How strongly vignetting and curves are held at none, where photographs do not tell; 0.01 holds them firmly."""

    def __post_init__(self) -> None:
        if not (0 < self.start <= 1 and 0 < self.end <= 1):
            raise BadInput(f"appearance: the shares are {self.start:g} and {self.end:g}; give more than 0 and at most 1")
        if not 0 < self.prior < math.inf:
            raise BadInput(f"appearance: the prior is {self.prior:g}; give more than 0")

    def begin(self, count: int) -> Tensor:
        """(V, 3): stops of red, green and blue."""
        return torch.zeros(count, OWN)

    def begin_cameras(self, count: int) -> Tensor:
        """(C, 14, 15): of each camera its numbers, and beside them the matrix of how sure they are."""
        return torch.cat([torch.zeros(OF_CAMERA, 1), FIRST_INFORMATION * torch.eye(OF_CAMERA)], 1).repeat(count, 1, 1)

    def rate_at(self, index: int, steps: int) -> float:
        return log_linear(self.start, self.end, index / steps)

    def __call__(self, numbers: Tensor, color: Tensor, of_camera: Tensor, camera: Camera) -> Tensor:
        places = sensor_axes(camera, color)
        return _Responded.apply(color, numbers, of_camera[:, 0], *places)  # type: ignore[no-any-return, no-untyped-call]

    def fitted(self, looks: Looks, shown: Shown, rate: float) -> Looks:
        """See the class: a share `rate` of the way for the photograph, as far as all looks together say for its camera."""
        which = int(looks.taken_by[shown.at])
        own = looks.photos[shown.at].double().cpu()
        camera, sure = looks.cameras[which].double().cpu().split([1, OF_CAMERA], 1)
        camera, held = camera[:, 0], (1 - MEMORY) * self.prior
        sampled, before = _sampled(shown), torch.cat([own, camera])
        now = before
        for _ in range(ROUNDS):
            normal, pull = _equations(now, sampled)
            step = torch.zeros_like(normal)
            step[OWN:, OWN:] = MEMORY * sure + held * torch.eye(OF_CAMERA)
            pull[OWN:] -= MEMORY * sure @ (now - before)[OWN:] + held * now[OWN:]
            step += normal + 1e-9 * torch.eye(len(now))  # a photograph that shows nothing changes nothing
            now = now + torch.linalg.solve(step, pull)
        own_now, camera_now = own + rate * (now - before)[:OWN], now[OWN:]
        across = normal[OWN:, :OWN]
        told = across @ torch.linalg.solve(normal[:OWN, :OWN] + 1e-9 * torch.eye(OWN), across.T)
        sure = MEMORY * sure + held * torch.eye(OF_CAMERA) + normal[OWN:, OWN:] - told  # what exposure does not explain
        return _centred(looks, shown.at, own_now, torch.cat([camera_now[:, None], sure], 1))

    def folded(self, numbers: Tensor, params: Columns) -> Columns:
        """The parameters as they are: the scene has the colours of the mean photograph already (see the class)."""
        return params


def sensor_axes(camera: Camera, like: Tensor) -> tuple[Tensor, Tensor]:
    """(W,) x and (H,) y of the pixels, from the principal point, in halves of the picture's diagonal."""
    x, y = camera.ray_axes(like.dtype, like.device)
    half = math.hypot(camera.width, camera.height) / 2
    return x * (camera.fx / half), y * (camera.fy / half)


def falloff(values: Tensor, squared: Tensor) -> Tensor:
    """Stops that vignetting takes at r^2 = `squared`, by the (14,) numbers of a camera."""
    a, b, c = values[FALLOFF]
    return squared * (a + squared * (b + squared * c))


def curve_terms(encoded: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """What the three numbers of a response curve add to values in [0, 1]: integrals of P1, P2, P3 of (1 - 2 value).

    They are 0 at both ends. As no |P| is above 1, a sum of numbers up to 1 keeps the curve monotone.
    """
    u = 1 - 2 * encoded
    bow = (1 - u.square()) / 4
    return bow, bow * u, bow * (5 * u.square() - 1) / 4


def curve_slopes(encoded: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """The derivatives of `curve_terms`: P1, P2 and P3 of (1 - 2 value)."""
    u = 1 - 2 * encoded
    return u, (3 * u.square() - 1) / 2, u * (5 * u.square() - 3) / 2


def _decoded(color: Tensor) -> Tensor:
    """Linear light of sRGB values; those below 0 go on along the straight part."""
    return torch.where(color <= KNEE, color / 12.92, ((color.clamp(min=0) + 0.055) / 1.055) ** 2.4)


def _encoded(light: Tensor) -> Tensor:
    """The inverse of `_decoded`."""
    return torch.where(light <= KNEE / 12.92, light * 12.92, 1.055 * light.clamp(min=0) ** (1 / 2.4) - 0.055)


def _encoding_slope(light: Tensor, encoded: Tensor) -> Tensor:
    """d encoded / d log2(light)."""
    return math.log(2) * torch.where(light <= KNEE / 12.92, encoded, (encoded + 0.055) / 2.4)


class _Responded(torch.autograd.Function):
    """(3, H, W) colours in a photograph, differentiable in those of the scene, (3, H, W); in closed form, for its speed.

    Where a photograph would be brighter than white, a gradient passes that makes it darker, and no other.
    """

    @staticmethod
    def forward(ctx: Any, color: Tensor, own: Tensor, values: Tensor, x: Tensor, y: Tensor) -> Tensor:
        if _is_native(color):
            color, result, slope = color.detach().contiguous(), torch.empty_like(color), torch.empty_like(color)
            numbers = own.tolist(), values.tolist(), result, slope
            native.kernels().respond(color, x, y, *numbers, native.kernels().kernels_in_use(), torch.get_num_threads())
        else:
            result, slope = responded(color, own, values, x, y)
        ctx.slope = slope
        return result

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        slope = ctx.slope
        if not _is_native(grad):
            return torch.where((slope < 0) & (grad < 0), 0, grad * slope.abs()), None, None, None, None
        grad, result = grad.contiguous(), torch.empty_like(slope)
        how = native.kernels().kernels_in_use(), torch.get_num_threads()
        native.kernels().respond_backward(grad, slope, result, *how)
        return result, None, None, None, None


def _is_native(image: Tensor) -> bool:
    return native.module() is not None and image.device.type == "cpu" and image.dtype == torch.float32


def responded(color: Tensor, own: Tensor, values: Tensor, x: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
    """(3, H, W) colours in a photograph, and their derivatives by those of the scene, negative where they were above 1;
    in plain torch, in any precision.

    Args:
        color: (3, H, W) of the scene.
        own: (3,) stops of the photograph.
        values: (14,) of its camera.
        x, y: (W,) and (H,), see `sensor_axes`.
    """
    squared = (x - values[CENTRE][0]).square() + (y - values[CENTRE][1]).square()[:, None]
    gain = (own[:, None, None] - falloff(values, squared)).exp2()
    dark, light = color <= KNEE, _decoded(color)
    slope = gain * torch.where(dark, 1 / 12.92, 2.4 * light / (color + 0.055))
    light = light * gain
    encoded = _encoded(light)
    slope *= torch.where(light <= KNEE / 12.92, 12.92, (encoded + 0.055) / (2.4 * light))
    over = encoded > 1
    inside, numbers = encoded.clamp(0, 1), values[CURVES].view(3, 3).T[:, :, None, None]
    slope *= 1 + sum(n * term for n, term in zip(numbers, curve_slopes(inside), strict=True))
    result = encoded.clamp(max=1) + sum(n * term for n, term in zip(numbers, curve_terms(inside), strict=True))
    return result, torch.where(over, -slope, slope)


@dataclass(frozen=True)
class _Sampled:
    """Pixels of a photograph on a lattice, float64: (n,) positions x and y, (3, n) light of the scene, (3, n) the
    photograph, and (n,) whether they count."""

    x: Tensor
    y: Tensor
    light: Tensor
    photo: Tensor
    counts: Tensor


def _sampled(shown: Shown) -> _Sampled:
    x, y = sensor_axes(shown.camera, shown.color.double())
    by = max(1, math.ceil(math.sqrt(len(x) * len(y) / SAMPLES)))
    some = slice(by // 2, None, by)
    grid_y, grid_x = torch.meshgrid(y[some], x[some], indexing="ij")
    color, photo = (each[:, some, some].flatten(1).double() for each in (shown.color, shown.photo))
    counts = torch.ones_like(color[0]) if shown.mask is None else shown.mask[some, some].flatten().to(color)
    return _Sampled(grid_x.flatten(), grid_y.flatten(), _decoded(color), photo, counts)


def _equations(numbers: Tensor, at: _Sampled) -> tuple[Tensor, Tensor]:
    """(17, 17) and (17,): the normal equations of a Gauss-Newton step from the numbers of a photograph and its camera,
    as means over pixels; on the CPU."""
    own, values = numbers.to(at.light).split([OWN, OF_CAMERA])
    dx, dy = at.x - values[CENTRE][0], at.y - values[CENTRE][1]
    squared = dx.square() + dy.square()
    light = at.light * (own[:, None] - falloff(values, squared)).exp2()
    free = _encoded(light)
    encoded = free.clamp(0, 1)
    terms, slopes = torch.stack(curve_terms(encoded), 1), torch.stack(curve_slopes(encoded), 1)  # (3, 3, n)
    curves = values[CURVES].view(3, 3, 1)
    residual = at.photo - encoded - (curves * terms).sum(1)
    stops = (1 + (curves * slopes).sum(1)) * _encoding_slope(light, free)  # d colour / d stops
    seen = (free < 1) | (residual < 0)  # what is white in both says nothing
    stops, terms = stops * seen, terms * (free < 1)[:, None]
    a, b, c = values[FALLOFF]
    steep = 2 * (a + squared * (2 * b + squared * 3 * c))  # d falloff / d r, over r
    along = torch.stack([torch.ones_like(squared), -squared, -(squared**2), -(squared**3), steep * dx, steep * dy])
    jacobian = torch.cat([stops[:, None] * along, terms], 1)  # (3, 9, n)
    weight = at.counts / (1 + residual.abs() / ROBUST)
    weight = weight / at.counts.sum().clamp(min=1)
    weighted = jacobian * weight[:, None]
    normal, pull = torch.zeros(OWN + OF_CAMERA, OWN + OF_CAMERA).double(), torch.zeros(OWN + OF_CAMERA).double()
    squares, sums = (weighted @ jacobian.mT).cpu(), (weighted @ residual[..., None])[..., 0].cpu()
    for places, square, part in zip(PLACES, squares, sums, strict=True):
        normal[places[:, None], places] += square
        pull[places] += part
    return normal, pull


def _centred(looks: Looks, at: int, own: Tensor, camera: Tensor) -> Looks:
    """With the new numbers of a photograph (3,) and its camera (14, 15), and less of the change for all photographs, so
    that their mean stays what it was."""
    photos, cameras, which = looks.photos.clone(), looks.cameras.clone(), int(looks.taken_by[at])
    photos[at] = own
    photos += looks.photos.mean(0) - photos.mean(0)
    cameras[which] = camera
    shares = torch.bincount(looks.taken_by, minlength=len(cameras)).to(cameras) / len(photos)
    cameras[:, CURVES, 0] -= shares[which] * (cameras[which] - looks.cameras[which])[CURVES, 0]
    curves = cameras[:, CURVES, 0].view(-1, 3, 3)
    cameras[:, CURVES, 0] = (curves * (MAX_SLOPE_CHANGE / curves.abs().sum(2, keepdim=True)).clamp(max=1)).flatten(1)
    return Looks(photos, cameras, looks.taken_by)
