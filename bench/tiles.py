"""Pairs of a splat and a tile in a view, by four rules: `python bench/tiles.py RUN --scale 1`.

RUN is a finished run of 3D Gaussians. The rules are those of 3DGS (a square of three standard deviations of the longer
axis), the axis-aligned box of FlashGS and its exact test of the ellipse against the tile (Feng et al. 2024: alpha of
1/256 or more somewhere in the tile), and what the kernels of surfkit for GPUs list, which run in the emulator. All are
compared with the pairs that are needed: those in which alpha is 1/255 or more at a pixel. A rule that lists all of
these draws the same picture, as fainter ones are skipped pixel by pixel.
"""

from __future__ import annotations

import argparse
import math
import statistics
from functools import cache
from pathlib import Path

import torch
from machine import save
from torch import Tensor

import surfkit
from surfkit.raster.api import ALPHA_MIN, Splats
from surfkit.raster.cuda.rasterizer import TILE_SIDE_PX, TileRasterizer, source
from surfkit.raster.nvrtc.emulated import Emulated
from surfkit.raster.projection import footprints
from surfkit.runs.run_method import splats_of
from surfkit.scene.camera import Camera
from surfkit.scene.rotations import rotations

FLASH_ALPHA = 1 / 256


def covariances(splats: Splats, camera: Camera) -> Tensor:
    """(N, 2, 2) of the footprints, with the low-pass filter, in square pixels (3DGS, equation 5)."""
    pose = camera.world_to_camera.to(splats.means)
    at = splats.means @ pose[:3, :3].T + pose[:3, 3]
    z = at[:, 2].clamp_min(1e-6)
    wide, high = 0.5 * camera.width / camera.fx, 0.5 * camera.height / camera.fy
    x = (at[:, 0] / z).clamp(-camera.cx / camera.fx - 0.3 * wide, (camera.width - camera.cx) / camera.fx + 0.3 * wide)
    y = (at[:, 1] / z).clamp(-camera.cy / camera.fy - 0.3 * high, (camera.height - camera.cy) / camera.fy + 0.3 * high)
    none = torch.zeros_like(z)
    rows = [camera.fx / z, none, -camera.fx * x / z, none, camera.fy / z, -camera.fy * y / z]
    axes = torch.stack(rows, 1).view(-1, 2, 3) @ pose[:3, :3] @ rotations(splats.quats) * splats.scales[:, None]
    return axes @ axes.transpose(1, 2) + splats.dilation * torch.eye(2, dtype=z.dtype)


def tiles_of_boxes(center: Tensor, half: Tensor, tiles: tuple[int, int]) -> tuple[Tensor, Tensor]:
    """(P,) splat and (P,) tile of all pairs whose tile the box (N, 2) about `center` touches, in pixels."""
    most = torch.tensor(tiles)
    low = ((center - half) / TILE_SIDE_PX).floor().long().clamp_min(0)
    high = torch.minimum(((center + half) / TILE_SIDE_PX).floor().long() + 1, most)
    size = (high - low).clamp_min(0)
    count = size.prod(1)
    splat = torch.arange(len(center)).repeat_interleave(count)
    place = torch.arange(int(count.sum())) - (count.cumsum(0) - count).repeat_interleave(count)
    column, row = place % size[splat, 0] + low[splat, 0], place // size[splat, 0] + low[splat, 1]
    return splat, row * tiles[0] + column


def nearest(conic: Tensor, low: Tensor, high: Tensor) -> Tensor:
    """(P,) smallest d^T conic d over the rectangles [low, high], (P, 2) each, about the middles of the ellipses."""
    inside = ((low <= 0) & (high >= 0)).all(1)
    best = torch.full((len(conic),), math.inf, dtype=conic.dtype)
    for axis, other in ((0, 1), (1, 0)):
        for edge in (low[:, axis], high[:, axis]):
            along = -conic[:, axis, other] * edge / conic[:, other, other]
            along = torch.minimum(torch.maximum(along, low[:, other]), high[:, other])
            value = conic[:, axis, axis] * edge**2 + 2 * conic[:, axis, other] * edge * along
            best = torch.minimum(best, value + conic[:, other, other] * along**2)
    return torch.where(inside, 0.0, best)


def pairs(splats: Splats, camera: Camera, near: float) -> dict[str, Tensor]:
    """Sorted numbers, splat times tiles plus tile, of the pairs by each rule."""
    tiles = (-(-camera.width // TILE_SIDE_PX), -(-camera.height // TILE_SIDE_PX))
    every = tiles[0] * tiles[1]
    exact = splats.with_named({name: value.double() for name, value in splats.tensors().items()})
    seen = footprints(exact, camera, near)
    rows = seen.drawn.nonzero()[:, 0]
    covariance, center, opacity = covariances(exact, camera)[rows], seen.screen[rows], exact.opacities[rows]
    conic = torch.linalg.inv(covariance)

    def numbers(splat: Tensor, tile: Tensor) -> Tensor:
        return (rows[splat] * every + tile).sort().values

    longest = torch.linalg.eigvalsh(covariance)[:, 1].sqrt()
    square = (3 * longest).ceil()[:, None].expand(-1, 2)
    spread = covariance.diagonal(dim1=1, dim2=2)
    box = (2 * spread * (opacity / FLASH_ALPHA).log()[:, None]).sqrt() + 1
    found = {"3dgs, square of 3 sigma": numbers(*tiles_of_boxes(center, square, tiles))}
    splat, tile = tiles_of_boxes(center, box, tiles)
    found["flashgs, box"] = numbers(splat, tile)
    corner = torch.stack([tile % tiles[0], tile // tiles[0]], 1) * TILE_SIDE_PX - center[splat]
    least = nearest(conic[splat], corner, corner + TILE_SIDE_PX)
    touches = least <= 2 * (opacity[splat] / FLASH_ALPHA).log()
    found["flashgs, exact"] = numbers(splat[touches], tile[touches])
    found["surfkit"] = listed(splats, camera, near, every)
    found["needed"] = numbers(*needed(conic, opacity, splat, tile, corner))
    return found


def needed(conic: Tensor, opacity: Tensor, splat: Tensor, tile: Tensor, corner: Tensor) -> tuple[Tensor, Tensor]:
    """The pairs in which alpha is ALPHA_MIN or more at one of the tile's pixels; `corner` is that of the tile."""
    steps = torch.arange(TILE_SIDE_PX, dtype=corner.dtype) + 0.5
    y, x = torch.meshgrid(steps, steps, indexing="ij")
    is_needed = []
    for chunk in torch.arange(len(splat)).split(50_000):
        dx, dy, q = corner[chunk, :1] + x.flatten(), corner[chunk, 1:] + y.flatten(), conic[splat[chunk]]
        power = q[:, 0, 0, None] * dx**2 + 2 * q[:, 0, 1, None] * dx * dy + q[:, 1, 1, None] * dy**2
        alpha = opacity[splat[chunk], None] * torch.exp(-power / 2)
        is_needed.append((alpha >= ALPHA_MIN).any(1))
    chosen = torch.cat(is_needed)
    return splat[chosen], tile[chosen]


def listed(splats: Splats, camera: Camera, near: float, every: int) -> Tensor:
    """Sorted numbers of the pairs in the lists of the kernels."""
    drawn = KERNELS.render(splats, camera, near)._pass
    _, _, entries, offsets = drawn.lists
    tile = torch.repeat_interleave(torch.arange(every), offsets.diff().cpu().long())
    return (drawn.index.cpu()[entries[:, 0].cpu().long()] * every + tile).sort().values


class EmulatedKernels(TileRasterizer):
    """The kernels in the emulator, with the CPU's tensors."""

    def where(self) -> torch.device:
        return torch.device("cpu")

    def program(self, name: str, **defines: int) -> Emulated:
        return compiled(name, tuple(sorted(defines.items())))


@cache
def compiled(name: str, defines: tuple[tuple[str, int], ...]) -> Emulated:
    """A program of the kernels, for the emulator."""
    return Emulated(source(name, **dict(defines)))


KERNELS = EmulatedKernels()


def main() -> None:
    """Count, print, keep."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("run", type=Path)
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--scale", type=float, default=1.0, help="divides the size of the photographs that are drawn")
    parser.add_argument("--views", type=int, default=5)
    given = parser.parse_args()
    ctx, made = surfkit.open(given.run)._loaded
    model = splats_of(ctx.run, made)
    splats = model.splats
    views = surfkit.read(given.data, scale=given.scale, test_every=8).held_out[: given.views]
    counts: dict[str, list[float]] = {}
    lost: dict[str, int] = {}
    for view in views:
        found = pairs(splats, view.camera, model.near)
        for name, numbers in found.items():
            counts.setdefault(name, []).append(len(numbers))
            lost[name] = lost.get(name, 0) + int((~torch.isin(found["needed"], numbers)).sum())
    base = statistics.median(counts["needed"])
    figures = {
        name: {
            "pairs": statistics.median(each),
            "of_needed": round(statistics.median(each) / base, 3),
            "needed_but_not_listed": lost[name],
        }
        for name, each in counts.items()
    }
    size = [views[0].camera.width, views[0].camera.height]
    for name, each in figures.items():
        print(f"{name:26} {each}")
    print(save("tiles", {"splats": len(splats), "views": len(views), "size": size, "rules": figures}))


if __name__ == "__main__":
    main()
