"""Starts, refinements and primitives of a plugin that give what is no set of points are named in one line: colours in
[0, 1] would begin as black, and a column of one number would be repeated."""

from dataclasses import dataclass, replace

import pytest
import torch
from models import data_set

import surfkit
from surfkit.plugin import BadInput, Refine, Start
from surfkit.primitives.base import refuse_other_params
from surfkit.primitives.gaussian3d import Gaussian3D
from surfkit.start.base import InitialModel


@dataclass(frozen=True)
class BrokenStart(Start):
    """Gives points of another type."""

    how: str = "none"

    def expected(self, sparse, pixels):
        return sparse

    def cloud(self, known):
        cloud = known.scene.cloud
        return {
            "none": None,
            "unit": replace(cloud, rgb=cloud.rgb / 255),
            "grey": replace(cloud, rgb=cloud.rgb[:, :1]),
            "short": replace(cloud, rgb=cloud.rgb[:3]),
            "nan": replace(cloud, xyz=cloud.xyz * torch.nan),
            "numpy": replace(cloud, xyz=cloud.xyz.numpy()),
        }[self.how]


@dataclass(frozen=True)
class BrokenModel(Start):
    """Gives other columns than the primitive's."""

    how: str = "none"

    def expected(self, sparse, pixels):
        return sparse

    def cloud(self, known):
        return known.scene.cloud

    def model(self, primitive, known, generator):
        params = primitive.init(known.scene.cloud, generator)
        return InitialModel(changed(params, self.how)) if self.how != "dict" else params


@dataclass(frozen=True)
class BrokenRefine(Refine):
    """Goes on from other columns."""

    how: str = "none"

    def params(self, params):
        return changed(params, self.how)


@dataclass(frozen=True)
class NoViews(Refine):
    """Looks from nowhere."""

    def views(self, views, seed):
        return ()


def changed(params, how):
    return {
        "none": None,
        "double": params | {"means": params["means"].double()},
        "short": params | {"quats": params["quats"][:5]},
        "one": params | {"scales": params["scales"][:, :1]},
        "numpy": params | {"scales": params["scales"].numpy()},
    }[how]


COLUMNS = [
    ("none", "expected dict, got NoneType"),
    ("double", r"means: expected a tensor of float32 of shape \(N, 3\), got a tensor of float64"),
    ("short", r"quats: expected shape \(N, 4\) with N = \d+, got \(5, 4\)"),
    ("one", r"scales: expected shape \(N, 3\) with N = \d+, got \(\d+, 1\)"),
    ("numpy", "scales: expected a tensor of float32 .*, got ndarray"),
]
CASES = [
    (BrokenStart("none"), "BrokenStart.cloud: expected SparsePoints, got NoneType"),
    (BrokenStart("unit"), r"rgb: expected a tensor of uint8 of shape \(P, 3\), got a tensor of float32"),
    (BrokenStart("grey"), r"rgb: expected shape \(P, 3\) with P = \d+, got \(\d+, 1\)"),
    (BrokenStart("short"), r"rgb: expected shape \(P, 3\) with P = \d+, got \(3, 3\)"),
    (BrokenStart("nan"), "xyz: .* are not finite"),
    (BrokenStart("numpy"), "xyz: expected a tensor .*, got ndarray"),
    (BrokenModel("dict"), "start.model: expected InitialModel, got dict"),
    *((BrokenModel(how), f"the points that it begins with: {said}") for how, said in COLUMNS),
    *((BrokenRefine(how=how), f"refine.0.* the points that it begins with: {said}") for how, said in COLUMNS),
    (NoViews(), "refine.0.*views: there are none to look from"),
]


@pytest.mark.parametrize(("part", "said"), CASES)
def test_the_part_is_named(tmp_path, part, said):
    surfkit.offer(f"own-{type(part).__name__.lower()}", type(part))
    recipe = surfkit.evolve(surfkit.get_recipe("3dgs"), "mesh", None)
    slot = ("refine", (part,)) if isinstance(part, Refine) else ("start", part)
    with pytest.raises(BadInput, match=said) as error:
        surfkit.train(surfkit.evolve(recipe, *slot), data_set(tmp_path / "scene"), tmp_path / "run", steps=2)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("degree", [-1, 4])
def test_degrees_that_there_are_not(degree):
    with pytest.raises(BadInput, match=f"sh_degree {degree}; it must be 0, 1, 2 or 3"):
        InitialModel({}, degree)


def test_columns_that_the_primitive_does_not_declare():
    with pytest.raises(BadInput, match="declares the columns .*, and its points have means"):
        refuse_other_params(Gaussian3D(), {"means": torch.zeros(2, 3)})
