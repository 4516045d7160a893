"""What comes back of a file lies within the stated bounds, for every point."""

import numpy as np
import pytest
import torch

from surfkit.compress.container import ModelFile, write_model
from surfkit.compress.lossless import Float16, Lossless
from surfkit.compress.octree import MAX_TREE_LEVELS, Leaf, interleaved, leaves, separated
from surfkit.compress.packed import Packed
from surfkit.compress.scalars import LogSteps, MortonPositions, SmallestThree, UniformLevels
from surfkit.core.check import BadInput
from surfkit.primitives.columns import IDENTITY
from surfkit.primitives.gaussian3d import Gaussian3D
from surfkit.primitives.model import SplatModel
from surfkit.testing.compressor_checks import splat_model

UTM = (492_000.0, 5_260_000.0, 430.0)
DRAW = np.random.default_rng(0)


def normal(count: int = 400) -> np.ndarray:
    return DRAW.standard_normal((count, 3))


PLACES = {
    "normal": normal(),
    "one place": np.tile(normal(1), (300, 1)),
    "one place, negative powers of two": np.full((50, 3), -4.0),
    "origin": np.zeros((40, 3)),
    "cell borders": np.stack(np.meshgrid(*[np.arange(-4, 4) / 4.0] * 3), -1).reshape(-1, 3),
    "a line": np.linspace(-1, 1, 300)[:, None] * [1.0, 0, 0],
    "a diagonal": np.linspace(-1, 1, 300)[:, None] * [1.0, 1, 1],
    "far outliers": np.concatenate([normal(), 1e6 * normal(3)]),
    "two points": np.array([[0.0, 0, 0], [1e-3, 5, -7]]),
    "tiny": 1e-20 * normal(),
    "huge": 1e20 * normal(),
    "far away": 1e-3 * normal() + 1000,
    "farther than floats tell apart": 1e-4 * normal() + 4096,
}
CASES = [(name, places.astype(np.float32)) for name, places in PLACES.items()]
CASES += [("survey coordinates", 100 * normal() + UTM), ("survey, clustered", 1e-6 * normal() + UTM)]
CASES += [("survey, one place", np.tile([UTM], (9, 1)))]
each_place = pytest.mark.parametrize(("name", "places"), CASES, ids=[name for name, _ in CASES])


def written(tmp_path, places, encoding=None, most=60):
    """A file of points at some places, with their row in a column, and the order in which they come back."""
    model = splat_model(Gaussian3D(sh_degree=0), len(places))
    rows = torch.arange(len(places), dtype=torch.float32)
    model = SplatModel(model.primitive, model.params | {"means": torch.from_numpy(places), "opacities": rows})
    plan = Lossless().plan(model, None, 0)
    found = tuple(encoding if encoding and e.columns == ("means",) else e for e in plan.encodings)
    path = tmp_path / "m.surfkit"
    write_model(path, model, type(plan)(found), Lossless(), most=most)
    return ModelFile(path)


@each_place
@pytest.mark.parametrize("exponent", [None, -30, -6, 40])
def test_positions(tmp_path, name, places, exponent):
    encoding = MortonPositions("means", exponent)
    file = written(tmp_path, places, encoding)
    assert len(file.index.leaves) > 1 or len(places) <= 60
    seen = []
    for at, entry in enumerate(file.index.leaves):
        found, leaf = file.leaf(at), Leaf(entry.exponent, entry.corner, entry.finest)
        rows = found["opacities"].long().numpy()
        seen += rows.tolist()
        back = found["means"].double().numpy()
        ulp = np.spacing(np.abs(found["means"].numpy())).astype(np.float64)
        assert (np.abs(back - places[rows]) <= encoding.bound(leaf) + ulp / 2).all(), (name, at)
        low, high = file.box(at)
        assert ((low <= places[rows]) & (places[rows] < high)).all(), "the box of a leaf holds its points"
        assert ((low <= back) & (back <= high)).all()
        wanted = leaf.exponent - 16 if exponent is None else exponent
        if leaf.exponent - MAX_TREE_LEVELS < wanted < leaf.exponent - 1 and wanted >= leaf.finest:
            assert encoding.bound(leaf) == 2.0**wanted / 2, "cells are as small as they are said to be"
    assert sorted(seen) == list(range(len(places)))


@each_place
def test_a_file_written_again_is_the_same(tmp_path, name, places):
    for exponent in (None, -30, -6, 40):
        file = written(tmp_path, places, MortonPositions("means", exponent))
        before = file.path.read_bytes()
        model, plan = file.read()
        write_model(tmp_path / "again.surfkit", model, plan, Lossless(), most=60)
        assert (tmp_path / "again.surfkit").read_bytes() == before, (name, exponent)


@pytest.mark.parametrize("places", [np.full((3, 3), np.nan), np.full((3, 3), np.inf), np.full((3, 3), 1e300)])
def test_places_that_are_none_are_refused(places):
    with pytest.raises(BadInput, match=r"positions .*beyond 2\^200"):
        list(leaves(places))


def test_morton_codes():
    """Bit by bit, against a loop."""
    numbers = DRAW.integers(0, 1 << MAX_TREE_LEVELS, (50, 3))
    codes = interleaved(numbers)
    for (x, y, z), code in zip(numbers.tolist(), codes.tolist(), strict=True):
        assert code == sum(
            ((n >> bit) & 1) << (3 * bit + axis) for bit in range(21) for axis, n in enumerate((x, y, z))
        )
    assert (separated(codes) == numbers).all()


def returned(tmp_path, model, compressor):
    """A model and what comes back of it, both in the order of the file, and the file."""
    path = tmp_path / "m.surfkit"
    write_model(path, model, compressor.plan(model, None, 0), compressor, most=100)
    rows = np.concatenate([leaf.rows for leaf in leaves(model.params["means"].numpy(), 100)])
    return {name: value[torch.from_numpy(rows)] for name, value in model.params.items()}, ModelFile(path).read()


@pytest.mark.parametrize("factor", [0.01, 1.0, 10.0])
def test_radii_rotations_opacities_and_colors(tmp_path, factor):
    model = splat_model(Gaussian3D(), 1_000)
    extremes = torch.tensor([-40.0, -10, 0, 10, 40])
    model.params["opacities"][:5] = extremes
    model.params["scales"][:5] = extremes[:, None]
    before, (after, plan) = returned(tmp_path, model, Packed().coarser(factor))
    by_column = {encoding.columns[0]: encoding for encoding in plan.encodings}
    steps = by_column["scales"]
    assert isinstance(steps, LogSteps)
    assert (before["scales"] - after.params["scales"]).abs().max() <= steps.step / 2 + 1e-5
    levels = by_column["opacities"]
    assert isinstance(levels, UniformLevels)
    away = (before["opacities"].double().sigmoid() - after.params["opacities"].double().sigmoid()).abs()
    assert away.max() <= 0.5 / levels.levels + 1e-7
    assert 0.2 * steps.step < (before["scales"] - after.params["scales"]).abs().mean() < 0.3 * steps.step
    colors = by_column["sh0"]
    columns = [torch.cat([p["sh0"], p["sh_rest"]], 1).flatten(1).double() for p in (before, after.params)]
    assert (columns[0] - columns[1]).norm(dim=1).max() <= 48**0.5 * colors.step / 2 + 1e-4
    away = turned(before["quats"], after.params["quats"])
    assert away.max() <= by_column["quats"].step * (1 + 1e-6) + 1e-6


def turned(before: torch.Tensor, after: torch.Tensor) -> torch.Tensor:
    """How far the three smallest components of quaternions are from what they were."""
    unit = torch.nn.functional.normalize(before.double(), dim=1)
    largest = after.abs().argmax(1, keepdim=True)
    unit = unit * unit.gather(1, largest).sign()
    return (unit - after).abs().scatter(1, largest, 0.0).max(1).values


@pytest.mark.parametrize("step", [1e-6, 1e-4, 0.007, 0.1, 0.19, 0.2, 0.25, 0.7071 / 7, 0.5 / 3])
def test_rotations(step):
    """Of components that are equal too, where the largest must stay the largest."""
    draw = torch.Generator().manual_seed(0)
    quats = torch.randn(4_000, 4, generator=draw)
    quats[:1000] = quats[:1000].sign() + 1e-3 * quats[1000:2000]
    quats[1000:1500] = quats[1000:1500].sign()
    quats[1500:2000, 2:] = 0
    quats[1700:2000, :2] = 1 + 1e-7 * quats[1700:2000, :2]
    quats[2000] = torch.tensor([1e-20, 0, 0, 0])
    quats[2001] = torch.tensor([3e38, 3e38, 0, -1])
    encoding, kinds, leaf = SmallestThree("quats", step), {"quats": kind((4,))}, Leaf(0, (0, 0, 0), -20)
    streams = encoding.encode({"quats": quats}, kinds, leaf, {})
    back = encoding.decode(streams, kinds, leaf, len(quats), {})
    assert turned(quats, back["quats"]).max() <= step * (1 + 1e-6) + 1e-6
    assert (back["quats"].norm(dim=1) - 1).abs().max() < 1e-6
    again = encoding.encode(back, kinds, leaf, {})
    assert all(np.array_equal(streams[name], again[name]) for name in streams)


def kind(shape, activation=IDENTITY):
    from surfkit.compress.encoding import ColumnType

    return ColumnType(shape, torch.float32, activation)


@pytest.mark.parametrize("levels", [2, 3, 255, 256, 257, 65_536])
def test_levels_cover_0_to_1(levels):
    values = {"opacities": torch.cat([torch.tensor([0.0, 1.0, 0.5]), torch.rand(500)])}
    encoding, kinds, leaf = UniformLevels("opacities", levels), {"opacities": kind(())}, Leaf(0, (0, 0, 0), -20)
    streams = encoding.encode(values, kinds, leaf, {})
    back = encoding.decode(streams, kinds, leaf, 503, {})
    assert (back["opacities"] - values["opacities"]).abs().max() <= 0.5 / levels + 1e-7
    assert np.array_equal(encoding.encode(back, kinds, leaf, {})["opacities"], streams["opacities"])


def test_float16_and_lossless(tmp_path):
    model = splat_model(Gaussian3D(), 500)
    before, (after, _) = returned(tmp_path, model, Lossless())
    assert all(torch.equal(value, after.params[name]) for name, value in before.items())
    before, (after, _) = returned(tmp_path, model, Float16())
    assert torch.equal(before["means"], after.params["means"])
    for name in ("scales", "quats", "opacities", "sh0", "sh_rest"):
        assert torch.equal(before[name].half().float(), after.params[name]), name
    model.params["sh0"][7] = 1e6
    with pytest.raises(BadInput, match="sh0: .*float16.*compress:lossless"):
        returned(tmp_path, model, Float16())


def test_steps_that_floats_do_not_tell_apart_are_refused(tmp_path):
    model = splat_model(Gaussian3D(sh_degree=0), 20)
    with pytest.raises(BadInput, match=r"scales: .*2\^22 steps.*compress:float"):
        returned(tmp_path, model, Packed(scale=1e-8))
