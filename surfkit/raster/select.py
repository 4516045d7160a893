"""Which rasterizer draws: the device decides, a recipe does not."""

from __future__ import annotations

import re
import warnings
from collections.abc import Mapping

import torch

from surfkit.core.check import BadInput
from surfkit.core.registry import components, unknown
from surfkit.raster.base import Rasterizer

Device = str
"""auto, cpu, cuda, a GPU such as cuda:1, or the name of a registered rasterizer."""
DEVICES = ("auto", "cpu", "cuda")


def select(device: Device = "auto") -> tuple[Rasterizer, str]:
    """A rasterizer for a device or of a name, and its title for run.json, such as "cpu avx512".

    For `auto` that is one for CUDA where torch finds a GPU, else the best of the CPU. The CPU never takes the place of
    a GPU that is there unasked.

    Raises:
        BadInput: None draws there, or the one of that name cannot run here.
    """
    known, kind = rasterizers(device), _use_gpu(device)
    if kind in known:
        return _able(device, [known[kind]()])
    is_there = torch.cuda.is_available()
    wanted = ("cuda", "cpu") if kind == "auto" and is_there else ("cpu",) if kind == "auto" else (kind,)
    for each in wanted:
        if there := [rasterizer() for rasterizer in known.values() if rasterizer.device == each]:
            return _able(device, sorted(there, key=lambda rasterizer: rasterizer.rank, reverse=True))
    raise BadInput(f"--device {device}: no rasterizer for it is part of this version; use --device cpu")


def _able(device: Device, best_first: list[Rasterizer]) -> tuple[Rasterizer, str]:
    """The first that can run, and its title; a warning says why it is not the very first."""
    lacking = [each.missing() for each in best_first]
    if None not in lacking:
        raise BadInput(f"--device {device}: {lacking[0]}")
    taken = lacking.index(None)
    title = best_first[taken].title()
    for text in lacking[:taken]:
        warnings.warn(f"{text}: {title} draws instead, about a hundred times slower", stacklevel=3)
    return best_first[taken], title


def torch_device(device: Device = "auto") -> torch.device:
    """Where torch computes what no rasterizer does, such as depth maps.

    For `auto` that is CUDA where torch has it, whatever draws; for the name of a rasterizer, the device that it draws
    on.

    Raises:
        BadInput: Torch has no CUDA device and one is asked for, or the name is unknown.
    """
    known, kind = rasterizers(device), _use_gpu(device)
    wanted, there = known[kind].device if kind in known else kind, torch.cuda.is_available()
    if wanted == "cuda" and not there:
        raise BadInput(f"--device {device}: torch finds no CUDA device here; use --device cpu")
    return torch.device("cuda" if wanted != "cpu" and there else "cpu")


def _use_gpu(device: Device) -> str:
    """The device without the number of a GPU, which torch uses from now on.

    Raises:
        BadInput: There are fewer GPUs.
    """
    kind, _, number = device.partition(":")
    if kind == "cuda" and number and torch.cuda.is_available():
        count = torch.cuda.device_count()
        if int(number) >= count:
            raise BadInput(f"--device {device}: torch finds {count} of them here; the last is cuda:{count - 1}")
        torch.cuda.set_device(int(number))
    return kind


def rasterizers(device: Device) -> Mapping[str, type[Rasterizer]]:
    """All rasterizers by name; BadInput if `device` is none of them and no device either."""
    known = components(Rasterizer)  # type: ignore[type-abstract]
    if device not in (*DEVICES, *known) and not re.fullmatch(r"cuda:\d{1,3}", device):
        raise BadInput(unknown("--device", device, (*DEVICES, *known)))
    return known
