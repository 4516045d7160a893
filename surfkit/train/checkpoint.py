"""A stage on disk: everything needed to go on as if nothing had happened, without pickle.

The last two states are kept, and each carries a digest of itself. When the last one turns out damaged, the one before
takes its place.
"""

from __future__ import annotations

import errno
import hashlib
import json
import os
import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar

import torch
from torch import Tensor

from surfkit.core.check import BadInput
from surfkit.core.codec import from_json
from surfkit.core.codec import load as load_value
from surfkit.core.files import being_written, remove, sync_folder
from surfkit.primitives.points import Points
from surfkit.train.moments import SHORT
from surfkit.train.state import StageState
from surfkit.train.view_order import ViewOrder

CHECKPOINT_FORMAT = "surfkit-stage-3"
TENSOR_GROUPS = {"params": "params", "first": "exp_avg", "second": "exp_avg_sq", "stats": "stats"}
"""Of the columns of points, as a file has them and as `Points` does."""
SCALAR_FIELDS = {
    "index": int,
    "seconds": float,
    "cpu_seconds": float,
    "peak_memory_bytes": int,
    "peak_gpu_bytes": int,
    "reset_at": int,
    "sh_degree": int,
    "halvings": int,
    "skipped": tuple[int, ...],
}
"""What of a state is written as it is."""
FACT_TYPES = {"views": int, "shown": int, **SCALAR_FIELDS}
ADDED_DEFAULTS = {"peak_gpu_bytes": 0}
"""What files of older versions lack, and stands for it."""
OS_ERROR_PATTERN = re.compile(r"os error (\d+)")
"""How safetensors says what the system has refused."""
Read = TypeVar("Read")


def before(path: Path) -> Path:
    """Where the state before the last one lies."""
    return path.with_name(f"{path.stem}-before{path.suffix}")


def save(path: Path, state: StageState) -> None:
    """Write a state, and keep the one that was there as the one before; nothing is lost at any moment.

    Raises:
        OSError: It cannot be written; what was there stays.
    """
    small, facts = beside_points(state)
    tensors = small | {
        f"{group}.{name}": value.contiguous()
        for group, attribute in TENSOR_GROUPS.items()
        for name, value in getattr(state.points, attribute).items()
    }
    tensors |= {f"frozen.{name}": value.contiguous() for name, value in state.frozen.items()}
    with taking_the_place(path) as part:
        _write(part, tensors, facts)


def beside_points(state: StageState) -> tuple[dict[str, Tensor], str]:
    """What a file holds of a state beside its points: numbers of the photographs (V, ...), shared parameters, the order
    of the views (V,), the generator's state (bytes,), and facts as text."""
    tensors = {f"looks.{name}": value.contiguous() for name, value in state.appearances.items()}
    tensors |= {f"shared.{name}": value.contiguous() for name, value in state.points.shared.items()}
    tensors |= {"order": state.order.queue, "generator": state.generator.get_state()}
    facts = {"views": state.order.count, "shown": state.order.at} | {
        name: getattr(state, name) for name in SCALAR_FIELDS
    }
    return tensors, json.dumps(facts)


@contextmanager
def taking_the_place(path: Path) -> Iterator[Path]:
    """Where to write what takes the place of a state when all went well; the one that was there becomes the one before.

    What is written must be on the disk at the end.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    room = being_written(path)  # a folder, as safetensors begins a file of its own beside the one that it writes
    try:
        remove(room)
        room.mkdir()
        part = room / path.name
        yield part
        if path.exists():
            os.replace(path, before(path))
        os.replace(part, path)
    finally:
        remove(room)
    sync_folder(path.parent)


def load_last(path: Path) -> tuple[StageState, str | None] | None:
    """The last state that is whole, and what is wrong with the file that should hold it; None if nothing was saved.

    Raises:
        BadInput: There are files, and none of them can be used.
    """
    return last_whole(path, load)


def last_whole(path: Path, read: Callable[[Path], Read]) -> tuple[Read, str | None] | None:
    """What `read` makes of the last file that it does not refuse by BadInput; else as `load_last`."""
    there = [file for file in (path, before(path)) if file.exists()]
    wrong: list[str] = []
    for file in there:
        try:
            return read(file), wrong[0] if wrong else None
        except BadInput as error:
            wrong.append(str(error))
    if wrong:
        raise BadInput("; ".join(wrong))
    return None


def restore(path: Path) -> None:
    """Put the state before in the place of a damaged last one, so that the next one does not push it out."""
    os.replace(before(path), path)
    sync_folder(path.parent)


def discard(path: Path) -> None:
    """Delete all states."""
    for file in (path, before(path)):
        file.unlink(missing_ok=True)


def load(path: Path) -> StageState:
    """The state in a file that `save` wrote."""
    tensors, text = _read(path)
    return state_of(path, tensors, text)


def state_of(path: Path, tensors: Mapping[str, Tensor], text: str) -> StageState:
    """The state that the tensors and facts in a file make.

    Args:
        path: Of the file, for messages.
        tensors: By name; the columns of the points, (N, ...), may be without values (meta).
        text: The facts.

    Raises:
        BadInput: They make none.
    """
    facts = _facts(path, tensors, text)
    groups: dict[str, dict[str, Tensor]] = {group: {} for group in (*TENSOR_GROUPS, "looks", "frozen", "shared")}
    for key, value in tensors.items():
        group, _, name = key.partition(".")
        if group in groups:
            groups[group][name] = value
    appearances, frozen = groups.pop("looks"), groups.pop("frozen")
    columns = {attribute: groups[group] for group, attribute in TENSOR_GROUPS.items()}
    points = Points(columns["params"], columns["exp_avg"], columns["exp_avg_sq"], columns["stats"], groups["shared"])
    _check(path, points, tensors["order"], facts)
    _check_frozen(path, points, frozen)
    generator = torch.Generator()
    try:
        generator.set_state(tensors["generator"])
    except (TypeError, RuntimeError) as error:
        raise _unusable(path, "the state of the random generator is none") from error
    order = ViewOrder(facts["views"], tensors["order"], facts["shown"])
    state = StageState(
        points,
        order,
        generator,
        appearances=appearances,
        frozen=frozen,
        **{name: facts[name] for name in SCALAR_FIELDS},
    )
    state.skipped = list(state.skipped)
    return state


def _write(part: Path, tensors: dict[str, Tensor], facts: str) -> None:
    """Write a file and let the disk know it."""
    from safetensors import SafetensorError
    from safetensors.torch import save_file

    tensors = {name: value.cpu() for name, value in tensors.items()}
    metadata = {"format": CHECKPOINT_FORMAT, "facts": facts, "digest": _digest(tensors, facts)}
    try:
        save_file(tensors, part, metadata=metadata)
    except SafetensorError as error:
        said = OS_ERROR_PATTERN.search(str(error))
        code = int(said[1]) if said else errno.EIO
        raise OSError(code, os.strerror(code), str(part)) from error
    mask = os.umask(0o077)  # it can only be read by being set
    os.umask(mask)
    os.chmod(part, 0o666 & ~mask)  # safetensors lets nobody else read its files
    with open(part, "rb+") as file:
        os.fsync(file.fileno())


def _read(path: Path) -> tuple[dict[str, Tensor], str]:
    with reading(path) as (file, metadata):
        tensors = {name: file.get_tensor(name) for name in file.keys()}
    if _digest(tensors, metadata["facts"]) != metadata.get("digest"):
        raise damaged(path)
    return tensors, metadata["facts"]


@contextmanager
def reading(path: Path) -> Iterator[tuple[Any, dict[str, str]]]:
    """Within, a file that `save` wrote is open, by safetensors; also gives its metadata."""
    from safetensors import SafetensorError, safe_open

    try:
        with safe_open(path, framework="pt") as file:
            metadata = file.metadata() or {}
            if metadata.get("format") != CHECKPOINT_FORMAT:
                raise BadInput(
                    f"{path} is of format {metadata.get('format')!r}, not {CHECKPOINT_FORMAT!r}; delete it to start "
                    f"anew"
                )
            if "facts" not in metadata:
                raise BadInput(f"{path} is no readable checkpoint (it lacks its facts); delete it to start anew")
            yield file, metadata
    except (SafetensorError, OSError, KeyError, ValueError) as error:
        if isinstance(error, BadInput):
            raise
        raise BadInput(f"{path} is no readable checkpoint ({error}); delete it to start anew") from error


def _facts(path: Path, tensors: Mapping[str, Tensor], text: str) -> dict[str, Any]:
    """What is written beside the tensors; all that should be there is."""
    try:
        facts = from_json(text)
    except BadInput as error:
        raise BadInput(f"{path} is no readable checkpoint ({error}); delete it to start anew") from error
    if not isinstance(facts, dict):
        raise _unusable(path, "it lacks its facts")
    facts = ADDED_DEFAULTS | facts
    wanted = {"params.means", "order", "generator"}
    if missing := (wanted - tensors.keys()) | (FACT_TYPES.keys() - facts.keys()):
        raise _unusable(path, f"it lacks {', '.join(sorted(missing))}")
    try:
        return {name: load_value(hint, facts[name], name) for name, hint in FACT_TYPES.items()}
    except BadInput as error:
        raise _unusable(path, str(error)) from error


def damaged(path: Path) -> BadInput:
    """For a file whose digest is another."""
    return BadInput(f"{path} is damaged: its digest does not fit what is in it; delete it to start anew")


def _unusable(path: Path, why: str) -> BadInput:
    return BadInput(f"{path}: {why}; delete it to start anew")


def _digest(tensors: Mapping[str, Tensor], facts: str) -> str:
    """SHA-256 of names, types, shapes, bytes and facts."""
    return digest(facts, ((name, tensors[name], [tensors[name]]) for name in sorted(tensors)))


def digest(facts: str, tensors: Iterable[tuple[str, Tensor, Iterable[Tensor]]]) -> str:
    """SHA-256 of facts and tensors, (N, ...) each.

    Args:
        facts: As in the file.
        tensors: Sorted by name: the name; a tensor of that type and shape, whose values do not count; the values, in
            pieces.
    """
    found = hashlib.sha256(facts.encode())
    for name, like, pieces in tensors:
        found.update(f"\0{name}\0{like.dtype}\0{tuple(like.shape)}\0".encode())
        for value in pieces:
            value = value.detach().cpu().contiguous()
            found.update(value.reshape(-1).view(torch.uint8).numpy().data if value.numel() else b"")
    return found.hexdigest()


def _check(path: Path, points: Points, order: Tensor, facts: dict[str, Any]) -> None:
    """Every column must have a row per point, every parameter its moments, and the order every view."""
    count = tuple(points.params["means"].shape[:1])
    for group, attribute in TENSOR_GROUPS.items():
        for name, value in getattr(points, attribute).items():
            if name not in points.shared and (not count or value.shape[:1] != count):
                raise _unusable(path, f"{group}.{name} has shape {tuple(value.shape)} for {sum(count)} points")
    params = points.all_params()
    shapes = {name: value.shape for name, value in params.items()}
    floats = all(value.is_floating_point() for value in params.values())
    for moments in (points.exp_avg, points.exp_avg_sq):
        kinds = all(value.dtype in (SHORT, params[name].dtype) for name, value in moments.items() if name in params)
        floats = floats and kinds and {name: value.shape for name, value in moments.items()} == shapes
    if not floats:
        raise _unusable(path, "the optimiser's moments do not fit the parameters")
    size, views = order.numel(), torch.arange(order.numel())
    ordered = order.dtype == torch.int64 and order.dim() == 1 and torch.equal(order.sort().values, views)
    if not ordered or size not in (0, facts["views"]) or not 0 <= facts["shown"] <= len(order):
        raise _unusable(path, f"the order of views does not fit {facts['views']} views")
    if not all(0 <= at < facts["views"] for at in facts["skipped"]) or not 0 <= facts["sh_degree"] <= 3:
        raise _unusable(path, "it knows of views or degrees of harmonics that do not exist")
    if min(facts[name] for name in ("index", "seconds", "cpu_seconds", "reset_at", "halvings")) < 0:
        raise _unusable(path, "a number in it is below 0")


def _check_frozen(path: Path, points: Points, frozen: dict[str, Tensor]) -> None:
    """Frozen points have the columns of the others, each as many rows; a state from before there were any has none."""
    kinds = {name: (value.shape[1:], value.dtype) for name, value in points.params.items()}
    there = {name: (value.shape[1:], value.dtype) for name, value in frozen.items()}
    if frozen and (there != kinds or len({len(value) for value in frozen.values()}) != 1):
        raise _unusable(path, "its frozen points do not fit the others")
