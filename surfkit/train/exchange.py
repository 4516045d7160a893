"""One picture drawn by several processes, each of which has some of the splats (Grendel-GS, Zhao et al. 2025, sec. 3).

"Gaussian-wise" work, which is done by whoever has the splat: raw values, colours, the optimizer. "Pixel-wise" work, by
whoever has the strip of the picture: projection, blending and its gradients. Between the two, splats go to the strips
that they touch ("sparse all-to-all"), and their gradients back. The pictures of the strips are then sent to everybody,
and each process computes the losses of the whole picture: they are small beside the splats, and losses may look at
neighbouring pixels. In the paper strips are balanced by the times of their tiles; here by the number of pairs of a
splat and a tile, the last time that the view was shown, which does not depend on what else the machine does.

The picture has the bits of a single process with the same splats in the order of the processes: each strip's owner gets
its splats in this order. Gradients of a splat in several strips are sums of float32 instead of float64.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import pairwise
from typing import Any

import torch
from torch import Tensor

from surfkit.core.check import BadInput
from surfkit.raster.api import STANDARD, Gradients, Maps, Render, Splats
from surfkit.raster.base import Rasterizer
from surfkit.raster.native_rasterizer import NativeRasterizer, NativeRender, maps_made, may_touch
from surfkit.raster.strips import Strip, colors, colors_backward, contribution, leading, pixel_rows, tile_rows
from surfkit.scene.camera import Camera
from surfkit.train.processes import Processes

EMPTY_TILE_PAIRS = 4
"""What a tile costs beside its splats, in pairs."""


@dataclass(frozen=True)
class DividedRasterizer(Rasterizer):
    """Draws the splats of all processes; takes and gives those of this process. All of them draw the same view."""

    inner: NativeRasterizer
    processes: Processes
    borders: dict[tuple[int, int, bytes], list[int]] = field(default_factory=dict)
    """By the size and the pose of a camera, the cost of each row of tiles."""

    def title(self) -> str:
        """See `Rasterizer.title`."""
        return self.inner.title()

    def render(
        self, splats: Splats, camera: Camera, near: float, geometry: bool = True, distortion: bool = True
    ) -> Render:
        """See `Rasterizer.render`; N is of this process."""
        return DividedRender(self, splats, camera, near, maps_made(geometry, distortion))

    def in_view(self, splats: Splats, camera: Camera, near: float) -> Tensor:
        """See `Rasterizer.in_view`."""
        return self.inner.in_view(splats, camera, near)

    def contribution(
        self, splats: Splats, camera: Camera, near: float, alpha_power: float, transmittance_power: float
    ) -> tuple[Tensor, Tensor]:
        """See `Rasterizer.contribution`; N is of this process."""
        sent = Exchange(self.processes, splats, camera, near, self.strips(camera))
        powers = alpha_power, transmittance_power
        found = contribution(sent.received(), camera, near, powers, sent.strips[self.processes.rank])
        total = sent.returned(torch.stack([value.double() for value in found], 1))
        return total[:, 0].float(), total[:, 1].long()

    def leading(self, splats: Splats, camera: Camera, near: float) -> Tensor:
        """See `Rasterizer.leading`; N is of this process."""
        sent = Exchange(self.processes, splats, camera, near, self.strips(camera))
        return sent.returned(leading(sent.received(), camera, near, sent.strips[self.processes.rank]))

    def opacity_before(self, splats: Splats, camera: Camera, near: float, points: Tensor) -> Tensor:
        """BadInput: no process has all splats that may be before (P, 3) points."""
        raise BadInput("the opacity in front of points is not found by several processes together; use --processes 1")

    def strips(self, camera: Camera) -> list[Strip]:
        """Strips of an image that cost about the same, one for each process."""
        rows, count = tile_rows(camera), self.processes.count
        ends = torch.tensor(self.borders.get(_key(camera), [1] * rows), dtype=torch.float64).cumsum(0)
        goals = ends[-1] * torch.arange(1, count, dtype=torch.float64) / count
        above = torch.cat([ends.new_zeros(1), ends])  # the cost above each border of rows
        cuts = [int((above - goal).abs().argmin()) for goal in goals]
        return list(pairwise([0, *cuts, rows]))

    def learn(self, camera: Camera, strips: list[Strip], pairs: list[int]) -> None:
        """Note what the rows of tiles of this process's strip have cost."""
        first, end = strips[self.processes.rank]
        empty = EMPTY_TILE_PAIRS * -(-camera.width // 16)
        mine = torch.tensor([cost + empty for cost in pairs[first:end]], dtype=torch.int64)
        self.borders[_key(camera)] = self.processes.gathered(mine, [end - first for first, end in strips]).tolist()


class Exchange:
    """The splats of this process, on their way to the strips that they touch, and what comes back.

    Attributes:
        strips: One for each process.
        rows: (S,) int64, the splats that are sent: those for process 0, then those for process 1, and so on.
    """

    def __init__(self, processes: Processes, splats: Splats, camera: Camera, near: float, strips: list[Strip]) -> None:
        self.processes, self.splats, self.camera, self.strips = processes, splats, camera, strips
        each = [may_touch(splats, camera, near, strip).nonzero()[:, 0] for strip in strips]
        self.rows, self.sent = torch.cat(each), [len(rows) for rows in each]
        self.from_each = processes.swapped(self.sent)

    def received(self) -> Splats:
        """(R,) splats that touch the strip of this process, in the order of the processes, with colours for `sh0`."""
        parts = [getattr(self.splats, name).detach().index_select(0, self.rows) for name in STANDARD[:4]]
        parts.append(colors(self.splats, self.camera, self.rows))
        means, quats, scales, opacities, color = [
            self.processes.exchanged(part, self.sent, self.from_each) for part in parts
        ]
        shapes = replace(self.splats, means=means, quats=quats, scales=scales, opacities=opacities)
        return shapes.with_colors(color)

    def touched(self) -> Tensor:
        """(K,) int64, the splats that are sent, once each."""
        sent = torch.zeros(len(self.splats), dtype=torch.bool).index_fill_(0, self.rows, True)
        return sent.nonzero()[:, 0]

    def returned(self, values: Tensor, most: bool = False) -> Tensor:
        """(N, ...) sums, or the `most`, of what strips have for each splat of this process; (R, ...) of this strip."""
        back = self.processes.exchanged(values, self.from_each, self.sent)
        found = values.new_zeros(len(self.splats), *values.shape[1:])
        if most:
            return found.scatter_reduce_(0, self.rows[:, None].expand_as(back), back, "amax")
        return found.index_add_(0, self.rows, back)


class DividedRender(Render):
    """A view that several processes draw, each a strip; `seen`, `radii` and gradients are of this process's splats."""

    def __init__(
        self, by: DividedRasterizer, splats: Splats, camera: Camera, near: float, made: tuple[str, ...]
    ) -> None:
        self._processes, self._splats, self._camera, self._made = by.processes, splats, camera, made
        self._exchange = Exchange(by.processes, splats, camera, near, by.strips(camera))
        self._strips = self._exchange.strips
        strip = self._strips[by.processes.rank]
        self._drawn = NativeRender(self._exchange.received(), camera, near, made, strip)
        by.learn(camera, self._strips, self._drawn.pairs_by_row())
        shown = self._exchange.returned(torch.stack([self._drawn.seen.float(), self._drawn.radii], 1), most=True)
        self.seen, self.radii = shown[:, 0] > 0, shown[:, 1].contiguous()

    @cached_property
    def maps(self) -> Maps:  # type: ignore[override]  # drawn when it is asked for
        """See `Render`; the whole picture, in every process."""
        width, drawn = self._camera.width, self._drawn.maps.present()
        planes = [value.view(-1, *value.shape[-2:]) for value in drawn.values()]
        mine = torch.cat([plane[:, self._pixels(self._processes.rank)] for plane in planes]).transpose(0, 1)
        heights = [self._pixels(rank).stop - self._pixels(rank).start for rank in range(self._processes.count)]
        whole = self._processes.gathered(mine.contiguous(), heights).transpose(0, 1).contiguous()
        found = torch.split(whole, [len(plane) for plane in planes])
        size = self._camera.height, width
        return Maps(**{n: v.view(*drawn[n].shape[:-2], *size) for n, v in zip(drawn, found, strict=True)})

    def backward(
        self, total: Maps, chosen: Maps | None = None, absolute: bool = False, rows: int | None = None
    ) -> Gradients:
        """See `Render.backward`."""
        if rows is not None and rows != len(self._splats):
            raise BadInput("splats that nothing changes are not drawn by several processes together; use --processes 1")
        means, quats, scales, opacities, color, signal, *more = self._sums(total, chosen, absolute)
        by_sh = torch.zeros_like(self._splats.sh0), torch.zeros_like(self._splats.sh_rest)
        touched = self._exchange.touched()
        colors_backward(self._splats, self._camera, touched, color[touched], by_sh, means)
        standard: dict[str, Any] = dict(means=means, quats=quats, scales=scales, opacities=opacities)
        standard |= dict(zip(STANDARD[4:], by_sh, strict=True))
        return Gradients(**standard, signal=signal, chosen=more[0] if more else None)

    def _sums(self, total: Maps, chosen: Maps | None, absolute: bool) -> list[Tensor]:
        """(N, ...) gradients by what the strips were sent, and the signals; what leads to them is freed."""
        here = self._drawn.backward(total, chosen, absolute)
        colored = [value for name, value in here.tensors().items() if name != "sh_rest"]  # strips get colours alone
        parts = [*colored, here.signal, *([] if here.chosen is None else [here.chosen])]
        del here, colored
        return [self._exchange.returned(parts.pop(0)) for _ in range(len(parts))]

    def _pixels(self, rank: int) -> slice:
        return pixel_rows(self._strips[rank], self._camera)


def _key(camera: Camera) -> tuple[int, int, bytes]:
    """Of a camera, for a table; two cameras of a rig, or two sizes of a photograph, may have one pose."""
    return camera.width, camera.height, camera.world_to_camera.double().numpy().tobytes()
