"""A stage on disk: everything needed to go on as if nothing had happened, without pickle."""

from __future__ import annotations

import json
import os
from pathlib import Path

import torch
from torch import Tensor

from surfkit.core.check import BadInput
from surfkit.primitives.points import Points
from surfkit.train.stage import StageState
from surfkit.train.views import Order

FORMAT = "surfkit-stage-2"
GROUPS = ("params", "first", "second", "stats")
FACTS = {"index", "views", "shown", "seconds", "cpu_seconds", "peak_memory_bytes", "reset_at"}


def save(path: Path, state: StageState) -> None:
    """Write a state; the file at `path` is replaced at once or not at all."""
    from safetensors.torch import save_file

    tensors = {
        f"{group}.{name}": value.contiguous()
        for group in GROUPS
        for name, value in getattr(state.points, group).items()
    }
    tensors |= {f"looks.{name}": value.contiguous() for name, value in state.looks.items()}
    tensors |= {"order": state.order.queue, "generator": state.generator.get_state()}
    facts = {
        "index": state.index,
        "views": state.order.count,
        "shown": state.order.at,
        "seconds": state.seconds,
        "cpu_seconds": state.cpu_seconds,
        "peak_memory_bytes": state.peak_memory_bytes,
        "reset_at": state.reset_at,
    }
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_name(f".{path.name}.part")
    save_file(tensors, part, metadata={"format": FORMAT, "facts": json.dumps(facts)})
    with open(part, "rb+") as file:
        os.fsync(file.fileno())
    os.replace(part, path)


def load(path: Path) -> StageState:
    """The state in a file that `save` wrote."""
    tensors, facts = _read(path)
    groups: dict[str, dict[str, Tensor]] = {group: {} for group in (*GROUPS, "looks")}
    for key, value in tensors.items():
        group, _, name = key.partition(".")
        if group in groups:
            groups[group][name] = value
    looks = groups.pop("looks")
    points = Points(**groups)
    _check(path, points, tensors["order"], facts)
    generator = torch.Generator()
    generator.set_state(tensors["generator"])
    order = Order(facts["views"], tensors["order"], facts["shown"])
    done = ("index", "seconds", "cpu_seconds", "peak_memory_bytes")
    state = StageState(points, order, generator, *(facts[name] for name in done))
    state.looks, state.reset_at = looks, facts["reset_at"]
    return state


def _read(path: Path) -> tuple[dict[str, Tensor], dict]:
    from safetensors import SafetensorError, safe_open

    try:
        with safe_open(path, framework="pt") as file:
            metadata = file.metadata() or {}
            if metadata.get("format") != FORMAT:
                raise BadInput(
                    f"{path} is of format {metadata.get('format')!r}, not {FORMAT!r}; delete it to start anew"
                )
            tensors, facts = {name: file.get_tensor(name) for name in file.keys()}, json.loads(metadata["facts"])
    except (SafetensorError, OSError, KeyError, json.JSONDecodeError) as error:
        raise BadInput(f"{path} is no readable checkpoint ({error}); delete it to start anew") from error
    wanted = {"params.means", "order", "generator"}
    if missing := (wanted - tensors.keys()) | (FACTS - facts.keys()):
        raise BadInput(f"{path} lacks {', '.join(sorted(missing))}; delete it to start anew")
    return tensors, facts


def _check(path: Path, points: Points, order: Tensor, facts: dict) -> None:
    """Every column must have a row per point, every parameter its moments, and the order every view."""
    count = len(points)
    for group in GROUPS:
        for name, value in getattr(points, group).items():
            if len(value) != count:
                raise BadInput(
                    f"{path}: {group}.{name} has {len(value)} rows for {count} points; delete it to start anew"
                )
    shapes = [
        {name: value.shape for name, value in group.items()} for group in (points.params, points.first, points.second)
    ]
    if shapes[0] != shapes[1] or shapes[0] != shapes[2]:
        raise BadInput(f"{path}: the optimiser's moments do not fit the parameters; delete it to start anew")
    if len(order) not in (0, facts["views"]) or facts["shown"] > len(order):
        raise BadInput(f"{path}: the order of views does not fit {facts['views']} views; delete it to start anew")
