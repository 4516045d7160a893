"""The checks of compressors and of encodings. They raise AssertionError with a sentence that says what is wrong."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch

from surfkit.compress.base import Compressor, Plan, kinds_of
from surfkit.compress.container import ModelFile, write_model
from surfkit.compress.encoding import ColumnType, Encoding, Tables
from surfkit.compress.index import TABLE_TYPES
from surfkit.compress.octree import Leaf, leaves
from surfkit.compress.streams import array, packed, unpacked
from surfkit.primitives.base import Primitive
from surfkit.primitives.columns import Column, standard_columns
from surfkit.primitives.gaussian3d import Gaussian3D
from surfkit.primitives.model import SplatModel
from surfkit.primitives.points import Columns
from surfkit.primitives.surfel2d import Surfel2D
from surfkit.testing.equality import assert_same, refuses, unchanged

CPU = torch.device("cpu")
LEAF_POINTS = 70
"""Points of a leaf in the files of the check, so that there are several."""


def splat_model(primitive: Primitive, count: int, seed: int = 0) -> SplatModel:
    """Random splats within a few units of 0, with the columns of a primitive that has the standard ones."""
    values = column_values(primitive.columns(), count, seed)
    return SplatModel(primitive, values, primitive.sh_degree)


def column_values(columns: Mapping[str, Column], count: int, seed: int = 0) -> Columns:
    """Random raw numbers, (count, ...) of each column, that stand for values which the column may have."""
    draw, found = torch.Generator().manual_seed(seed), {}
    for name, column in columns.items():
        assert None not in column.shape, f"column {name!r}: a size that only the points tell cannot be drawn"
        shape = column.of_point if column.shared else (count, *column.of_point)
        share = torch.rand(shape, generator=draw, dtype=torch.float64)
        if name == "means":
            values = 4 * share - 2
        elif name in ("scales", "opacities"):
            values = column.activation.inverse(0.02 + 0.9 * share)
        else:
            values = torch.randn(shape, generator=draw, dtype=torch.float64)
        found[name] = values.float()
    return found


def check_compressor(compressor: Compressor, count: int = 300) -> None:
    """A compressor leaves its inputs alone, takes every column of a model once, does the same for the same seed, and
    its files come back complete: written again, they are the same bytes. It takes models of any primitive with standard
    columns and of any degree, without points too; a coarser one gives no larger files.

    Args:
        compressor: To check.
        count: Points of the larger models.
    """
    name = type(compressor).__name__
    assert isinstance(compressor.needs_importance, bool), f"{name}.needs_importance must be True or False"
    with tempfile.TemporaryDirectory() as temporary:
        for primitive in (Surfel2D(sh_degree=0), Gaussian3D(sh_degree=2), Surfel2D()):
            for number in (0, 1, count):
                model = splat_model(primitive, number)
                what = f"{name}, {number} points of degree {primitive.sh_degree}"
                plan = _check_plan(what, compressor, model)
                _check_file(what, compressor, model, plan, Path(temporary))
        _check_coarser(name, compressor, model, Path(temporary))


def check_encoding(
    encoding: Encoding,
    columns: Mapping[str, Column] | None = None,
    tables: Tables | None = None,
    marks: Columns | None = None,
    near: float = 0.1,
    count: int = 200,
) -> None:
    """An encoding leaves its inputs alone, gives unsigned numbers, the same each time, and its columns come back near
    what they were: encoded again, they give the same numbers. Streams that are missing, of another shape or of any
    numbers give finite columns or BadInput.

    Args:
        encoding: To check.
        columns: What it takes; by default those of 3DGS of degree 1.
        tables: Of the whole file.
        marks: (count, ...) each, what it wants to know beside its columns.
        near: How far values may come back at most, in the mean, as a share of their spread.
        count: Points.
    """
    name, tables = type(encoding).__name__, tables or {}
    taken = encoding.columns
    assert isinstance(taken, tuple) and taken and len(set(taken)) == len(taken), f"{name}.columns must be names"
    columns = columns or standard_columns(3, 1)
    values = column_values(columns, count)
    rows = next(leaves(values["means"].numpy()))
    kinds = {key: ColumnType(column.of_point, torch.float32, column.activation) for key, column in columns.items()}
    leaf, order = Leaf(rows.exponent, rows.corner, rows.finest), torch.from_numpy(rows.rows)
    values = {key: value[order] for key, value in (values | (marks or {})).items()}
    for number in (count, 1, 0):
        some = {key: value[:number] for key, value in values.items()}
        with unchanged(f"{name}.encode", values=some, tables=tables):
            streams = encoding.encode(some, kinds, leaf, tables)
        assert_same(
            f"{name}.encode", dict(streams), dict(encoding.encode(some, kinds, leaf, tables)), "draw nothing in it"
        )
        _check_streams(name, streams)
        stored = unpacked(packed(streams), max(number, 1))
        found = encoding.decode(stored, kinds, leaf, number, tables)
        _check_columns(f"{name}.decode", found, {key: kinds[key] for key in taken}, number)
        assert_same(f"{name}.decode", found, encoding.decode(streams, kinds, leaf, number, tables), "draw nothing")
        again = encoding.encode(some | found, kinds, leaf, tables)
        for key, numbers in streams.items():
            same = np.array_equal(array(numbers), array(again[key]))
            assert same, f"{name}: what comes back gives other numbers in stream {key}"
    _check_near(name, encoding, kinds, leaf, values, tables, near)
    _check_damage(name, encoding, kinds, leaf, values, tables)


def _check_plan(what: str, compressor: Compressor, model: SplatModel) -> Plan:
    importance = None
    if compressor.needs_importance:
        importance = torch.rand(len(model), generator=torch.Generator().manual_seed(1))
    with unchanged(f"{what}: plan", model=model.params, importance=importance):
        plan = compressor.plan(model, importance, 3, CPU)
    again = compressor.plan(model, importance, 3, CPU)
    assert isinstance(plan, Plan), f"{what}: plan returned {type(plan).__name__}, not a Plan"
    assert_same(f"{what}: plan", [plan.tables, plan.marks], [again.tables, again.marks], "draw from its seed only")
    assert plan.encodings == again.encodings, f"{what}: plan is not repeatable; its encodings differ"
    taken = [name for encoding in plan.encodings for name in encoding.columns]
    for name in {*taken, *kinds_of(model)}:
        times = taken.count(name) if name in kinds_of(model) else -1
        assert times == 1, f"{what}: " + (
            f"it takes the column {name!r}, which the model does not have"
            if times < 0
            else f"the column {name!r} is taken {times} times; one encoding must take it"
        )
    for name, table in plan.tables.items():
        known = isinstance(table, np.ndarray) and str(table.dtype) in TABLE_TYPES
        assert known, f"{what}: table {name} must be an array of {', '.join(TABLE_TYPES)}"
    for name, mark in plan.marks.items():
        assert len(mark) == len(model), f"{what}: mark {name} has {len(mark)} rows for {len(model)} points"
    return plan


def _check_file(what: str, compressor: Compressor, model: SplatModel, plan: Plan, folder: Path) -> None:
    path, again = folder / "model.surfkit", folder / "again.surfkit"
    write_model(path, model, plan, compressor, most=LEAF_POINTS)
    read, carried = ModelFile(path).read()
    assert read.primitive == model.primitive, f"{what}: it came back as {read.primitive}"
    _check_columns(what, read.params, kinds_of(model), len(model))
    for name in ("means", "scales"):
        if len(model):
            before, after = model.params[name].double().sort(0).values, read.params[name].double().sort(0).values
            worst = float((before - after).abs().max())
            assert worst < 0.5, f"{what}: {name} came back {worst:.3g} away from what they were"
    write_model(again, read, carried, compressor, most=LEAF_POINTS)
    assert path.read_bytes() == again.read_bytes(), f"{what}: what comes back of a file gives another file"


def _check_coarser(name: str, compressor: Compressor, model: SplatModel, folder: Path) -> None:
    coarser: list[Any] = []
    if not refuses(f"{name}.coarser", lambda: coarser.append(compressor.coarser(4.0))):
        other = coarser[0]
        assert type(other) is type(compressor), f"{name}.coarser returned {type(other).__name__}"
        sizes = []
        for each in (compressor, other):
            importance = torch.linspace(0, 1, len(model)) if each.needs_importance else None
            sizes.append(write_model(folder / "coarser.surfkit", model, each.plan(model, importance, 0, CPU), each))
        assert sizes[1] < sizes[0], f"{name}.coarser(4.0) gives a file of {sizes[1]} bytes in place of {sizes[0]}"


def _check_streams(name: str, streams: Mapping[str, Any]) -> None:
    for key, numbers in streams.items():
        is_array = isinstance(numbers, np.ndarray) and numbers.ndim == 2 and numbers.dtype.kind == "u"
        assert is_array, f"{name}.encode: stream {key} must be (rows, components) of an unsigned type"


def _check_columns(what: str, found: Columns, kinds: Mapping[str, ColumnType], count: int) -> None:
    for name, kind in kinds.items():
        assert name in found, f"{what}: the column {name!r} does not come back"
        value = found[name]
        shape = (count, *kind.shape)
        assert tuple(value.shape) == shape, f"{what}: {name!r} came back as {tuple(value.shape)}, not {shape}"
        assert value.dtype == kind.dtype, f"{what}: {name!r} came back as {value.dtype}, not {kind.dtype}"
        assert value.isfinite().all(), f"{what}: {name!r} came back with NaN or Inf"


def _check_near(
    name: str,
    encoding: Encoding,
    kinds: Mapping[str, ColumnType],
    leaf: Leaf,
    values: Columns,
    tables: Tables,
    near: float,
) -> None:
    count = len(values["means"])
    found = encoding.decode(encoding.encode(values, kinds, leaf, tables), kinds, leaf, count, tables)
    for column in encoding.columns:
        if not values[column].numel():
            continue
        before, after = (kinds[column].activation.value(each[column].double()) for each in (values, found))
        if column == "quats":
            before, after = (torch.nn.functional.normalize(each, dim=1) for each in (before, after))
            after = torch.where((before * after).sum(1, keepdim=True) < 0, -after, after)
        away = float((before - after).abs().mean() / before.std())
        assert away <= near, f"{name}: {column!r} came back {away:.3g} of its spread away from what it was"


def _check_damage(
    name: str, encoding: Encoding, kinds: Mapping[str, ColumnType], leaf: Leaf, values: Columns, tables: Tables
) -> None:
    count, draw = len(values["means"]), np.random.default_rng(0)
    whole = {key: array(stream) for key, stream in encoding.encode(values, kinds, leaf, tables).items()}

    def decode(streams: Mapping[str, Any]) -> Callable[[], object]:
        return lambda: encoding.decode(unpacked(packed(streams), count + 9), kinds, leaf, count, tables)

    for key, numbers in whole.items():
        rest = {other: value for other, value in whole.items() if other != key}
        assert refuses(f"{name}.decode without the stream {key}", decode(rest)), f"{name} does without stream {key}"
        longer = rest | {key: np.concatenate([numbers, numbers[:1]])}
        refused = refuses(f"{name}.decode with another shape of the stream {key}", decode(longer))
        assert refused, f"{name}.decode takes a stream {key} with a row too many"
        for kind in ("u1", "u2", "u4", "u8"):
            drawn = draw.integers(0, np.iinfo(kind).max, numbers.shape, kind, endpoint=True)
            with np.errstate(all="ignore"):
                refuses(f"{name}.decode with other numbers in the stream {key}", decode(rest | {key: drawn}))
