"""A limit on the number of points holds for any densifier, also for one that has no setting for it."""

from dataclasses import dataclass, replace

import pytest
import torch
from test_densify import N, step

from surfkit.core.check import BadInput
from surfkit.core.codec import dump, load
from surfkit.core.hooks import hookimpl
from surfkit.core.registry import Component, components, plugins
from surfkit.densify import ADC, CountCap, PointCap
from surfkit.densify.base import ComparedView, Densify, Step
from surfkit.primitives import Gaussian3D
from surfkit.primitives.edit import Edit, NewPoints, apply, merge
from surfkit.primitives.points import Points
from surfkit.scene.scene import SparsePoints
from surfkit.testing import check_component, check_densify, check_policy
from surfkit.testing.inputs import KnownViews


@dataclass(frozen=True)
class Doubling(Densify):
    """Clones and splits, with neither a cap nor filters, as a package outside this repository may have it."""

    clones: int = 1
    """Copies of every second point."""

    drops: int = 0
    """Points to drop."""

    def edit(self, points: Points, step: Step) -> Edit | None:
        """Clone every second point, and split the others."""
        even = torch.arange(len(points)) % 2 == 0
        smaller = torch.full((len(points),), 0.5)
        clone = even if self.clones == 1 else even.to(torch.int64) * self.clones
        return Edit(torch.arange(len(points)) < self.drops, clone, ~even, scale_by=smaller, forget=even)

    def edits(self, steps: int) -> range:
        """See `Densify.edits`."""
        return range(1, steps + 1)


@dataclass(frozen=True)
class Sprouting(Densify):
    """Adds two points of their own for every third, and copies every second."""

    def edit(self, points: Points, step: Step) -> Edit | None:
        """Add and copy."""
        parent = torch.arange(0, len(points), 3).repeat(2)
        new = NewPoints(points.take(parent).params, parent)
        return Edit(clone=torch.arange(len(points)) % 2 == 0, new=new)

    def edits(self, steps: int) -> range:
        """See `Densify.edits`."""
        return range(1, steps + 1)


@pytest.fixture(autouse=True)
def offered():
    class Offer:
        @hookimpl
        def surfkit_components(self) -> dict[str, type[Component]]:
            return {"doubling": Doubling, "sprouting": Sprouting}

    name = plugins().register(Offer())
    yield
    plugins().unregister(name=name)


def gaussians(count: int = N) -> Points:
    draw = torch.Generator().manual_seed(0)
    cloud = SparsePoints(torch.rand(count, 3, generator=draw), torch.full((count, 3), 100, dtype=torch.uint8))
    return Points.fresh(Gaussian3D().init(cloud, draw))


def step_of(points: Points, index: int = 1, **other) -> Step:
    splats = Gaussian3D().activate(points.params, 0)
    per_point = {"seen": torch.ones(len(points), dtype=torch.bool)}
    per_point |= {name: torch.full((len(points),), 1.0) for name in ("grad_norm", "signed_norm")}
    draw = torch.Generator().manual_seed(1)
    color, photo = (torch.rand(3, 12, 16, generator=draw) for _ in range(2))
    view = ComparedView(color, photo, lambda values: torch.full((len(points),), float(values.sum())))
    views = KnownViews(torch.ones(len(points)))
    facts = per_point | {"views": views, "view": view, "radii": torch.ones(len(points))}
    return step(index, splats=splats, **(facts | other))


@pytest.mark.parametrize("inner", [Doubling(), Doubling(drops=7), Doubling(clones=3), Doubling(clones=3, drops=20)])
@pytest.mark.parametrize("limit", [1, N - 5, N, N + 1, N + 17, 10 * N])
def test_the_limit_holds_and_room_is_used(inner, limit):
    points = gaussians()
    edits = [densify.edit(points, step_of(points)) for densify in (inner, inner.limited(limit))]
    free, got = (len(apply(Gaussian3D(), points, merge([edit]), torch.Generator())) for edit in edits)
    most = max(limit, N - inner.drops)  # a limit takes no point away
    assert got == free if free <= limit else most - inner.clones < got <= most
    check_policy(inner.limited(limit), points, step_of(points))


@pytest.mark.parametrize("limit", [1, N, N + 1, N + 50, 10 * N])
def test_new_points_count_too(limit):
    points = gaussians()
    edits = [densify.edit(points, step_of(points)) for densify in (Sprouting(), Sprouting().limited(limit))]
    free, got = (len(apply(Gaussian3D(), points, merge([edit]), torch.Generator())) for edit in edits)
    assert free == N + (N + 1) // 2 + 2 * ((N + 2) // 3)
    assert got == free if free <= limit else max(limit, N) - 3 < got <= max(limit, N)
    check_densify(Sprouting())


def test_a_point_that_gets_no_copies_is_not_changed_for_them():
    points = gaussians()
    edit = Doubling(clones=3).limited(N + 10).edit(points, step_of(points))
    copied = (edit.clone > 0) | edit.split
    assert 0 < int(copied.sum()) < N
    assert torch.equal(edit.scale_by != 1, copied) and torch.equal(edit.forget, edit.clone > 0)
    assert set(edit.clone.unique().tolist()) <= {0, 3}, "all copies of a point or none"


def test_all_points_have_the_same_chance():
    points = gaussians()
    chosen = torch.zeros(N)
    for seed in range(200):
        edit = Doubling().limited(N + 6).edit(points, step_of(points, seed=seed))
        chosen += edit.clone | edit.split
    assert chosen.sum() == 200 * 6 and chosen.min() > 5 and chosen.max() < 45


def test_points_of_other_blocks_take_no_room():
    points = gaussians()
    own = step_of(points, owns=lambda means: means[:, 0] < 0.5)
    limited, may = Doubling().limited(N + 10), own.may_be_densified()
    edit = limited.edit(points, own)
    assert 10 < int(may.sum()) < N - 10 and int(((edit.clone | edit.split) & may).sum()) == 10


@pytest.mark.parametrize("name", components(Densify))
def test_every_densifier_can_be_limited(name):
    """Grown for many steps, and against what it comes to without a limit."""
    counts = []
    for densify in (components(Densify)[name](), components(Densify)[name]().limited(100)):
        points, generator = gaussians(), torch.Generator().manual_seed(0)
        for index in range(1, 2_001):
            told = step_of(points, index)
            try:
                densify.watch(points, told)
            except BadInput as refusal:  # it knows the points of one primitive only
                pytest.skip(str(refusal))
            edit = densify.edit(points, told)
            if edit is not None:
                points = apply(Gaussian3D(), points, replace(edit, drop=None), generator)
            if len(points) > 1_000:
                break
        counts.append(len(points))
    assert counts[0] > 100 and N < counts[1] <= 100
    assert densify.most_points == 100 and densify.limited(50).most_points == densify.limited(50).limited(70).most_points
    assert densify.edits(2_000) is None or len(densify.edits(2_000)) > 2


def test_one_with_a_limit_of_its_own_keeps_to_its_own_way():
    assert ADC().limited(50) == ADC(filters=(CountCap(50),))
    assert Doubling().limited(50) == PointCap(Doubling(), 50) and Doubling().most_points is None
    assert Doubling().limited(50).limited(40) == PointCap(Doubling(), 40)
    assert PointCap(ADC(filters=(CountCap(9),)), 50).most_points == 9


def test_a_limited_densifier_is_saved_and_loaded():
    limited = Doubling(clones=2).limited(50)
    assert load(Densify, dump(limited)) == limited
    check_component(limited)
