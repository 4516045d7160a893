"""Ellipsoids evaluated in space, along rays, instead of by footprints on the image plane.

They hide by their largest density before a point (Yu et al. 2024, GOF), or as stochastic solids (Zhang et al. 2026,
GGGS).
"""

from __future__ import annotations

import torch
from torch import Tensor

from surfkit.core.check import BadInput
from surfkit.raster import native
from surfkit.raster.api import ALPHA_MAX, ALPHA_MIN, CUTOFF, Splats
from surfkit.raster.validate import validate
from surfkit.scene.camera import Camera
from surfkit.scene.rotations import rotations

BATCH_POINT_SPLATS = 1 << 22
"""Pairs of a point and a splat that the reference evaluates at once."""


def ray_opacity(splats: Splats, camera: Camera, near: float, points: Tensor, solid: bool = False) -> Tensor:
    """What ellipsoids hide of points from a camera: the opacity field of one view.

    That is 1 - product of (1 - alpha), where alpha is the opacity times the largest density on the ray between `near`
    and the point (GOF, section 4.2): one that the point lies in hides it in part. Compiled, on
    `torch.get_num_threads()` threads, with the same bits on any number of them.

    As stochastic solids (GGGS, eq. 11 and 12), with the opacity times the density G at the point, and G* at the largest
    density on the ray, an ellipsoid leaves open sqrt(1 - G) up to there and (1 - G*) / sqrt(1 - G) behind: it goes on
    hiding while the density falls, and behind it both ways hide the same. G and G* are at most ALPHA_MAX. Where G is
    below ALPHA_MIN it counts as 0, as in pictures; the tail that is cut would hide 0.2 % at either end. What lies in
    front of `near` counts as if it were there.

    Args:
        splats: N ellipsoids; as where rays are drawn (`Splats.geometry`), those do not count whose centre has z <= near
            or whose contour at CUTOFF reaches the camera plane.
        camera: World is the splats' frame.
        near: Local units.
        points: (P, 3) world.
        solid: Whether they hide as stochastic solids.

    Returns:
        (P,) in [0, 1]; NaN where the point is outside the image or not beyond `near`.

    Raises:
        BadInput: The splats are not ellipsoids, or a value is not finite.
    """
    validate(splats)
    if splats.scales.shape[1] != 3:
        raise BadInput(f"rays meet ellipsoids, which have three scales; {splats.kind} splats have two")
    if native.module() is None:
        return ray_opacity_reference(splats, camera, near, points, solid)
    arrays = (splats.means, splats.quats, splats.scales, splats.opacities)
    opacity = torch.empty(len(points), dtype=torch.float32)
    native.kernels().ray_opacity(
        [value.detach().to("cpu", torch.float32).contiguous() for value in arrays],
        camera.world_to_camera.double().flatten().tolist(),
        [camera.fx, camera.fy, camera.cx, camera.cy],
        camera.width,
        camera.height,
        near,
        camera.project(points.cpu()).contiguous(),
        solid,
        opacity,
        torch.get_num_threads(),
    )
    return opacity.to(points.device)


def ray_opacity_reference(splats: Splats, camera: Camera, near: float, points: Tensor, solid: bool = False) -> Tensor:
    """(P,) as `ray_opacity`, in plain torch, in the precision of the splats, every pair of a point and a splat."""
    to_camera = camera.world_to_camera.to(splats.means)
    centre = splats.means @ to_camera[:3, :3].T + to_camera[:3, 3]
    axes = to_camera[:3, :3] @ rotations(splats.quats)
    units = axes.transpose(1, 2) / splats.scales[:, :, None]
    origin = -torch.einsum("nij,nj->ni", units, centre)
    x, y, z = camera.project(points).to(splats.means).unbind(1)
    found = torch.full_like(z, torch.nan)
    inside = ((z > near) & (x >= 0) & (y >= 0) & (x < camera.width) & (y < camera.height)).nonzero()[:, 0]
    deep = (axes[:, 2] * splats.scales).square().sum(1) * CUTOFF**2
    there = (centre[:, 2] > near) & (deep < centre[:, 2] ** 2)
    for rows in inside.split(max(1, BATCH_POINT_SPLATS // max(1, len(splats)))):  # type: ignore[no-untyped-call]
        ray = torch.stack(
            [(x[rows] - camera.cx) / camera.fx, (y[rows] - camera.cy) / camera.fy, torch.ones_like(z[rows])], 1
        )
        direction = torch.einsum("nij,pj->pni", units, ray)
        a, b = direction.square().sum(2), 2 * (direction * origin).sum(2)
        c = origin.square().sum(1)
        here, peak = z[rows][:, None], -b / (2 * a)

        def alpha(t: Tensor, a: Tensor = a, b: Tensor = b, c: Tensor = c) -> Tensor:
            value = splats.opacities * torch.exp(-(a * t**2 + b * t + c) / 2)
            return torch.where((value >= ALPHA_MIN) & there, value.clamp_max(ALPHA_MAX), 0.0)

        if solid:
            t = peak.clamp_min(near)
            vacancy = (1 - alpha(here)).sqrt()
            left = torch.where(t < here, (1 - alpha(t)) / vacancy, vacancy)
        else:
            left = 1 - alpha(torch.minimum(peak, here).clamp_min(near))
        found[rows] = 1 - left.prod(1)
    return found
