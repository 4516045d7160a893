"""Which rasterizer draws: the device decides, a recipe does not."""

from __future__ import annotations

import warnings
from collections.abc import Mapping

import torch

from surfkit.core.check import BadInput
from surfkit.core.registry import components, unknown
from surfkit.raster.api import Rasterizer

Device = str
"""auto, cpu, cuda, or the name of a registered rasterizer."""
DEVICES = ("auto", "cpu", "cuda")


def select(device: Device = "auto") -> tuple[Rasterizer, str]:
    """A rasterizer for a device or of a name, and its title for run.json, such as "cpu avx512".

    Raises:
        BadInput: None draws there, or the one of that name cannot run here.
    """
    known = {name: kind() for name, kind in rasterizers(device).items()}
    if device in known:
        if why := known[device].missing():
            raise BadInput(f"--device {device}: {why}")
        return known[device], known[device].title()
    there = [each for each in known.values() if device in ("auto", each.device)]
    there.sort(key=lambda each: (each.device == "cuda", each.rank), reverse=True)
    if not there:
        raise BadInput(f"--device {device}: no rasterizer for it is part of this version; use --device cpu")
    lacking = []
    for each in there:
        why = each.missing()
        if why is None:
            for text in lacking:
                warnings.warn(f"{text}: {each.title()} draws instead, about a hundred times slower", stacklevel=2)
            return each, each.title()
        lacking.append(why)
    raise BadInput(f"--device {device}: {lacking[0]}")


def torch_device(device: Device = "auto") -> torch.device:
    """Where torch computes what no rasterizer does, such as depth maps.

    For `auto` that is CUDA where torch has it, whatever draws; for the name of a rasterizer, the device that it draws
    on.

    Raises:
        BadInput: Torch has no CUDA device and one is asked for, or the name is unknown.
    """
    known = rasterizers(device)
    wanted, there = known[device].device if device in known else device, torch.cuda.is_available()
    if wanted == "cuda" and not there:
        raise BadInput(f"--device {device}: torch finds no CUDA device here; use --device cpu")
    return torch.device("cuda" if wanted != "cpu" and there else "cpu")


def rasterizers(device: Device) -> Mapping[str, type[Rasterizer]]:
    """All rasterizers by name; BadInput if `device` is none of them and no device either."""
    known = components(Rasterizer)
    if device not in (*DEVICES, *known):
        raise BadInput(unknown("--device", device, (*DEVICES, *known)))
    return known
