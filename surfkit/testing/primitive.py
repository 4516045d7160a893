"""The check of a primitive."""

from __future__ import annotations

import torch
from torch import Tensor

from surfkit.core.check import BadInput, expect
from surfkit.primitives.base import Primitive
from surfkit.primitives.drawing import refuse_wrong_maps
from surfkit.primitives.points import Columns
from surfkit.raster.api import STANDARD, Maps, Splats
from surfkit.raster.select import select
from surfkit.scene.camera import Camera
from surfkit.testing.equality import unchanged
from surfkit.testing.inputs import cloud


def check_primitive(primitive: Primitive, count: int = 50) -> None:
    """A primitive declares the columns that it begins with, its splats have the right shapes, edits change them as
    asked, children are no larger than their parents, splats come back from the table of a file, and the same seed gives
    the same. A `render` of its own draws maps and has gradients, the absolute ones where it declares them.

    Args:
        primitive: To check.
        count: Points in the cloud that it starts from, 10 or more.
    """
    name = type(primitive).__name__
    given = cloud(count)
    with unchanged(f"{name}.init", cloud=given):
        params = primitive.init(given, torch.Generator().manual_seed(1))
    _check_same(f"{name}.init", params, primitive.init(given, torch.Generator().manual_seed(1)))
    _check_columns(f"{name}.init", primitive, params, count)
    for degree in range(primitive.sh_degree + 1):
        with unchanged(f"{name}.activate", params=params):
            splats = primitive.activate(params, degree)
        assert isinstance(splats, Splats), f"{name}.activate gives {type(splats).__name__}, not surfkit.plugin.Splats"
        _check_splats(f"{name}.activate", splats, degree)
    assert torch.allclose(primitive.activate(params, 0).means, given.xyz, atol=1e-5), f"{name}: points begin elsewhere"
    _check_dependent(name, primitive, params)
    if primitive.has_free_points:
        _check_moved(name, primitive, params)
        _check_split(name, primitive, params, count // 2)
    _check_edits(name, primitive, params)
    _check_table(name, primitive, params)
    if type(primitive).render is not Primitive.render:
        _check_render(f"{name}.render", primitive, primitive.activate(params, primitive.sh_degree).detached())


def _check_columns(name: str, primitive: Primitive, params: Columns, count: int) -> None:
    """What begins is what is declared, and every activation has its inverse."""
    columns = primitive.columns()
    owner = name.partition(".")[0]
    assert "means" in columns and not columns["means"].shared, f"{owner} needs a column 'means', (N, 3) positions"
    assert set(params) == set(columns), f"{name} gives {sorted(params)}, and columns() declares {sorted(columns)}"
    for key, column in columns.items():
        value, wanted = params[key], column.shape if column.shared else (count, *column.shape)
        assert column.fits(value.shape, count), f"{name}: {key!r} has shape {tuple(value.shape)}, not {wanted}"
        assert value.dtype == torch.float32, f"{name}: {key!r} is {value.dtype}, not float32"
        assert torch.isfinite(value).all(), f"{name}: {key!r} is not finite"
        raw = torch.linspace(-2, 2, 9, dtype=torch.float64)
        there = column.activation.value(raw)
        back = column.activation.inverse(there)
        assert torch.allclose(back, raw, atol=1e-6), f"{owner}: the inverse of {key!r}'s activation does not lead back"
        assert bool((there.diff() > 0).all()), f"{owner}: the activation of {key!r} does not increase"


def _check_splats(name: str, splats: Splats, degree: int) -> None:
    sizes = {"N": len(splats.means)}
    axes, rest = 2 if splats.kind == "surfel" else 3, (degree + 1) ** 2 - 1
    shapes: dict[str, tuple[str | int, ...]] = {"means": ("N", 3), "quats": ("N", 4), "scales": ("N", axes)}
    shapes |= {"opacities": ("N",), "sh0": ("N", 1, 3), "sh_rest": ("N", rest, 3)}
    for field, shape in shapes.items():
        try:
            expect(f"{name}: {field}", getattr(splats, field), shape, sizes)
        except BadInput as error:
            raise AssertionError(str(error)) from error
    assert (splats.scales > 0).all(), f"{name}: scales must be positive"
    assert ((splats.opacities >= 0) & (splats.opacities <= 1)).all(), f"{name}: opacities must lie in [0, 1]"
    finite = all(torch.isfinite(value).all() for value in (splats.means, splats.sh0, splats.sh_rest))
    assert finite, f"{name}: values are not finite"
    assert not set(splats.extra) & set(splats.shared), f"{name}: extra and shared tensors have names in common"


def _check_dependent(name: str, primitive: Primitive, params: Columns) -> None:
    """What other parameters determine belongs to points, is not trained, and is so from the beginning."""
    with unchanged(f"{name}.dependent", params=params):
        found = primitive.dependent(params)
    for key, value in found.items():
        column = primitive.columns().get(key)
        assert column is not None and not column.shared, f"{name}.dependent gives {key!r}, which is no column of points"
        assert column.rate.start == 0, f"{name}.dependent gives {key!r}, whose learning rate is not 0"
        close = value.shape == params[key].shape and torch.allclose(value, params[key], atol=1e-5)
        assert close, f"{name}.init gives {key!r} other values than dependent does"
    if not found.keys() & {"means"}:
        return
    drawn = primitive.activate(params, 0).means
    assert torch.allclose(found["means"], drawn, atol=1e-5), f"{name}.dependent gives other means than are drawn"


def _check_moved(name: str, primitive: Primitive, params: Columns) -> None:
    """Moved points are so when they are drawn."""
    before, shift = primitive.activate(params, 0), torch.full((len(params["means"]), 3), 0.25)
    moved = primitive.activate(primitive.moved(params, shift), 0)
    assert torch.allclose(moved.means, before.means + 0.25, atol=1e-5), f"{name}.moved does not move as asked"


def _check_edits(name: str, primitive: Primitive, params: Columns) -> None:
    """Scaled and dimmed points are so when they are drawn."""
    before, count = primitive.activate(params, 0), len(params["means"])
    factor = torch.linspace(0.5, 2, count)
    for given, wanted in ((0.5, torch.tensor(0.5)), (factor, factor[:, None])):
        scaled = primitive.activate(primitive.scaled(params, given), 0).scales
        assert torch.allclose(scaled, before.scales * wanted, rtol=1e-3), f"{name}.scaled does not scale as asked"
    asked = torch.linspace(0.01, 0.99, count)
    asked[::2] = torch.nan
    dimmed = primitive.activate(primitive.with_opacities(params, asked), 0).opacities
    expected = torch.where(asked.isnan(), before.opacities, asked)
    assert torch.allclose(dimmed, expected, atol=1e-4), f"{name}.with_opacities does not give the opacities asked for"


def _check_split(name: str, primitive: Primitive, params: Columns, count: int) -> None:
    shared = primitive.shared()
    rows = {key: value if key in shared else value[:count] for key, value in params.items()}
    with unchanged(f"{name}.split", params=rows):
        twins = primitive.split(rows, torch.Generator().manual_seed(2))
    _check_same(f"{name}.split", twins, primitive.split(rows, torch.Generator().manual_seed(2)))
    own = set(params) - shared
    assert set(twins) == own, f"{name}.split gives {sorted(twins)}, not {sorted(own)}"
    for key, value in twins.items():
        assert value.shape == (2 * count, *params[key].shape[1:]), f"{name}.split: {key!r} is not 2 M rows"
    common = {key: params[key] for key in shared}
    parents, children = primitive.activate(rows, 0).scales, primitive.activate(twins | common, 0).scales
    assert (children <= torch.cat([parents, parents]) + 1e-6).all(), f"{name}.split: a child is larger than its parent"


def _check_table(name: str, primitive: Primitive, params: Columns) -> None:
    """Splats that files have a place for are drawn the same when they are read again, if they can be read at all."""
    if not primitive.in_ply:
        return
    try:
        again = primitive.from_table(primitive.table(params), torch.Generator().manual_seed(1))
    except BadInput:
        return  # from_table says what the primitive lacks
    _check_columns(f"{name}.from_table", primitive, again, len(params["means"]))
    before, after = (primitive.activate(each, primitive.sh_degree) for each in (params, again))
    for field in STANDARD:
        close = torch.allclose(getattr(before, field), getattr(after, field), rtol=1e-3, atol=1e-5)
        assert close, f"{name}.from_table does not give back the {field} of its table"


def _check_render(name: str, primitive: Primitive, splats: Splats) -> None:
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, 3] = torch.tensor([-0.5, -0.5, 2])
    camera = Camera(pose, 30.0, 30.0, 16.0, 12.0, 32, 24)
    with unchanged(name, splats=splats.named()):
        render = primitive.render(splats, camera, select("cpu")[0], 0.01)
    try:
        refuse_wrong_maps(primitive, render.maps, camera)
    except BadInput as error:
        raise AssertionError(str(error)) from error
    for field, value in (("seen", render.seen), ("radii", render.radii)):
        assert value.shape == (len(splats),), f"{name}: {field} has shape {tuple(value.shape)}, not ({len(splats)},)"
    cotangent = Maps(color=torch.ones_like(render.maps.need("color")))
    for key, value in render.backward(cotangent, cotangent).named().items():
        shape = splats.named()[key].shape
        assert value.shape == shape, f"{name}: the gradient of {key!r} has shape {tuple(value.shape)}, not {shape}"
    try:
        render.backward(cotangent, cotangent, absolute=True)
    except BadInput as error:
        assert not primitive.has_absolute_gradients, f"{name}: set has_absolute_gradients to False: {error}"
    else:
        assert primitive.has_absolute_gradients, f"{name} gives absolute gradients, and has_absolute_gradients is False"


def _check_same(what: str, first: dict[str, Tensor], second: dict[str, Tensor]) -> None:
    assert first.keys() == second.keys(), f"{what} is not repeatable"
    for key, value in first.items():
        assert torch.equal(value, second[key]), f"{what}: {key!r} differs for the same seed; draw from the generator"
