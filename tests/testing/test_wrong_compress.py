"""Compressors and encodings that break their contract are named, with what is wrong."""

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
import pytest
import torch

from surfkit.compress.base import Compressor
from surfkit.compress.encoding import Encoding, flat, stream
from surfkit.compress.lossless import Lossless
from surfkit.compress.packed import Packed
from surfkit.compress.scalars import Floats, float_bits
from surfkit.core import hooks, registry
from surfkit.primitives.columns import standard_columns
from surfkit.testing import check_compressor, check_encoding


@dataclass(frozen=True)
class Steps(Encoding):
    """Scales as multiples of a step."""

    size: float = 1e-3

    @property
    def columns(self):
        return ("scales",)

    def encode(self, values, kinds, leaf, tables):
        return {"scales": (np.rint(flat(values, "scales") / self.size) + 30_000).astype(np.uint32)}

    def decode(self, streams, kinds, leaf, count, tables):
        numbers = stream(streams, "scales", count, 3).astype(np.float64)
        return {"scales": kinds["scales"].rows((numbers - 30_000) * self.size)}


class Twice(Steps):
    @property
    def columns(self):
        return ("scales", "scales")


class Writes(Steps):
    def encode(self, values, kinds, leaf, tables):
        values["scales"].add_(0.5)
        return super().encode(values, kinds, leaf, tables)


class Draws(Steps):
    def encode(self, values, kinds, leaf, tables):
        streams = super().encode(values, kinds, leaf, tables)
        return {"scales": streams["scales"] + np.random.randint(0, 99, (len(values["scales"]), 1)).astype(np.uint32)}


class Signed(Steps):
    def encode(self, values, kinds, leaf, tables):
        return {"scales": flat(values, "scales").astype(np.int32)}


class Double(Steps):
    def decode(self, streams, kinds, leaf, count, tables):
        return {"scales": super().decode(streams, kinds, leaf, count, tables)["scales"].double()}


class Silent(Steps):
    def decode(self, streams, kinds, leaf, count, tables):
        super().decode(streams, kinds, leaf, count, tables)
        return {}


class Drifts(Steps):
    def decode(self, streams, kinds, leaf, count, tables):
        return {"scales": super().decode(streams, kinds, leaf, count, tables)["scales"] + self.size}


class Coarse(Steps):
    def __init__(self):
        object.__setattr__(self, "size", 1.0)


class Trusting(Steps):
    def decode(self, streams, kinds, leaf, count, tables):
        numbers = streams["scales"]
        numbers = getattr(numbers, "numbers", lambda: numbers)().astype(np.float64)
        return {"scales": kinds["scales"].rows((numbers - 30_000) * self.size)}


class Lax(Steps):
    def decode(self, streams, kinds, leaf, count, tables):
        numbers = stream(streams, "scales", streams["scales"].shape[0] if "scales" in streams else count, 3)
        return {"scales": kinds["scales"].rows((numbers[:count].astype(np.float64) - 30_000) * self.size)}


@pytest.mark.parametrize(
    ("encoding", "message"),
    [
        (Twice(), "Twice.columns must be names"),
        (Writes(), r"Writes.encode changed .*values\['scales'\]"),
        (Draws(), r"Draws.encode is not repeatable: \['scales'\]"),
        (Signed(), r"Signed.encode: stream scales .*unsigned"),
        (Double(), "Double.decode: 'scales' .*float64, .*float32"),
        (Silent(), "Silent.decode: the column 'scales' does not come back"),
        (Drifts(), "Drifts: .*stream scales"),
        (Coarse(), "Coarse: 'scales' came back .*away"),
        (Trusting(), "Trusting.decode .*scales .*KeyError .*BadInput"),
        (Lax(), "Lax.decode .*scales .*row too many"),
    ],
)
def test_encodings_that_are_wrong(encoding, message):
    check_encoding(Steps())
    with pytest.raises(AssertionError, match=message):
        check_encoding(encoding)


def test_streams_of_any_numbers_must_not_crash():
    @dataclass(frozen=True)
    class Table(Encoding):
        """Opacities of a short list."""

        @property
        def columns(self):
            return ("opacities",)

        def encode(self, values, kinds, leaf, tables):
            return {"opacities": np.zeros((len(values["opacities"]), 1), np.uint8)}

        def decode(self, streams, kinds, leaf, count, tables):
            return {"opacities": kinds["opacities"].rows(np.zeros(3)[stream(streams, "opacities", count, 1)])}

    with pytest.raises(AssertionError, match="Table.decode .*IndexError .*BadIn"):
        check_encoding(Table(), near=99)


@dataclass(frozen=True)
class Own(Compressor):
    """All as it is."""

    needs_importance = True

    def plan(self, model, importance, seed, device=None):
        return self.spoilt(Lossless().plan(model, None, seed), model, importance, seed)

    def spoilt(self, plan, model, importance, seed):
        return plan


@dataclass(frozen=True)
class Says(Own):
    needs_importance: ClassVar[str] = "no"


@dataclass(frozen=True)
class Changes(Own):
    def spoilt(self, plan, model, importance, seed):
        importance.mul_(0)
        return plan


@dataclass(frozen=True)
class Random(Own):
    def spoilt(self, plan, model, importance, seed):
        return replace(plan, tables={"x": np.random.rand(3)})


@dataclass(frozen=True)
class Encodings(Own):
    def spoilt(self, plan, model, importance, seed):
        return plan.encodings


@dataclass(frozen=True)
class Forgets(Own):
    def spoilt(self, plan, model, importance, seed):
        return replace(plan, encodings=plan.encodings[1:])


@dataclass(frozen=True)
class More(Own):
    def spoilt(self, plan, model, importance, seed):
        return replace(plan, encodings=(*plan.encodings, Floats("wings")))


@dataclass(frozen=True)
class Whole(Own):
    def spoilt(self, plan, model, importance, seed):
        return replace(plan, tables={"x": np.arange(3)})


@dataclass(frozen=True)
class Short(Own):
    def spoilt(self, plan, model, importance, seed):
        return replace(plan, marks={"x": torch.zeros(5)})


@dataclass(frozen=True)
class Halves(Floats):
    """Floats that shrink."""

    def encode(self, values, kinds, leaf, tables):
        return {self.column: float_bits(flat(values, self.column) * np.float32(0.5), self.kind, self.column)}


@dataclass(frozen=True)
class Shrinks(Own):
    def spoilt(self, plan, model, importance, seed):
        return replace(plan, encodings=tuple(Halves(e.column) if e.column == "sh0" else e for e in plan.encodings))


@dataclass(frozen=True)
class Away(Own):
    def spoilt(self, plan, model, importance, seed):
        return replace(plan, encodings=tuple(Halves(e.column) if e.column == "means" else e for e in plan.encodings))


@dataclass(frozen=True)
class Finer(Own):
    def coarser(self, factor):
        return Finer()


@dataclass(frozen=True)
class Other(Own):
    def coarser(self, factor):
        return Packed()


@dataclass(frozen=True)
class Crashes(Own):
    def coarser(self, factor):
        raise KeyError("factor")


class Package:
    @hooks.hookimpl
    def surfkit_components(self):
        return {cls.__name__.lower(): cls for cls in (Halves, Own, *Own.__subclasses__())}


@pytest.fixture
def installed():
    registry.plugins().register(Package(), "wrong")
    yield
    registry.plugins().unregister(name="wrong")


@pytest.mark.parametrize(
    ("compressor", "message"),
    [
        (Says(), "Says.needs_importance must be True or False"),
        (Changes(), "Changes, 1 .*degree 0: plan changed .*importance"),
        (Random(), r"plan is not repeatable: \[0\]\['x'\]"),
        (Encodings(), "plan returned tuple, not a Plan"),
        (Forgets(), "'means' is taken 0 times"),
        (More(), "takes the column 'wings'"),
        (Whole(), "table x must be an array of float16, float32"),
        (Short(), "mark x has 5 rows for 0 points"),
        (Shrinks(), "what comes back of a file gives another file"),
        (Away(), "means came back .* away from what they were"),
        (Finer(), r"Finer.coarser\(4.0\) gives a file of \d+ bytes in place of \d+"),
        (Other(), "Other.coarser returned Packed"),
        (Crashes(), "Crashes.coarser raises KeyError in place of BadInput"),
    ],
)
def test_compressors_that_are_wrong(installed, compressor, message):
    with pytest.raises(AssertionError, match=message):
        check_compressor(compressor)


def test_what_is_right_passes(installed):
    check_compressor(Own())
    check_encoding(Steps(), standard_columns(3, 0))
