"""Primitives, policies, filters and signals that break their contract are named, with what is wrong."""

from dataclasses import dataclass, replace

import pytest
import torch

from surfkit.densify.base import Densify, Filter, Prune, Signal
from surfkit.primitives.edit import Edit
from surfkit.primitives.surfel2d import Surfel2D
from surfkit.testing import check_densify, check_filter, check_policy, check_primitive, check_prune, check_signal


@dataclass(frozen=True)
class Sound(Prune):
    """Drops every other point."""

    def watch(self, points, step):
        points.stat("sound/n").add_(1)

    def edit(self, points, step):
        return Edit(drop=torch.arange(len(points)) % 2 == 0)


@dataclass(frozen=True)
class Mutates(Prune):
    def edit(self, points, step):
        points.params["means"].add_(1)


@dataclass(frozen=True)
class Ints(Prune):
    def edit(self, points, step):
        return Edit(drop=torch.zeros(len(points)))


@dataclass(frozen=True)
class Short(Prune):
    def edit(self, points, step):
        return Edit(split=torch.zeros(3, dtype=torch.bool))


@dataclass(frozen=True)
class Random(Prune):
    def edit(self, points, step):
        return Edit(clone=torch.rand(len(points)) > 0.5)


@dataclass(frozen=True)
class Counts(Prune):
    def watch(self, points, step):
        points.stat("n")

    def edit(self, points, step):
        points.stat("n").add_(1)


@dataclass(frozen=True)
class Opaque(Prune):
    def edit(self, points, step):
        return Edit(max_opacity=1.5)


def test_a_sound_policy_passes(crowd):
    check_policy(Sound(), *crowd)


@pytest.mark.parametrize(
    ("policy", "message"),
    [
        (Mutates(), "Mutates changed the parameter 'means'"),
        (Ints(), "Ints: drop is torch.float32, not bool"),
        (Short(), r"Short: split has shape \(3,\), not \(200,\)"),
        (Random(), "Random: clone is not repeatable"),
        (Counts(), "Counts.edit changed 'n'; only watch may"),
        (Opaque(), "Opaque: max_opacity must lie between 0 and 1"),
    ],
)
def test_unsound_policies_are_named(crowd, policy, message):
    with pytest.raises(AssertionError, match=message):
        check_policy(policy, *crowd)


class Grows(Surfel2D):
    def split(self, params, generator):
        twins = Surfel2D.split(self, params, generator)
        return twins | {"scales": twins["scales"] + 1}


class OneChild(Surfel2D):
    def split(self, params, generator):
        return params


class Unseeded(Surfel2D):
    def init(self, cloud, generator):
        return Surfel2D.init(self, cloud, torch.Generator().manual_seed(torch.seed() % 2**31))


class Thick(Surfel2D):
    def activate(self, params, degree):
        splats = Surfel2D.activate(self, params, degree)
        return replace(splats, scales=torch.ones(len(splats), 3))


class Swells(Surfel2D):
    def from_table(self, table, generator):
        params = Surfel2D.from_table(self, table, generator)
        return params | {"scales": params["scales"] + 1}


class Forgets(Surfel2D):
    def from_table(self, table, generator):
        return {"means": table.means}


@pytest.mark.parametrize(
    ("primitive", "message"),
    [
        (Grows(), "Grows.split: a child is larger than its parent"),
        (OneChild(), "OneChild.split: 'means' is not 2 M rows"),
        (Unseeded(), "Unseeded.init: 'quats' differs for the same seed"),
        (Swells(), "Swells.from_table .*scales"),
        (Forgets(), r"Forgets.from_table .*\['means'\], .*columns\(\)"),
        (Thick(), r"Thick.activate: scales: expected shape \(N, 2\)"),
    ],
)
def test_primitives_that_do_not_conform(primitive, message):
    check_primitive(Surfel2D(), count=10)
    with pytest.raises(AssertionError, match=message):
        check_primitive(primitive, count=10)


@dataclass(frozen=True)
class Remembers(Prune):
    """Counts its steps in itself, which a resumed run would not know of."""

    def edit(self, points, step):
        vars(self)["calls"] = vars(self).get("calls", 0) + 1
        return Edit(drop=torch.full((len(points),), vars(self)["calls"] > 1))


class Moves(Sound):
    def edit(self, points, step):
        return Edit(move=torch.full((len(points), 3), torch.nan))


class Marks(Sound):
    def edit(self, points, step):
        step.grad_norm.zero_()


def test_policies_taken_through_a_stage():
    check_policy(Sound())
    for policy, message in (
        (Remembers(), "Remembers: drop is not repeatable; .*`points.stat"),
        (Moves(), "Moves: move is not finite"),
        (Marks(), "Marks changed .*step.grad_norm"),
    ):
        with pytest.raises(AssertionError, match=message):
            check_policy(policy)


@dataclass(frozen=True)
class Doubles(Densify):
    """Clones everything at step 500, and says so."""

    at: int = 500
    told: tuple[int, ...] | None = (500,)

    def edits(self, steps):
        return self.told

    def edit(self, points, step):
        return Edit(clone=torch.ones(len(points), dtype=torch.bool)) if step.index == self.at else None


class Unlimited(Doubles):
    def limited(self, points):
        return self


@pytest.mark.parametrize(
    ("densify", "message"),
    [
        (Doubles(at=600), r"Doubles adds .*600, .*edits\(30000\)"),
        (Doubles(told=(500, 500)), "Doubles.edits: steps .*in order"),
        (Doubles(told=(0, 500)), "Doubles.edits: steps .*1 to 30000"),
        (Unlimited(), r"Unlimited.limited\(205\) .*205 after step 500"),
        (Doubles(at=0), "Doubles neither clones nor splits"),
    ],
)
def test_densifiers_that_are_wrong(densify, message):
    check_densify(Doubles())
    check_densify(Doubles(told=None))
    with pytest.raises(AssertionError, match=message):
        check_densify(densify)


class Multiplies(Sound):
    def edit(self, points, step):
        return Edit(split=torch.ones(len(points), dtype=torch.bool))


class Idle(Sound):
    def edit(self, points, step):
        return None


@pytest.mark.parametrize(
    ("prune", "message"),
    [
        (Multiplies(), "Multiplies adds .*1; .*Densify"),
        (Idle(), "Idle drops no point"),
        (Ints(), "Ints: drop is torch.float32, not bool"),
    ],
)
def test_pruners_that_are_wrong(prune, message):
    check_prune(Sound())
    with pytest.raises(AssertionError, match=message):
        check_prune(prune)


@dataclass(frozen=True)
class Small(Filter):
    """Admits small points."""

    def admits(self, step, want):
        return step.splats.scales.amax(-1) < 0.1


class Weights(Small):
    def admits(self, step, want):
        return want * 0.5


class Surfels(Small):
    def admits(self, step, want):
        return step.splats.scales < 0.1


class Takes(Small):
    def admits(self, step, want):
        return want.sub_(0.1) > 0


class Tosses(Small):
    def admits(self, step, want):
        return torch.rand(len(want)) > 0.5


@pytest.mark.parametrize(
    ("condition", "message"),
    [
        (Weights(), "Weights.admits gives torch.float32, not bool"),
        (Surfels(), r"Surfels.admits has shape \(200, 2\), not \(200,\)"),
        (Takes(), "Takes.admits changed .*want"),
        (Tosses(), "Tosses.admits is not repeatable; .*`step.seed`"),
    ],
)
def test_filters_that_are_wrong(condition, message):
    check_filter(Small())
    with pytest.raises(AssertionError, match=message):
        check_filter(condition)


@dataclass(frozen=True)
class Total(Signal):
    """The gradient of all losses."""

    terms: tuple[str, ...] | None = None

    def combine(self, chosen, total):
        return total


class Lengths(Total):
    def combine(self, chosen, total):
        return total.norm(dim=-1)


class Ratio(Total):
    def combine(self, chosen, total):
        return total * total.norm() / chosen.norm()


class Lifts(Total):
    def combine(self, chosen, total):
        return total + 1e-6


@pytest.mark.parametrize(
    ("signal", "message"),
    [
        (Lengths(), r"Lengths.combine has shape \(60,\), not \(60, 2\)"),
        (Ratio(), "Ratio.combine .*without gradient is not finite"),
        (Lifts(), "Lifts.combine is not 0"),
        (Total(terms="ssim"), "Total.terms is 'ssim'; .*None .*tuple"),
    ],
)
def test_signals_that_are_wrong(signal, message):
    check_signal(Total())
    with pytest.raises(AssertionError, match=message):
        check_signal(signal)
