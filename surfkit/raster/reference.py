"""The definition of correct: the contract of `raster.api` in plain torch, any float dtype, differentiable.

Every formula, here and in `raster.footprints`, is evaluated as it stands in the papers, without the rearrangements that
make the native kernels fast, so that the two check each other.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from surfkit.raster.api import ALPHA_MAX, ALPHA_MIN, T_MIN, Gradients, Maps, Render, Splats
from surfkit.raster.base import Rasterizer
from surfkit.raster.projection import ProjectedSplats, footprints
from surfkit.raster.solids import Solids
from surfkit.raster.validate import validate
from surfkit.scene.camera import Camera

TILE_SIDE_PX = 16


@dataclass(frozen=True)
class DifferentiableView:
    """A rendered view with its autograd graph; `near_threshold` (H, W) marks pixels where rounding may take another
    branch (an alpha within 1e-4 of ALPHA_MIN, a transmittance within 1e-4 of T_MIN or 0.5, relatively)."""

    maps: Maps
    footprints: ProjectedSplats
    seen: Tensor
    near_threshold: Tensor


def draw(splats: Splats, camera: Camera, near: float, *, cull: bool = True) -> DifferentiableView:
    """Draw splats with the autograd graph kept.

    Args:
        splats: Any float dtype.
        camera: World is the splats' frame.
        near: Local units, as in `Rasterizer.render`.
        cull: Skip splats whose box misses a tile; off, every splat is evaluated at every pixel.
    """
    validate(splats)
    prints = footprints(splats, camera, near)
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
    across = -(-camera.width // TILE_SIDE_PX)
    channels = torch.cat([torch.cat(blocks[i : i + across], 2) for i in range(0, len(blocks), across)], 1)
    maps = Maps(channels[0:3], channels[3], channels[4], channels[5], channels[6:9], channels[9])
    return DifferentiableView(maps, prints, seen, near_threshold)


def _tiles(camera: Camera) -> Iterator[tuple[int, int, int, int]]:
    """Left, upper, right and lower edge of each tile, row by row."""
    for y0 in range(0, camera.height, TILE_SIDE_PX):
        for x0 in range(0, camera.width, TILE_SIDE_PX):
            yield x0, y0, min(x0 + TILE_SIDE_PX, camera.width), min(y0 + TILE_SIDE_PX, camera.height)


def _pixels(tile: tuple[int, int, int, int], dtype: torch.dtype) -> tuple[Tensor, Tensor]:
    """x and y of the pixel centres in a tile, (P,) each."""
    x0, y0, x1, y1 = tile
    y, x = torch.meshgrid(torch.arange(y0, y1) + 0.5, torch.arange(x0, x1) + 0.5, indexing="ij")
    return x.flatten().to(dtype), y.flatten().to(dtype)


def _in_tile(prints: ProjectedSplats, tile: tuple[int, int, int, int], cull: bool) -> Tensor:
    """Rows of the splats that may touch a tile, front to back; the order of float32 depths, in every precision."""
    keep = prints.drawn.clone()
    if cull:
        low = torch.tensor(tile[:2]).to(prints.half)
        high = torch.tensor(tile[2:]).to(prints.half)
        keep &= ((prints.center + prints.half + 1 >= low) & (prints.center - prints.half - 1 <= high)).all(1)
    rows = keep.nonzero()[:, 0]
    return rows[prints.z.detach()[rows].float().argsort(stable=True)]


def _alphas(
    prints: ProjectedSplats, rows: Tensor, x: Tensor, y: Tensor, shift: Tensor | None = None
) -> tuple[Tensor, ...]:
    """What is blended, and where.

    Returns:
        Alpha of what is blended (else 0), transmittance before it and depth, (n, P) each; (P,) pixels near a
        threshold; (n,) rows whose footprint holds a pixel, be it hidden or not.
    """
    rho, depth, opacity = prints.at(rows, x, y, x.new_zeros(2) if shift is None else shift)
    raw = opacity * torch.exp(-rho / 2)
    alpha = torch.where(raw >= ALPHA_MIN, raw.clamp_max(ALPHA_MAX), torch.zeros_like(raw))
    after = torch.cumprod(1 - alpha, 0)
    blended = (alpha > 0) & (after >= T_MIN)
    before = torch.cat([torch.ones_like(after[:1]), torch.cumprod(1 - torch.where(blended, alpha, 0.0), 0)[:-1]])
    with torch.no_grad():
        margins = [(raw / ALPHA_MIN - 1).abs(), (after / T_MIN - 1).abs(), (after / 0.5 - 1).abs()]
        risky = (torch.stack(margins) < 1e-4).any(0).any(0)
    return torch.where(blended, alpha, 0.0), before, depth, risky, (alpha > 0).any(1)


def _blend(
    prints: ProjectedSplats, rows: Tensor, x: Tensor, y: Tensor, shift: Tensor | None = None
) -> tuple[Tensor, Tensor, Tensor]:
    """The ten channels at P pixels, (10, P), the pixels near a threshold, (P,), and whether a row touches one, (n,)."""
    if not len(rows):
        return torch.zeros(10, len(x), dtype=x.dtype), torch.zeros(len(x), dtype=torch.bool), rows.bool()
    alpha, before, depth, risky, touched = _alphas(prints, rows, x, y, shift)
    weight = alpha * before
    total = weight.sum(0)
    middle, opaque = _median(alpha, before, total)
    median = torch.where(opaque, depth.gather(0, middle[None])[0], 0.0)
    if prints.peaks is not None:
        moved = x.new_zeros(2) if shift is None else shift
        rho, _, opacity = prints.at(rows, x, y, moved)
        solids = Solids(opacity * torch.exp(-rho / 2), *prints.peaks(rows, x, y, moved))
        median, unsure = solids.depth(median.detach(), prints.near)
        risky = risky | unsure
    inverse = 1 / depth
    shift = inverse.detach().mean(0)  # a pair's difference does not change with it, its rounding does
    inverse = inverse - shift
    ahead, ahead1, ahead2 = (torch.cumsum(weight * inverse**p, 0) - weight * inverse**p for p in (0, 1, 2))
    bend = (weight * (inverse**2 * ahead + ahead2 - 2 * inverse * ahead1)).sum(0)
    parts = [prints.color[rows].T @ weight, total[None], (weight * depth).sum(0)[None], median[None]]
    if prints.normals is None:
        normal = prints.normal[rows].T @ weight
    else:
        normal = torch.einsum("npi,np->ip", prints.normals(rows, x, y), weight)
    block = torch.cat([*parts, normal, bend[None]])
    return block, risky, touched


def _median(alpha: Tensor, before: Tensor, total: Tensor) -> tuple[Tensor, Tensor]:
    """(P,) which of n splats is that of the median depth, and (P,) bool where there is one; of (n, P) alpha and
    transmittance and (P,) the sum of the weights."""
    met = (alpha > 0) & (before > 0.5)
    last = (met * torch.arange(1, len(alpha) + 1)[:, None]).amax(0)
    return (last - 1).clamp_min(0), (last > 0) & (total >= 0.5)


@dataclass(frozen=True)
class Reference(Rasterizer):
    """Draws with `draw`, in the precision of the splats; slow, and right."""

    def title(self) -> str:
        """See `Rasterizer.title`."""
        return f"cpu reference ({torch.__version__})"

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
            prints = footprints(splats, camera, near)
            for tile in _tiles(camera):
                rows, x, y = _in_tile(prints, tile, True), *_pixels(tile, total.dtype)
                alpha, before, *_ = _alphas(prints, rows, x, y)
                term = torch.where(alpha > 0, alpha**alpha_power * before**transmittance_power, 0.0)
                total[rows] += term.sum(1)
                count[rows] += (alpha > 0).sum(1)
        return total, count

    def leading(self, splats: Splats, camera: Camera, near: float) -> Tensor:
        """See `Rasterizer.leading`."""
        validate(splats)
        count = torch.zeros(len(splats), dtype=torch.int64)
        with torch.no_grad():
            prints = footprints(splats, camera, near)
            for tile in _tiles(camera):
                rows, x, y = _in_tile(prints, tile, True), *_pixels(tile, splats.means.dtype)
                if not len(rows):
                    continue
                alpha, before, *_ = _alphas(prints, rows, x, y)
                weight = alpha * before
                middle, opaque = _median(alpha, before, weight.sum(0))
                leads = opaque & (weight.argmax(0) == middle)  # of equal weights the first
                count += torch.bincount(rows[middle[leads]], minlength=len(splats))
        return count

    def opacity_before(self, splats: Splats, camera: Camera, near: float, points: Tensor) -> Tensor:
        validate(splats)
        x, y, z = camera.project(points).to(splats.means).unbind(1)
        inside = (z > near) & (x >= 0) & (y >= 0) & (x < camera.width) & (y < camera.height)
        found = torch.full_like(z, torch.nan)
        with torch.no_grad():
            prints = footprints(splats, camera, near)
            rows = prints.drawn.nonzero()[:, 0]
            for some in inside.nonzero()[:, 0].split(TILE_SIDE_PX * TILE_SIDE_PX):  # type: ignore[no-untyped-call]
                rho, depth, opacity = prints.at(rows, x[some], y[some], x.new_zeros(2))
                alpha = (opacity * torch.exp(-rho / 2)).clamp_max(ALPHA_MAX)
                found[some] = 1 - torch.where((alpha >= ALPHA_MIN) & (depth <= z[some]), 1 - alpha, 1.0).prod(0)
        return found


class ReferenceRender(Render):
    """A view drawn by the reference; autograd takes it back."""

    def __init__(self, splats: Splats, camera: Camera, near: float, left_out: set[str]) -> None:
        leaves = {name: value.detach().requires_grad_() for name, value in splats.tensors().items()}
        with torch.enable_grad():
            standard: dict[str, Any] = dict(leaves)
            form: dict[str, Any] = {name: getattr(splats, name) for name in ("antialias", "dilation", "geometry")}
            self._drawn = draw(Splats(splats.kind, **standard, **form), camera, near)
        self._leaves, self._camera = leaves, camera
        self._surfel = splats.kind == "surfel"
        self._half_image = torch.tensor([camera.width / 2, camera.height / 2]).to(splats.means)
        made = self._drawn.maps.present()
        self.maps = Maps(**{name: value.detach() for name, value in made.items() if name not in left_out})
        self.seen = self._drawn.seen
        prints = self._drawn.footprints
        self.radii = torch.where(self.seen, prints.radius.detach(), 0.0)

    def backward(
        self, total: Maps, chosen: Maps | None = None, absolute: bool = False, rows: int | None = None
    ) -> Gradients:
        leaves = list(self._leaves.values())
        *grads, screen = self._pull(total, [*leaves, self._drawn.footprints.screen])
        part = None
        if chosen is not None and absolute:
            part = self._scaled(self._sizes(chosen))
        elif chosen is not None:
            part = self._signal(self._pull(chosen, [self._drawn.footprints.screen])[0])
        standard: dict[str, Any] = {name: value[:rows] for name, value in zip(self._leaves, grads, strict=True)}
        return Gradients(**standard, signal=self._signal(screen)[:rows], chosen=None if part is None else part[:rows])

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
        return self._scaled(torch.stack([screen[:, 0, 2], screen[:, 1, 2]], 1) if self._surfel else screen)

    def _scaled(self, gradient: Tensor) -> Tensor:
        """The signal from (N, 2) gradients by what is shifted on the screen."""
        if self._surfel:
            gradient = gradient * self._drawn.footprints.screen.detach()[:, 2, 2:]
        return torch.where(self.seen[:, None], gradient * self._half_image, 0.0)

    def _sizes(self, cotangents: Maps) -> Tensor:
        """(N, 2) sums over the pixels of the size of each pixel's gradient: every pixel has a shift of its own.

        What the depth of solids adds has a size for itself.
        """
        prints, camera = self._drawn.footprints, self._camera
        shape, total = (camera.height, camera.width), torch.zeros_like(self._leaves["means"][:, :2])
        sizes = {"color": 3, "alpha": 1, "depth": 1, "median": 1, "normal": 3, "distortion": 1}
        given = cotangents.present()
        planes = torch.cat(
            [
                given[name].to(total).view(n, *shape) if name in given else total.new_zeros(n, *shape)
                for name, n in sizes.items()
            ]
        )
        median = (torch.arange(10) == 5).to(total)
        groups = [torch.ones_like(median)] if prints.peaks is None else [1 - median, median]
        for x0, y0, x1, y1 in _tiles(camera):
            rows, x, y = _in_tile(prints, (x0, y0, x1, y1), True), *_pixels((x0, y0, x1, y1), total.dtype)
            if not len(rows):
                continue
            with torch.enable_grad():
                shift = total.new_zeros(len(rows), len(x), 2).requires_grad_()
                block, *_ = _blend(prints, rows, x, y, shift)
            given_here = planes[:, y0:y1, x0:x1].reshape(10, -1)
            for some in groups:
                (share,) = torch.autograd.grad(block, shift, given_here * some[:, None], retain_graph=True)
                total[rows] += share.abs().sum(1)
        return total
