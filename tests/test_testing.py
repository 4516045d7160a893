"""The conformance checks find what they are there for."""

from dataclasses import dataclass, replace

import pytest
import torch

from surfkit.core.registry import hookimpl, plugins
from surfkit.densify.base import Prune
from surfkit.losses.base import Loss
from surfkit.primitives.edit import Edit
from surfkit.primitives.surfel2d import Surfel2D
from surfkit.testing import check_component, check_loss, check_policy, check_primitive


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


@dataclass(frozen=True)
class Mute(Prune):
    """Says nothing of its setting."""

    share: float = 0.5

    def edit(self, points, step):
        return None


@dataclass(frozen=True)
class Forgets(Prune):
    """Rounds on construction, so that saving changes it."""

    share: float = 0.26
    """Share."""

    def __post_init__(self):
        object.__setattr__(self, "share", round(self.share / 2, 2))

    def edit(self, points, step):
        return None


def test_components_that_do_not_conform():
    class Offer:
        @hookimpl
        def surfkit_components(self):
            return {"mute": Mute, "forgets": Forgets, "sound": Sound, "mutates": Mutates}

    name = plugins().register(Offer())
    try:
        check_component(Sound())
        with pytest.raises(AssertionError, match="Mute.share needs a docstring under it"):
            check_component(Mute())
        with pytest.raises(AssertionError, match="Mutates needs a docstring"):
            check_component(Mutates())
        with pytest.raises(AssertionError, match="Forgets came back from JSON as"):
            check_component(Forgets())
    finally:
        plugins().unregister(name=name)


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


@pytest.mark.parametrize(
    ("primitive", "error", "message"),
    [
        (Grows(), AssertionError, "Grows.split: a child is larger than its parent"),
        (OneChild(), AssertionError, "OneChild.split: 'means' is not 2 M rows"),
        (Unseeded(), AssertionError, "Unseeded.init: 'quats' differs for the same seed"),
        (Thick(), ValueError, r"Thick.activate: scales: expected shape \(N, 2\)"),
    ],
)
def test_primitives_that_do_not_conform(primitive, error, message):
    check_primitive(Surfel2D(), count=10)
    with pytest.raises(error, match=message):
        check_primitive(primitive, count=10)


@dataclass(frozen=True)
class Bright(Loss):
    """Colour against the photograph."""

    reads = ("color",)

    def weight_at(self, index, steps):
        return 1.0

    def __call__(self, maps, sample):
        return (maps.color - sample.photo).abs().mean()


class PerPixel(Bright):
    def __call__(self, maps, sample):
        return (maps.color - sample.photo).abs()


class Divides(Bright):
    def __call__(self, maps, sample):
        return (sample.photo / maps.color).mean()


class Infinite(Bright):
    def __call__(self, maps, sample):
        return maps.color.sqrt().sum()


class Negative(Bright):
    def weight_at(self, index, steps):
        return 400.0 - index


class Constant(Bright):
    def __call__(self, maps, sample):
        return sample.photo.mean()


@pytest.mark.parametrize(
    ("loss", "message"),
    [
        (PerPixel(), r"PerPixel gives shape \(3, 24, 32\), not one number"),
        (Divides(), "Divides of an empty render is inf"),
        (Infinite(), "Infinite of an empty render: the gradient of 'color' is not finite"),
        (Negative(), "Negative: the weight at step 500 of 1000 is -100.0"),
        (Constant(), "Constant does not depend on color"),
    ],
)
def test_losses_that_do_not_conform(loss, message):
    check_loss(Bright())
    with pytest.raises(AssertionError, match=message):
        check_loss(loss)
