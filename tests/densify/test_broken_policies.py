"""Policies, filters and primitives of a plugin that give what is no edit of the points are named in one line: wrong
rows would pass for others, and wrong values be found in a later step, which could not tell whose they were."""

from dataclasses import dataclass
from types import SimpleNamespace

import pytest
import torch
from models import data_set

import surfkit
from surfkit.core.check import read_only
from surfkit.densify.base import Filter, admitted
from surfkit.plugin import BadInput, Densify, Edit
from surfkit.primitives.edit import NewPoints, apply, sound
from surfkit.primitives.gaussian3d import Gaussian3D
from surfkit.primitives.points import Points
from surfkit.scene.scene import SparsePoints

N = 6


def points():
    draws = torch.Generator().manual_seed(0)
    cloud = SparsePoints(torch.rand(N, 3, generator=draws), torch.zeros(N, 3, dtype=torch.uint8))
    return Points.fresh(Gaussian3D(sh_degree=0).init(cloud, draws))


def asked(edit):
    return sound(edit, N, object(), points().params)


def new(parent=None, **columns):
    params = {name: value[:2] for name, value in points().params.items()} | columns
    return Edit(
        new=NewPoints(
            {n: v for n, v in params.items() if v is not None}, torch.tensor([0, 5]) if parent is None else parent
        )
    )


def ones(value, row=0):
    return torch.ones(N).index_fill(0, torch.tensor([row]), value)


@pytest.mark.parametrize(
    ("edit", "said"),
    [
        (Edit(clone=torch.tensor([0, 1, -1, 0, 0, 0])), "edit: clone of point 2 is -1; give 0 or more"),
        (Edit(opacities=ones(0.5) * 0.5 + 0.5), "opacities of point 1 is 1; give between 0 and 1, or NaN"),
        (Edit(scale_by=ones(0.0, 3)), "scale_by of point 3 is 0; give finite and above 0"),
        (Edit(scale_by=ones(torch.nan)), "scale_by of point 0 is nan"),
        (Edit(max_opacity=1.5), "max_opacity is 1.5; it must be a number between 0 and 1"),
        (Edit(max_opacity=float("nan")), "max_opacity is nan"),
        (Edit(max_opacity=torch.tensor([0.1, 0.2])), "max_opacity is tensor"),
        (Edit(new={}), "new: expected NewPoints, got dict"),
        (new(quats=None), "new: there is no column quats; the points have means, opacities"),
        (new(scales=torch.zeros(3, 3)), r"new: scales: expected shape \(2, 3\), got \(3, 3\)"),
        (new(scales=torch.zeros(2, 1)), r"new: scales: expected shape \(2, 3\), got \(2, 1\)"),
        (
            new(means=torch.zeros(2, 3).double()),
            r"new: means: expected a tensor of float32 .*, got a tensor of float64",
        ),
        (new(torch.tensor([0, 6])), "new.parent names points that are not there; they are counted from 0 to 5"),
        (new(torch.zeros(2).bool()), r"new.parent: expected a tensor of int64 of shape \(M,\), got a tensor of bool"),
    ],
)
def test_edits(edit, said):
    with pytest.raises(BadInput, match=said) as error:
        asked(edit)
    assert "\n" not in str(error.value)


def test_sound_edits_pass():
    dropped = torch.arange(N) == 0
    for edit in (new(), Edit(drop=dropped, scale_by=ones(0.0)), Edit(opacities=ones(torch.nan) * 0.5, max_opacity=0.1)):
        assert asked(edit) is edit


def test_values_of_another_type():
    with pytest.raises(BadInput, match="Edit.values: 'means': expected a tensor of float32"):
        apply(Gaussian3D(sh_degree=0), points(), Edit(values={"means": torch.zeros(N, 3).double()}), torch.Generator())


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (
            lambda rows: {name: value[:1] for name, value in rows.items()},
            r"means: expected shape \(2, 3\), got \(1, 3\)",
        ),
        (lambda rows: rows | {"scales": rows["scales"].repeat(2, 1)}, r"scales: expected shape \(2, 3\), got \(4, 3\)"),
        (lambda rows: rows | {"scales": rows["scales"][:, :1]}, r"scales: expected shape \(2, 3\), got \(2, 1\)"),
        (lambda rows: None, "split: expected dict, got NoneType"),
    ],
)
def test_children_of_a_split(change, said):
    class Splits(Gaussian3D):
        def split(self, params, generator):
            return change(super().split(params, generator))

    with pytest.raises(BadInput, match=said):
        apply(Splits(sh_degree=0), points(), Edit(split=torch.arange(N) == 1), torch.Generator())


@pytest.mark.parametrize(
    ("given", "said"),
    [
        (torch.ones(N, 1).bool(), r"admits: expected shape \(6,\), got \(6, 1\)"),
        (torch.ones(1).bool(), r"admits: expected shape \(6,\), got \(1,\)"),
        (-torch.ones(N), "admits: expected a tensor of bool .*, got a tensor of float32"),
        (None, "admits: expected a tensor of bool .*, got NoneType"),
    ],
)
def test_filters(given, said):
    @dataclass(frozen=True)
    class Given(Filter):
        def admits(self, step, want):
            return given

    with pytest.raises(BadInput, match=said):
        admitted([Given()], SimpleNamespace(may_be_densified=lambda: torch.ones(N).bool()), torch.ones(N))


@dataclass(frozen=True)
class Moves(Densify):
    """Moves the points itself."""

    watches: bool = False

    def watch(self, points, step):
        if self.watches:
            points.params["means"].add_(1.0)

    def edit(self, points, step):
        points.params["means"][0] = 0.0


@pytest.mark.parametrize(("part", "method"), [(Moves(), "edit"), (Moves(watches=True), "watch")])
def test_points_are_not_changed_behind_the_trainer(tmp_path, part, method):
    surfkit.offer("moves", Moves)
    recipe = surfkit.evolve(surfkit.get_recipe("2dgs"), "pretrain.densify", part)
    with pytest.raises(BadInput, match=f"Moves.{method} changes means in place, which others read too"):
        surfkit.train(recipe, data_set(tmp_path / "scene"), tmp_path / "run", steps=2)


def test_what_is_read_may_be_read_in_inference_too():
    with torch.inference_mode(), read_only("reader", {"values": torch.ones(2)}):
        pass
    with read_only("reader", {"values": torch.ones(2)}):
        pass
