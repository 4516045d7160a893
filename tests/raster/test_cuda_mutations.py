"""Mistakes put into the CUDA kernels of the rasterizer: the emulator reports each, or the result is wrong."""

from dataclasses import dataclass, replace

import pytest
import torch

from surfkit.raster.api import Maps
from surfkit.raster.cuda.rasterizer import TileRasterizer, source
from surfkit.raster.nvrtc.emulated import Emulated, KernelError

from .cases import case, different_gradients, different_maps
from .scenes import NEAR
from .test_cuda import emulated, pytestmark  # noqa: F401 (the mark skips these tests too)

BARRIER = "__syncthreads();"
# File, what is replaced, by what, after how many others; and what is said of it.
MISTAKES = {
    "no barrier after staging": ("forward", BARRIER, "", 0, "of the block has written|with no barrier"),
    "no barrier before staging again": (
        "forward", "if (!__syncthreads_or(ray.alive)) break;", "", 0, "with no barrier",
    ),
    "one splat too many": ("forward", "threadIdx.x < count", "threadIdx.x <= count", 0, "index .* which has|with no"),
    "a row beyond the image": (
        "forward", "if (!pixel.is_inside) return;", "", 0, "index .* which has|another block",
    ),
    "a word of all warps": ("forward", "* kWarps + warp]", "* kWarps]", 0, "with no barrier|which has written|another"),
    "no barrier after staging, backward": ("backward", BARRIER, "", 0, "of the block has written|with no barrier"),
    "no barrier before the sum of warps": ("backward", BARRIER, "", 1, "of the block has written|with no barrier"),
    "no barrier before the next batch": ("backward", BARRIER, "", 2, "with no barrier"),
    "front to back": ("backward", "31 - __clz(todo)", "__ffs(todo) - 1", 0, "wrong"),
    "a lane that stays away from a shuffle": (
        "backward", "const int column = fold", "if (lane == 7) continue; const int column = fold", 0, "shfl",
    ),
    "moments about the tile": ("backward", "if (is_moment) sum +=", "if (false) sum +=", 0, "wrong"),
    "no barrier after staging solids": ("solid", BARRIER, "", 0, "of the block has written|with no barrier"),
    "no barrier before the sum of warps, solids": ("solid", BARRIER, "", 2, "of the block has written|with no barrier"),
    "rows of sums are written over": ("solid", "has_sums[j] ?", "false ?", 0, "wrong"),
    "behind the peak as before it": ("solid", "select(front, -half, half)", "-half", 0, "wrong"),
    "one slot too many": ("gather", "slot < first[r + 1]", "slot <= first[r + 1]", 0, "index .* which has|wrong"),
    "no atomic": ("project", "atomicMin(&invalid[0], i)", "invalid[0] = i", 0, "wrong|another block|with no barrier"),
}  # fmt: skip


@dataclass(frozen=True)
class Broken(TileRasterizer):
    """Draws with one mistake."""

    mistake: tuple[str, str, str, int, str]

    def where(self) -> torch.device:
        return torch.device("cpu")

    def title(self) -> str:
        return "broken"

    def program(self, name: str, **defines: int) -> Emulated:
        file, old, new, skip, _ = self.mistake
        if name != file:
            return emulated(name, 0, **defines)
        changed = source(name, **defines)
        parts = changed.text.split(old)
        assert len(parts) > skip + 1, f"{name}.cu has no {old}"
        changed.__dict__["text"] = old.join(parts[: skip + 1]) + new + old.join(parts[skip + 1 :])
        return Emulated(changed)


@pytest.mark.parametrize("name", MISTAKES)
def test_mistakes(name):
    c = case("opaque", "solid" if MISTAKES[name][0] == "solid" else "surfel")
    splats, is_larger = c.splats, "again" in name or "next batch" in name
    if name == "no atomic":
        splats = replace(splats, scales=-splats.scales)
    if is_larger:  # several batches in a tile, and rays that go through all
        splats = case("plain", "surfel").splats.take(torch.arange(100).repeat(6) % 40)
        splats = replace(splats, opacities=0.05 + 0 * splats.opacities)
    total = Maps(**c.cotangents)
    with pytest.raises(KernelError, match=MISTAKES[name][-1]):
        render = Broken(MISTAKES[name]).render(splats, c.view, NEAR)
        if different_maps(render.maps, c.true.maps, c.clear) and not is_larger:
            raise KernelError("wrong")
        found = render.backward(total, Maps(color=total.color))
        if is_larger or different_gradients(found, c.true.backward(total, Maps(color=total.color))):
            raise KernelError("a mistake in the result" if is_larger else "wrong")
