"""Where splats lie on the image plane, in plain torch: the formulas of the papers as they stand there.

2DGS: Huang et al. 2024; 3DGS: Kerbl et al. 2023; the depth of an ellipsoid along a ray: Zhang et al. 2024 (RaDe-GS),
as z instead of distance.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from surfkit.raster.api import ALONG_RAYS, ALPHA_MIN, CUTOFF, Splats
from surfkit.scene.camera import Camera
from surfkit.scene.rotations import rotations

ANTIALIAS_FLOOR = 2.5e-5
LOW_PASS_SIGMA = 3.0
"""The contour whose box has the low-pass filter's centre in its middle."""

EDGE_ON = 2e-3
"""Radians between a disc's plane and the ray to its centre, below which only the low-pass filter draws it."""

MIN_FOOTPRINT = 1e-6
"""Pixels: ellipsoids along rays whose standard deviation on the screen is below this in a direction are not
drawn, as nothing widens them there."""


@dataclass(frozen=True)
class ProjectedSplats:
    """N splats on the image plane.

    Attributes:
        drawn: (N,) bool, not culled.
        z: (N,) depth of the centres.
        color: (N, 3).
        normal: (N, 3) camera frame, facing the camera.
        center: (N, 2) pixels, middle of the box.
        half: (N, 2) pixels, half sides of the box in which alpha reaches ALPHA_MIN.
        radius: (N,) pixels, half the larger side of the contour's own box, the low-pass disc's at least.
        screen: What the densification signal is the gradient of: (N, 3, 3) homographies or (N, 2) centres.
        normals: (rows, x, y) to normals (n, P, 3) that differ from pixel to pixel; None where `normal` holds.
        peaks: (rows, x, y, shift) to where the density is largest along each ray and, of solids, how fast it falls: rho
            grows by curve times the squared distance of depths; (n, P) each. None where no median depth of solids is
            wanted.
        near: Nothing nearer to the camera is a depth.
        at: (rows, x, y, shift) to rho, depth and opacity, (n, P), (n, P) and (n, 1), at P pixel positions; shift is
            added to what the signal is the gradient of, (n, P, 2) or 0.
    """

    drawn: Tensor
    z: Tensor
    color: Tensor
    normal: Tensor
    center: Tensor
    half: Tensor
    radius: Tensor
    screen: Tensor
    at: Callable[[Tensor, Tensor, Tensor, Tensor], tuple[Tensor, Tensor, Tensor]]
    normals: Callable[[Tensor, Tensor, Tensor], Tensor] | None = None
    peaks: Callable[[Tensor, Tensor, Tensor, Tensor], tuple[Tensor, Tensor]] | None = None
    near: float = 0.0


def footprints(splats: Splats, camera: Camera, near: float) -> ProjectedSplats:
    """Project splats of any kind and geometry."""
    if splats.kind == "surfel":
        return surfels(splats, camera, near)
    return (along_rays if splats.geometry in ALONG_RAYS else gaussians)(splats, camera, near)


def sh_basis(directions: Tensor, count: int) -> Tensor:
    """(N, count) real spherical harmonics of degree <= 3 at (N, 3) unit directions; count is 1, 4, 9 or 16."""
    x, y, z = directions.unbind(1)
    basis = [torch.full_like(x, 0.28209479177387814)]
    if count >= 4:
        basis += [c * 0.4886025119029199 for c in (-y, z, -x)]
    if count >= 9:
        c = 1.0925484305920792
        basis += [c * x * y, -c * y * z, 0.31539156525252005 * (3 * z * z - 1), -c * x * z, c / 2 * (x * x - y * y)]
    if count >= 16:
        basis += [
            -0.5900435899266435 * y * (3 * x * x - y * y),
            2.890611442640554 * x * y * z,
            -0.4570457994644658 * y * (5 * z * z - 1),
            0.3731763325901154 * z * (5 * z * z - 3),
            -0.4570457994644658 * x * (5 * z * z - 1),
            1.445305721320277 * z * (x * x - y * y),
            -0.5900435899266435 * x * (x * x - 3 * y * y),
        ]
    return torch.stack(basis, 1)


def colors(splats: Splats, camera: Camera) -> Tensor:
    """(N, 3) colours of the splats as seen from the camera, not negative."""
    offset = splats.means - camera.centre.to(splats.means)
    length = offset.norm(dim=1, keepdim=True)
    directions = offset / torch.where(length > 0, length, 1.0)
    sh = splats.sh
    return ((sh_basis(directions, sh.shape[1])[:, :, None] * sh).sum(1) + 0.5).clamp_min(0)


def facing(normals: Tensor, centres: Tensor) -> Tensor:
    """(N, 3) the normals, turned so that they face a camera at the origin."""
    return torch.where((normals * centres).sum(1, keepdim=True) > 0, -normals, normals)


def clamped(z: Tensor, low: Tensor, high: Tensor) -> Tensor:
    """(N, ...) depths kept in [low, high], which count as constants; low where not finite."""
    inside = (z >= low) & (z <= high)
    return torch.where(inside, torch.where(inside, z, low), torch.where(z > high, high, low).detach())


def surfels(splats: Splats, camera: Camera, near: float) -> ProjectedSplats:
    """Project discs (2DGS, section 4.2)."""
    to_camera = camera.world_to_camera.to(splats.means)
    turn = to_camera[:3, :3]
    centre = splats.means @ turn.T + to_camera[:3, 3]
    axes = turn @ rotations(splats.quats)
    disc = torch.stack([axes[:, :, 0] * splats.scales[:, :1], axes[:, :, 1] * splats.scales[:, 1:], centre], 2)
    screen = torch.stack(
        [
            camera.fx * disc[:, 0] + camera.cx * disc[:, 2],
            camera.fy * disc[:, 1] + camera.cy * disc[:, 2],
            disc[:, 2],
        ],
        1,
    )
    t_u, t_v, t_w = screen.unbind(1)
    drawn = (centre[:, 2] > near) & (splats.opacities > ALPHA_MIN)
    drawn &= CUTOFF**2 * (t_w[:, 0] ** 2 + t_w[:, 1] ** 2) < t_w[:, 2] ** 2

    def box(sigma: float | Tensor) -> tuple[Tensor, Tensor, Tensor]:
        squared = torch.as_tensor(sigma, dtype=t_w.dtype).expand(len(t_w)) ** 2
        t = torch.stack([squared, squared, -torch.ones_like(squared)], 1)
        d = (t * t_w * t_w).sum(1, keepdim=True)
        f = t / torch.where(d < 0, d, -torch.ones_like(d))
        middle = torch.stack([(f * t_u * t_w).sum(1), (f * t_v * t_w).sum(1)], 1)
        spread = middle**2 - torch.stack([(f * t_u * t_u).sum(1), (f * t_v * t_v).sum(1)], 1)
        return middle, spread.clamp_min(0), f[:, 2] * t_w[:, 2]

    low_pass, _, slope = box(LOW_PASS_SIGMA)
    with torch.no_grad():
        k = (2 * (splats.opacities / ALPHA_MIN).clamp_min(1).log()).sqrt().clamp_max(CUTOFF)
        middle, spread, _ = box(k)
        half = spread.sqrt()
        radius = torch.maximum(half.amax(1), k / 2**0.5)
        half = torch.maximum(half, (middle - low_pass).abs() + (k / 2**0.5)[:, None])
        reach = CUTOFF * t_w[:, :2].norm(dim=1)
        edge_on = (axes[:, :, 2] * centre).sum(1).abs() < EDGE_ON * centre.norm(dim=1)
        z = centre[:, 2]
        z_low, z_high = (z - reach).clamp_min(near)[:, None], (z + reach)[:, None]

    def at(rows: Tensor, x: Tensor, y: Tensor, shift: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        along = torch.tensor([0, 0, 1]).to(t_w)
        u_row = t_u[rows][:, None] + shift[..., :1] * along
        v_row, w_row = t_v[rows][:, None] + shift[..., 1:] * along, t_w[rows][:, None]
        ray = torch.linalg.cross(x[None, :, None] * w_row - u_row, y[None, :, None] * w_row - v_row)
        # Where the ray misses the plane, or so nearly that a slope leaves the range, no infinity enters the graph.
        meets = torch.isfinite(ray.detach()[..., :2] / ray.detach()[..., 2:] / ray.detach()[..., 2:]).all(-1)
        meets = meets & ~edge_on[rows][:, None]
        ray = torch.where(meets[..., None], ray, 1.0)
        uv = ray[..., :2] / ray[..., 2:]
        rho_disc = (uv**2).sum(-1)
        offset = torch.stack([x[None] - low_pass[rows, :1], y[None] - low_pass[rows, 1:]], -1)
        offset = offset - slope[rows][:, None, None] * shift
        rho_low = 2 * (offset**2).sum(-1)
        on_disc = meets & (rho_disc <= rho_low)
        rho = torch.where(on_disc, rho_disc, rho_low)
        depth = (uv * w_row[..., :2]).sum(-1) + w_row[..., 2]
        depth = torch.where(meets, depth, z_low[rows])
        return rho, clamped(depth, z_low[rows], z_high[rows]), splats.opacities[rows][:, None]

    normal = facing(axes[:, :, 2], centre.detach())
    return ProjectedSplats(drawn, centre[:, 2], colors(splats, camera), normal, middle, half, radius, screen, at)


def gaussians(splats: Splats, camera: Camera, near: float) -> ProjectedSplats:
    """Project ellipsoids (3DGS, section 4) with their depth along the ray to first order."""
    to_camera = camera.world_to_camera.to(splats.means)
    turn = to_camera[:3, :3]
    centre = splats.means @ turn.T + to_camera[:3, 3]
    axes = turn @ rotations(splats.quats)
    drawn = centre[:, 2] > near
    centre = torch.where(drawn[:, None], centre, torch.tensor([0, 0, 1]).to(centre))
    z = centre[:, 2]
    tan_x, tan_y = 0.5 * camera.width / camera.fx, 0.5 * camera.height / camera.fy
    jx = (centre[:, 0] / z).clamp(
        -camera.cx / camera.fx - 0.3 * tan_x, (camera.width - camera.cx) / camera.fx + 0.3 * tan_x
    )
    jy = (centre[:, 1] / z).clamp(
        -camera.cy / camera.fy - 0.3 * tan_y, (camera.height - camera.cy) / camera.fy + 0.3 * tan_y
    )
    zero = torch.zeros_like(z)
    jacobian = torch.stack(
        [
            torch.stack([camera.fx / z, zero, -camera.fx * jx / z], 1),
            torch.stack([zero, camera.fy / z, -camera.fy * jy / z], 1),
        ],
        1,
    )
    half_axes = jacobian @ axes * splats.scales[:, None]
    raw = half_axes @ half_axes.transpose(1, 2)
    footprint = raw + splats.dilation * torch.eye(2).to(raw)
    opacity = splats.opacities
    if splats.antialias:
        kept, whole = (m[:, 0, 0] * m[:, 1, 1] - m[:, 0, 1] * m[:, 1, 0] for m in (raw, footprint))
        opacity = opacity * (kept / whole).clamp_min(ANTIALIAS_FLOOR).sqrt()
    drawn = drawn & (opacity > ALPHA_MIN)
    conic = torch.linalg.inv(footprint)
    screen = torch.stack([camera.fx * centre[:, 0] / z + camera.cx, camera.fy * centre[:, 1] / z + camera.cy], 1)
    # Density along a ray d0 + offset is largest at z (1 - offset . P d0 / d0 . P d0), P the precision matrix.
    ray = centre / z[:, None]
    weight = (splats.scales.amin(1, keepdim=True) / splats.scales) ** 2 * (axes * ray[:, :, None]).sum(1)
    upright = (axes * weight[:, None]).sum(2)
    steep = upright / (upright * ray).sum(1, keepdim=True)
    slope = -z[:, None] * steep[:, :2] / torch.tensor([camera.fx, camera.fy], dtype=steep.dtype)
    with torch.no_grad():
        k = (2 * (opacity / ALPHA_MIN).clamp_min(1).log()).sqrt()
        half = k[:, None] * torch.stack([footprint[:, 0, 0], footprint[:, 1, 1]], 1).sqrt()
        reach = CUTOFF * splats.scales.amax(1)
        z_low, z_high = (z - reach).clamp_min(near)[:, None], (z + reach)[:, None]

    def at(rows: Tensor, x: Tensor, y: Tensor, shift: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        offset = torch.stack([x[None] - screen[rows, :1], y[None] - screen[rows, 1:]], -1) - shift
        rho = torch.einsum("npi,nij,npj->np", offset, conic[rows], offset)
        depth = z[rows][:, None] + (offset * slope[rows][:, None]).sum(-1)
        return rho, clamped(depth, z_low[rows], z_high[rows]), opacity[rows][:, None]

    thin = splats.scales.argmin(1)
    normal = facing(axes[torch.arange(len(z)), :, thin], centre.detach())
    if splats.geometry == "plane":
        size = upright.norm(dim=1, keepdim=True)
        normal = torch.where(size > 0, -upright / torch.where(size > 0, size, 1.0), normal)
    radius = half.amax(1)
    return ProjectedSplats(
        drawn, centre[:, 2], colors(splats, camera), normal, screen.detach(), half, radius, screen, at
    )


def along_rays(splats: Splats, camera: Camera, near: float) -> ProjectedSplats:
    """Ellipsoids evaluated in space at the largest density along each ray (GOF, section 4.1).

    In the frame in which the ellipsoid is the unit sphere the ray is o + t r with A = r.r, B = 2 o.r, C = o.o: depth is
    t = -B / 2A and rho is C - B^2 / 4A = |o x r|^2 / A. Not drawn where the contour at CUTOFF reaches the camera plane.
    """
    to_camera = camera.world_to_camera.to(splats.means)
    turn = to_camera[:3, :3]
    centre = splats.means @ turn.T + to_camera[:3, 3]
    axes = turn @ rotations(splats.quats)
    focal = torch.tensor([camera.fx, camera.fy], dtype=centre.dtype, device=centre.device)
    with torch.no_grad():
        z = centre[:, 2]
        drawn = (z > near) & (splats.opacities > ALPHA_MIN)
        ahead = torch.where(drawn, z, 1.0)
        sized = axes * splats.scales[:, None]
        spread = (sized[:, :2] - (centre[:, :2] / ahead[:, None])[:, :, None] * sized[:, 2:]) * focal[:, None]
        across = spread / ahead[:, None, None]  # (N, 2, 3): pixels per axis
        xx, xy, yy = (across[:, i] * across[:, j] for i, j in ((0, 0), (0, 1), (1, 1)))
        xx, xy, yy = xx.sum(1), xy.sum(1), yy.sum(1)
        det = torch.linalg.cross(across[:, 0], across[:, 1]).square().sum(1)
        drawn &= (MIN_FOOTPRINT**2 * torch.maximum(xx, yy) < det) & (MIN_FOOTPRINT**2 < torch.minimum(xx, yy))
        drawn &= CUTOFF**2 * sized[:, 2].square().sum(1) < z**2
    centre = torch.where(drawn[:, None], centre, torch.tensor([0, 0, 1]).to(centre))
    scales, z = torch.where(drawn[:, None], splats.scales, 1.0), centre[:, 2]
    least = scales.detach().amin(1, keepdim=True)  # all is in units of it, lest the squares leave the range
    into = axes.transpose(1, 2) * (least / scales)[:, :, None]
    origin = -(into @ centre[:, :, None])[:, :, 0]
    screen = torch.stack([camera.fx * centre[:, 0] / z + camera.cx, camera.fy * centre[:, 1] / z + camera.cy], 1)
    with torch.no_grad():
        k = (2 * (splats.opacities / ALPHA_MIN).clamp_min(1).log()).clamp_max(CUTOFF**2)[:, None]
        depth2 = torch.where(drawn, z**2 - k[:, 0] * sized[:, 2].square().sum(1), 1.0)[:, None]
        tilt = (spread * sized[:, 2:]).sum(2)
        off = -k * tilt / depth2
        half = (off**2 + k * spread.square().sum(2) / depth2).sqrt()
        reach = CUTOFF * scales.amax(1)
        z_low, z_high = (z - reach).clamp_min(near)[:, None], (z + reach)[:, None]

    def ray_of(rows: Tensor, x: Tensor, y: Tensor, shift: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """The camera, the ray and how far it is turned from that through the centre; (n, 1, 3), (n, P, 3) twice."""
        offset = torch.stack([x[None] - screen[rows, :1], y[None] - screen[rows, 1:]], -1) - shift
        turned = torch.einsum("nij,npj->npi", into[rows][:, :, :2], offset / focal)
        start = origin[rows][:, None]
        return start, turned - start / z[rows][:, None, None], turned

    def at(rows: Tensor, x: Tensor, y: Tensor, shift: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        start, ray, turned = ray_of(rows, x, y, shift)
        a, b = (ray**2).sum(-1), 2 * (start * ray).sum(-1)
        # What the ray through the centre adds to the cross product is 0.
        rho = torch.linalg.cross(start.expand_as(turned), turned).square().sum(-1) / a / least[rows] ** 2
        depth = -b / (2 * a)
        return rho, clamped(depth, z_low[rows], z_high[rows]), splats.opacities[rows][:, None]

    def peaks(rows: Tensor, x: Tensor, y: Tensor, shift: Tensor) -> tuple[Tensor, Tensor]:
        start, ray, _ = ray_of(rows, x, y, shift)
        a = (ray**2).sum(-1)
        return -(start * ray).sum(-1) / a, a / least[rows] ** 2

    def normals(rows: Tensor, x: Tensor, y: Tensor) -> Tensor:
        ray = torch.stack([(x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy, torch.ones_like(x)], -1)
        steep = torch.einsum("nki,nkj,pj->npi", into[rows], into[rows], ray)
        return -steep / steep.norm(dim=-1, keepdim=True).clamp_min(1e-30)

    normal = facing(axes[torch.arange(len(z)), :, scales.argmin(1)], centre.detach())
    radius = half.amax(1)
    middle = screen.detach() + off
    return ProjectedSplats(
        *(drawn, z, colors(splats, camera), normal, middle, half, radius, screen, at, normals),
        peaks=peaks if splats.geometry == "solid" else None,
        near=near,
    )
