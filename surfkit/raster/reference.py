"""The definition of correct: the contract of `raster.api` in plain torch, any float dtype, differentiable.

Every formula here is evaluated as it stands in the papers, without the rearrangements that make the native kernels
fast, so that the two check each other. 2DGS: Huang et al. 2024; 3DGS: Kerbl et al. 2023; the depth of an ellipsoid
along a ray: Zhang et al. 2024 (RaDe-GS), as z instead of distance.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from surfkit.raster.api import ALPHA_MAX, ALPHA_MIN, CUTOFF, EDGE_ON, T_MIN, Gradients, Maps, Rasterizer, Render, Splats
from surfkit.raster.validate import validate
from surfkit.scene.camera import Camera

TILE = 16
DILATION = 0.3
ANTIALIAS_FLOOR = 2.5e-5
LOW_PASS_SIGMA = 3.0
"""The contour whose box has the low-pass filter's centre in its middle."""


@dataclass(frozen=True)
class Footprints:
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
        at: (rows, x, y) to rho, depth and opacity, (n, P), (n, P) and (n, 1), at P pixel positions.
    """

    drawn: Tensor
    z: Tensor
    color: Tensor
    normal: Tensor
    center: Tensor
    half: Tensor
    radius: Tensor
    screen: Tensor
    at: Callable[[Tensor, Tensor, Tensor], tuple[Tensor, Tensor, Tensor]]


@dataclass(frozen=True)
class Drawn:
    """A rendered view with its autograd graph; `near_threshold` (H, W) marks pixels where rounding may take another
    branch (an alpha within 1e-4 of ALPHA_MIN, a transmittance within 1e-4 of T_MIN or 0.5, relatively)."""

    maps: Maps
    footprints: Footprints
    seen: Tensor
    near_threshold: Tensor


def rotations(quats: Tensor) -> Tensor:
    """(N, 3, 3) rotations of (N, 4) quaternions wxyz of any length."""
    quats = quats / quats.detach().abs().amax(1, keepdim=True)  # lest the squares leave the range
    w, x, y, z = (quats / quats.norm(dim=1, keepdim=True)).unbind(1)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return torch.stack([torch.stack(row, 1) for row in rows], 1)


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
    basis = sh_basis(directions, splats.sh.shape[1])
    return ((basis[:, :, None] * splats.sh).sum(1) + 0.5).clamp_min(0)


def facing(normals: Tensor, centres: Tensor) -> Tensor:
    """(N, 3) the normals, turned so that they face a camera at the origin."""
    return torch.where((normals * centres).sum(1, keepdim=True) > 0, -normals, normals)


def clamped(z: Tensor, low: Tensor, high: Tensor) -> Tensor:
    """Depths kept in [low, high], which count as constants; low where not finite."""
    inside = (z >= low) & (z <= high)
    return torch.where(inside, torch.where(inside, z, low), torch.where(z > high, high, low).detach())


def surfels(splats: Splats, camera: Camera, near: float) -> Footprints:
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

    def box(sigma: float | Tensor) -> tuple[Tensor, Tensor]:
        squared = torch.as_tensor(sigma, dtype=t_w.dtype).expand(len(t_w)) ** 2
        t = torch.stack([squared, squared, -torch.ones_like(squared)], 1)
        d = (t * t_w * t_w).sum(1, keepdim=True)
        f = t / torch.where(d < 0, d, -torch.ones_like(d))
        middle = torch.stack([(f * t_u * t_w).sum(1), (f * t_v * t_w).sum(1)], 1)
        spread = middle**2 - torch.stack([(f * t_u * t_u).sum(1), (f * t_v * t_v).sum(1)], 1)
        return middle, spread.clamp_min(0)

    low_pass, _ = box(LOW_PASS_SIGMA)
    with torch.no_grad():
        k = (2 * (splats.opacities / ALPHA_MIN).clamp_min(1).log()).sqrt().clamp_max(CUTOFF)
        middle, spread = box(k)
        half = spread.sqrt()
        radius = torch.maximum(half.amax(1), k / 2**0.5)
        half = torch.maximum(half, (middle - low_pass).abs() + (k / 2**0.5)[:, None])
        reach = CUTOFF * t_w[:, :2].norm(dim=1)
        edge_on = (axes[:, :, 2] * centre).sum(1).abs() < EDGE_ON * centre.norm(dim=1)
        z = centre[:, 2]
        z_low, z_high = (z - reach).clamp_min(near)[:, None], (z + reach)[:, None]

    def at(rows: Tensor, x: Tensor, y: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        u_row, v_row, w_row = t_u[rows][:, None], t_v[rows][:, None], t_w[rows][:, None]
        ray = torch.linalg.cross(x[None, :, None] * w_row - u_row, y[None, :, None] * w_row - v_row)
        # Where the ray misses the plane, or so nearly that a slope leaves the range, no infinity enters the graph.
        meets = torch.isfinite(ray.detach()[..., :2] / ray.detach()[..., 2:] / ray.detach()[..., 2:]).all(-1)
        meets = meets & ~edge_on[rows][:, None]
        ray = torch.where(meets[..., None], ray, 1.0)
        uv = ray[..., :2] / ray[..., 2:]
        rho_disc = (uv**2).sum(-1)
        offset = torch.stack([x[None] - low_pass[rows, :1], y[None] - low_pass[rows, 1:]], -1)
        rho_low = 2 * (offset**2).sum(-1)
        on_disc = meets & (rho_disc <= rho_low)
        rho = torch.where(on_disc, rho_disc, rho_low)
        depth = (uv * w_row[..., :2]).sum(-1) + w_row[..., 2]
        depth = torch.where(meets, depth, z_low[rows])
        return rho, clamped(depth, z_low[rows], z_high[rows]), splats.opacities[rows][:, None]

    normal = facing(axes[:, :, 2], centre.detach())
    return Footprints(drawn, centre[:, 2], colors(splats, camera), normal, middle, half, radius, screen, at)


def gaussians(splats: Splats, camera: Camera, near: float) -> Footprints:
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
    footprint = raw + DILATION * torch.eye(2).to(raw)
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
    steep = (axes * weight[:, None]).sum(2)
    steep = steep / (steep * ray).sum(1, keepdim=True)
    slope = -z[:, None] * steep[:, :2] / torch.tensor([camera.fx, camera.fy], dtype=steep.dtype)
    with torch.no_grad():
        k = (2 * (opacity / ALPHA_MIN).clamp_min(1).log()).sqrt()
        half = k[:, None] * torch.stack([footprint[:, 0, 0], footprint[:, 1, 1]], 1).sqrt()
        reach = CUTOFF * splats.scales.amax(1)
        z_low, z_high = (z - reach).clamp_min(near)[:, None], (z + reach)[:, None]

    def at(rows: Tensor, x: Tensor, y: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        offset = torch.stack([x[None] - screen[rows, :1], y[None] - screen[rows, 1:]], -1)
        rho = torch.einsum("npi,nij,npj->np", offset, conic[rows], offset)
        depth = z[rows][:, None] + (offset * slope[rows][:, None]).sum(-1)
        return rho, clamped(depth, z_low[rows], z_high[rows]), opacity[rows][:, None]

    thin = splats.scales.argmin(1)
    normal = facing(axes[torch.arange(len(z)), :, thin], centre.detach())
    radius = half.amax(1)
    return Footprints(drawn, centre[:, 2], colors(splats, camera), normal, screen.detach(), half, radius, screen, at)


def draw(splats: Splats, camera: Camera, near: float, *, cull: bool = True) -> Drawn:
    """Draw splats with the autograd graph kept.

    Args:
        splats: Any float dtype.
        camera: World is the splats' frame.
        near: Local units, as in `Rasterizer.render`.
        cull: Skip splats whose box misses a tile; off, every splat is evaluated at every pixel.
    """
    validate(splats)
    prints = (surfels if splats.kind == "surfel" else gaussians)(splats, camera, near)
    near_threshold = torch.zeros(camera.height, camera.width, dtype=torch.bool)
    seen = torch.zeros(len(splats), dtype=torch.bool)
    blocks = []
    for tile in _tiles(camera):
        x0, y0, x1, y1 = tile
        rows, x, y = _in_tile(prints, tile, cull), *_pixels(tile, splats.means.dtype)
        # The way back draws the tile again, so that one tile at a time is in memory and not the whole view.
        block, risky, touched = checkpoint(_blend, prints, rows, x, y, use_reentrant=False, preserve_rng_state=False)
        seen[rows[touched]] = True
        near_threshold[y0:y1, x0:x1] = risky.view(y1 - y0, x1 - x0)
        blocks.append(block.view(10, y1 - y0, x1 - x0))
    across = -(-camera.width // TILE)
    channels = torch.cat([torch.cat(blocks[i : i + across], 2) for i in range(0, len(blocks), across)], 1)
    maps = Maps(channels[0:3], channels[3], channels[4], channels[5], channels[6:9], channels[9])
    return Drawn(maps, prints, seen, near_threshold)


def _tiles(camera: Camera) -> Iterator[tuple[int, int, int, int]]:
    """Left, upper, right and lower edge of each tile, row by row."""
    for y0 in range(0, camera.height, TILE):
        for x0 in range(0, camera.width, TILE):
            yield x0, y0, min(x0 + TILE, camera.width), min(y0 + TILE, camera.height)


def _pixels(tile: tuple[int, int, int, int], dtype: torch.dtype) -> tuple[Tensor, Tensor]:
    """x and y of the pixel centres in a tile, (P,) each."""
    x0, y0, x1, y1 = tile
    y, x = torch.meshgrid(torch.arange(y0, y1) + 0.5, torch.arange(x0, x1) + 0.5, indexing="ij")
    return x.flatten().to(dtype), y.flatten().to(dtype)


def _in_tile(prints: Footprints, tile: tuple[int, int, int, int], cull: bool) -> Tensor:
    """Rows of the splats that may touch a tile, front to back; the order of float32 depths, in every precision."""
    keep = prints.drawn.clone()
    if cull:
        low = torch.tensor(tile[:2]).to(prints.half)
        high = torch.tensor(tile[2:]).to(prints.half)
        keep &= ((prints.center + prints.half + 1 >= low) & (prints.center - prints.half - 1 <= high)).all(1)
    rows = keep.nonzero()[:, 0]
    return rows[prints.z.detach()[rows].float().argsort(stable=True)]


def _alphas(prints: Footprints, rows: Tensor, x: Tensor, y: Tensor) -> tuple[Tensor, ...]:
    """What is blended, and where.

    Returns:
        Alpha of what is blended (else 0), transmittance before it and depth, (n, P) each; (P,) pixels near a
        threshold; (n,) rows whose footprint holds a pixel, be it hidden or not.
    """
    rho, depth, opacity = prints.at(rows, x, y)
    raw = opacity * torch.exp(-rho / 2)
    alpha = torch.where(raw >= ALPHA_MIN, raw.clamp_max(ALPHA_MAX), torch.zeros_like(raw))
    after = torch.cumprod(1 - alpha, 0)
    blended = (alpha > 0) & (after >= T_MIN)
    before = torch.cat([torch.ones_like(after[:1]), torch.cumprod(1 - torch.where(blended, alpha, 0.0), 0)[:-1]])
    with torch.no_grad():
        margins = [(raw / ALPHA_MIN - 1).abs(), (after / T_MIN - 1).abs(), (after / 0.5 - 1).abs()]
        risky = (torch.stack(margins) < 1e-4).any(0).any(0)
    return torch.where(blended, alpha, 0.0), before, depth, risky, (alpha > 0).any(1)


def _blend(prints: Footprints, rows: Tensor, x: Tensor, y: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """The ten channels at P pixels, (10, P), the pixels near a threshold, (P,), and whether a row touches one, (n,)."""
    if not len(rows):
        return torch.zeros(10, len(x), dtype=x.dtype), torch.zeros(len(x), dtype=torch.bool), rows.bool()
    alpha, before, depth, risky, touched = _alphas(prints, rows, x, y)
    weight = alpha * before
    total = weight.sum(0)
    met = (alpha > 0) & (before > 0.5)
    last = (met * torch.arange(1, len(rows) + 1)[:, None]).amax(0)
    opaque = (last > 0) & (total >= 0.5)
    median = torch.where(opaque, depth.gather(0, (last - 1).clamp_min(0)[None])[0], 0.0)
    inverse = 1 / depth
    shift = inverse.detach().mean(0)  # a pair's difference does not change with it, its rounding does
    inverse = inverse - shift
    ahead, ahead1, ahead2 = (torch.cumsum(weight * inverse**p, 0) - weight * inverse**p for p in (0, 1, 2))
    bend = (weight * (inverse**2 * ahead + ahead2 - 2 * inverse * ahead1)).sum(0)
    parts = [prints.color[rows].T @ weight, total[None], (weight * depth).sum(0)[None], median[None]]
    block = torch.cat([*parts, prints.normal[rows].T @ weight, bend[None]])
    return block, risky, touched


class Reference(Rasterizer):
    """Draws with `draw`, in the precision of the splats; slow, and right."""

    def render(
        self, splats: Splats, camera: Camera, near: float, geometry: bool = True, distortion: bool = True
    ) -> Render:
        left_out = {"distortion"} if not distortion else set()
        if not geometry:
            left_out = {"depth", "median", "normal", "distortion"}
        return ReferenceRender(splats, camera, near, left_out)

    def contribution(
        self, splats: Splats, camera: Camera, near: float, alpha_power: float, transmittance_power: float
    ) -> tuple[Tensor, Tensor]:
        validate(splats)
        total = torch.zeros(len(splats), dtype=splats.means.dtype)
        count = torch.zeros(len(splats), dtype=torch.int64)
        with torch.no_grad():
            prints = (surfels if splats.kind == "surfel" else gaussians)(splats, camera, near)
            for tile in _tiles(camera):
                rows, x, y = _in_tile(prints, tile, True), *_pixels(tile, total.dtype)
                alpha, before, *_ = _alphas(prints, rows, x, y)
                term = torch.where(alpha > 0, alpha**alpha_power * before**transmittance_power, 0.0)
                total[rows] += term.sum(1)
                count[rows] += (alpha > 0).sum(1)
        return total, count


class ReferenceRender(Render):
    """A view drawn by the reference; autograd takes it back."""

    def __init__(self, splats: Splats, camera: Camera, near: float, left_out: set[str]) -> None:
        leaves = {name: value.detach().requires_grad_() for name, value in splats.tensors().items()}
        with torch.enable_grad():
            self._drawn = draw(Splats(splats.kind, *leaves.values(), splats.antialias), camera, near)
        self._leaves = leaves
        self._surfel = splats.kind == "surfel"
        self._half_image = torch.tensor([camera.width / 2, camera.height / 2]).to(splats.means)
        made = self._drawn.maps.present()
        self.maps = Maps(**{name: value.detach() for name, value in made.items() if name not in left_out})
        self.seen = self._drawn.seen
        prints = self._drawn.footprints
        self.radii = torch.where(self.seen, prints.radius.detach(), 0.0)

    def backward(self, total: Maps, chosen: Maps | None = None) -> Gradients:
        leaves = list(self._leaves.values())
        *grads, screen = self._pull(total, [*leaves, self._drawn.footprints.screen])
        part = None
        if chosen is not None:
            part = self._signal(self._pull(chosen, [self._drawn.footprints.screen])[0])
        return Gradients(*grads, self._signal(screen), part)

    def _pull(self, cotangents: Maps, wanted: list[Tensor]) -> list[Tensor]:
        given = cotangents.present()
        outputs = [getattr(self._drawn.maps, name) for name in given]
        pairs = [(out, value.to(out)) for out, value in zip(outputs, given.values(), strict=True) if out.requires_grad]
        if not pairs:
            return [torch.zeros_like(t) for t in wanted]
        grads = torch.autograd.grad(
            [out for out, _ in pairs], wanted, [value for _, value in pairs], retain_graph=True, allow_unused=True
        )
        return [torch.zeros_like(t) if g is None else g for t, g in zip(wanted, grads, strict=True)]

    def _signal(self, screen: Tensor) -> Tensor:
        if self._surfel:
            depth = self._drawn.footprints.screen.detach()[:, 2, 2:]
            screen = torch.stack([screen[:, 0, 2], screen[:, 1, 2]], 1) * depth
        return torch.where(self.seen[:, None], screen * self._half_image, 0.0)
