"""Parts that give None or another type are named by `check` in one line, and not by an error inside of it."""

from dataclasses import dataclass

import pytest
import torch

from surfkit.core.registry import kebab, plugins
from surfkit.plugin import TSDF, Appearance, Densify, Edit, Loss, Signal, Surfel2D, hookimpl
from surfkit.testing import check


@dataclass(frozen=True)
class NoLoss(Loss):
    """Gives nothing."""

    def weight_at(self, index, steps):
        return 1.0

    def __call__(self, maps, target):
        return None


@dataclass(frozen=True)
class NoSignal(Signal):
    """Gives nothing."""

    def combine(self, chosen, total):
        return None


@dataclass(frozen=True)
class ListEdit(Densify):
    """Gives numbers in place of a mask."""

    def edit(self, points, step):
        return Edit(drop=[1, 2])


@dataclass(frozen=True)
class Constant(Appearance):
    """Gives colours without a graph."""

    def begin(self, count):
        return torch.zeros(count, 2)

    def rate_at(self, index, steps):
        return 0.01

    def __call__(self, numbers, color, camera):
        return color.detach()

    def folded(self, numbers, params):
        return params


@dataclass(frozen=True)
class Turned(Constant):
    """Gives the picture the other way round."""

    def __call__(self, numbers, color, camera):
        return color.permute(1, 2, 0)


@dataclass(frozen=True)
class NoMesh(TSDF):
    """Gives nothing."""

    def mesh(self, subject):
        return None


@dataclass(frozen=True)
class NoSplats(Surfel2D):
    """Gives nothing."""

    def activate(self, params, degree):
        return None


class Offer:
    """Their plugin."""

    @hookimpl
    def surfkit_components(self):
        parts = (NoLoss, NoSignal, ListEdit, Constant, Turned, NoMesh, NoSplats)
        return {f"wrong-{kebab(cls.__name__)}": cls for cls in parts}


@pytest.fixture(autouse=True)
def offered():
    offer = Offer()
    plugins().register(offer)
    yield
    plugins().unregister(offer)


@pytest.mark.parametrize(
    ("part", "said"),
    [
        (NoLoss(), "NoLoss gives NoneType, not a tensor"),
        (NoSignal(), "NoSignal.combine gives NoneType, not a tensor"),
        (ListEdit(), "drop gives list, not a tensor"),
        (Constant(), "Constant gives no gradient"),
        (Turned(), r"Turned gives shape \(12, 16, 3\), not \(3, 12, 16\)"),
        (NoMesh(), "NoMesh.mesh gives NoneType, not a surfkit.Mesh"),
        (NoSplats(), "NoSplats.activate gives NoneType, not surfkit.plugin.Splats"),
    ],
)
def test_another_type_is_named(part, said):
    with pytest.raises(AssertionError, match=said):
        check(part)
