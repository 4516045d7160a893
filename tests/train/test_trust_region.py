"""Steps of second order within a trust region: the curvature against exact Jacobians, distances against integrals."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from surfkit.core.check import BadInput
from surfkit.core.codec import dump
from surfkit.core.schedule import LearningRate
from surfkit.losses.base import Target
from surfkit.primitives import Gaussian3D, Surfel2D
from surfkit.primitives.points import Points
from surfkit.raster.api import Maps, Splats
from surfkit.raster.reference import Reference
from surfkit.scene.rotations import numpy_rotations
from surfkit.scene.scene import SparsePoints
from surfkit.train import checkpoint
from surfkit.train.adam import Adam
from surfkit.train.stage import Stage
from surfkit.train.step import view_gradients
from surfkit.train.trust_region import BOUNDS, TrustRegion, axes, probe

from .conftest import looking_down

RADIUS = 1e-3
QUIET = Stage(steps=8, densify=None, sh_every=2, optimizer=TrustRegion(probe_every=3))


@pytest.mark.parametrize("primitive", [Gaussian3D(1), Surfel2D(1)], ids=lambda part: type(part).__name__)
def test_the_mean_of_probes_is_the_exact_diagonal(primitive):
    """Of J^T B J, with the Jacobian of a tiny view by the float64 reference, a row at a time."""
    draw = torch.Generator().manual_seed(1)
    xyz = torch.rand(5, 3, generator=draw) * torch.tensor([0.4, 0.4, 0.05]) - torch.tensor([0.2, 0.2, 0.0])
    cloud = SparsePoints(xyz, torch.randint(0, 256, (5, 3), generator=draw, dtype=torch.uint8))
    leaves = {name: value.double().requires_grad_() for name, value in primitive.init(cloud, draw).items()}
    camera = replace(looking_down(0, 0), fx=8.0, fy=8.0, cx=4.0, cy=3.0, width=8, height=6)
    shape = primitive.activate(leaves, 1)
    render, rows = Reference().render(shape, camera, 0.005), []
    for k in range(3 * 6 * 8):
        cotangent = torch.zeros(3 * 6 * 8, dtype=torch.float64).index_fill(0, torch.tensor([k]), 1.0).view(3, 6, 8)
        by_splats = render.backward(Maps(color=cotangent)).tensors()
        pairs = [(value, by_splats[name]) for name, value in shape.tensors().items() if value.requires_grad]
        values, grads = zip(*pairs, strict=True)
        grads = torch.autograd.grad(values, list(leaves.values()), grads, retain_graph=True)
        rows.append(dict(zip(leaves, grads, strict=True)))
    jacobian = {name: torch.stack([row[name] for row in rows]) for name in leaves}
    photo, keep = torch.rand(3, 6, 8, generator=draw, dtype=torch.float64), torch.arange(8) > 1
    mask = keep.expand(6, 8)
    error = (render.maps.color - photo).abs()[:, mask].mean()
    weight = (mask.double() / (3 * int(mask.sum()) * error)).expand(3, 6, 8).reshape(-1)
    exact = {name: torch.tensordot(weight, rows**2, 1) for name, rows in jacobian.items()}

    def pull(maps):
        return {name: torch.tensordot(maps.color.reshape(-1), rows, 1) for name, rows in jacobian.items()}

    target = Target(SimpleNamespace(), photo, mask=mask)
    seeds = 3_000
    sums = {name: torch.zeros_like(value) for name, value in exact.items()}
    for seed in range(seeds):
        for name, square in probe(SimpleNamespace(maps=render.maps, target=target, seed=seed, pull=pull)).items():
            sums[name] += square / seeds
    for name, value in exact.items():  # a square of signs has a variance of 2 at most; six standard errors
        assert value.abs().max() > 0
        assert ((sums[name] - value).abs() <= 6 * value * (2 / seeds) ** 0.5 + 1e-12).all(), name


def test_what_is_pulled_is_the_product_with_the_jacobian(begin):
    """Of the trainer's own step, by differences: a change of the parameters changes the maps."""
    trainer, state = begin(replace(QUIET, optimizer=Adam()), Gaussian3D(1))
    result = view_gradients(trainer, state)
    draw = torch.Generator().manual_seed(5)
    cotangent = torch.randn(result.render.maps.color.shape, generator=draw)
    pulled, camera = result.pull(Maps(color=cotangent)), result.target.view.camera
    assert result.pull(Maps(color=cotangent))["means"].equal(pulled["means"]), "it can be asked again"
    double = {name: value.double() for name, value in state.points.params.items()}
    for name in ("means", "scales", "opacities", "sh0"):
        way = torch.randn(double[name].shape, generator=draw, dtype=torch.float64)
        ends = []
        for sign in (1, -1):
            moved = double | {name: double[name] + sign * 1e-6 * way}
            shown = Reference().render(trainer.primitive.activate(moved, 0), camera, trainer.stage.near).maps.color
            ends.append(float((shown * cotangent).sum()))
        assert float((pulled[name] * way).sum()) == pytest.approx((ends[0] - ends[1]) / 2e-6, rel=2e-3), name


def shapes(flat: bool, count: int = 60) -> Splats:
    """Random splats of which no axis is thinner than a tenth of the longest, unless `flat`."""
    draw = torch.Generator().manual_seed(2)
    scales = 0.02 * (0.12 + 0.88 * torch.rand(count, 2 if flat else 3, generator=draw))
    quats = torch.randn(count, 4, generator=draw)
    opacities = 0.02 + 0.96 * torch.rand(count, generator=draw)
    return Splats("surfel" if flat else "gaussian", torch.rand(count, 3, generator=draw), quats, scales, opacities,
                  torch.zeros(count, 1, 3))  # fmt: skip


def covariance(sigma, quats):
    turn = numpy_rotations(np.asarray(quats, float))
    return turn @ (np.asarray(sigma, float)[:, :, None] ** 2 * turn.transpose(0, 2, 1))


def distance(mean1, cov1, mean2, cov2):
    """(N,) squared Hellinger distances of Gaussians, float64, by determinants."""
    middle, shift = (cov1 + cov2) / 2, np.asarray(mean2, float) - np.asarray(mean1, float)
    det = np.linalg.det
    overlap = (det(cov1) * det(cov2)) ** 0.25 / det(middle) ** 0.5
    return 1 - overlap * np.exp(-np.einsum("ni,nij,nj->n", shift, np.linalg.inv(middle), shift) / 8)


def test_the_distance_of_the_tests_against_an_integral():
    """1 - the integral of the root of two densities, on a grid in the plane."""
    x = np.stack(np.meshgrid(*[np.linspace(-9, 9, 601)] * 2, indexing="ij"), -1)
    turn = np.array([[np.cos(0.7), -np.sin(0.7)], [np.sin(0.7), np.cos(0.7)]])
    means, covs = np.array([[0, 0], [0.5, -0.3]]), np.array([np.diag([1.0, 0.25]), turn @ np.diag([1.2, 0.3]) @ turn.T])
    densities = [
        np.exp(-np.einsum("xyi,ij,xyj->xy", x - m, np.linalg.inv(c), x - m) / 2) / (2 * np.pi * np.linalg.det(c) ** 0.5)
        for m, c in zip(means, covs, strict=True)
    ]
    overlap = np.sqrt(densities[0] * densities[1]).sum() * 0.03**2
    assert distance(means[:1], covs[:1], means[1:], covs[1:])[0] == pytest.approx(1 - overlap, rel=1e-6)


def moved(splats: Splats, name: str, old: torch.Tensor, size: float) -> torch.Tensor:
    """Raw values after a change in random directions, of numbers at least as large as `size`."""
    change = torch.randn(old.shape, generator=torch.Generator().manual_seed(3))
    return BOUNDS[name](old, size * (change + change.sign()), splats, RADIUS)


@pytest.mark.parametrize("flat", [False, True])
@pytest.mark.parametrize("name", ["means", "scales", "quats"])
def test_no_splat_changes_by_more_than_the_radius(name, flat):
    """Large steps end at the bound, small ones are taken as they are; discs count as a tenth as thick as wide."""
    splats = shapes(flat)
    sigma = axes(splats)
    raw = {"means": splats.means, "scales": splats.scales.log(), "quats": splats.quats}
    cov = covariance(sigma, splats.quats)
    small = moved(splats, name, raw[name], 1e-7)
    assert (small - raw[name]).abs().max() < 1e-6 and not torch.equal(small, raw[name])
    after = moved(splats, name, raw[name], 10.0)
    if name == "means":
        found = distance(splats.means, cov, after, cov)
        assert np.allclose(found, RADIUS, rtol=1e-3)
    elif name == "quats":
        found = distance(splats.means, cov, splats.means, covariance(sigma, after))
        assert found.max() < RADIUS * 1.001 and np.median(found) > RADIUS / 20
    else:
        for axis in range(after.shape[1]):  # each by itself
            wide = splats.scales.clone()
            wide[:, axis] = after[:, axis].exp()
            one, two = (
                covariance(torch.cat([s, torch.full((60, 3 - s.shape[1]), 0.01)], 1), splats.quats)
                for s in (splats.scales, wide)
            )
            assert np.allclose(distance(splats.means, one, splats.means, two), RADIUS, rtol=1e-3)


def test_a_turn_in_the_plane_of_the_longest_and_the_shortest_axis_ends_at_the_radius():
    splats = shapes(False)
    turns = torch.tensor([[1.0, 0, 0, 0]]).repeat(60, 1)
    splats = replace(splats, quats=turns, scales=torch.tensor([[0.02, 0.01, 0.003]]).repeat(60, 1))
    change = torch.tensor([[0.0, 0, 1.0, 0]]).repeat(60, 1)  # about y: x, the longest, towards z, the shortest
    after, cov = BOUNDS["quats"](turns, change, splats, RADIUS), covariance(splats.scales, turns)
    assert np.allclose(distance(splats.means, cov, splats.means, covariance(splats.scales, after)), RADIUS, rtol=1e-3)


def test_opacities_and_colours():
    splats = shapes(False)
    old = splats.opacities.logit()
    for size in (1e-7, 10.0):
        after = moved(splats, "opacities", old, size).double().sigmoid()
        before = old.double().sigmoid()
        found = 1 - (before * after).sqrt() - ((1 - before) * (1 - after)).sqrt()
        assert found.max() <= RADIUS * 1.001
        assert size < 1 or found.min() > RADIUS * 0.99
    half, tint = torch.zeros(60), torch.zeros(60, 1, 3)
    change = (BOUNDS["opacities"](half, torch.full((60,), 9.0), splats, RADIUS).double().sigmoid() - 0.5)[0]
    colour = 0.28209479 * moved(splats, "sh0", tint, 9e9).abs()
    assert torch.allclose(colour, torch.full_like(colour, float(change)), rtol=2e-3)
    rest = 0.28209479 * moved(splats, "sh_rest", torch.zeros(60, 3, 3), 9e9).abs()
    assert rest.max() < 0.06 * colour.max()


def test_a_newton_step_that_fits_is_taken():
    """A squared error in one number, with its curvature: relaxation 1 ends at the minimum, but for the damping."""
    points = Points.fresh({"means": torch.zeros(4, 3)})
    splats = replace(shapes(False, 4), scales=torch.full((4, 3), 1e3))
    curvature, minimum = torch.tensor([1.0, 4.0, 25.0, 100.0])[:, None], torch.tensor([[1.0, -2.0, 0.5]])
    given = SimpleNamespace(
        index=1, steps=10, rates={"means": 1.0}, rows=torch.arange(4), seed=0, splats=splats,
        maps=Maps(color=torch.zeros(3, 2, 2)), target=Target(SimpleNamespace(), torch.ones(3, 2, 2)),
        pull=lambda maps: {"means": curvature.sqrt().expand(4, 3)},
    )  # fmt: skip
    mean = float(curvature.mean())
    TrustRegion(relaxation=1.0).step(points, {"means": -curvature * minimum}, given)
    first = (curvature + mean) / 2  # a first probe is half of all points together
    assert torch.allclose(points.params["means"], minimum * curvature / (first + 0.1 * mean), rtol=1e-4)


def test_it_raises_psnr_and_goes_on_from_a_checkpoint_with_the_same_bits(begin, tmp_path):
    from .test_stage import scored

    ends = []
    for threads in (1, 2):
        torch.set_num_threads(threads)
        trainer, state = begin(replace(QUIET, steps=40))
        before = scored(trainer, state)
        for done in trainer.run(state):
            if done.index == 17:  # between two probes
                checkpoint.save(tmp_path / "c.safetensors", state)
        assert scored(trainer, state) > before + 3
        ends.append(state)
    ends.append(checkpoint.load(tmp_path / "c.safetensors"))
    list(begin(replace(QUIET, steps=40))[0].run(ends[2]))
    for other in ends[1:]:
        for group in ("params", "exp_avg", "exp_avg_sq", "stats"):
            one, two = getattr(ends[0].points, group), getattr(other.points, group)
            assert one.keys() == two.keys() and all(torch.equal(one[name], two[name]) for name in one), group


def test_a_rate_of_0_keeps_a_parameter(begin):
    trainer, state = begin(QUIET)
    trainer = replace(trainer, stage=replace(QUIET, rates={"opacities": LearningRate(0.0)}))
    before = state.points.params["opacities"].clone()
    list(trainer.run(state))
    assert state.points.params["opacities"].sort().values.equal(before.sort().values), "points are put in order"


@pytest.mark.parametrize(
    "settings", [{"radius": 0.0}, {"last_radius": 0.5}, {"relaxation": 1.5}, {"probe_every": 0}], ids=str
)
def test_settings_that_make_no_sense(settings):
    name = next(iter(settings))
    with pytest.raises(BadInput, match=rf"trust-region.*{name} "):
        TrustRegion(**settings)
    assert name in dump(TrustRegion())


def test_parameters_that_it_does_not_know_are_refused():
    points = Points.fresh({"means": torch.zeros(2, 3), "weights": torch.zeros(2, 4)})
    with pytest.raises(BadInput, match="'weights' of this primitive; choose optimizer:adam"):
        TrustRegion().step(points, points.params, SimpleNamespace(index=1))
