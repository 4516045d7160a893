"""Models of all kinds as files: complete, the same bytes again, leaf by leaf, on any number of threads; or refused."""

from dataclasses import dataclass, replace

import numpy as np
import pytest
import torch
from needs import needs

from surfkit import Activation, Column, LearningRate, Primitive, hookimpl, standard_columns
from surfkit.compress.base import Plan
from surfkit.compress.container import ModelFile, read_model, write_model
from surfkit.compress.lossless import Float16, Lossless
from surfkit.compress.packed import Packed
from surfkit.compress.vectree import Vectree
from surfkit.core import registry
from surfkit.core.check import BadInput
from surfkit.primitives.flat3d import Flat3D
from surfkit.primitives.gaussian3d import Gaussian3D
from surfkit.primitives.init import seeds
from surfkit.primitives.model import SplatModel
from surfkit.primitives.surfel2d import Surfel2D
from surfkit.scene.scene import Frame
from surfkit.testing.compressor_checks import column_values, splat_model

hypothesis = needs("hypothesis")
st = hypothesis.strategies
LEAF = 40
DENSITY = Activation(lambda raw: 1 - torch.exp(-torch.exp(raw)), lambda value: torch.log(-torch.log1p(-value)))
SOFTPLUS = Activation(lambda raw: torch.log1p(raw.exp()), lambda value: torch.log(torch.expm1(value)))


@dataclass(frozen=True)
class Other(Primitive):
    """Other activations, no rotations, a column of its own and shared ones of any shape."""

    def columns(self):
        known = standard_columns(1, self.sh_degree)
        del known["quats"]
        rate = LearningRate(1e-2)
        return known | {
            "scales": Column((1,), rate, SOFTPLUS),
            "opacities": Column((), rate, DENSITY),
            "größe": Column((2, 3), rate),
            "net": Column((3, 5_000), rate, shared=True),
            "one": Column((), rate, shared=True),
            "none": Column((0, 4), rate, shared=True),
        }

    def init(self, cloud, generator):
        return seeds(self.columns(), cloud) | column_values({"größe": self.columns()["größe"]}, len(cloud.xyz))

    def activate(self, params, degree):
        raise NotImplementedError


@dataclass(frozen=True)
class Bare(Primitive):
    """Positions and nothing else."""

    def columns(self):
        return {"means": Column((3,), LearningRate(1e-2))}

    def init(self, cloud, generator):
        return {"means": cloud.xyz.clone()}

    def activate(self, params, degree):
        raise NotImplementedError


class Package:
    @hookimpl
    def surfkit_components(self):
        return {"other": Other, "bare": Bare}


@pytest.fixture(scope="module", autouse=True)
def installed():
    registry.plugins().register(Package(), "stranger")
    yield
    registry.plugins().unregister(name="stranger")


def write(path, model, compressor, plan=None, frame=None) -> bytes:
    importance = torch.rand(len(model), generator=torch.Generator().manual_seed(0))
    plan = plan or compressor.plan(model, importance, 0)
    write_model(path, model, plan, compressor, frame, most=LEAF)
    return path.read_bytes()


def assert_complete(path, model, compressor):
    """It comes back with all that it had, and gives the same file again with the plan that the file carries."""
    whole = write(path, model, compressor)
    back, plan = ModelFile(path).read()
    assert (back.primitive, back.sh_degree, back.near) == (model.primitive, model.sh_degree, model.near)
    assert list(back.params) == [*model.primitive.per_point(model.params), *sorted(model.primitive.shared())]
    for name, value in model.params.items():
        assert back.params[name].shape == value.shape and back.params[name].dtype == value.dtype, name
        assert back.params[name].isfinite().all()
    for name in model.primitive.shared():
        assert torch.equal(back.params[name], model.params[name])
    assert write(path, back, compressor, plan) == whole
    if isinstance(compressor, (Lossless, Float16)):
        assert write(path, back, compressor) == whole, "a fresh plan gives the same"


COMPRESSORS = [Lossless(), Float16(), Packed(), Vectree(codes=16), Vectree(codes=300, codebooks="by-degree")]
PRIMITIVES = (Surfel2D, Gaussian3D, Flat3D, Other, Bare)


@pytest.mark.parametrize("compressor", COMPRESSORS, ids=["lossless", "float16", "packed", "vectree", "by-degree"])
@pytest.mark.parametrize("primitive", PRIMITIVES)
@pytest.mark.parametrize("count", [0, 1, 150])
def test_models_of_every_kind(tmp_path, compressor, primitive, count):
    degree = {Surfel2D: 3, Gaussian3D: 1, Flat3D: 2}.get(primitive, 0)
    model = splat_model(primitive(sh_degree=degree), count)
    if primitive is Bare and isinstance(compressor, Vectree):
        with pytest.raises(BadInput, match="vectree needs .*sh0 .*sh_rest.*compress:pack"):
            write(tmp_path / "m.surfkit", model, compressor)
        return
    assert_complete(tmp_path / "m.surfkit", model, compressor)


@st.composite
def models(draw):
    """A model of any primitive, with values of any size, many of them equal."""
    primitive = draw(st.sampled_from(PRIMITIVES))(sh_degree=draw(st.integers(0, 3)))
    count, seed = draw(st.sampled_from([0, 1, 2, 3, 60])), draw(st.integers(0, 99))
    size, offset = draw(st.sampled_from([1e-30, 1e-4, 1.0, 50.0, 1e18])), draw(st.sampled_from([0.0, -1.0, 4096.0]))
    generator, params = torch.Generator().manual_seed(seed), {}
    for name, column in primitive.columns().items():
        shape = column.shape if column.shared else (count, *column.shape)
        kind = draw(st.sampled_from(["normal", "equal", "few"]))
        values = torch.randn(shape, generator=generator)
        if kind == "equal":
            values = torch.full(shape, draw(st.sampled_from([0.0, -1.0, 1e-20, 3.5])))
        elif kind == "few":
            values = values.sign() * draw(st.sampled_from([0.5, 1.0, 2.0**10]))
        params[name] = values * size + offset if name == "means" else values
    dtype = draw(st.sampled_from([torch.float32, torch.float64]))
    return SplatModel(primitive, params | {"means": params["means"].to(dtype)}, primitive.sh_degree)


@hypothesis.settings(max_examples=60, deadline=None, derandomize=True, database=None)
@hypothesis.given(model=models(), compressor=st.sampled_from(COMPRESSORS))
def test_models_of_any_values(tmp_path_factory, model, compressor):
    path = tmp_path_factory.getbasetemp() / "any.surfkit"
    try:
        assert_complete(path, model, compressor)
    except BadInput as error:
        told = ("in 0 to 1", "2^22 steps", "no logarithm", "beyond what float16", "NaN or Inf", "needs the columns")
        assert any(words in str(error) for words in told) and "\n" not in str(error), str(error)


@pytest.mark.parametrize("compressor", COMPRESSORS[:4], ids=["lossless", "float16", "packed", "vectree"])
@pytest.mark.parametrize("column", ["means", "scales", "quats", "opacities", "sh0", "sh_rest"])
@pytest.mark.parametrize("value", [float("nan"), float("inf"), -float("inf")])
def test_nan_is_refused_and_the_old_file_stays(tmp_path, compressor, column, value):
    path = tmp_path / "m.surfkit"
    path.write_bytes(b"old")
    model = splat_model(Surfel2D(sh_degree=1), 100)
    model.params[column][70] = value
    with pytest.raises(BadInput) as error:
        write(path, model, compressor)
    assert "NaN" in str(error.value) and "\n" not in str(error.value)
    assert path.read_bytes() == b"old" and [p.name for p in tmp_path.iterdir()] == ["m.surfkit"]


def test_shared_nan_is_refused(tmp_path):
    model = splat_model(Other(sh_degree=0), 10)
    model.params["net"][1, 2] = float("nan")
    with pytest.raises(BadInput, match="shared.net: NaN or Inf in 1 places"):
        write(tmp_path / "m.surfkit", model, Lossless())


@pytest.mark.parametrize("compressor", COMPRESSORS[:4], ids=["lossless", "float16", "packed", "vectree"])
def test_the_number_of_threads_changes_nothing(tmp_path, compressor):
    model, before, found = splat_model(Surfel2D(), 500), torch.get_num_threads(), []
    try:
        for threads in (1, 2, 3):
            torch.set_num_threads(threads)
            whole = write(tmp_path / "m.surfkit", model, compressor)
            back, plan = ModelFile(tmp_path / "m.surfkit").read()
            assert torch.get_num_threads() == threads
            found.append((whole, {name: value.numpy().tobytes() for name, value in back.params.items()}))
    finally:
        torch.set_num_threads(before)
    assert found[0] == found[1] == found[2]


def test_leaves_are_read_one_by_one(tmp_path):
    """With all other leaves damaged, and those alone are told."""
    path, model = tmp_path / "m.surfkit", splat_model(Surfel2D(), 400)
    whole = write(path, model, Packed())
    file = ModelFile(path)
    entries, expected = file.index.leaves, [file.leaf(at) for at in range(len(file.index.leaves))]
    assert len(entries) > 8
    for at in range(len(entries)):
        spoilt = bytearray(whole)
        for other, entry in enumerate(entries):
            if other != at:
                spoilt[entry.block.offset + entry.block.length // 2] ^= 1
        path.write_bytes(spoilt)
        file = ModelFile(path)
        found = file.leaf(at)
        assert all(torch.equal(found[name], value) for name, value in expected[at].items())
        low, high = (torch.from_numpy(corner) for corner in file.box(at))
        assert ((low <= found["means"]) & (found["means"] <= high)).all()
        other = (at + 1) % len(entries)
        with pytest.raises(BadInput, match=rf"m.surfkit: leaf {other} of {len(entries)}: .*checksum"):
            file.leaf(other)
        with pytest.raises(BadInput, match="leaf"):
            file.read()


def test_frames_come_back(tmp_path):
    frame = Frame(np.array([492_000.123456789, 5_260_000.0, 1 / 3]), 0.01, 1.0, "EPSG:32632", (492_000.0, 5.26e6, 0.0))
    path, model = tmp_path / "m.surfkit", splat_model(Surfel2D(sh_degree=0), 30)
    write(path, model, Packed(), frame=frame)
    back = read_model(path)[1]
    assert np.array_equal(back.origin, frame.origin)
    assert (back.scale, back.metres, back.crs, back.shift) == (frame.scale, frame.metres, frame.crs, frame.shift)
    write(path, model, Packed())
    assert read_model(path)[1] is None


def test_columns_that_no_encoding_takes(tmp_path):
    model = splat_model(Surfel2D(sh_degree=0), 30)
    plan = Lossless().plan(model, None, 0)
    with pytest.raises(BadInput, match="means must .*one encoding.*scales"):
        write(tmp_path / "m.surfkit", model, Lossless(), Plan(plan.encodings[1:]))


def test_progress_and_bytes(tmp_path):
    model, told = splat_model(Surfel2D(sh_degree=0), 100), []
    path = tmp_path / "m.surfkit"
    plan = Packed().plan(model, None, 0)
    size = write_model(path, model, plan, Packed(), progress=lambda *a: told.append(a), most=LEAF)
    assert size == path.stat().st_size and told[-1] == (100, 100) and len(told) == len(ModelFile(path).index.leaves)


def test_coarser_files_are_smaller(tmp_path):
    model = splat_model(Surfel2D(), 400)
    sizes = [len(write(tmp_path / "m.surfkit", model, Packed().coarser(factor))) for factor in (0.25, 1, 4)]
    assert sizes == sorted(sizes, reverse=True) and sizes[0] > 1.2 * sizes[2]
    with pytest.raises(BadInput, match="compress:lossless has no .*compress:pack"):
        Lossless().coarser(2)
    assert Packed().coarser(1.0) == Packed() == replace(Packed())
