"""Models as `.surfkit` files, written and read leaf by leaf; `index.py` has the layout."""

from __future__ import annotations

import mmap
import zlib
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from functools import cached_property
from pathlib import Path
from typing import BinaryIO, TypeVar

import numpy as np
import torch

from surfkit.compress.base import Compressor, Plan, kinds_of
from surfkit.compress.encoding import ColumnType, stream
from surfkit.compress.index import (
    HEADER_STRUCT,
    TABLE_TYPES,
    ChecksummedBlock,
    ColumnEntry,
    Index,
    LeafEntry,
    TableEntry,
    head_bytes,
    index_bytes,
    place_of,
    read_index,
    refuse_unencoded,
    table_shape,
)
from surfkit.compress.octree import MAX_LEAF_POINTS, Leaf, leaves
from surfkit.compress.streams import Stored, packed, unpacked
from surfkit.core.check import BadInput
from surfkit.core.codec import dump
from surfkit.core.files import replacing
from surfkit.core.version import own_version
from surfkit.primitives.model import SplatModel
from surfkit.primitives.points import Columns
from surfkit.scene.scene import Frame

T = TypeVar("T")
R = TypeVar("R")


def write_model(
    path: Path,
    model: SplatModel,
    plan: Plan,
    compressor: Compressor,
    frame: Frame | None = None,
    progress: Callable[[int, int], None] | None = None,
    most: int = MAX_LEAF_POINTS,
) -> int:
    """Write a model as its plan says; the bytes of the file, which appears only when it is complete.

    Memory beside the model: about 40 bytes a point, and a few leaves.

    Args:
        path: Of the file.
        model: On the CPU; its columns may be mapped from disk.
        plan: Of its compressor.
        compressor: Named in the file.
        frame: Of the data set that the model lies in.
        progress: Told how many points of how many are done.
        most: Points of a leaf.

    Raises:
        BadInput: A column that is NaN or Inf, or that an encoding has no place for.
    """
    kinds, points = kinds_of(model), model.primitive.per_point(model.params)
    refuse_unencoded(plan.encodings, kinds)
    shared = {f"shared.{name}": model.params[name].detach().numpy() for name in sorted(model.primitive.shared())}
    refuse_not_finite({name: torch.from_numpy(value) for name, value in shared.items()})
    with replacing(path) as file:
        file.write(b"\0" * HEADER_STRUCT.size)
        tables = {
            name: TableEntry(str(value.dtype), value.shape, _append(file, _table_bytes(name, value)))
            for name, value in (dict(plan.tables) | shared).items()
        }

        def coded(leaf: Leaf) -> tuple[Leaf, bytes]:
            rows = torch.from_numpy(leaf.rows)
            values = {name: value[rows] for name, value in (points | plan.marks).items()}
            refuse_not_finite(values)
            streams: dict[str, np.ndarray | Stored] = {}
            for encoding in plan.encodings:
                streams |= encoding.encode(values, kinds, leaf, plan.tables)
            return leaf, packed(streams)

        entries, done = [], 0
        for leaf, data in in_threads(coded, leaves(points["means"].numpy(), most)):
            block = _append(file, data)
            entries.append(LeafEntry(len(leaf.rows), leaf.exponent, leaf.corner, leaf.finest, block))
            done += len(leaf.rows)
            if progress is not None:
                progress(done, len(model))
        text = index_bytes(
            Index(
                writer=f"surfkit {own_version()}",
                points=len(model),
                primitive=model.primitive,
                sh_degree=model.sh_degree,
                near=model.near,
                frame=place_of(frame),
                compressor=dump(compressor),
                columns={
                    name: ColumnEntry(kind.shape, str(kind.dtype).removeprefix("torch."))
                    for name, kind in kinds.items()
                },
                encodings=plan.encodings,
                tables=tables,
                leaves=tuple(entries),
            )
        )
        start = file.tell()
        file.write(text)
        file.seek(0)
        file.write(head_bytes(start, text))
        return start + len(text)


class ModelFile:
    """A `.surfkit` file, open for reading: its index is read and checked at once, leaves when they are asked for.

    Raises:
        BadInput: Not such a file, damaged, or of a newer version.
    """

    def __init__(self, path: Path) -> None:
        self.path = Path(path)
        try:
            with self.path.open("rb") as file:
                self.data = memoryview(mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ))
        except (OSError, ValueError) as error:  # ValueError: an empty file
            reason = error.strerror if isinstance(error, OSError) else "the file is empty"
            raise BadInput(f"{path}: cannot be read: {reason}") from error
        with self._naming():
            self.index = read_index(self.data)
        self.kinds = {
            name: ColumnType(entry.shape, getattr(torch, entry.dtype), self.index.primitive.columns()[name].activation)
            for name, entry in self.index.columns.items()
        }

    def __len__(self) -> int:
        return self.index.points

    @cached_property
    def tables(self) -> dict[str, np.ndarray]:
        """What all leaves share, by name: arrays (rows, components)."""
        found = {}
        for name, entry in self.index.tables.items():
            with self._naming(f"table {name}"):
                rows, components = table_shape(entry.shape)
                numbers = stream(unpacked(self._block(entry.block), rows), "table", rows, components)
                if numbers.dtype != np.dtype(TABLE_TYPES[entry.dtype]):
                    raise BadInput(f"numbers of another type than {entry.dtype}")
                found[name] = np.frombuffer(numbers.tobytes(), entry.dtype).reshape(entry.shape)
                refuse_not_finite({name: torch.from_numpy(found[name].copy())} if name.startswith("shared.") else {})
        return found

    def leaf(self, at: int) -> Columns:
        """The points of a leaf by its position, with the marks of its encodings.

        Raises:
            BadInput: It is damaged.
        """
        entry = self.index.leaves[at]
        leaf = Leaf(entry.exponent, entry.corner, entry.finest)
        found: Columns = {}
        tables = self.tables
        with self._naming(f"leaf {at} of {len(self.index.leaves)}"):
            streams = unpacked(self._block(entry.block), entry.points)
            with np.errstate(all="ignore"):  # what overflows is refused below
                for encoding in self.index.encodings:
                    found |= encoding.decode(streams, self.kinds, leaf, entry.points, tables)
            refuse_not_finite(found)
        return found

    def box(self, at: int) -> tuple[np.ndarray, np.ndarray]:
        """Opposite corners of a leaf, (3,) float64, local frame."""
        entry = self.index.leaves[at]
        leaf = Leaf(entry.exponent, entry.corner, entry.finest)
        return leaf.low, leaf.high

    def read(self) -> tuple[SplatModel, Plan]:
        """The whole model, and the plan with which it comes to the same file again."""
        rows = {name: (self.index.points, *entry.shape) for name, entry in self.index.columns.items()}
        columns = {name: torch.empty(shape, dtype=self.kinds[name].dtype) for name, shape in rows.items()}
        marks: Columns = {}
        ends = np.cumsum([0, *(entry.points for entry in self.index.leaves)]).tolist()

        def placed(at: int) -> None:
            for name, value in self.leaf(at).items():
                if name not in columns:
                    marks.setdefault(name, torch.empty(self.index.points, *value.shape[1:], dtype=value.dtype))
                (columns if name in columns else marks)[name][ends[at] : ends[at + 1]] = value

        for _ in in_threads(placed, iter(range(len(self.index.leaves)))):
            pass
        shared = {name: value for name, value in self.tables.items() if name.startswith("shared.")}
        params = columns | {
            name.removeprefix("shared."): torch.from_numpy(value.copy()) for name, value in shared.items()
        }
        own = {name: value for name, value in self.tables.items() if name not in shared}
        index = self.index
        model = SplatModel(index.primitive, params, index.sh_degree, index.near)
        return model, Plan(index.encodings, own, marks)

    @property
    def frame(self) -> Frame | None:
        """The frame of the data set that the model lies in."""
        place = self.index.frame
        if place is None:
            return None
        return Frame(np.array(place.origin), place.scale, place.metres, place.crs, place.shift)

    def _block(self, block: ChecksummedBlock) -> memoryview:
        data = self.data[block.offset : block.offset + block.length]
        if zlib.crc32(data) != block.crc:
            raise BadInput("damaged (checksum)")
        return data

    @contextmanager
    def _naming(self, part: str = "") -> Iterator[None]:
        """Within, BadInput and what else damaged bytes lead to is told with the name of the file and its part."""
        try:
            yield
        except (ValueError, OverflowError, LookupError) as error:
            where = f"{self.path}: {part}: " if part else f"{self.path}: "
            raise BadInput(f"{where}{' '.join(str(error).split())}; copy or write the file again") from error


def in_threads(work: Callable[[T], R], items: Iterable[T]) -> Iterator[R]:
    """The results of `work` for items in their order, on as many threads as torch has, with few at a time in memory."""
    threads = torch.get_num_threads()
    waiting: deque[Future[R]] = deque()
    try:
        with ThreadPoolExecutor(threads, initializer=torch.set_num_threads, initargs=(1,)) as pool:
            try:
                for item in items:
                    waiting.append(pool.submit(work, item))
                    if len(waiting) > threads:
                        yield waiting.popleft().result()
                while waiting:
                    yield waiting.popleft().result()
            finally:
                for each in waiting:
                    each.cancel()
    finally:
        torch.set_num_threads(threads)  # that of a thread is what threads to come begin with


def refuse_not_finite(values: Columns) -> None:
    """BadInput if a column has NaN or Inf."""
    for name, value in values.items():
        if value.is_floating_point() and not value.sum().isfinite() and not value.isfinite().all():
            raise BadInput(f"{name}: NaN or Inf in {int((~value.isfinite()).sum())} places; such a model is of no use")


def _append(file: BinaryIO, data: bytes) -> ChecksummedBlock:
    offset = file.tell()
    file.write(data)
    return ChecksummedBlock(offset, len(data), zlib.crc32(data))


def _table_bytes(name: str, value: np.ndarray) -> bytes:
    if str(value.dtype) not in TABLE_TYPES:
        raise BadInput(f"table {name}: {value.dtype}; types are {', '.join(TABLE_TYPES)}")
    rows = np.frombuffer(value.tobytes(), TABLE_TYPES[str(value.dtype)])
    return packed({"table": rows.reshape(table_shape(value.shape))})


def read_model(path: Path) -> tuple[SplatModel, Frame | None]:
    """The model in a `.surfkit` file, in its local frame, and that frame.

    Raises:
        BadInput: Not such a file, or damaged.
    """
    file = ModelFile(path)
    return file.read()[0], file.frame
