"""The recipe at its published values, and densification by the largest gradient of a view."""

from dataclasses import replace
from types import SimpleNamespace

import pytest
import surfkit_hierarchy
import torch
from surfkit_hierarchy import HIERARCHICAL, PeakADC

from surfkit.core.check import BadInput
from surfkit.core.registry import offered, plugins
from surfkit.plugin import Gaussian3D, Points, SparsePoints, ViewStatistics, rescale
from surfkit.study.ablation import build, offered_tables
from surfkit.testing import check


@pytest.fixture(autouse=True)
def registered():
    """The plugin, as if it were installed, where it is not."""
    there = any(name == "hierarchical-3dgs" for _, name, _ in offered("surfkit_recipes"))
    if not there:
        plugins().register(surfkit_hierarchy, "hierarchy of this test")
    yield
    if not there:
        plugins().unregister(surfkit_hierarchy)


def test_the_recipe_is_that_of_the_paper():
    HIERARCHICAL.refuse_unfit()
    scaffold, chunk, lod = HIERARCHICAL.pretrain, HIERARCHICAL.tune, HIERARCHICAL.lod
    assert scaffold.densify is None and scaffold.rates["means"].at(1, 30_000) == 0
    assert 30_000 // scaffold.sh_every == 1, "degree 1 at most"
    assert (chunk.densify.threshold, chunk.densify.every, chunk.densify.small) == (0.015, 300, 1e-4)
    assert (chunk.rates["means"].start, chunk.rates["means"].end) == (2e-5, 2e-7)
    assert (chunk.losses["depth"].start, chunk.losses["depth"].end) == (1.0, 0.01)
    assert (lod.steps, lod.finest, lod.coarsest) == (15_000, 0.005, 0.1)
    assert rescale(HIERARCHICAL, 0.01).lod.steps == 150
    assert (HIERARCHICAL.min_views, HIERARCHICAL.assign.most, HIERARCHICAL.partition.padding) == (101, 1_500, 0.2)


def test_its_row_stands_in_the_table_of_methods():
    assert build(offered_tables()["methods"])["Hierarchical 3DGS"].tune == HIERARCHICAL.tune


def test_the_densifier_keeps_the_contract():
    check(PeakADC(threshold=2e-4, small=0.01))


def cloud(count):
    xyz = torch.rand(count, 3, generator=torch.Generator().manual_seed(0))
    return SparsePoints(xyz, torch.full((count, 3), 128, dtype=torch.uint8))


def noted(densify, views):
    """The edit after steps that show three points with these gradients each."""
    primitive = Gaussian3D(sh_degree=0)
    points = Points.fresh(primitive.init(cloud(3), torch.Generator().manual_seed(0)))
    for index, gradients in views.items():
        grad = torch.tensor(gradients)
        shown = ViewStatistics(None, grad > 0, grad, torch.ones(3))
        splats = SimpleNamespace(scales=torch.full((3, 3), 0.1), opacities=torch.full((3,), 0.5))
        free = torch.ones(3, dtype=torch.bool)
        step = SimpleNamespace(
            index=index, shown=shown, splats=splats, image_px=32, may_be_densified=lambda free=free: free
        )
        densify.watch(points, step)
    return densify.edit(points, step)


def test_one_view_with_a_high_gradient_is_enough():
    """Point 0: high in one of four views; 1: the sum is as high, and no view; 2: exactly the threshold."""
    densify = PeakADC(start=0, every=4, until=100, threshold=0.5, small=0.01)
    rows = {1: [0.6, 0.4, 0.0], 2: [0.0, 0.4, 0.5], 3: [0.0, 0.4, 0.0], 4: [0.0, 0.4, 0.0]}
    edit = noted(densify, rows)
    assert edit.split.tolist() == [True, False, True] and not edit.clone.any()
    again = noted(densify, rows | {5: [0.1, 0.1, 0.1], 6: [0.1, 0.1, 0.1], 7: [0.1, 0.1, 0.1], 8: [0.1, 0.1, 0.1]})
    assert not again.split.any(), "what was before the last edit is forgotten"
    assert noted(replace(densify, every=5), rows) is None


def test_two_thresholds_are_refused():
    with pytest.raises(BadInput, match="peak-adc has one threshold"):
        PeakADC(split_threshold=4e-4)
