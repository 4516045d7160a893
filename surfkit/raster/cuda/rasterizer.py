"""The CUDA rasterizer: the kernels of this folder behind the contract of `raster.api`.

Per view: `measure` finds which tiles each splat touches, `record` writes what blending needs of those that are seen, in
the order of their depths, a stable sort by tile makes the lists, `forward` blends, `backward` and `gather` go back. Of
stochastic solids `solid` and `solid_backward` come after `forward` and `backward`.
Sums are taken in a fixed order, so that the same splats give the same bits each time.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torch.utils.weak import WeakTensorKeyDictionary

from surfkit.core.check import BadInput
from surfkit.raster.api import ALONG_RAYS, GEOMETRIES, MAPS, STANDARD, Gradients, Maps, Render, Splats
from surfkit.raster.base import Rasterizer
from surfkit.raster.culling import boxes_may_touch, image_sides, may_touch
from surfkit.raster.nvrtc.cuda_source import CudaSource
from surfkit.raster.nvrtc.modules import Kernels
from surfkit.raster.splat_boxes import SplatBoxes
from surfkit.raster.validate import validate
from surfkit.scene.camera import Camera

KERNEL_FOLDER = Path(__file__).parent
TILE_SIDE_PX, WARPS_PER_TILE = 16, 8
SURFEL, GAUSSIAN, RAY = 0, 1, 2
RECORD_BYTES = {SURFEL: 192, GAUSSIAN: 128, RAY: 192}
TINT_BYTES, ENTRY_BYTES = 40, 8
SUMS = {SURFEL: 20, GAUSSIAN: 16, RAY: 24}
"""Sums over the pixels that each splat gets on the way back; with chosen losses 4 more, of which 2 are used."""
LEVEL_COLOR, LEVEL_GEOMETRY, LEVEL_DISTORTION = 0, 1, 2
CHOSEN_NOTHING, CHOSEN_COLOR, CHOSEN_ALL, CHOSEN_ABSOLUTE = 0, 1, 2, 3
UPLOADED = WeakTensorKeyDictionary()
"""Of a tensor on the CPU: a device, the version that was copied there, and the copy."""
NEVER = torch.iinfo(torch.int64).max


class RasterView(ctypes.Structure):
    """`View` of view.h, where a `Pair` is two floats."""

    _fields_ = (
        ("pose", ctypes.c_float * 30),  # rotation by columns, translation, and the camera's position
        ("lens", ctypes.c_float * 10),  # fx, fy, cx, cy, near
        ("size", ctypes.c_int * 2),
        ("rounded_camera", ctypes.c_float * 20),  # pose and lens again
        ("rounded_size", ctypes.c_int * 2),
        ("sides", ctypes.c_float * 12),
        ("dilation", ctypes.c_float * 2),
        ("is_compensated", ctypes.c_bool),
        ("geometry", ctypes.c_int),
        ("rim", ctypes.c_float),
        ("tiles", ctypes.c_int * 2),
    )


def _pairs(*numbers: float) -> list[float]:
    """Each as the sum of two floats, one after the other."""
    highs = [ctypes.c_float(number).value for number in numbers]
    return [part for number, high in zip(numbers, highs, strict=True) for part in (high, number - high)]


def _view(splats: Splats, camera: Camera, near: float, rim: float) -> RasterView:
    pose = camera.world_to_camera.double().cpu()
    turn, shift = pose[:3, :3], pose[:3, 3]
    numbers = [*turn.T.flatten().tolist(), *shift.tolist(), *(-turn.T @ shift).tolist()]
    lens, width, height = (camera.fx, camera.fy, camera.cx, camera.cy, near), camera.width, camera.height
    return RasterView(
        (ctypes.c_float * 30)(*_pairs(*numbers)),
        (ctypes.c_float * 10)(*_pairs(*lens)),
        (ctypes.c_int * 2)(width, height),
        (ctypes.c_float * 20)(*numbers, *lens),
        (ctypes.c_int * 2)(width, height),
        (ctypes.c_float * 12)(*(number for side in image_sides(camera) for number in side)),
        (ctypes.c_float * 2)(*_pairs(splats.dilation)),
        splats.antialias,
        GEOMETRIES.index(splats.geometry),
        rim,
        (ctypes.c_int * 2)(-(-width // TILE_SIDE_PX), -(-height // TILE_SIDE_PX)),
    )


def blocks(count: int) -> int:
    """Blocks of 128 threads for so many."""
    return -(-count // 128)


class RasterPass:
    """Splats projected onto one camera and sorted into tiles; `rim` is 0 if more than pixel centres will be drawn.

    Attributes:
        arrays: The standard tensors of the splats.
        are_solids: Whether the median depth is that of stochastic solids.
        seen, radii: As in `Render`.
        index: (M,) int64, the splat of each record: those seen, by depth.
        first: (M + 1,) int32, the first slot of each record; a slot is a pair of a splat and a tile.
        slots: How many there are.
        lists: What kernels that go through the tiles' lists take first: the view, records, and (slots, 2) int32
            entries, record and slot, by tile and depth; those of tile t are offsets[t] to offsets[t + 1]. They are made
            again where they have been let go of.
    """

    def __init__(
        self,
        program: Callable[..., Kernels],
        device: torch.device,
        splats: Splats,
        camera: Camera,
        near: float,
        rim: float,
    ) -> None:
        validate(splats, values=False)
        self.kind = SURFEL if splats.kind == "surfel" else RAY if splats.geometry in ALONG_RAYS else GAUSSIAN
        self.are_solids = splats.geometry == "solid"
        self.program = partial(program, KIND=self.kind)  # which knows nothing of this pass: its tensors go with it
        self.device, self.home, self.view = device, splats.means.device, _view(splats, camera, near, rim)
        self.arrays = [_upload(t, device) for t in splats.tensors().values()]
        self.coefficients = 1 + self.arrays[5].shape[1]
        self.tiles = self.view.tiles[0] * self.view.tiles[1]
        self.tile_bytes = 2 if self.tiles < 2**15 else 4  # a sort takes a pass for each
        defines = {"COEFFICIENTS": self.coefficients, "TILE_BYTES": self.tile_bytes}
        self._project = self.program("project", LEVEL=LEVEL_COLOR, CHOSEN=CHOSEN_NOTHING, **defines)
        touched, depth, self.slots = self._measure(splats)
        self._order(touched, depth)

    def let_go(self) -> None:
        """Free the memory of the lists."""
        self.__dict__.pop("lists", None)

    def _measure(self, splats: Splats) -> tuple[Tensor, Tensor, int]:
        """(N,) int32 tiles that each splat touches, (N,) depths, and the sum of the former; sets `seen` and `radii`.

        Raises:
            BadInput: A splat cannot be drawn, or there are too many slots.
        """
        count, shape = len(splats), self.arrays[0].new_empty(0)
        touched, self.radii = shape.new_empty(count, dtype=torch.int32), shape.new_empty(count)
        depth, invalid = shape.new_empty(count), shape.new_full((1,), NEVER, dtype=torch.int64)
        launch = self._project.launch
        launch("measure", blocks(count), 128, *self.arrays[:4], self.view, touched, depth, self.radii, invalid)
        self.seen = touched > 0
        slots, wrong = torch.stack([touched.sum(), invalid[0]]).tolist()  # waits for the device
        if wrong != NEVER:
            validate(splats)
            raise BadInput(f"splats: row {wrong} is out of the range of float32")
        if slots >= 2**31:
            raise BadInput(
                f"{slots:,} pairs of a splat and a tile in one view, at most 2^31 can be drawn; lower the "
                "number of splats or the size of the photographs"
            )
        return touched, depth, slots

    def _order(self, touched: Tensor, depth: Tensor) -> None:
        """Give the splats that are seen a record each, by depth, and a slot for each tile; sets `index` and `first`."""
        index = self.seen.nonzero()[:, 0]
        self.index = index[depth[index].argsort(stable=True)]
        self.first = torch.zeros(len(index) + 1, dtype=torch.int32, device=self.device)
        torch.cumsum(touched[self.index], 0, dtype=torch.int32, out=self.first[1:])

    @cached_property
    def lists(self) -> tuple[RasterView, Tensor, Tensor, Tensor]:
        """The view, the records, entries (S, 2) by tile, and where those of each tile begin; sets `tints`, too."""
        shape, count, slots, project = self.arrays[0].new_empty(0), len(self.index), self.slots, self._project
        records = shape.new_empty(count * RECORD_BYTES[self.kind], dtype=torch.uint8)
        number = torch.int16 if self.tile_bytes == 2 else torch.int32
        tile_of, record_of = shape.new_empty(slots, dtype=number), shape.new_empty(slots, dtype=torch.int32)
        keeps_tints = self.coefficients > 4  # `kKeepsTints` of view.h
        self.tints = shape.new_empty(count * TINT_BYTES * keeps_tints, dtype=torch.uint8)
        given = *self.arrays, self.view, self.index, self.first
        project.launch("record", blocks(count), 128, *given, records, self.tints, tile_of, record_of)
        tile_of, slot = tile_of.sort(stable=True)
        entries = shape.new_empty(slots, 2, dtype=torch.int32)
        project.launch("list", blocks(slots), 128, slot, record_of, entries)
        tiles = torch.arange(self.tiles + 1, device=self.device, dtype=tile_of.dtype)
        return self.view, records, entries, torch.searchsorted(tile_of, tiles)

    def words(self) -> int:
        """Words of 32 bits that `forward` notes in which splats are blended where."""
        return (self.slots // 32 + self.tiles + 1) * WARPS_PER_TILE


class CudaRender(Render):
    """A view drawn by the CUDA kernels, when its maps are first asked for; keeps what the backward needs."""

    def __init__(self, drawn: RasterPass, made: tuple[str, ...]) -> None:
        self._pass, self._made = drawn, made
        self._level = {2: LEVEL_COLOR, 5: LEVEL_GEOMETRY, 6: LEVEL_DISTORTION}[len(made)]
        self._size = drawn.view.size[1], drawn.view.size[0]
        self.seen, self.radii = drawn.seen.to(drawn.home), drawn.radii.to(drawn.home)

    @cached_property
    def maps(self) -> Maps:  # type: ignore[override]  # drawn when it is asked for
        """See `Render`."""
        return Maps(**{name: value.to(self._pass.home) for name, value in self._drawn.items()})

    @cached_property
    def _drawn(self) -> dict[str, Tensor]:
        """The maps by name, where they were drawn."""
        one, shapes = self._pass.arrays[0], {"color": (3, *self._size), "normal": (3, *self._size)}
        maps = {name: one.new_empty(shapes.get(name, self._size)) for name in self._made}
        none = one.new_empty(0)

        def plane(level: int, dtype: torch.dtype = torch.float32) -> Tensor:
            return one.new_empty(self._size if self._level >= level else 0, dtype=dtype)

        self._saved = (
            plane(LEVEL_COLOR),
            plane(LEVEL_COLOR, torch.int32),
            plane(LEVEL_GEOMETRY, torch.int32),
            *(plane(LEVEL_DISTORTION) for _ in range(3)),
            one.new_zeros(self._pass.words(), dtype=torch.int32),
        )
        outputs = (maps.get(name, none) for name in MAPS)
        forward = self._pass.program("forward", LEVEL=self._level, CHOSEN=CHOSEN_NOTHING)
        forward.launch(
            "forward", self._pass.tiles, TILE_SIDE_PX * TILE_SIDE_PX, *self._pass.lists, *outputs, *self._saved
        )
        if self._pass.are_solids and self._level >= LEVEL_GEOMETRY:
            self._solid = (plane(LEVEL_GEOMETRY), plane(LEVEL_GEOMETRY))
            solid = self._pass.program("solid", LEVEL=LEVEL_GEOMETRY, CHOSEN=CHOSEN_NOTHING, WIDTH=SUMS[RAY])
            given = *self._pass.lists, maps["median"], self._saved[2], *self._solid
            solid.launch("solid", self._pass.tiles, TILE_SIDE_PX * TILE_SIDE_PX, *given)
        return maps

    def backward(
        self, total: Maps, chosen: Maps | None = None, absolute: bool = False, rows: int | None = None
    ) -> Gradients:
        drawn, arrays = self._pass, self._pass.arrays
        rows = len(arrays[0]) if rows is None else rows
        cotangents = [*self._cotangents(total), *self._cotangents(chosen or Maps())]
        level, what = self._levels(total, chosen, absolute)
        width = SUMS[drawn.kind] + 4 * (chosen is not None)
        sums, touched = arrays[0].new_empty(drawn.slots, width), arrays[0].new_zeros(drawn.slots, dtype=torch.uint8)
        backward = drawn.program("backward", LEVEL=level, CHOSEN=what, WIDTH=width)
        given: tuple[Any, ...] = *drawn.lists, drawn.index, rows, *cotangents, *self._saved
        backward.launch("backward", drawn.tiles, TILE_SIDE_PX * TILE_SIDE_PX, *given, sums, touched)
        medians = [each[MAPS.index("median")] for each in (cotangents[: len(MAPS)], cotangents[len(MAPS) :])]
        if drawn.are_solids and any(map(len, medians)):
            solid = drawn.program("solid", LEVEL=LEVEL_GEOMETRY, CHOSEN=what, WIDTH=width)
            given = *drawn.lists, drawn.index, rows, *medians, *self._solid
            solid.launch("solid_backward", drawn.tiles, TILE_SIDE_PX * TILE_SIDE_PX, *given, sums, touched)
        del given
        drawn.let_go()  # the gradients take about as much
        grads = [torch.zeros_like(each[:rows]) for each in arrays]
        signal = arrays[0].new_zeros(rows, 2)
        part = arrays[0].new_zeros(rows if chosen is not None else 0, 2)
        program = {"CHOSEN": int(chosen is not None), "WIDTH": width, "COEFFICIENTS": drawn.coefficients}
        gather = drawn.program("gather", LEVEL=LEVEL_COLOR, **program)
        given = *arrays, drawn.view, drawn.tints, drawn.index, drawn.first, sums, touched, rows
        gather.launch("gather", blocks(len(drawn.index)), 128, *given, *grads, signal, part)
        home = drawn.home
        standard: dict[str, Any] = {name: grad.to(home) for name, grad in zip(STANDARD, grads, strict=True)}
        return Gradients(**standard, signal=signal.to(home), chosen=None if chosen is None else part.to(home))

    def _levels(self, total: Maps, chosen: Maps | None, absolute: bool) -> tuple[int, int]:
        """Only what has a cotangent costs time."""
        part = (chosen or Maps()).present()
        names, level = {*total.present(), *part}, LEVEL_COLOR
        if names & {"depth", "median", "normal"}:
            level = LEVEL_GEOMETRY
        if "distortion" in names:
            level = LEVEL_DISTORTION
        if chosen is None:
            return level, CHOSEN_NOTHING
        what = CHOSEN_ALL if {*part} - {"color"} else CHOSEN_COLOR
        return level, CHOSEN_ABSOLUTE if absolute else what

    def _cotangents(self, maps: Maps) -> list[Tensor]:
        given, drawn = maps.present(), self._drawn
        for name, value in given.items():
            made = drawn.get(name)
            if made is None or made.shape != value.shape:
                raise BadInput(f"cotangent of {name}: shape {tuple(value.shape)} does not fit the maps rendered")
        none = self._pass.arrays[0].new_empty(0)
        return [given[name].to(none).contiguous() if name in given else none for name in MAPS]


class TileRasterizer(Rasterizer):
    """What draws with the kernels of this folder; a subclass says on which device, and how they are compiled."""

    def program(self, name: str, **defines: int) -> Kernels:
        """The kernels of NAME.cu for these defines, compiled once; `source` has what to compile."""
        raise NotImplementedError  # not abstract: an abstract class would be a kind of component (`kind_of`)

    def title(self) -> str:
        """See `Rasterizer.title`."""
        return f"{self.where()}"

    def render(
        self, splats: Splats, camera: Camera, near: float, geometry: bool = True, distortion: bool = True
    ) -> Render:
        return CudaRender(self._pass(splats, camera, near), MAPS[: 2 + 3 * geometry + (geometry and distortion)])

    def contribution(
        self, splats: Splats, camera: Camera, near: float, alpha_power: float, transmittance_power: float
    ) -> tuple[Tensor, Tensor]:
        drawn = self._pass(_grey(splats), camera, near)
        one, slots = drawn.arrays[0], drawn.slots
        sums, counts = one.new_zeros(slots), one.new_zeros(slots, dtype=torch.int32)
        total, count = one.new_zeros(len(splats)), one.new_zeros(len(splats), dtype=torch.int64)
        program = drawn.program("contribution", LEVEL=LEVEL_COLOR, CHOSEN=CHOSEN_NOTHING)
        given = *drawn.lists, float(alpha_power), float(transmittance_power)
        program.launch("contribution", drawn.tiles, TILE_SIDE_PX * TILE_SIDE_PX, *given, sums, counts)
        program.launch("total", blocks(len(drawn.index)), 128, drawn.index, drawn.first, sums, counts, total, count)
        return total.to(drawn.home), count.to(drawn.home)

    def leading(self, splats: Splats, camera: Camera, near: float) -> Tensor:
        """See `Rasterizer.leading`."""
        drawn = self._pass(_grey(splats), camera, near)
        count = drawn.arrays[0].new_zeros(len(splats), dtype=torch.int32)
        program = drawn.program("contribution", LEVEL=LEVEL_COLOR, CHOSEN=CHOSEN_NOTHING)
        program.launch("leading", drawn.tiles, TILE_SIDE_PX * TILE_SIDE_PX, *drawn.lists, drawn.index, count)
        return count.long().to(drawn.home)

    def in_view(self, splats: Splats, camera: Camera, near: float) -> Tensor:
        """See `Rasterizer.in_view`."""
        return may_touch(splats, camera, near)

    def boxes_in_view(self, boxes: SplatBoxes, camera: Camera, near: float) -> Tensor | None:
        """See `Rasterizer.boxes_in_view`."""
        return boxes_may_touch(boxes, camera, near)

    def opacity_before(self, splats: Splats, camera: Camera, near: float, points: Tensor) -> Tensor:
        drawn = self._pass(_grey(splats), camera, near, rim=0.0)
        at = camera.project(points.to(drawn.device))
        x, y, z = at.unbind(1)
        inside = (z > near) & (x >= 0) & (y >= 0) & (x < camera.width) & (y < camera.height)
        order = inside.nonzero()[:, 0]
        column, row = (each.int() // TILE_SIDE_PX for each in (x, y))
        tile = row * drawn.view.tiles[0] + column
        order = order[tile[order].argsort(stable=True)]  # threads of a warp read the same list
        middles = (torch.stack([column, row], 1) + 0.5) * TILE_SIDE_PX
        local = torch.cat([at[:, :2] - middles, at[:, 2:]], 1).float()
        opacity = drawn.arrays[0].new_full((len(points),), torch.nan)
        program = drawn.program("contribution", LEVEL=LEVEL_GEOMETRY, CHOSEN=CHOSEN_NOTHING)
        program.launch("probe", blocks(len(order)), 128, *drawn.lists, local, tile, order, opacity)
        return opacity.to(points.device)

    def _pass(self, splats: Splats, camera: Camera, near: float, rim: float = 0.5) -> RasterPass:
        return RasterPass(self.program, self.where(), splats, camera, near, rim)


def _upload(tensor: Tensor, device: torch.device) -> Tensor:
    """float32 values on a device. Those of the CPU are kept there for as long as they are here, unchanged: many views
    are drawn of the same splats."""
    if tensor.device == device:
        return tensor.detach().to(torch.float32).contiguous()
    known: Any = UPLOADED.get(tensor)  # type: ignore[no-untyped-call]
    if known is None or known[:2] != (device, tensor._version):
        there = tensor.detach().to(device, torch.float32).contiguous()
        UPLOADED[tensor] = known = device, tensor._version, there
    return known[2]


def _grey(splats: Splats) -> Splats:
    """The same without colours, which cost a third of the projection."""
    return splats.with_colors(splats.sh0.new_zeros(len(splats), 1, 3))


def _raw(name: str, size: int) -> type[ctypes.Structure]:
    """A structure of which only the size is known."""
    return type(name, (ctypes.Structure,), {"_fields_": (("raw", ctypes.c_ubyte * size),)})


def source(name: str, **defines: int) -> CudaSource:
    """The source of NAME.cu for one kind of splats."""
    sizes = {"SplatRecord": RECORD_BYTES[defines["KIND"]], "SplatTint": TINT_BYTES, "Entry": ENTRY_BYTES}
    sizes["TileNumber"] = defines.get("TILE_BYTES", 4)
    structures: dict[str, type[ctypes.Structure]] = {"View": RasterView}
    structures |= {name: _raw(name, size) for name, size in sizes.items()}
    return CudaSource(KERNEL_FOLDER / f"{name}.cu", defines, structures, is_exact=name in ("project", "gather"))
