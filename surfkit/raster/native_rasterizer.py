"""The CPU rasterizer: the compiled kernels behind the contract of `raster.api`."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar

import torch
from torch import Tensor

from surfkit.core.check import BadInput
from surfkit.raster import native
from surfkit.raster.api import GEOMETRIES, MAPS, STANDARD, Gradients, Maps, Render, Splats
from surfkit.raster.base import Rasterizer
from surfkit.raster.culling import boxes_may_touch
from surfkit.raster.splat_boxes import SplatBoxes
from surfkit.raster.validate import validate
from surfkit.scene.camera import Camera

WHOLE_IMAGE = (0, 1 << 30)
"""Rows of tiles, all that there are."""


@dataclass(frozen=True)
class NativeRasterizer(Rasterizer):
    """Draws on the CPU with SIMD on `torch.get_num_threads()` threads; their number does not change a bit."""

    rank: ClassVar[int] = 10

    def missing(self) -> str | None:
        """See `Rasterizer.missing`."""
        return native.lacking() if native.module() is None else None

    def title(self) -> str:
        """See `Rasterizer.title`."""
        return f"cpu {native.kernels().kernels_in_use()}"

    def render(
        self, splats: Splats, camera: Camera, near: float, geometry: bool = True, distortion: bool = True
    ) -> Render:
        return NativeRender(splats, camera, near, maps_made(geometry, distortion))

    def in_view(self, splats: Splats, camera: Camera, near: float) -> Tensor:
        """See `Rasterizer.in_view`."""
        return may_touch(splats, camera, near)

    def boxes_in_view(self, boxes: SplatBoxes, camera: Camera, near: float) -> Tensor | None:
        """See `Rasterizer.boxes_in_view`."""
        return boxes_may_touch(boxes, camera, near)

    def contribution(
        self, splats: Splats, camera: Camera, near: float, alpha_power: float, transmittance_power: float
    ) -> tuple[Tensor, Tensor]:
        grey = splats.with_colors(torch.zeros(len(splats), 1, 3))  # colours cost a third of the projection
        drawn = Pass(grey, camera, near)
        total = torch.zeros(len(splats), dtype=torch.float32)
        count = torch.zeros(len(splats), dtype=torch.int64)
        drawn.native.contribution(alpha_power, transmittance_power, total, count, torch.get_num_threads())
        return total, count

    def leading(self, splats: Splats, camera: Camera, near: float) -> Tensor:
        """See `Rasterizer.leading`."""
        drawn = Pass(splats.with_colors(torch.zeros(len(splats), 1, 3)), camera, near)
        count = torch.zeros(len(splats), dtype=torch.int64)
        drawn.native.leading(count, torch.get_num_threads())
        return count

    def opacity_before(self, splats: Splats, camera: Camera, near: float, points: Tensor) -> Tensor:
        drawn = Pass(splats.with_colors(torch.zeros(len(splats), 1, 3)), camera, near, rim=0.0)
        opacity = torch.empty(len(points), dtype=torch.float32)
        drawn.native.probe(camera.project(points).contiguous(), opacity, torch.get_num_threads())
        return opacity


def maps_made(geometry: bool, distortion: bool) -> tuple[str, ...]:
    """Names of the maps that a view gets."""
    return MAPS[: 2 + 3 * geometry + (geometry and distortion)]


def may_touch(splats: Splats, camera: Camera, near: float, strip: tuple[int, int] = WHOLE_IMAGE) -> Tensor:
    """(N,) bool, the splats that may touch a pixel of some rows of tiles, and more; see `Rasterizer.in_view`."""
    found = torch.empty(len(splats), dtype=torch.bool)
    native.kernels().in_view(
        splats.kind == "surfel",
        GEOMETRIES.index(splats.geometry),
        *(t.detach().to("cpu", torch.float32).contiguous() for t in (splats.means, splats.scales)),
        *pose_and_lens(camera),
        near,
        found,
        torch.get_num_threads(),
        *strip,
    )
    return found.to(splats.means.device)


def pose_and_lens(camera: Camera) -> tuple[list[float], list[float], int, int]:
    """A camera as the kernels take it: pose, 4 x 4 by rows; fx, fy, cx, cy; width and height."""
    pose = camera.world_to_camera.double().flatten().tolist()
    return pose, [camera.fx, camera.fy, camera.cx, camera.cy], camera.width, camera.height


class Pass:
    """Splats projected onto one camera and sorted into tiles; `rim` is 0 if more than pixel centres will be drawn.

    Only tiles of the rows of a `strip` are drawn, with the bits of the whole image. `sh0` may be (N, 3) colours.
    """

    def __init__(
        self, splats: Splats, camera: Camera, near: float, rim: float = 0.5, strip: tuple[int, int] = WHOLE_IMAGE
    ) -> None:
        validate(splats if splats.sh0.dim() > 2 else splats.with_colors(splats.sh0[:, None]), values=False)
        self.arrays = [t.detach().to("cpu", torch.float32).contiguous() for t in splats.tensors().values()]
        self.seen = torch.empty(len(splats), dtype=torch.bool)
        self.radii = torch.empty(len(splats), dtype=torch.float32)
        self.native = native.kernels().Pass(
            splats.kind == "surfel",
            GEOMETRIES.index(splats.geometry),
            self.arrays,
            *pose_and_lens(camera),
            near,
            splats.dilation,
            splats.antialias,
            rim,
            self.seen,
            self.radii,
            torch.get_num_threads(),
            *strip,
        )
        if self.native.first_invalid >= 0:
            validate(splats)
            raise BadInput(f"splats: row {self.native.first_invalid} is out of the range of float32")


class NativeRender(Render):
    """A view drawn by the native kernels, when its maps are first asked for; keeps what the backward needs."""

    def __init__(
        self,
        splats: Splats,
        camera: Camera,
        near: float,
        made: tuple[str, ...],
        strip: tuple[int, int] = WHOLE_IMAGE,
    ) -> None:
        self._pass = Pass(splats, camera, near, strip=strip)
        self.seen, self.radii = self._pass.seen, self._pass.radii
        self._size, self._made = (camera.height, camera.width), made

    def pairs_by_row(self) -> list[int]:
        """Pairs of a splat and a tile in each row of tiles: about what drawing the row costs."""
        found: list[int] = self._pass.native.pairs_by_row()
        return found

    @cached_property
    def maps(self) -> Maps:  # type: ignore[override]  # drawn when it is asked for
        """See `Render`."""
        shapes = {"color": (3, *self._size), "normal": (3, *self._size)}
        maps = {name: torch.empty(shapes.get(name, self._size), dtype=torch.float32) for name in self._made}
        self._pass.native.forward(
            {2: 0, 5: 1, 6: 2}[len(self._made)], [maps.get(name) for name in MAPS], torch.get_num_threads()
        )
        return Maps(**maps)

    def backward(
        self, total: Maps, chosen: Maps | None = None, absolute: bool = False, rows: int | None = None
    ) -> Gradients:
        arrays = self._pass.arrays
        rows = len(arrays[0]) if rows is None else rows
        grads = [torch.empty_like(a[:rows]) for a in arrays]
        signal = torch.empty(rows, 2)
        chosen_signal = None if chosen is None else torch.empty(rows, 2)
        self._pass.native.backward(
            arrays,
            self._cotangents(total),
            [] if chosen is None else self._cotangents(chosen),
            absolute,
            rows,
            grads,
            signal,
            chosen_signal,
            torch.get_num_threads(),
        )
        standard: dict[str, Any] = dict(zip(STANDARD, grads, strict=True))
        return Gradients(**standard, signal=signal, chosen=chosen_signal)

    def _cotangents(self, maps: Maps) -> list[Tensor | None]:
        given, drawn = maps.present(), self.maps
        for name, value in given.items():
            made = getattr(drawn, name)
            if made is None or made.shape != value.shape:
                raise BadInput(f"cotangent of {name}: shape {tuple(value.shape)} does not fit the maps rendered")
        return [given[name].to(torch.float32).contiguous() if name in given else None for name in MAPS]
