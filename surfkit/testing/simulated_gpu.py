"""A GPU that is not there: tensors of the CPU which say that they are on cuda:0, and refuse what CUDA refuses.

With it a machine without a GPU tests that code runs on one: that all tensors of an operation are in one place, that
nothing hands a tensor of a GPU to NumPy, how often the host waits for the GPU, how much memory is held there, and what
happens when it gives out. Kernels are run by the emulator.
"""

from __future__ import annotations

import weakref
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any
from unittest import mock

import torch
from torch import Tensor
from torch.overrides import TorchFunctionMode

from surfkit.raster.api import Gradients, Maps, Render, Splats
from surfkit.raster.base import Rasterizer
from surfkit.raster.nvrtc import modules
from surfkit.raster.nvrtc.emulated import Emulated
from surfkit.raster.splat_boxes import SplatBoxes
from surfkit.scene.camera import Camera

GPU = torch.device("cuda", 0)
CPU = torch.device("cpu")
GPU_MEMORY_BYTES = 1 << 34
"""Bytes."""
SYNCHRONIZING_OPERATIONS = {
    "item",
    "tolist",
    "nonzero",
    "unique",
    "masked_select",
    "__bool__",
    "__float__",
    "__int__",
    "__index__",
}
"""Operations after which the host knows something that was computed on the GPU."""
HOST_ATTRIBUTES = {
    "data_ptr",
    "__len__",
    "__hash__",
    "__repr__",
    "__format__",
    "__dir__",
    "__reduce_ex__",
    "untyped_storage",
}
REFUSED_ATTRIBUTES = {"numpy", "__array__", "__dlpack__"}
"""What takes the memory of a tensor as the CPU's."""


class SimulatedGpu(TorchFunctionMode):
    """Within, a tensor can be made on and moved to "cuda".

    Attributes:
        waits: How often the host waited for a result, by the name of the operation.
        held: Bytes of all tensors on the GPU now.
        peak: Most of them so far, since it was last reset.
        limit: Bytes that the GPU has; what needs more raises what torch raises. None for none: it says that it has
            `GPU_MEMORY_BYTES`.
        refused: Numbers of allocations, counted from 1, that fail as if the GPU were full.
        allocations: How many there have been.
    """

    def __init__(self) -> None:
        super().__init__()
        self.waits: dict[str, int] = {}
        self.held = self.peak = self.allocations = 0
        self.limit: int | None = None
        self.refused: set[int] = set()
        self._storages: set[int] = set()

    def __torch_function__(
        self, func: Callable, types: Any, args: tuple[Any, ...] = (), kwargs: dict[str, Any] | None = None
    ) -> Any:
        kwargs, name = dict(kwargs or {}), _name(func)
        if name == "device":
            return GPU if is_there(args[0]) else func(*args)
        if name in ("is_cuda", "is_cpu"):
            return is_there(args[0]) == (name == "is_cuda")
        tensors = list(_tensors((args, kwargs)))
        if name in ("to", "cpu", "cuda", "type"):
            return self._moved(func, name, args, kwargs)
        there = any(map(is_there, tensors))
        if name in REFUSED_ATTRIBUTES and there:
            raise TypeError(f"{name}: can't convert cuda:0 device type tensor to numpy; use Tensor.cpu() first")
        if there and (name in SYNCHRONIZING_OPERATIONS or _picks_by_mask(name, args)):
            self._wait(name)
        device = kwargs.pop("device", None)
        if device is not None:
            there = torch.device(device).type == "cuda"
            if there and isinstance(draws := kwargs.get("generator"), torch.Generator) and draws.device.type == "cpu":
                raise RuntimeError(f"{name}: expected a 'cuda' device type for generator but found 'cpu'")
            return self._put(func(*args, **kwargs), there)
        if name == "copy_":
            return func(*args, **kwargs)
        self._check(name, tensors, args)
        out = func(*args, **kwargs)
        return self._put(out, there) if there else out

    def reset_peak(self) -> None:
        """Count the peak from what is held now."""
        self.peak = self.held

    def free(self) -> int:
        """Bytes that can still be had."""
        return (GPU_MEMORY_BYTES if self.limit is None else self.limit) - self.held

    def _put(self, value: Any, there: bool) -> Any:
        """The same, with all its tensors in a place."""
        for tensor in _tensors(value):
            tensor.__dict__["_is_on_simulated_gpu"] = there
            if there:
                self._allocate(tensor)
        return value

    def _allocate(self, tensor: Tensor) -> None:
        """Count the memory of a tensor once, until it is freed."""
        with torch._C.DisableTorchFunction():
            storage = tensor.untyped_storage()
            key, size = storage._cdata, storage.nbytes()
        if key in self._storages or not size:
            return
        self.allocations += 1
        if self.allocations in self.refused or (self.limit is not None and self.held + size > self.limit):
            capacity = (self.held if self.limit is None else self.limit) / 2**20
            raise torch.cuda.OutOfMemoryError(
                f"CUDA out of memory. Tried to allocate {size / 2**20:.2f} MiB. GPU 0 has a total capacity of "
                f"{capacity:.2f} MiB of which {max(0, self.free()) / 2**20:.2f} MiB is free."
            )
        self._storages.add(key)
        self.held += size
        self.peak = max(self.peak, self.held)
        weakref.finalize(storage, self._freed, key, size)

    def _freed(self, key: int, size: int) -> None:
        self._storages.discard(key)
        self.held -= size

    def _moved(self, func: Callable, name: str, args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
        """What `Tensor.to` and its like give: another tensor if the place changes."""
        was = is_there(args[0])
        there, rest = was, [args[0]]
        for value in args[1:]:
            if isinstance(value, Tensor):
                there = is_there(value)
                rest.append(value)
            elif isinstance(value, (str, torch.device)):
                there = torch.device(value).type == "cuda"
            else:
                rest.append(value)
        if (device := kwargs.pop("device", None)) is not None:
            there = torch.device(device).type == "cuda"
        if name in ("cpu", "cuda"):
            there, out = name == "cuda", args[0]
        else:
            out = func(*rest, **kwargs) if len(rest) > 1 or kwargs else args[0]
        if was and not there:
            self._wait("to cpu")
        if there != was and out is args[0]:
            out = out.clone()
        return self._put(out, there)

    def _check(self, name: str, tensors: list[Tensor], args: tuple[Any, ...]) -> None:
        """Raise what CUDA raises where tensors of both places meet; a number of the CPU may meet all."""
        if name in HOST_ATTRIBUTES or not any(map(is_there, tensors)):
            return
        others = [t for t in tensors if not is_there(t) and t.dim() > 0]
        if name in ("__getitem__", "__setitem__", "index_put_") and is_there(args[0]):
            others = [t for t in others if t.dtype not in (torch.int64, torch.bool)]  # CUDA takes these from the host
        if others or (name == "__getitem__" and not is_there(args[0])):
            raise RuntimeError(
                f"{name}: expected all tensors to be on the same device, but found at least two devices, cuda:0 and cpu"
            )

    def _wait(self, name: str) -> None:
        self.waits[name] = self.waits.get(name, 0) + 1


def is_there(value: Any) -> bool:
    """Whether a tensor says that it is on the GPU."""
    return isinstance(value, Tensor) and value.__dict__.get("_is_on_simulated_gpu", False)


@contextmanager
def simulated_gpu() -> Iterator[SimulatedGpu]:
    """Within, "cuda" is simulated, and kernels for it are emulated."""
    loaded: dict[tuple[Any, torch.device], Emulated] = {}

    def emulated(source: Any, device: torch.device) -> Emulated:
        if (source, device) not in loaded:
            loaded[source, device] = Emulated(source, device=device)
        return loaded[source, device]

    gpu = SimulatedGpu()
    memory: dict[str, Any] = {
        "max_memory_allocated": lambda device=None: gpu.peak,
        "reset_peak_memory_stats": lambda device=None: gpu.reset_peak(),
        "mem_get_info": lambda device=None: (gpu.free(), gpu.free() + gpu.held),
        "memory_allocated": lambda device=None: gpu.held,
        "memory_reserved": lambda device=None: gpu.held,
        "synchronize": lambda device=None: gpu._wait("synchronize"),
    }
    with mock.patch.object(modules, "_loaded", emulated), mock.patch.multiple(torch.cuda, **memory), gpu:
        yield gpu


def _name(func: Callable) -> str:
    name = getattr(func, "__name__", "")
    return getattr(getattr(func, "__self__", None), "__name__", name) if name in ("__get__", "__set__") else name


def _picks_by_mask(name: str, args: tuple[Any, ...]) -> bool:
    """Whether the size of a result depends on how many are true of a mask."""
    if name != "__getitem__":
        return False
    index = args[1] if isinstance(args[1], tuple) else (args[1],)
    return any(isinstance(each, Tensor) and each.dtype in (torch.bool, torch.uint8) for each in index)


def _tensors(value: Any) -> Iterator[Tensor]:
    if isinstance(value, Tensor):
        yield value
    elif isinstance(value, (list, tuple)):
        for each in value:
            yield from _tensors(each)
    elif isinstance(value, dict):
        for each in value.values():
            yield from _tensors(each)


@dataclass(frozen=True)
class OnSimulatedGpu(Rasterizer):
    """A rasterizer of the CPU that says it draws on the simulated GPU, where the kernels are not what is tested."""

    inner: Rasterizer

    def title(self) -> str:
        return f"simulated GPU, {self.inner.title()}"

    def where(self) -> torch.device:
        return GPU

    def render(
        self, splats: Splats, camera: Camera, near: float, geometry: bool = True, distortion: bool = True
    ) -> Render:
        return _SimulatedRender(self.inner.render(_here(splats), camera, near, geometry, distortion), splats)

    def in_view(self, splats: Splats, camera: Camera, near: float) -> torch.Tensor:
        return self.inner.in_view(_here(splats), camera, near).to(splats.means.device)

    def boxes_in_view(self, boxes: SplatBoxes, camera: Camera, near: float) -> torch.Tensor | None:
        here = replace(boxes, low=boxes.low.cpu(), high=boxes.high.cpu(), scale=boxes.scale.cpu())
        found = self.inner.boxes_in_view(here, camera, near)
        return None if found is None else found.to(boxes.low.device)

    def contribution(
        self, splats: Splats, camera: Camera, near: float, alpha_power: float, transmittance_power: float
    ) -> tuple[Tensor, Tensor]:
        total, count = self.inner.contribution(_here(splats), camera, near, alpha_power, transmittance_power)
        return total.to(splats.means.device), count.to(splats.means.device)

    def leading(self, splats: Splats, camera: Camera, near: float) -> Tensor:
        return self.inner.leading(_here(splats), camera, near).to(splats.means.device)

    def opacity_before(self, splats: Splats, camera: Camera, near: float, points: Tensor) -> Tensor:
        return self.inner.opacity_before(_here(splats), camera, near, points.cpu()).to(points.device)


class _SimulatedRender(Render):
    def __init__(self, inner: Render, splats: Splats) -> None:
        self._inner, self._there = inner, splats.means.device
        self.seen, self.radii = inner.seen.to(self._there), inner.radii.to(self._there)

    @cached_property
    def maps(self) -> Maps:  # type: ignore[override]  # drawn when it is asked for
        return Maps(**{name: value.to(self._there) for name, value in self._inner.maps.present().items()})

    def backward(
        self, total: Maps, chosen: Maps | None = None, absolute: bool = False, rows: int | None = None
    ) -> Gradients:
        found = self._inner.backward(_maps_here(total), chosen and _maps_here(chosen), absolute, rows)
        moved: dict[str, Any] = {
            name: value.to(self._there) for name, value in vars(found).items() if isinstance(value, Tensor)
        }
        return replace(found, **moved)


def _maps_here(maps: Maps) -> Maps:
    return Maps(**{name: value.cpu() for name, value in maps.present().items()})


def _here(splats: Splats) -> Splats:
    return splats.with_named({name: value.detach().cpu() for name, value in splats.named().items()})
