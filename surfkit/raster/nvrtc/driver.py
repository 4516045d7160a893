"""The few calls of the CUDA driver that loading and launching kernels takes, through ctypes."""

from __future__ import annotations

import ctypes
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import cache
from typing import Any

import torch

from surfkit.core.check import BadInput

UNFIT = {200, 209, 218, 222, 223}
"""Results of loading an image that this driver or GPU does not understand."""


class Driver:
    """The CUDA driver for one device, within the context that torch uses too."""

    def __init__(self, device: torch.device) -> None:
        try:
            self._library = ctypes.CDLL("libcuda.so.1")
        except OSError as error:
            raise BadInput(
                f"--device {device}: found no NVIDIA driver ({error}); install one, or use --device cpu"
            ) from error
        self._device = device
        self._context = ctypes.c_void_p()
        version, handle = ctypes.c_int(), ctypes.c_int()
        self._call("cuInit", 0)
        self._call("cuDriverGetVersion", ctypes.byref(version))
        self._call("cuDeviceGet", ctypes.byref(handle), device.index)
        self._call("cuDevicePrimaryCtxRetain", ctypes.byref(self._context), handle)
        self.version = version.value
        self.capability = torch.cuda.get_device_capability(device)

    def load(self, image: bytes) -> ctypes.c_void_p:
        """The module of a cubin, or of PTX.

        Raises:
            BadInput: The driver is too old for it.
        """
        module = ctypes.c_void_p()
        with self._current():
            status = self._library.cuModuleLoadData(ctypes.byref(module), image)
        if status in UNFIT:
            knows = f"{self.version // 1000}.{self.version % 1000 // 10}"
            raise BadInput(
                f"--device {self._device}: the NVIDIA driver, for CUDA {knows}, cannot run kernels of CUDA "
                f"{torch.version.cuda} on this GPU ({self._explain(status)}); update the driver, install a build of "
                "torch for an older CUDA, or use --device cpu"
            )
        self._check("cuModuleLoadData", status)
        return module

    def function(self, module: ctypes.c_void_p, name: str) -> ctypes.c_void_p:
        """A kernel of a module."""
        found = ctypes.c_void_p()
        with self._current():
            self._call("cuModuleGetFunction", ctypes.byref(found), module, name.encode())
        return found

    def launch(
        self, function: ctypes.c_void_p, grid: Sequence[int], block: Sequence[int], arguments: Sequence[Any]
    ) -> None:
        """Queue a kernel on torch's current stream; `arguments` are ctypes values, one for each parameter."""
        pointers = (ctypes.c_void_p * len(arguments))(*(ctypes.addressof(value) for value in arguments))
        stream = ctypes.c_void_p(torch.cuda.current_stream(self._device).cuda_stream)
        with self._current():
            self._call("cuLaunchKernel", function, *grid, *block, 0, stream, pointers, None)

    @contextmanager
    def _current(self) -> Iterator[None]:
        """Within, this thread's context is that of the device: backward passes run in threads of torch."""
        self._call("cuCtxPushCurrent_v2", self._context)
        try:
            yield
        finally:
            self._call("cuCtxPopCurrent_v2", ctypes.byref(ctypes.c_void_p()))

    def _call(self, name: str, *arguments: Any) -> None:
        self._check(name, getattr(self._library, name)(*arguments))

    def _check(self, name: str, status: int) -> None:
        if status:
            raise RuntimeError(f"{name} on {self._device}: {self._explain(status)}")

    def _explain(self, status: int) -> str:
        text = ctypes.c_char_p()
        self._library.cuGetErrorString(status, ctypes.byref(text))
        return (text.value or b"unknown error").decode() + f", {status}"


@cache
def driver(device: torch.device) -> Driver:
    """The driver for a device, such as cuda:0."""
    return Driver(device)
