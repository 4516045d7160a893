"""Sources of kernels for the tests: the small ones here, and every one of surfkit with its limits."""

import ctypes
from dataclasses import replace
from pathlib import Path

from surfkit.compress.cuda import codes
from surfkit.depth.cuda import passes
from surfkit.mesh.cuda import gpu_grid as grid
from surfkit.raster.cuda import cuda_ssim as ssim
from surfkit.raster.cuda import rasterizer
from surfkit.raster.nvrtc.cuda_source import CudaSource
from surfkit.train import adam

KERNELS = Path(__file__).parent / "kernels"


class Affine(ctypes.Structure):
    _fields_ = (("scale", ctypes.c_float * 2), ("shift", ctypes.c_int))


BASIC = CudaSource(KERNELS / "basic.cu", structures={"Affine": Affine})


def changed(source: CudaSource, old: str, new: str, skip: int = 0) -> CudaSource:
    """A source with one mistake: `new` in place of the occurrence of `old` after the first `skip`."""
    parts = source.text.split(old)
    assert len(parts) > skip + 1, f"{source.path.name} has no {old}"
    other = replace(source)
    other.__dict__["text"] = old.join(parts[: skip + 1]) + new + old.join(parts[skip + 1 :])
    return other


def raster(name: str, kind: int = rasterizer.SURFEL) -> CudaSource:
    """Kernels of the rasterizer as most training steps use them: all maps, and a signal of the colours alone."""
    on_the_way_back = name in ("backward", "gather", "solid")
    width = {"WIDTH": rasterizer.SUMS[kind] + 4} if on_the_way_back else {}
    width |= {"COEFFICIENTS": 16} if name in ("project", "gather") else {}
    return rasterizer.source(name, KIND=kind, LEVEL=rasterizer.LEVEL_DISTORTION, CHOSEN=int(on_the_way_back), **width)


SHIPPED: tuple[tuple[CudaSource, dict[str, tuple[int, ...]]], ...] = (
    (adam.ADAM_SOURCE, {"adam": (40, 0), "adam_16": (40, 0), "adam_rows": (64, 0), "adam_rows_16": (64, 0)}),
    (ssim.SSIM_SOURCE, {"ssim_forward": (64, 23_000), "ssim_backward": (64, 24_000)}),
    (grid.FUSION_SOURCE, {"reach": (40, 0), "fuse": (48, 100)}),
    (passes.SOURCE_BY_SAMPLES[16], {"improve": (128, 0, 1000)}),
    (passes.SOURCE_BY_SAMPLES[32], {"improve": (168, 0, 1000)}),
    (codes.CODES_SOURCE, {"approach": (112, 13_000), "settle": (64, 0), "sum_by_code": (48, 0)}),
    (raster("project"), {"measure": (128, 0), "record": (168, 0), "list": (32, 0)}),
    (raster("forward"), {"forward": (85, 18_000)}),
    (raster("backward"), {"backward": (128, 31_000)}),
    (raster("gather"), {"gather": (168, 0)}),
    (raster("solid", rasterizer.RAY), {"solid": (88, 14_000), "solid_backward": (80, 33_000)}),
    (raster("contribution"), {"contribution": (80, 7_000), "leading": (80, 6_000), "total": (56, 0), "probe": (56, 0)}),
)
"""Each source with the most registers and bytes of shared memory that a thread and a block of each kernel may have; and
bytes of a thread's own memory, where it keeps lists whose length is not known."""
