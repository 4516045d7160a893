"""Anchors: the contract, the decoding against float64 and finite differences, levels and growth against their rules."""

import math
from dataclasses import replace

import pytest
import surfkit_octree
import torch
from surfkit_octree import OCTREE, SCAFFOLD, AnchorGrowth, Anchors, AnchorVolume, AnchorVoxels
from surfkit_octree.decode import decode
from surfkit_octree.growth import GRAD, OPACITY, SEEN, VIEWS
from surfkit_octree.levels import TABLE, LevelTable, census, is_in_view, level_count, view_distances

from surfkit.core.registry import plugins
from surfkit.plugin import BadInput, Camera, Densify, Derived, Maps, Points, SparsePoints, Splats, Step, components
from surfkit.raster.select import select
from surfkit.testing import check, check_component, check_densify, check_policy, check_primitive
from surfkit.testing.inputs import KnownViews, start_input

SMALL = Anchors(feature=3, offsets=2, hidden=4)


@pytest.fixture(autouse=True, scope="module")
def offered():
    """The plugin, as if it were installed, where it is not."""
    there = AnchorGrowth in components(Densify).values()
    if not there:
        plugins().register(surfkit_octree, "octree of this test")
    yield
    if not there:
        plugins().unregister(surfkit_octree)


def camera(z=-2.0, size=24):
    pose = torch.eye(4, dtype=torch.float64)
    pose[2, 3] = -z
    return Camera(pose, float(size), float(size), size / 2, size / 2, size, size)


def model(count=8, primitive=SMALL, seed=0):
    """Random anchors around 0, with features, offsets and opacities that are not those of the beginning."""
    draw = torch.Generator().manual_seed(seed)
    xyz = torch.rand(count, 3, generator=draw) - 0.5
    params = primitive.init(
        SparsePoints(xyz, torch.zeros(count, 3, dtype=torch.uint8), size=torch.full((count,), 0.1)), draw
    )
    params["feature"] = torch.randn(params["feature"].shape, generator=draw)
    params["offsets"] = torch.randn(params["offsets"].shape, generator=draw)
    params["scales"] += 0.3 * torch.randn(params["scales"].shape, generator=draw)
    params["opacity_out_bias"] = torch.full_like(params["opacity_out_bias"], 0.7)
    return params


@pytest.mark.parametrize("part", [AnchorVoxels(), AnchorVoxels(levels=3), AnchorVolume()])
def test_the_parts_keep_the_contract(part):
    check(part)


@pytest.mark.parametrize("draws", ["gaussian", "surfel"])
def test_anchors_keep_the_contract(draws):
    check_primitive(Anchors(draws=draws))


def by_hand(params, row, slot, centre, kind):
    """One Gaussian from the formulas of the paper, in plain numbers of float64."""
    value = {name: tensor.double() for name, tensor in params.items()}
    anchor, sizes = value["means"][row], value["scales"][row].exp()
    sight = anchor - centre
    inputs = torch.cat([value["feature"][row], sight / sight.norm(), sight.norm()[None]])

    def mlp(name):
        hidden = (inputs @ value[f"{name}_in"] + value[f"{name}_in_bias"]).clamp_min(0)
        return hidden @ value[f"{name}_out"] + value[f"{name}_out_bias"]

    shape, color = mlp("shape")[7 * slot : 7 * slot + 7], mlp("color")[3 * slot : 3 * slot + 3]
    opacity = max(0.0, math.tanh(float(mlp("opacity")[slot]))) / (1 + math.exp(-float(value["opacities"][row])))
    scales = sizes[3:] / (1 + (-shape[:3]).exp())
    return {
        "means": anchor + value["offsets"][row, slot] * sizes[:3],
        "quats": shape[3:] / shape[3:].norm(),
        "scales": scales[:2] if kind == "surfel" else scales,
        "opacities": torch.tensor(opacity).double(),
        "rgb": 1 / (1 + (-color).exp()),
    }


@pytest.mark.parametrize("kind", ["gaussian", "surfel"])
def test_decoding_is_that_of_the_formulas(kind):
    params, centre = model(), torch.tensor([0.1, -0.2, -2.0]).double()
    params["opacity_out_bias"][1] = -2.0  # the second of each is faint
    rows = torch.tensor([5, 2])
    made, owner = decode(kind, SMALL.activate(params, 0), rows, centre)
    assert owner.tolist() == [5, 5, 2, 2] and made.kind == kind
    for at, (row, slot) in enumerate([(5, 0), (5, 1), (2, 0), (2, 1)]):
        wanted = by_hand(params, row, slot, centre, kind)
        for name in ("means", "quats", "scales", "opacities"):
            assert torch.allclose(getattr(made, name)[at].double(), wanted[name], atol=1e-5), name
        assert torch.allclose(0.5 + 0.28209479 * made.sh[at, 0].double(), wanted["rgb"], atol=1e-5)
    assert (made.opacities[::2] > 0.1).any() and not made.opacities[1::2].any()


def test_gradients_go_through_the_networks():
    """Against float64 finite differences of the decoding, by every parameter that is trained."""
    params = {name: value.double() for name, value in model(3).items()}
    names = [name for name, column in SMALL.columns().items() if column.rate.start > 0]
    centre = torch.tensor([0.1, -0.2, -2.0]).double()

    def drawn(*values):
        anchors = SMALL.activate(params | dict(zip(names, values, strict=True)), 0)
        made, _ = decode("gaussian", anchors, torch.arange(3), centre)
        return tuple(made.tensors().values())

    leaves = [params[name].clone().requires_grad_() for name in names]
    assert torch.autograd.gradcheck(drawn, leaves, atol=1e-6, fast_mode=False)


def test_a_view_has_the_gradients_of_the_reference():
    """The way back through rasterizer and networks against autograd through the reference's own drawing."""
    from surfkit.raster.reference import draw

    params, view = model(), camera()
    leaves = {name: value.clone().requires_grad_() for name, value in params.items()}
    splats = SMALL.activate(leaves, 0)
    render = SMALL.render(splats.detached(), view, select("cpu")[0], 0.01)
    assert render.maps.alpha.max() > 0.3
    weights = torch.rand(3, 24, 24, generator=torch.Generator().manual_seed(1))
    found = render.backward(Maps(color=weights)).named()
    made, _ = decode("gaussian", splats, torch.arange(8), view.centre)
    image = draw(made, view, 0.01).maps.color
    wanted = torch.autograd.grad(
        (image * weights).sum(), [*splats.extra.values(), *splats.shared.values()][:1], retain_graph=True
    )
    assert torch.allclose(found["sizes"], wanted[0], rtol=2e-2, atol=2e-3 * float(wanted[0].abs().max()))
    names = [name for name, value in splats.shared.items() if value.requires_grad]
    exact = torch.autograd.grad((image * weights).sum(), [splats.shared[name] for name in names], allow_unused=True)
    for name, value in zip(names, exact, strict=True):
        assert value.abs().max() > 0, name
        assert torch.allclose(found[name], value, rtol=2e-2, atol=2e-3 * float(value.abs().max())), name


def test_gaussians_and_surfels_have_depth_and_normals():
    for kind in ("gaussian", "surfel"):
        primitive = replace(SMALL, draws=kind)
        maps = primitive.render(primitive.activate(model(), 0).detached(), camera(), select("cpu")[0], 0.01).maps
        inside = maps.alpha > 0.5
        assert (
            inside.any()
            and (maps.expected_depth()[inside] > 1).all()
            and maps.normal[:, inside].norm(dim=0).min() > 0.1
        )


def test_no_anchor_that_is_seen_is_left_out(monkeypatch):
    """The picture with the anchors that are kept by the frustum is the one with all of them, to the bit."""
    params = model(60)
    params["means"] *= 8
    splats, view = SMALL.activate(params, 0).detached(), camera(z=-1.0)
    kept = SMALL.needed(splats, view, 0.01)
    assert 0 < len(kept) < 60
    first = SMALL.render(splats, view, select("cpu")[0], 0.01).maps
    monkeypatch.setattr("surfkit_octree.anchors.is_in_view", lambda means, *_: torch.ones(len(means), dtype=torch.bool))
    assert len(SMALL.needed(splats, view, 0.01)) == 60
    second = SMALL.render(splats, view, select("cpu")[0], 0.01).maps
    for name, value in first.present().items():
        assert torch.equal(value, getattr(second, name)), name


def test_only_anchors_of_the_levels_that_are_needed_are_drawn():
    """The picture is that of a model without the others; contributions and hidden places are those of the Gaussians."""
    params, view, rasterizer = model(40), camera(), select("cpu")[0]
    params["level"] = (torch.arange(40) % 3).float()
    params[TABLE] = LevelTable(4.0, 3, 3, 0.1, 2.0).stored()
    splats = SMALL.activate(params, 0).detached()
    distance = (splats.means - view.centre.float()).norm(dim=1)
    needed = params["level"] <= (4.0 / distance).log2().round()
    assert needed[params["level"] == 1].any() and not needed[params["level"] == 2].all()
    kept = {name: value if name in SMALL.shared() else value[needed] for name, value in params.items()}
    kept["level"] = torch.zeros_like(kept["level"])
    less = SMALL.activate(kept, 0).detached()
    one, two = (SMALL.render(each, view, rasterizer, 0.01) for each in (splats, less))
    assert torch.equal(one.maps.color, two.maps.color) and not one.seen[~needed].any()

    made, owner = decode("gaussian", splats, needed.nonzero()[:, 0], view.centre)
    total, hits = SMALL.contribution(splats, view, rasterizer, 0.01, 0.5, 0.5)
    each, count = rasterizer.contribution(made.detached(), view, 0.01, 0.5, 0.5)
    for row in range(40):
        assert float(total[row]) == pytest.approx(float(each[owner == row].sum()), rel=1e-5)
        assert int(hits[row]) == int(count[owner == row].sum())
    places = torch.tensor([[0.0, 0, 0.5], [0.1, 0.1, 0], [0, 0, -5]])
    hidden = SMALL.opacity_before(splats, view, rasterizer, 0.01, places)
    wanted = rasterizer.opacity_before(made.detached(), view, 0.01, places)
    assert torch.equal(hidden.nan_to_num(-1), wanted.nan_to_num(-1)) and hidden[0] > 0 and total.sum() > 0


def test_a_view_without_anchors_is_black_and_has_gradients():
    splats = SMALL.activate(model(), 0).detached()
    render = SMALL.render(splats, camera(z=5.0), select("cpu")[0], 0.01)
    assert not render.maps.alpha.any() and not render.seen.any()
    found = render.backward(Maps(color=torch.ones(3, 24, 24))).named()
    assert all(not value.any() for value in found.values())


@pytest.mark.parametrize(
    ("nearest", "farthest", "fork", "wanted"), [(1, 1, 2, 1), (1, 8, 2, 4), (0.5, 1.4, 2, 2), (1, 16, 4, 3)]
)
def test_the_number_of_levels_is_that_of_the_paper(nearest, farthest, fork, wanted):
    assert level_count(nearest, farthest, fork) == wanted


def test_the_level_drawn_is_that_of_the_formula():
    table, draw = LevelTable(4.0, 5, 4, 0.8, 2.0), torch.Generator().manual_seed(0)
    means = torch.randn(500, 3, generator=draw)
    extra = 0.6 * torch.rand(500, generator=draw)
    level = torch.randint(0, 5, (500,), generator=draw)
    view = camera()
    drawn = table.is_drawn(means, level, extra, view).tolist()
    for at in range(500):
        distance = math.dist(means[at].tolist(), view.centre.tolist())
        wanted = min(max(round(math.log2(4.0 / distance) + float(extra[at])), 0), 3)
        assert drawn[at] == (int(level[at]) <= wanted), at
    assert 0 < sum(drawn) < 500


def test_view_distances_and_frustum():
    points = torch.tensor([[0.0, 0, 0], [0, 0, 1], [0, 0, -3], [50, 0, 0]])
    assert view_distances(points, [camera()], 1.0) == pytest.approx((2.0, 3.0)), "behind and beside do not count"
    assert is_in_view(points, 0.0, camera(), 0.1).tolist() == [True, True, False, False]
    # the plane of the right border of the picture, and 2 px, is 42.2 from the last point
    assert is_in_view(points, torch.tensor([0, 0, 2, 42.0]), camera(), 0.1).tolist() == [True, True, True, False]
    assert is_in_view(points, torch.tensor([0, 0, 2, 43.0]), camera(), 0.1).tolist() == [True, True, True, True]


def test_anchors_begin_at_the_voxels_of_the_points():
    """Every sparse point lies in the voxel of an anchor of level 0, no two anchors of a level share a voxel."""
    start, known = AnchorVoxels(levels=3, voxel=0.05), start_input(priors=False)
    begun = start.model(SMALL, known, torch.Generator().manual_seed(0)).params
    table = LevelTable.of(begun[TABLE])
    assert (table.count, table.active, table.voxel) == (3, 0, pytest.approx(0.1)) and table.drawn == 3
    seen = set()
    for level in range(3):
        side = table.voxel / 2**level
        mine = begun["means"][begun["level"] == level]
        keys = {tuple(math.floor(v / side) for v in place) for place in mine.tolist()}
        points = {tuple(math.floor(v / side) for v in place) for place in known.scene.cloud.xyz.tolist()}
        least = [
            min(math.dist([side * (i + 0.5) for i in key], view.camera.centre.tolist()) for view in known.scene.train)
            for key in sorted(points)
        ]
        wanted = {
            k for k, d in zip(sorted(points), least, strict=True) if level <= round(math.log2(table.distance / d))
        }
        assert len(keys) == len(mine) and keys == (wanted if level else points), level
        sizes = begun["scales"][begun["level"] == level].exp()
        assert torch.allclose(sizes, torch.full_like(sizes, side), rtol=1e-4)
        seen.add(len(points - keys))
    assert seen - {0}, "some are left out"


def test_the_census_counts_what_is_drawn():
    params = model(200)
    params["level"] = (torch.arange(200) % 3).float()
    params[TABLE] = LevelTable(2.0, 3, 3, 0.1, 2.0).stored()
    near, far = census(params, camera(z=-0.9)), census(params, camera(z=-6.0))
    assert far.in_view == 200 and far.used == sum(far.by_level) == 67 and far.by_level == (67, 0, 0)
    assert near.used == sum(near.by_level) > 67 and near.by_level[1] > 0 and near.distance < far.distance


def grown_case(levels=1):
    """Two anchors in voxels (0, 0, 0) and (5, 0, 0) of side 0.1, two Gaussians each, and what was seen of them."""
    growth = AnchorGrowth(start=0, every=10, until=100, kept=1.0, sizes=1, progressive=0)
    params = model(2)
    params["means"] = torch.tensor([[0.05, 0.05, 0.05], [0.55, 0.05, 0.05]])
    params["scales"] = torch.full((2, 6), math.log(0.1))
    params["offsets"] = torch.tensor([[[0.1, 0, 0], [2.0, 0, 0]], [[-3.0, 0, 0], [0, 1.0, 0]]])
    params[TABLE] = LevelTable(2.0, levels, levels, 0.1, 2.0).stored()
    points = Points.fresh(params, SMALL.shared())
    points.stat(GRAD, 2).copy_(torch.tensor([[9e-3, 2.5e-3], [2.4e-3, 1e-3]]))
    points.stat(SEEN, 2).fill_(10.0)
    points.stat(VIEWS).fill_(10.0)
    points.stat(OPACITY).copy_(torch.tensor([5.0, 0.02]))
    anchors = SMALL.activate(params, 0).detached()
    made, owner = decode("gaussian", anchors, torch.arange(2), torch.zeros(3))
    derived = Derived(made.detached(), owner, torch.ones(4, dtype=torch.bool), torch.zeros(4, 2))
    derived = derived.combined(lambda chosen, total: total)
    both = torch.ones(2, dtype=torch.bool)
    step = Step(
        index=10, steps=100, seen=both, splats=anchors, grad_norm=torch.zeros(2), radii=torch.ones(2), image_px=24,
        views=KnownViews(torch.ones(2)), derived=derived,
    )  # fmt: skip
    return growth, points, step


def test_anchors_grow_where_gradients_are_high():
    """Of four Gaussians, one lies in its anchor's own voxel and one has a low gradient; two share a voxel."""
    growth, points, step = grown_case()
    edit = growth.edit(points, step)
    assert len(edit.new) == 1 and edit.new.parent.tolist() == [0], "of the higher gradient"
    new = edit.new.params
    assert new["means"].tolist() == [pytest.approx([0.25, 0.05, 0.05])]
    assert torch.equal(new["feature"][0], points.params["feature"].amax(0)), "the largest of both"
    assert not new["offsets"].any() and torch.allclose(new["scales"], torch.full((1, 6), math.log(0.1)))
    assert edit.drop.tolist() == [False, True], "opacity 0.002 in the mean of its views"
    assert edit.values is None, "one level"
    check_policy(growth, points, step)


def test_what_was_seen_too_seldom_is_not_judged():
    growth, points, step = grown_case()
    points.stats[SEEN].fill_(3.0)
    points.stats[VIEWS].fill_(7.0)
    edit = growth.edit(points, step)
    assert edit.new is None and not edit.drop.any()


def test_of_several_sizes_the_larger_voxel_comes_first():
    """With sides 0.4 and 0.1, the second with twice the threshold; no large one where an anchor is within it."""
    growth, points, step = grown_case()
    points.params["offsets"][0, 1, 0] = 8.0  # at 0.85
    points.stats[GRAD].copy_(torch.tensor([[0, 5e-3], [0, 0]]))
    edit = replace(growth, sizes=2).edit(points, step)
    assert sorted(edit.new.params["means"][:, 0].tolist()) == pytest.approx([0.85, 1.0])
    assert sorted(edit.new.params["scales"].exp()[:, 0].tolist()) == pytest.approx([0.1, 0.4], rel=1e-4)
    points.stats[GRAD].copy_(torch.tensor([[0, 3e-3], [0, 0]]))
    assert len(replace(growth, sizes=2).edit(points, step).new) == 1, "the small one needs twice the threshold"
    points.params["offsets"][0, 1, 0] = 3.0  # at 0.35, where the first anchor stands in the large voxel
    points.stats[GRAD].copy_(torch.tensor([[0, 5e-3], [0, 0]]))
    only = replace(growth, sizes=2).edit(points, step).new.params
    assert only["means"][:, 0].tolist() == pytest.approx([0.35])


def test_steeper_gradients_grow_the_next_level():
    growth, points, step = grown_case(levels=3)
    points.stats[GRAD].copy_(
        torch.tensor([[0, 2.1e-3], [0, 2.5e-3]])
    )  # means 2.1e-4 and 2.5e-4; 2e-4 * 2^.2 = 2.297e-4
    edit = growth.edit(points, step)
    found = dict(zip(edit.new.parent.tolist(), edit.new.params["level"].tolist(), strict=True))
    assert found == {0: 0.0, 1: 1.0}
    assert edit.new.params["scales"].exp()[:, 0].tolist() == pytest.approx([0.1, 0.05], rel=1e-4)
    assert edit.values["extra"].tolist() == pytest.approx([0.01, 0.01])
    points.shared[TABLE] = LevelTable(2.0, 3, 1, 0.1, 2.0).stored()
    edit = replace(growth, progressive=10_000).edit(points, step)
    assert set(edit.new.params["level"].tolist()) == {0.0}, "no level that is not drawn yet"


def test_levels_are_added_from_coarse_to_fine():
    growth = AnchorGrowth(progressive=1_900, progressive_factor=1.5)
    # 6 levels: 3 at first, then one each after 900, 600 and 400 steps
    assert [growth.active(at, 6) for at in (0, 899, 900, 1499, 1500, 1899, 1900)] == [3, 3, 4, 4, 5, 5, 6]
    assert growth.active(1, 1) == 1 and replace(growth, progressive=0).active(0, 6) == 6
    _, points, step = grown_case(levels=3)
    assert growth.edit(points, replace(step, index=1)) is None, "a trained model keeps its levels"
    points.shared[TABLE] = LevelTable(2.0, 3, 0, 0.1, 2.0).stored()
    edit = growth.edit(points, replace(step, index=1))
    assert LevelTable.of(edit.values[TABLE]).active == 1 and edit.new is None


def test_statistics_are_those_of_the_gaussians():
    growth, points, step = grown_case()
    points.stats.clear()
    derived = replace(
        step.derived, grad_norm=torch.tensor([1.0, 2, 3, 4]), seen=torch.tensor([True, True, False, True])
    )
    made = replace(derived.splats, opacities=torch.tensor([0.5, 0.0, 0.25, 0.5]))
    growth.watch(points, replace(step, index=3, derived=replace(derived, splats=made)))
    assert points.stats[GRAD].tolist() == [[1, 0], [0, 4]] and points.stats[SEEN].tolist() == [[1, 0], [0, 1]]
    assert points.stats[OPACITY].tolist() == [0.5, 0.75] and points.stats[VIEWS].tolist() == [1, 1]


def test_what_was_judged_is_forgotten_and_the_rest_is_kept():
    """After an edit: Gaussians seen in 4 views (half of 0.8 * 10) and anchors in 8 begin anew, the others go on."""
    growth, points, step = grown_case()
    points.stats[SEEN].copy_(torch.tensor([[4.0, 3], [0, 4]]))
    points.stats[VIEWS].copy_(torch.tensor([8.0, 7]))
    before = {name: value.clone() for name, value in points.stats.items()}
    unseen = replace(step.derived, grad_norm=torch.zeros(4), seen=torch.zeros(4, dtype=torch.bool))
    growth.edit(points, step)
    growth.watch(points, replace(step, index=11, derived=unseen))
    assert points.stats[SEEN].tolist() == [[0, 3], [0, 0]] and points.stats[VIEWS].tolist() == [1, 8]
    assert points.stats[GRAD].tolist() == [[0, before[GRAD][0, 1].item()], [before[GRAD][1, 0].item(), 0]]
    assert points.stats[OPACITY][0] < 2.1 and points.stats[OPACITY][1] >= before[OPACITY][1]
    growth.watch(points, replace(step, index=12, derived=unseen))
    assert points.stats[VIEWS].tolist() == [2, 9], "only after an edit"


def test_growth_keeps_the_contract():
    growth, points, step = grown_case()
    step = replace(step, derived=step.derived.combined(lambda chosen, total: torch.full((4, 2), 1e-2)))
    growth = replace(growth, until=30_000, every=100, shown=0.01)
    check_component(growth)
    points.params["offsets"] += 5.0
    check_densify(growth, (points, step))


def test_other_points_and_wrong_settings_are_refused():
    points = Points.fresh({"means": torch.zeros(2, 3)})
    _, _, step = grown_case()
    with pytest.raises(BadInput, match="anchor-growth.*primitive:anchors"):
        AnchorGrowth().watch(points, step)
    with pytest.raises(BadInput, match="primitive.sh_degree is 2"):
        Anchors(sh_degree=2)
    with pytest.raises(BadInput, match="start.levels is 40"):
        AnchorVoxels(levels=40)
    with pytest.raises(BadInput, match=r"kept is 0 .*shown 0\.8"):
        AnchorGrowth(kept=0)
    with pytest.raises(BadInput, match="anchors: PLY files"):
        SMALL.table(model())


def test_the_volume_is_that_of_the_scales():
    params = model(2)
    params["scales"] = torch.tensor([[0.0, 0, 0, 1, 2, 3], [0, 0, 0, -1, 0, 0]]).log1p().clamp_min(-3)
    volume = AnchorVolume()(SMALL.activate(params, 0))
    assert float(volume) == pytest.approx((2 * 3 * 4 + math.exp(-3) * 1 * 1) / 2, rel=1e-5)
    plain = Splats(
        "gaussian",
        torch.zeros(1, 3),
        torch.ones(1, 4),
        torch.tensor([[1.0, 2, 3]]),
        torch.ones(1),
        torch.zeros(1, 1, 3),
    )
    assert float(AnchorVolume()(plain)) == 6


def test_the_recipes_fit():
    for recipe in (OCTREE, SCAFFOLD):
        recipe.refuse_unfit()
