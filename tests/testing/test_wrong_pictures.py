"""Losses, regularizers, appearance models and estimators of depth that break their contract are named."""

from dataclasses import dataclass, replace
from typing import ClassVar

import pytest
import torch

from surfkit.appearance import CameraResponse, Exposure
from surfkit.depth.base import DepthEstimator, Estimate
from surfkit.losses.base import Loss, Regularizer
from surfkit.losses.transients import Robust, Transients
from surfkit.testing import (
    check_appearance,
    check_depth_estimator,
    check_loss,
    check_regularizer,
    check_transients,
)
from surfkit.testing.inputs import survey


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
        (Infinite(), "Infinite of an empty render: .*'color' is not finite"),
        (Negative(), "Negative: the weight at step 500 of 1000 is -100.0"),
        (Constant(), "Constant does not depend on color"),
    ],
)
def test_losses_that_do_not_conform(loss, message):
    check_loss(Bright())
    with pytest.raises(AssertionError, match=message):
        check_loss(loss)


class Covers(Bright):
    def __call__(self, maps, sample):
        sample.photo.clamp_(max=0.5)
        return maps.color.mean()


def test_a_loss_may_not_change_the_photograph():
    with pytest.raises(AssertionError, match="Covers changed .*target.photo"):
        check_loss(Covers())


@dataclass(frozen=True)
class Faint(Regularizer):
    """Mean opacity."""

    def weight_at(self, index, steps):
        return 0.01

    def __call__(self, splats):
        return splats.opacities.mean()


class Each(Faint):
    def __call__(self, splats):
        return splats.opacities


class Logarithm(Faint):
    def __call__(self, splats):
        return (splats.opacities - 1).log().mean()


class Cuts(Faint):
    def __call__(self, splats):
        return splats.opacities.detach().mean()


class Thick(Faint):
    def __call__(self, splats):
        return (splats.scales[:, 0] * 0).sqrt().mean()


class Grows(Faint):
    def weight_at(self, index, steps):
        return index / (index - 500) if index != 500 else float("inf")


class Seen(Faint):
    only_seen = True


class Remembers(Faint):
    seen: ClassVar[list] = []

    def in_step(self, splats, given):
        self.seen.append(given.index)
        return len(self.seen) * self(splats)


class Blind(Faint):
    def in_step(self, splats, given):
        return splats.opacities[given.seen].mean()


class Writes(Faint):
    def in_step(self, splats, given):
        given.maps.color.mul_(2.0)
        return self(splats)


@pytest.mark.parametrize(
    ("regularizer", "message"),
    [
        (Remembers(), "Remembers of surfels in a step: .*resumed .*`stat`"),
        (Blind(), "Blind of surfels of a view that shows none is nan"),
        (Writes(), "Writes of surfels in a step.in_step .*maps.color"),
    ],
)
def test_terms_that_are_wrong_in_a_step(regularizer, message):
    with pytest.raises(AssertionError, match=message):
        check_regularizer(regularizer)


@pytest.mark.parametrize(
    ("regularizer", "message"),
    [
        (Each(), r"Each gives shape \(60,\), not one number"),
        (Logarithm(), "Logarithm of surfels is nan"),
        (Cuts(), "Cuts .*means, quats, scales, opacities, sh"),
        (Thick(), "Thick of surfels: .*'scales' is not finite"),
        (Seen(), "Seen of no surfel is nan; a view may show none"),
        (Grows(), "Grows: the weight at step 1 of 1000 is -0.002"),
    ],
)
def test_regularizers_that_are_wrong(regularizer, message):
    check_regularizer(Faint())
    with pytest.raises(AssertionError, match=message):
        check_regularizer(regularizer)


class Darkens(Exposure):
    def begin(self, count):
        return 0.9 * Exposure.begin(self, count)


class Unlearned(Exposure):
    def __call__(self, numbers, color, camera):
        return Exposure.__call__(self, numbers.detach(), color, camera)


class Idles(Exposure):
    def rate_at(self, index, steps):
        return 0.0


class Reverses(Exposure):
    def rate_at(self, index, steps):
        return -Exposure.rate_at(self, index, steps)


class Starts(CameraResponse):
    def begin_with(self, light):
        return CameraResponse.begin_with(self, light) + 0.1


class Returns(Exposure):
    def of_scene(self, numbers, photo, camera):
        return photo, photo > 2


class Strays(CameraResponse):
    def of_scene(self, numbers, photo, camera):
        return 0.9 * photo, photo > 2


class Spills(Exposure):
    def folded(self, numbers, params):
        params["sh0"] += 0.1
        return params


class Loses(Exposure):
    def folded(self, numbers, params):
        return {"sh0": params["sh0"]}


class Shares(Exposure):
    """Its shared numbers change nothing."""

    def begin_shared(self):
        return torch.zeros(2)

    def __call__(self, numbers, color, camera):
        return Exposure.__call__(self, numbers[:12].view(3, 4), color, camera)


class Wanders(Shares):
    def begin_shared(self):
        return torch.rand(2)


class Folds(Shares):
    def begin_shared(self):
        return torch.zeros(1, 2)


@pytest.mark.parametrize(
    ("appearance", "message"),
    [
        (Darkens(), "Darkens: .*photograph 0 .*colours"),
        (Unlearned(), "Unlearned gives no gradient by the numbers"),
        (Idles(), "Idles: the learning rate is 0 throughout, so nothing is learned"),
        (Starts(), "Starts.begin_with, of light that did not change"),
        (Returns(), "Returns.of_scene: its numbers are learned"),
        (Strays(), "Strays.of_scene: the way back does not lead to the photograph"),
        (Reverses(), "Reverses: .* -0.00.*0 or more"),
        (Spills(), r"Spills.folded changed .*params\['sh0'\]"),
        (Shares(), "Shares gives no gradient by the shared numbers"),
        (Wanders(), "Wanders.begin_shared"),
        (Folds(), r"Folds.begin_shared has shape \(1, 2\), not \(S,\)"),
        (Loses(), "Loses.folded gives columns of shapes {'sh0'"),
    ],
)
def test_appearance_models_that_are_wrong(appearance, message):
    check_appearance(Exposure())
    with pytest.raises(AssertionError, match=message):
        check_appearance(appearance)


@dataclass(frozen=True)
class Far(Transients):
    """Colours that are far off."""

    def kept(self, color, target, index, steps):
        return (color - target.photo).abs().sum(0) < 1


class PerChannel(Far):
    def kept(self, color, target, index, steps):
        return (color - target.photo).abs() < 0.5


class Weighs(Far):
    def kept(self, color, target, index, steps):
        return (color - target.photo).abs().sum(0)


class Never(Far):
    def kept(self, color, target, index, steps):
        return None


class Draws(Far):
    def kept(self, color, target, index, steps):
        return torch.rand(color.shape[1:]) > 0.5


class Doubles(Far):
    def kept(self, color, target, index, steps):
        return super().kept(color.mul_(2), target, index, steps)


class Recalls(Far):
    seen: ClassVar[list] = []

    def kept(self, color, target, index, steps):
        self.seen.append(index)
        return super().kept(color, target, index, steps) if len(self.seen) < 15 else None


@pytest.mark.parametrize(
    ("transients", "message"),
    [
        (PerChannel(), r"PerChannel gives shape \(3, 24, 32\), not \(24, 32\)"),
        (Weighs(), "Weighs gives torch.float32, not bool"),
        (Never(), "Never says nothing at any step"),
        (Draws(), "Draws.kept is not repeatable.*keep nothing"),
        (Doubles(), "Doubles changed its input color"),
        (Recalls(), "Recalls.kept .*is not repeatable"),
    ],
)
def test_transients_that_are_wrong(transients, message):
    check_transients(Far())
    check_transients(Robust(radius_px=2))
    with pytest.raises(AssertionError, match=message):
        check_transients(transients)


@dataclass(frozen=True)
class Knows(DepthEstimator):
    """The true depth of the scene that the check shows."""

    aligned = True
    oriented = True
    scale: float = 1.0

    def estimate(self, given, wanted):
        truth = survey(views=9, width=72, height=54, points=600)
        for at in wanted:
            exact = truth.exact[given.views[at].name]
            inverse = torch.where(exact.depth > 0, self.scale / exact.depth, 0).float()
            yield self.spoilt(Estimate(at, inverse, (inverse > 0).float(), exact.normal.float()))

    def spoilt(self, estimate):
        return estimate


class Skips(Knows):
    def estimate(self, given, wanted):
        yield from Knows.estimate(self, given, wanted[1:])


class Depth(Knows):
    def spoilt(self, estimate):
        return replace(estimate, inverse=1 / estimate.inverse)


class Outwards(Knows):
    def spoilt(self, estimate):
        return replace(estimate, normal=-estimate.normal)


class Percent(Knows):
    def spoilt(self, estimate):
        return replace(estimate, confidence=100 * estimate.confidence)


class Bare(Knows):
    def spoilt(self, estimate):
        return replace(estimate, normal=None)


class Half(Knows):
    def spoilt(self, estimate):
        half = {"inverse": estimate.inverse[::2, ::2], "confidence": estimate.confidence[::2, ::2]}
        return replace(estimate, **half, normal=estimate.normal[:, ::2, ::2])


class Forgets(Knows):
    """Leaves a file in its work folder, and goes on from it with other depths."""

    def estimate(self, given, wanted):
        begun = given.work / "begun"
        for estimate in Knows.estimate(self, given, wanted):
            again = begun.exists() and len(wanted) == 1
            begun.touch()
            yield replace(estimate, inverse=1.01 * estimate.inverse) if again else estimate


@pytest.mark.parametrize(
    ("estimator", "message"),
    [
        (Skips(), r"Skips gives the photographs \[4\]; \[7, 4\] were wanted"),
        (Depth(), "Depth is `aligned`, .*1.68 times"),
        (Outwards(), "Outwards: a normal points away from the camera"),
        (Percent(), r"Percent: confidence .*\[0, 1\]"),
        (Bare(), "Bare: normals .*`oriented`"),
        (Half(), "Half: a map has 36 x 27 px, and Half.of_map tells 72 x 54: "),
        (Knows(scale=20.0), "Knows is `aligned`, .* 20 times"),
        (Forgets(), "Forgets.estimate .*interruption is not repeatable: inverse"),
    ],
)
def test_estimators_that_are_wrong(estimator, message):
    with pytest.raises(AssertionError, match=message):
        check_depth_estimator(estimator)


def test_an_estimator_that_is_right():
    check_depth_estimator(Knows())
