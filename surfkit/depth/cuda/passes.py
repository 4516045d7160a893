"""The passes of PatchMatch on a GPU: pictures stay there as long as they are kept, planes come and go."""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Sequence
from pathlib import Path
from weakref import WeakKeyDictionary

import numpy as np
import torch
from torch import Tensor

from surfkit.depth.native_patch_match import GreyImage, MatchingSettings, Planes, gains, pattern, way
from surfkit.raster import native
from surfkit.raster.nvrtc.cuda_source import CudaSource
from surfkit.raster.nvrtc.modules import Kernels, kernels
from surfkit.scene.camera import Camera

BLOCK_WIDTH, BLOCK_HEIGHT = 32, 4
"""Pixels of one colour that a block of threads takes: on so many columns of that colour, and rows."""


class PatchMatchView(ctypes.Structure):
    """`PatchMatchView` of patch_match.cu."""

    _fields_ = (
        ("first", ctypes.c_longlong),
        ("first_inverse", ctypes.c_longlong),
        ("size", ctypes.c_int * 2),
        ("stride", ctypes.c_int),
        ("inverse_size", ctypes.c_int * 2),
        ("gain", ctypes.c_float),
        ("to_inverse", ctypes.c_float * 2),
        ("way", ctypes.c_float * 12),
        ("back", ctypes.c_float * 12),
    )


class PatchMatchJob(ctypes.Structure):
    """`PatchMatchJob` of patch_match.cu."""

    _fields_ = (
        ("size", ctypes.c_int * 2),
        ("counts", ctypes.c_int * 2),
        ("survey", ctypes.c_int),
        ("seed", ctypes.c_uint),
        ("lens", ctypes.c_float * 4),
        ("terms", ctypes.c_float * 8),
        ("stretch", ctypes.c_float),
        ("pattern", ctypes.c_float * 96),
    )


SOURCE_BY_SAMPLES = {
    samples: CudaSource(
        Path(__file__).with_name("patch_match.cu"),
        defines={"SAMPLES": samples, "BLOCKS": blocks},
        structures={"View": PatchMatchView, "Job": PatchMatchJob},
    )
    for samples, blocks in ((16, 4), (32, 3))
}
"""By the pixels of a window that are compared. Windows are in registers; so many blocks fit on a multiprocessor."""


class GpuPasses:
    """`depth.native.improve` on a GPU.

    Args:
        device: The GPU.
        load: Gives the kernels of a source; by default those for the device.
    """

    def __init__(self, device: torch.device, load: Callable[[CudaSource], Kernels] | None = None) -> None:
        self.device, self.load = device, load or (lambda source: kernels(source, device))
        self.uploaded: WeakKeyDictionary[GreyImage, Tensor] = WeakKeyDictionary()

    def improve(
        self,
        here: GreyImage,
        others: Sequence[GreyImage],
        planes: Planes,
        terms: MatchingSettings,
        seed: int,
        known: Sequence[Tensor | None] | None = None,
    ) -> None:
        """See `depth.native.improve`; the same bits twice on one GPU."""
        on = self.load(SOURCE_BY_SAMPLES[terms.samples])
        pictures = [self.picture(other) for other in others]
        nothing = torch.empty(0, 0, device=self.device)
        maps = [nothing if found is None else found.to(self.device) for found in known or [None] * len(others)]
        views = self.uploads(np.frombuffer(bytes(views_of(here, others, planes, pictures, maps)), np.uint8))
        given = self.picture(here), joined(pictures), joined(maps)
        state = [self.uploads(part) for part in (planes.value, planes.cost, planes.each)]
        height, width = planes.cost.shape
        grid = -(-width // (2 * BLOCK_WIDTH)), -(-height // BLOCK_HEIGHT)
        job = job_of(here.camera, len(others), terms, seed)
        for colour in (0, 1):
            on.launch("improve", grid, BLOCK_WIDTH * BLOCK_HEIGHT, job, colour, views, *given, *state)
        for part, found in zip((planes.value, planes.cost, planes.each), state, strict=True):
            part[:] = found.cpu().numpy()

    def picture(self, grey: GreyImage) -> Tensor:
        """Four grey values in one number for each pixel, on the GPU, as long as it is kept here."""
        if grey not in self.uploaded:
            self.uploaded[grey] = self.uploads(in_fours(grey.value).view(np.int32))
        return self.uploaded[grey]

    def uploads(self, values: np.ndarray) -> Tensor:
        """A copy of an array on the GPU."""
        return torch.from_numpy(values.copy()).to(self.device)


def in_fours(value: np.ndarray) -> np.ndarray:
    """(H + 2 b, W + 2 b) uint32: a pixel, and those to the right, below, and below to the right, for interpolation.

    Continued by a border of b pixels. A GPU reads four bytes at once only where they are aligned, unlike a CPU
    (`GreyImage.in_pairs`).
    """
    border = native.kernels().STEREO_BORDER
    wide = np.pad(value, (border, border + 1), mode="edge").astype(np.uint32)
    return wide[:-1, :-1] | wide[:-1, 1:] << 8 | wide[1:, :-1] << 16 | wide[1:, 1:] << 24


def joined(parts: Sequence[Tensor]) -> Tensor:
    """All numbers of several tensors, one after the other: kernels take buffers by name, not lists of them."""
    return torch.cat([part.flatten() for part in parts])


def views_of(
    here: GreyImage, others: Sequence[GreyImage], planes: Planes, pictures: Sequence[Tensor], maps: Sequence[Tensor]
) -> ctypes.Array[PatchMatchView]:
    """A `PatchMatchView` for each picture to compare with, of those that are joined."""
    border = native.kernels().STEREO_BORDER
    made = (PatchMatchView * len(others))()
    first = first_inverse = 0
    bright = gains(here, others, planes)
    for view, other, gain, picture, inverse in zip(made, others, bright, pictures, maps, strict=True):
        height, width = (side - 2 * border for side in picture.shape)
        view.first, view.first_inverse = first, first_inverse
        view.size[:], view.stride, view.inverse_size[:] = (width, height), picture.shape[1], inverse.shape[::-1]
        view.gain = gain
        view.to_inverse[:] = inverse.shape[1] / width, inverse.shape[0] / height
        view.way[:], view.back[:] = way(here.camera, other.camera), way(other.camera, here.camera)
        first, first_inverse = first + picture.numel(), first_inverse + inverse.numel()
    return made


def job_of(camera: Camera, views: int, terms: MatchingSettings, seed: int) -> PatchMatchJob:
    """What a pass is told of one picture."""
    offsets = pattern(terms.window)
    most = max(1.0, float(np.abs(offsets[:2]).max()))
    parallax = terms.parallax, terms.jitter_px, terms.smoothness, terms.consistency
    numbers = terms.low, terms.high, *parallax, terms.spread, terms.brightness
    return PatchMatchJob(
        (camera.width, camera.height),
        (views, terms.best),
        terms.survey,
        seed % 2**32,
        (camera.fx, camera.fy, camera.cx, camera.cy),
        numbers,
        (native.kernels().STEREO_BORDER - 2) / most,
        tuple(offsets.flatten().tolist()),
    )
