"""Volumetric cutting against a loop in float64, and on an edge; the recipe as a whole."""

import math
from dataclasses import replace
from itertools import product
from types import SimpleNamespace

import pytest
import surfkit_gaussian_surfels
import torch
from surfkit_gaussian_surfels import GAUSSIAN_SURFELS
from surfkit_gaussian_surfels.mesh import CutPoisson, weight_around

from surfkit.core.codec import dump, load
from surfkit.core.registry import offered, plugins
from surfkit.plugin import BadInput, Splats, rotated
from surfkit.primitives.flat3d import NO_THICKNESS
from surfkit.study.ablation import build, offered_tables
from surfkit.testing import check_component


@pytest.fixture(autouse=True)
def registered():
    """The plugin, as if it were installed, where it is not."""
    there = any(name == "gaussian-surfels" for _, name, _ in offered("surfkit_recipes"))
    if not there:
        plugins().register(surfkit_gaussian_surfels, "gaussian-surfels of this test")
    yield
    if not there:
        plugins().unregister(surfkit_gaussian_surfels)


def discs(means: torch.Tensor, quats: torch.Tensor, scales: torch.Tensor, opacities: torch.Tensor) -> Splats:
    third = torch.full((len(means), 1), NO_THICKNESS).to(means)
    return Splats("gaussian", means, quats, torch.cat([scales, third], 1), opacities, torch.zeros(len(means), 1, 3))


def scattered(count: int, side: float) -> Splats:
    """Discs of a fifth of a cell to three cells, any way round, in a cube of side 1."""
    draw = torch.Generator().manual_seed(4)
    scales = side * 0.2 * 15 ** torch.rand(count, 2, generator=draw)
    return discs(torch.rand(count, 3, generator=draw), torch.randn(count, 4, generator=draw), scales,
                 0.1 + 0.9 * torch.rand(count, generator=draw))  # fmt: skip


def by_a_loop(points: torch.Tensor, splats: Splats, side: float) -> torch.Tensor:
    """(P,) weights: every disc and every cell, whose corners lie on both sides of the plane, within the 3 sigma box."""
    corner, total = points.amin(0).double(), {}
    wanted = {tuple(cell) for cell in ((points.double() - corner) / side).floor().long().tolist()}
    for at in range(len(splats)):
        quat = splats.quats[at : at + 1].double()
        turn = torch.stack([rotated(torch.eye(3)[k : k + 1].double(), quat)[0] for k in range(3)], 1)
        centre, scales = (splats.means[at].double() - corner) / side, splats.scales[at].double() / side
        for cell in wanted:
            low = torch.tensor(cell).double()
            ends = torch.tensor(list(product((0, 1), repeat=3))).double() + low
            heights = (ends - centre) @ turn[:, 2]
            nearest = torch.minimum(torch.maximum(centre, low), low + 1)
            square = float((((nearest - centre) @ turn[:, :2]) / scales[:2]).square().sum())
            half, keep = 3 * (turn[:, :2] * scales[:2]).norm(dim=1), torch.arange(3) != int(turn[:, 2].abs().argmax())
            near = ((low <= centre + half) & (low + 1 >= centre - half))[keep].all()
            if heights.min() <= 0 <= heights.max() and square <= 9 and near:
                total[cell] = total.get(cell, 0) + float(splats.opacities[at]) * math.exp(-square / 2)
    cells = ((points.double() - corner) / side).floor().long().tolist()
    return torch.tensor([total.get(tuple(cell), 0.0) for cell in cells])


def test_cells_have_the_weights_of_a_loop():
    side = 0.11
    splats, draw = scattered(60, side), torch.Generator().manual_seed(5)
    points = torch.rand(150, 3, generator=draw)
    found, wanted = weight_around(points, splats, side), by_a_loop(points, splats, side)
    assert (wanted > 0.1).float().mean() > 0.3 and (wanted == 0).any()
    assert torch.allclose(found.double(), wanted.double(), atol=1e-4)


def test_a_splat_in_few_groups_or_many_is_the_same(monkeypatch):
    splats, points = scattered(80, 0.1), torch.rand(200, 3, generator=torch.Generator().manual_seed(6))
    whole = weight_around(points, splats, 0.1)
    monkeypatch.setattr(surfkit_gaussian_surfels.mesh, "MOST_COLUMNS", 50)
    assert torch.allclose(weight_around(points, splats, 0.1), whole, atol=1e-5)


def edge() -> tuple[Splats, torch.Tensor, torch.Tensor]:
    """Two opaque walls, at z = 0 and z = 1, a faint splat between their edges, and the points of depth maps: on both
    walls, and between them, where the mean depth of a pixel lies."""
    y, x = (
        grid.flatten() for grid in torch.meshgrid(torch.linspace(0, 1, 21), torch.linspace(0, 1, 21), indexing="ij")
    )
    near, far = (torch.stack([x * 0.5 + shift, y, torch.full_like(x, z)], 1) for shift, z in ((0.0, 0.0), (0.5, 1.0)))
    means = torch.cat([near, far, torch.tensor([[0.5, 0.5, 0.5]])])
    upright = torch.tensor([1.0, 0, 0, 0]).repeat(len(means), 1)
    upright[-1] = torch.tensor([math.sqrt(0.5), 0, math.sqrt(0.5), 0])  # across x
    opacities = torch.full((len(means),), 0.95)
    opacities[-1] = 0.3
    splats = discs(means, upright, torch.full((len(means), 2), 0.05), opacities)
    bridge = torch.stack([torch.full((9,), 0.5), torch.linspace(0.1, 0.9, 9), torch.linspace(0.2, 0.8, 9)], 1)
    return splats, torch.cat([near, far]), bridge


def test_points_that_bridge_an_edge_are_cut_and_no_others():
    splats, walls, bridge = edge()
    given, points = SimpleNamespace(splats=splats), torch.cat([walls, bridge])
    kept = CutPoisson(cells=32).kept(given, points)
    assert kept[: len(walls)].all() and not kept[len(walls) :].any()
    faint = bridge.new_tensor([[0.5, 0.5, 0.5]])
    assert CutPoisson(cells=32, least=0.25).kept(given, torch.cat([walls, faint]))[-1], "it is there, but faint"
    assert CutPoisson(cells=32, least=0.0).kept(given, points).all()


def test_cells_are_no_larger_for_a_few_far_points():
    _, walls, _ = edge()
    far = torch.tensor([[50.0, 0.0, 0.0]])
    mesher = CutPoisson(cells=100)
    assert mesher.side(torch.cat([walls, far])) == pytest.approx(0.01, rel=1e-5) and mesher.side(far) > 0


def test_nothing_left_is_said():
    splats, walls, _ = edge()
    faint = replace(splats, opacities=splats.opacities * 0.01)
    with pytest.raises(BadInput, match="all 882 points"):
        CutPoisson(cells=32).kept(SimpleNamespace(splats=faint), walls)


@pytest.mark.parametrize("settings", [{"cells": 1}, {"cells": 100_000}, {"least": -1.0}, {"octree": 2}])
def test_settings_that_make_no_sense_are_refused(settings):
    check_component(CutPoisson())
    with pytest.raises(BadInput, match=next(iter(settings))):
        CutPoisson(**settings)


def test_the_recipe_is_whole_and_has_its_row():
    assert load(type(GAUSSIAN_SURFELS), dump(GAUSSIAN_SURFELS)) == GAUSSIAN_SURFELS
    GAUSSIAN_SURFELS.refuse_unfit()
    assert build(offered_tables()["methods"])["GaussianSurfels"].pretrain == GAUSSIAN_SURFELS.pretrain
