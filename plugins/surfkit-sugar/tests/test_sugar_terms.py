"""The density against brute force in float64, the terms against their formulas, and the columns that they keep."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import surfkit_sugar
import torch
from scipy.spatial.transform import Rotation
from surfkit_sugar import REFINED, SUGAR, FaintOnce, OpacityEntropy, SurfaceField
from surfkit_sugar.density import THICKNESS, Ellipsoids, density, gathered
from surfkit_sugar.neighbours import AT, nearest, remembered
from surfkit_sugar.terms import capped, deviations, distances

from surfkit.core.registry import plugins
from surfkit.core.schedule import rescale
from surfkit.losses.base import Target
from surfkit.plugin import BadInput, Maps, Points, Regularizer, RegularizerInput, Splats, View, components, dump, load
from surfkit.primitives.edit import Edit, apply
from surfkit.raster.select import select
from surfkit.runs.run_cache import part_keys
from surfkit.testing import check
from surfkit.testing.inputs import above, crowd, splats, survey
from surfkit.train import checkpoint
from surfkit.train.stage import Stage
from surfkit.train.trainer import Trainer


@pytest.fixture(autouse=True)
def offered():
    """The plugin, as if it were installed, where it is not."""
    there = SurfaceField in components(Regularizer).values()
    if not there:
        plugins().register(surfkit_sugar, "sugar of this test")
    yield
    if not there:
        plugins().unregister(surfkit_sugar)


def double(given: Splats) -> Splats:
    return given.with_named({name: value.double() for name, value in given.named().items()})


def anyhow(count: int = 12, kind: str = "gaussian") -> Splats:
    """Random splats in the unit cube, large enough to overlap, in float64."""
    given = double(splats(kind, count))
    return replace(given, scales=3 * given.scales)


def brute_force(given: Splats, place: np.ndarray, rows=None) -> tuple[float, np.ndarray]:
    """Density at one place and its gradient, with inverse covariances."""
    total, slope = 0.0, np.zeros(3)
    for at in range(len(given)) if rows is None else rows:
        w, x, y, z = given.quats[at].numpy()
        turn, scales = Rotation.from_quat([x, y, z, w]).as_matrix(), given.scales[at].numpy()
        inverse = np.linalg.inv(turn @ np.diag(scales**2) @ turn.T)
        away = place - given.means[at].numpy()
        value = float(given.opacities[at]) * math.exp(-0.5 * away @ inverse @ away)
        total, slope = total + value, slope - value * inverse @ away
    return total, slope


def everywhere(given: Splats, places: torch.Tensor) -> torch.Tensor:
    rows = torch.arange(len(given)).expand(len(places), -1)
    return gathered(Ellipsoids.of(given).table(), rows)


def test_the_density_and_its_fall_are_those_of_inverse_covariances():
    given, places = anyhow(), torch.rand(20, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    amount, falls = density(everywhere(given, places), places)
    for at, place in enumerate(places.numpy()):
        value, slope = brute_force(given, place)
        assert float(amount[at]) == pytest.approx(value, rel=1e-10)
        assert falls[at].numpy() == pytest.approx(-slope / value, rel=1e-9)


def test_surfels_have_a_thickness():
    solid = Ellipsoids.of(anyhow(kind="surfel"))
    assert torch.equal(solid.scales[:, 2], THICKNESS * solid.scales[:, :2].amin(1))
    assert torch.equal(solid.normals(), solid.axes[:, :, 2])


def test_densities_above_one_count_as_one_and_keep_a_gradient():
    amount = torch.tensor([0.2, 1.0, 2.5], dtype=torch.float64, requires_grad=True)
    found = capped(amount)
    assert found.tolist() == [0.2, 1.0, 1.0]
    assert torch.autograd.grad(found.sum(), amount)[0].tolist() == [1.0, 1.0, 1 / 2.5]
    apart = deviations(torch.tensor([1.0, math.exp(-0.5), math.exp(-8.0)], requires_grad=True))
    assert apart.tolist() == pytest.approx([0.0, 1.0, 4.0], abs=1e-6)


class Fixed(SurfaceField):
    """The term at places that do not depend on the splats, so that finite differences can tell its gradient."""

    def places(self, given, rows, seed):
        draw = torch.Generator().manual_seed(seed)
        return 0.2 + 0.6 * torch.rand(len(rows), 3, generator=draw, dtype=torch.float64)


@pytest.mark.parametrize("mode", ["density", "sdf"])
def test_the_term_is_its_formula(mode):
    given, term = anyhow(), Fixed(mode=mode, neighbours=5, normals=0.7)
    rows = term._drawn(torch.ones(12, dtype=torch.bool), 0)
    assert len(rows) == 12
    places, near = term.places(given, rows, 0).numpy(), nearest(given.means, 5).numpy()
    beta, wanted = float(given.scales.amin(1).mean()), []
    for row, place in zip(rows.tolist(), places, strict=True):
        w, x, y, z = given.quats[row].numpy()
        normal = Rotation.from_quat([x, y, z, w]).as_matrix()[:, int(given.scales[row].argmin())]
        across = float((place - given.means[row].numpy()) @ normal)
        value, slope = brute_force(given, place, near[row])
        if mode == "density":
            error = abs(min(value, 1) - math.exp(-(across**2) / 2 / beta**2))
        else:
            error = abs(math.sqrt(-2 * math.log(max(min(value, 1), 1e-10))) - abs(across) / beta)
        fall = -slope / np.linalg.norm(slope)
        wanted.append(error + 0.7 * min(np.sum((fall - normal) ** 2), np.sum((fall + normal) ** 2)))
    assert float(term(given)) == pytest.approx(np.mean(wanted), rel=1e-9)


def test_the_gradient_is_that_of_finite_differences():
    given, term = anyhow(6), Fixed(neighbours=6)

    def value(*tensors):
        return term(replace(given, means=tensors[0], quats=tensors[1], scales=tensors[2], opacities=tensors[3]))

    tensors = (given.means, given.quats, given.scales, 0.3 * given.opacities)
    assert torch.autograd.gradcheck(value, [tensor.clone().requires_grad_() for tensor in tensors])


def plane(thickness: float) -> Splats:
    """Opaque discs that overlap on the plane z = 0, so that its density is above 1 everywhere."""
    grid = torch.linspace(-0.5, 0.5, 21)
    xy = torch.cartesian_prod(grid, grid)
    count = len(xy)
    scales = torch.tensor([0.1, 0.1, thickness]).expand(count, 3).contiguous()
    quats = torch.tensor([1.0, 0, 0, 0]).expand(count, 4).contiguous()
    means = torch.cat([xy, torch.zeros(count, 1)], 1)
    return Splats("gaussian", means, quats, scales, torch.full((count,), 0.95), torch.zeros(count, 1, 3))


def moment(given: Splats, depth: torch.Tensor | None = None, index: int = 10_000) -> RegularizerInput:
    """A step with a camera that looks straight down from z = 0.5, at a rendered plane."""
    camera, columns = above(0.0, 0.0), {}
    depth = torch.full((camera.height, camera.width), 0.5) if depth is None else depth
    maps = Maps(torch.zeros(3, *depth.shape), torch.ones_like(depth), depth)
    seen, target = torch.ones(len(given), dtype=torch.bool), Target(View("", camera, None), maps.color, seed=3)
    return RegularizerInput(index, 15_000, target, maps, seen, lambda n: columns.setdefault(n, torch.zeros(len(given))))


@pytest.mark.parametrize("mode", ["density", "sdf"])
def test_gaussians_on_a_plane_have_distance_zero_and_no_loss(mode):
    given = plane(1e-6)
    places = torch.cat([0.3 * torch.rand(50, 2, generator=torch.Generator().manual_seed(0)), torch.zeros(50, 1)], 1)
    amount, _ = density(everywhere(given, places), places)
    assert (amount > 1).all() and not deviations(capped(amount)).any(), "the surface is where the plane is"

    class OnPlane(SurfaceField):
        def places(self, given, rows, seed):
            return super().places(given, rows, seed) * torch.tensor([1.0, 1.0, 0.0])

    loss = OnPlane(mode=mode, normals=0.0, spread=0.3)
    assert float(loss.in_step(given, moment(given))) < 2e-3, "in units of the thickness"
    lifted = moment(given, torch.full((40, 48), 0.49))
    assert (float(loss.in_step(given, lifted)) > 100) == (mode == "sdf"), "the rendered surface is 0.01 above the plane"
    tilted = replace(plane(0.01), quats=torch.tensor([[1.0, 0.3, 0, 0]]).expand(441, 4))
    assert (float(loss.in_step(tilted, moment(given))) > 0.1) == (mode == "density"), "planes of discs are others"


def test_normals_of_a_plane_are_those_of_the_density():
    value, many = [float(SurfaceField(normals=n, samples=400)(plane(1e-4))) for n in (0.0, 1.0)]
    assert many - value < 0.02, "only samples at the rim, and those within the plane, have another direction"


def test_distances_are_those_to_the_rendered_plane_of_pixels_that_count():
    """A camera that is turned about all axes before a plane that is slanted in its frame."""
    given, camera = moment(plane(0.1)), above(0.0, 0.0)
    turn = torch.from_numpy(Rotation.from_euler("xyz", [170.0, 12.0, 25.0], degrees=True).as_matrix())
    pose = camera.world_to_camera.clone()
    pose[:3, :3], pose[:3, 3] = turn, torch.tensor([0.02, -0.01, 0.5])
    camera = replace(camera, world_to_camera=pose)
    depth = (0.5 / (1 - 0.2 * camera.rays()[0])).float()  # z of the plane z - 0.2 x = 0.5, in the frame of the camera
    target = replace(given.target, view=View("", camera, None))
    given = replace(given, maps=replace(given.maps, depth=depth), target=target)
    local = np.array([[0.02, -0.03, 0.4], [-0.03, -0.01, 0.55], [3.0, 0.0, 0.5], [0.0, 0.0, -0.4]])
    places = torch.from_numpy((local - pose[:3, 3].numpy()) @ turn.numpy()).float()
    apart, counts = distances(given, places)
    assert counts.tolist() == [True, True, False, False], "beside the picture, and behind the camera, there is none"
    for at in range(2):
        surface = 0.5 / (1 - 0.2 * local[at, 0] / local[at, 2])
        assert float(apart[at]) == pytest.approx(abs(local[at, 2] - surface), abs=1e-6)
    masked = replace(given, target=replace(target, mask=torch.zeros(40, 48, dtype=torch.bool)))
    assert not distances(masked, places)[1].any()
    assert float(SurfaceField(mode="sdf").in_step(plane(0.01), masked)) == 0.0, "nothing to compare with, and no NaN"


def test_the_entropy_is_its_formula_between_its_steps():
    given, term = splats("gaussian"), OpacityEntropy()
    o = given.opacities.double().requires_grad_()
    value = term(replace(given, opacities=o))
    wanted = [-p * math.log(p) - (1 - p) * math.log(1 - p) for p in o.tolist()]
    assert float(value.detach()) == pytest.approx(np.mean(wanted))
    slope = torch.autograd.grad(value, o)[0]
    assert torch.allclose(slope, (((1 - o) / o).log() / len(o)).detach())
    assert [term.weight_at(i, 15_000) for i in (7_000, 7_001, 9_000, 9_001)] == [0.0, 0.1, 0.1, 0.0]
    assert [SurfaceField().weight_at(i, 15_000) for i in (9_000, 9_001, 15_000)] == [0.0, 0.2, 0.2]


def test_faint_points_go_once():
    points, step = crowd()
    step = replace(step, splats=replace(step.splats, opacities=torch.linspace(0, 1, len(points))))
    assert torch.equal(FaintOnce(at=9_000).edit(points, replace(step, index=9_000)).drop, step.splats.opacities < 0.5)
    assert all(FaintOnce(at=9_000).edit(points, replace(step, index=i)) is None for i in (1, 8_999, 9_001, 18_000))
    count = len(points)
    few = FaintOnce(at=9_000, most=0.3).edit(points, replace(step, index=9_000)).drop
    assert torch.equal(few, torch.arange(count) < int(0.3 * count)), "the faintest first"
    alike = replace(step, index=9_000, splats=replace(step.splats, opacities=torch.full((count,), 0.1)))
    assert int(FaintOnce(at=9_000).edit(points, alike).drop.sum()) == int(0.8 * count), "some are left"


def test_the_nearest_are_those_of_all_distances():
    centres = torch.rand(40, 3, generator=torch.Generator().manual_seed(2))
    apart = torch.cdist(centres.double(), centres.double())
    assert torch.equal(nearest(centres, 7), apart.argsort(1)[:, :7])
    assert nearest(centres[:3], 16).shape == (3, 3)


def test_the_table_is_refreshed_in_time_and_follows_edits():
    means = torch.rand(30, 3, generator=torch.Generator().manual_seed(4))
    points = Points.fresh({"means": means, "opacities": torch.zeros(30)})
    given = replace(moment(plane(0.1)), stat=points.stat, index=700)
    first = remembered(means, given, 4, 500)
    moved = means.flip(1).roll(3, 0)
    assert torch.equal(remembered(moved, replace(given, index=1_199), 4, 500), first), "not yet"
    assert torch.equal(remembered(moved, replace(given, index=1_199), 2, 500), first[:, :2])
    fresh = remembered(moved, replace(given, index=1_200), 4, 500)
    assert torch.equal(fresh, nearest(moved, 4)) and not torch.equal(fresh, first)
    keep = torch.arange(30) % 3 > 0
    fewer = points.take(keep)
    found = remembered(means[keep], replace(given, stat=fewer.stat, index=1_300), 4, 500)
    assert torch.equal(found, nearest(moved[keep], 4))
    more = fewer.append({"means": means[:5], "opacities": torch.zeros(5)})
    now = torch.rand(25, 3)
    assert torch.equal(remembered(now, replace(given, stat=more.stat, index=1_301), 4, 500), nearest(now, 4))
    assert set(more.stat(AT).tolist()) == {1_301.0}


def test_a_stage_that_goes_on_from_a_checkpoint_ends_in_the_same_bits(tmp_path: Path):
    truth = survey(views=4)
    photos = [(truth.exact[view.name].color * 255).round().to(torch.uint8) for view in truth.scene.train]
    terms = {
        "entropy": OpacityEntropy(start=1, until=4),
        "density": SurfaceField(start=4, refresh=5),
        "sdf": SurfaceField(start=6, refresh=5, mode="sdf", normals=0.0),
    }
    stage = Stage(steps=14, densify=None, prune=(FaintOnce(at=8, below=0.09),), regularizers=terms)
    trainer = Trainer(stage, SUGAR.primitive, truth.scene.train, photos, select("cpu")[0])

    def begun():
        draw = torch.Generator().manual_seed(0)
        params = SUGAR.primitive.init(truth.scene.cloud, draw)
        params["opacities"] += torch.randn(len(params["opacities"]), generator=draw)
        return trainer.begin(Points.fresh(params), draw)

    whole = begun()
    losses = [done.losses for done in trainer.run(whole)]
    assert [set(each) - {"l1", "ssim"} for each in (losses[2], losses[5], losses[7])] == [
        {"entropy"}, {"density"}, {"density", "sdf"}
    ]  # fmt: skip
    assert 0 < len(whole.points) < len(truth.scene.cloud.xyz)
    for stop in (7, 11):
        state = begun()
        for done in trainer.run(state):
            if done.index == stop:
                break
        checkpoint.save(tmp_path / "state.safetensors", state)
        again = checkpoint.load(tmp_path / "state.safetensors")
        list(trainer.run(again))
        for name, value in whole.points.params.items():
            assert torch.equal(value, again.points.params[name]), name


@pytest.mark.parametrize("mode", ["density", "sdf"])
def test_points_near_a_plane_move_to_it_and_turn(mode):
    draw, given = torch.Generator().manual_seed(0), plane(0.02)
    start = {
        "means": given.means + 0.01 * torch.randn(given.means.shape, generator=draw),
        "quats": given.quats + 0.1 * torch.randn(given.quats.shape, generator=draw),
        "scales": (given.scales * torch.tensor([0.4, 0.4, 1.0])).log(),
    }
    leaves, rates = {name: value.clone().requires_grad_() for name, value in start.items()}, [3e-4, 3e-3, 5e-3]
    groups = [{"params": [leaf], "lr": rate} for leaf, rate in zip(leaves.values(), rates, strict=True)]
    optimiser, term, about, states = torch.optim.Adam(groups), SurfaceField(mode=mode), moment(given), []
    for seed in range(60):
        now = replace(given, means=leaves["means"], quats=leaves["quats"], scales=leaves["scales"].exp())
        loss = term.in_step(now, replace(about, target=replace(about.target, seed=seed)))
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        solid = Ellipsoids.of(now.detached())
        states.append(
            [float(loss.detach()), float(solid.means[:, 2].abs().mean()), float(solid.normals()[:, 2].abs().mean())]
        )
    first, last = states[0], states[-1]
    assert last[0] < 0.8 * first[0] and last[1] < 0.95 * first[1]
    assert 1 - last[2] < 0.9 * (1 - first[2]), "normals turn to that of the plane"


@pytest.mark.parametrize(
    "part", [OpacityEntropy(), SurfaceField(), SurfaceField(mode="sdf"), FaintOnce(at=9_000, below=0.5)]
)
def test_the_parts_keep_to_the_contract(part):
    check(part)


@pytest.mark.parametrize(
    ("part", "setting"),
    [(OpacityEntropy, {"weight": -1.0}), (SurfaceField, {"spread": 0.0}), (SurfaceField, {"samples": 0}),
     (SurfaceField, {"neighbours": 0}), (FaintOnce, {"below": 1.0}), (FaintOnce, {"at": 0}),
     (FaintOnce, {"most": 0.0})],
)  # fmt: skip
def test_settings_that_make_no_sense_are_refused(part, setting):
    with pytest.raises(BadInput, match=next(iter(setting))):
        part(**setting)


def test_the_recipe_is_whole_and_its_schedule_scales_with_the_steps():
    assert load(type(SUGAR), dump(SUGAR)) == SUGAR
    SUGAR.refuse_unfit()
    short = rescale(SUGAR.pretrain, 1_500 / 15_000)
    entropy, surface = short.regularizers["entropy"], short.regularizers["surface"]
    assert (entropy.start, entropy.until, short.prune[0].at, surface.start, surface.refresh) == (700, 900, 900, 900, 50)
    assert short.densify.until == 700 and short.densify.edits(1_500)
    recipes, rows = surfkit_sugar.surfkit_recipes(), surfkit_sugar.surfkit_rows()["methods"]
    assert [row.recipe for row in rows] == [SUGAR, REFINED] == [recipes["sugar"], recipes["sugar-refined"]]
    assert not rows[0].paper and rows[1].paper["f1"] == 0.377
    first, whole = part_keys(SUGAR), part_keys(REFINED)
    assert first["pretrain"] == whole["pretrain"] and "refine0" in whole, "they have the first phases in common"


def test_new_points_in_an_edit_are_in_the_next_table():
    points = Points.fresh(SUGAR.primitive.init(survey(points=60).scene.cloud, torch.Generator().manual_seed(0)))
    given = replace(moment(plane(0.1)), stat=points.stat, index=3)
    remembered(points.params["means"], given, 4, 500)
    mask = torch.arange(len(points)) < 5
    after = apply(SUGAR.primitive, points, Edit(clone=mask), torch.Generator().manual_seed(0))
    table = remembered(after.params["means"], replace(given, stat=after.stat, index=4), 4, 500)
    assert len(table) == len(after) and (table[:5] >= len(points)).any(), "copies are nearest to their originals"
