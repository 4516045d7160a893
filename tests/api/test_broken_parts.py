"""Parts of a plugin that break the contract of their kind are named in one line, and not found out far from there."""

from dataclasses import dataclass

import numpy as np
import pytest
import torch
from models import data_set

import surfkit
from surfkit.core.registry import plugins
from surfkit.plugin import Appearance, Loss, Mesh, Mesher, Signal, hookimpl


@dataclass(frozen=True)
class BrokenLoss(Loss):
    """Gives something else than a number."""

    how: str = "float"

    def weight_at(self, index, steps):
        return None if self.how == "weight" else 0.1

    def __call__(self, maps, target):
        if self.how == "photo":
            target.photo.mul_(0.5)
        error = (maps.need("color") - target.photo).abs()
        given = {"float": 0.5, "image": error, "none": None, "detached": error.mean().detach(), "zero": torch.zeros(())}
        return given.get(self.how, error.mean())


@dataclass(frozen=True)
class BrokenSignal(Signal):
    """Gives another number of rows, or NaN."""

    how: str = "short"

    def combine(self, chosen, total):
        return total[:5] if self.how == "short" else total / 0 * 0


@dataclass(frozen=True)
class BrokenAppearance(Appearance):
    """Gives numbers of too few photographs, or a picture the other way round."""

    how: str = "count"

    def begin(self, count):
        return torch.zeros(1 if self.how == "count" else count, 2)

    def rate_at(self, index, steps):
        return 0.01

    def __call__(self, numbers, color, camera):
        return color.permute(1, 2, 0) + 0 * numbers.sum()

    def folded(self, numbers, params):
        return params


@dataclass(frozen=True)
class BrokenMesher(Mesher):
    """Gives something else than triangles with finite corners."""

    how: str = "none"

    def mesh(self, subject):
        corners = np.zeros((3, 3), np.float32)
        return {
            "none": None,
            "torch": Mesh(torch.zeros(3, 3), np.array([[0, 1, 2]], np.int32)),
            "range": Mesh(corners, np.array([[0, 1, 7]], np.int32)),
            "nan": Mesh(corners + np.nan, np.array([[0, 1, 2]], np.int32)),
        }[self.how]


class Offer:
    """The plugin."""

    @hookimpl
    def surfkit_components(self):
        return {f"broken-{cls.__name__[6:].lower()}": cls for cls in BROKEN}


BROKEN = (BrokenLoss, BrokenSignal, BrokenAppearance, BrokenMesher)


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    offer = Offer()
    plugins().register(offer, "broken")
    yield surfkit.read(data_set(tmp_path_factory.mktemp("broken") / "scene"))
    plugins().unregister(offer)


@pytest.mark.parametrize(
    ("slot", "part", "said"),
    [
        ("pretrain.losses.mine", BrokenLoss("float"), r"losses.mine: expected shape \(\), got float"),
        ("pretrain.losses.mine", BrokenLoss("none"), r"losses.mine: expected shape \(\), got NoneType"),
        ("pretrain.losses.mine", BrokenLoss("image"), r"losses.mine: expected shape \(\), got \(3, 36, 48\)"),
        ("pretrain.losses.mine", BrokenLoss("detached"), r"losses.mine: its value 0\.\d+ does not depend on what is"),
        ("pretrain.losses.mine", BrokenLoss("photo"), r"losses.mine changes target.photo in place"),
        ("pretrain.losses.mine", BrokenLoss("weight"), "losses.mine: its weight in step 1 is None"),
        ("pretrain.signal", BrokenSignal(), r"BrokenSignal.combine: expected shape \(\d+, 2\), got \(5, 2\)"),
        ("pretrain.signal", BrokenSignal("nan"), "BrokenSignal.combine: NaN or Inf, of gradients that are finite"),
        ("pretrain.appearance", BrokenAppearance("count"), r"BrokenAppearance.begin: .* got 1 rows"),
        ("pretrain.appearance", BrokenAppearance("turned"), r"expected shape \(3, 36, 48\), got \(36, 48, 3\)"),
    ],
)
def test_the_part_is_named(scene, tmp_path, slot, part, said):
    with pytest.raises(surfkit.BadInput, match=said) as error:
        surfkit.train(surfkit.evolve(surfkit.get_recipe("2dgs"), slot, part), scene, tmp_path / "run", steps=2)
    assert "\n" not in str(error.value)


def test_a_loss_may_have_nothing_to_say(scene, tmp_path):
    recipe = surfkit.evolve(surfkit.get_recipe("2dgs"), "pretrain.losses.mine", BrokenLoss("zero"))
    assert len(surfkit.train(recipe, scene, tmp_path / "run", steps=2).splats.means)


@pytest.fixture(scope="module")
def run(scene, tmp_path_factory):
    return surfkit.train("2dgs", scene, tmp_path_factory.mktemp("broken") / "run", steps=2)


@pytest.mark.parametrize(
    ("how", "said"),
    [
        ("none", "expected a surfkit.Mesh, got NoneType"),
        ("torch", "vertices: expected a numpy array of float32, got Tensor"),
        ("range", "faces: expected rows of 3 vertices, got 0 to 7"),
        ("nan", r"vertices: \[nan, nan, nan\] in row 0"),
    ],
)
def test_the_mesher_is_named(run, how, said):
    with pytest.raises(surfkit.BadInput, match=f"mesh:broken-mesher: {said}"):
        run.mesh(BrokenMesher(how))
