"""Merged splats are the moments of those that they stand for, and look like them from afar."""

from dataclasses import dataclass, replace

import numpy as np
import pytest
import torch

from surfkit import Activation, Column, Primitive, standard_columns
from surfkit.compress.levels import MergedLevels
from surfkit.compress.levels.cut import cut, depth_for
from surfkit.compress.levels.merge_cost import MergeCost, groups
from surfkit.compress.levels.merged_levels import blocks
from surfkit.compress.levels.moments import Shapes, merged_model
from surfkit.core.check import BadInput
from surfkit.primitives import Flat3D, Gaussian3D, Surfel2D
from surfkit.primitives.init import seeds
from surfkit.primitives.model import SplatModel
from surfkit.raster.api import ALPHA_MAX, Splats
from surfkit.raster.select import select
from surfkit.scene.camera import Camera
from surfkit.scene.rotations import numpy_rotations
from surfkit.scene.scene import SparsePoints
from surfkit.testing.inputs import lod_input

LABELS = np.array([0, 1, 0, 2, 1, 0])


def random_model(primitive, count=6, seed=0, opacity=0.3):
    draw = torch.Generator().manual_seed(seed)
    cloud = SparsePoints(torch.rand(count, 3, generator=draw), torch.randint(0, 256, (count, 3), generator=draw).byte())
    params = primitive.init(cloud, draw)
    params["quats"] = torch.randn(count, 4, generator=draw)
    params["scales"] = torch.randn(params["scales"].shape, generator=draw).mul(0.3).sub(3)
    params["sh_rest"] = torch.randn(params["sh_rest"].shape, generator=draw)
    params = primitive.with_opacities(params, opacity * (0.5 + 0.5 * torch.rand(count, generator=draw)))
    return SplatModel(primitive, params, primitive.sh_degree)


def moments(splats, weights):
    """Total opacity times area, mean and covariance of a mixture, written out point by point."""
    turns = numpy_rotations(splats.quats.double().numpy())
    mass, mean = 0.0, np.zeros(3)
    total = weights.sum()
    for at in range(len(splats)):
        s = np.append(splats.scales[at].double().numpy(), 0.0)
        mass += float(splats.opacities[at]) * (s[0] * s[1] + s[1] * s[2] + s[2] * s[0])
        mean += weights[at] / total * splats.means[at].double().numpy()
    covariance = np.zeros((3, 3))
    for at in range(len(splats)):
        s = np.append(splats.scales[at].double().numpy(), 0.0)[:3]
        off = splats.means[at].double().numpy() - mean
        covariance += weights[at] / total * (turns[at] @ np.diag(s**2) @ turns[at].T + np.outer(off, off))
    return mass, mean, covariance


@pytest.mark.parametrize("primitive", [Surfel2D(sh_degree=1), Gaussian3D(sh_degree=1)], ids=["surfels", "gaussians"])
def test_moments_are_kept(primitive):
    model, weights = random_model(primitive), np.linspace(1, 2, 6)
    merged = merged_model(model, LABELS, weights).splats
    assert len(merged) == 3
    for label in range(3):
        rows = torch.from_numpy(LABELS == label)
        mass, mean, covariance = moments(model.splats.take(rows), weights[rows.numpy()])
        got = moments(merged.take(torch.tensor([label])), np.ones(1))
        assert got[0] == pytest.approx(mass, rel=1e-4), "opacity times area"
        assert np.allclose(got[1], mean, atol=1e-6)
        if primitive == Surfel2D(sh_degree=1):  # all but the spread across the plane
            values, axes = np.linalg.eigh(covariance)
            covariance = axes[:, 1:] @ np.diag(values[1:]) @ axes[:, 1:].T
        assert np.allclose(got[2], covariance, atol=1e-6)


def test_colours_are_weighted_means():
    model, weights = random_model(Surfel2D(sh_degree=1)), np.array([1.0, 1, 3, 1, 1, 1e-9])
    merged = merged_model(model, LABELS, weights)
    for name in ("sh0", "sh_rest"):
        before = model.params[name].double()
        wanted = (before[0] + 3 * before[2]) / 4
        assert torch.allclose(merged.params[name][0].double(), wanted, atol=1e-6)


def test_a_flat_third_axis_follows_the_others():
    merged = merged_model(random_model(Flat3D(sh_degree=0)), LABELS, np.ones(6)).splats
    assert torch.allclose(merged.scales[:, 2], 1e-3 * merged.scales[:, :2].amin(1))


def test_one_splat_alone_stays_as_it_is():
    model = random_model(Gaussian3D(sh_degree=1))
    same = merged_model(model, np.arange(6), np.ones(6)).splats
    assert torch.allclose(same.means, model.splats.means) and torch.allclose(same.sh, model.splats.sh)
    assert np.allclose(Shapes.of(same).covariances, Shapes.of(model.splats).covariances, atol=1e-8)
    assert torch.allclose(same.opacities, model.splats.opacities, atol=1e-5)


def test_opaque_splats_in_one_place_stay_opaque():
    """Their overlap is hidden: half of the excess, as a factor, is area."""
    model = random_model(Surfel2D(sh_degree=0), 2)
    twice = {name: value[:1].repeat(2, *[1] * (value.dim() - 1)) for name, value in model.params.items()}
    twice = model.primitive.with_opacities(twice, torch.full((2,), ALPHA_MAX))
    merged = merged_model(replace(model, params=twice), np.zeros(2, int), np.ones(2)).splats
    assert float(merged.opacities) == pytest.approx(ALPHA_MAX, abs=1e-5)
    area = float(merged.scales.prod() / model.splats.scales[0].prod())
    assert area == pytest.approx(2**0.5, rel=1e-4)


def plane(side=16, gap=0.1):
    """Surfels of one colour on a tilted plane, a gap apart, and the plane's normal."""
    at = gap * torch.stack(torch.meshgrid(torch.arange(side), torch.arange(side), indexing="ij"), -1).view(-1, 2)
    primitive = Surfel2D(sh_degree=0)
    turn = torch.tensor([0.9, 0.3, -0.2, 0.1])
    turns = torch.from_numpy(numpy_rotations(turn[None].double().numpy()))[0]
    xyz = at.double() @ turns[:, :2].T
    cloud = SparsePoints(
        xyz.float(), torch.full((len(xyz), 3), 200, dtype=torch.uint8), size=torch.full((len(xyz),), 0.7 * gap)
    )
    params = primitive.init(cloud, torch.Generator().manual_seed(0)) | {"quats": turn.repeat(len(xyz), 1)}
    return SplatModel(primitive, primitive.with_opacities(params, torch.full((len(xyz),), 0.8))), turns[:, 2]


def looking(model, normal, distance, size=64):
    """A camera straight above the middle of a plane."""
    centre = model.splats.means.double().mean(0) + distance * normal
    x = torch.linalg.cross(normal, torch.tensor([0.0, 0.0, 1.0]).double())
    x /= x.norm()
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, :3] = torch.stack([x, torch.linalg.cross(-normal, x), -normal])
    pose[:3, 3] = -pose[:3, :3] @ centre
    return Camera(pose, size, size, size / 2, size / 2, size, size)


def test_a_plane_of_equal_surfels_stays_the_plane():
    model, normal = plane()
    given = replace(lod_input(), model=model)
    camera = looking(model, normal, 3.0)
    tree = MergedLevels(tile_points=64, steps=0).build(replace(given, views=[replace(given.views[0], camera=camera)]))
    assert [len(level) for level in tree.levels] == [256, 128, 64]
    draws = select("cpu")[0]
    drawn = [draws.render(level.splats, camera, 0.01).maps for level in tree.levels]
    inner = (slice(28, 36), slice(28, 36))
    for level, maps in zip(tree.levels[1:], drawn[1:], strict=True):
        heights = level.splats.means.double() @ normal
        assert float(heights.max() - heights.min()) < 1e-6
        axes = torch.from_numpy(numpy_rotations(level.splats.quats.double().numpy()))[:, :, 2]
        assert float((axes @ normal).abs().min()) > 1 - 1e-6
        assert float(maps.alpha[inner].min()) > 0.85, "no holes"
        assert float((maps.expected_depth() - 3.0)[inner].abs().max()) < 1e-4


def psnr(one, two):
    return float(-10 * (one - two).square().mean().log10())


def test_from_afar_a_merged_level_beats_dropping_every_second_point():
    model, normal = plane(side=32, gap=0.05)
    colors = torch.rand(len(model), 1, 3, generator=torch.Generator().manual_seed(1))
    model = replace(model, params=model.params | {"sh0": colors})
    given, camera = lod_input(), looking(model, normal, 4.0)
    given = replace(given, model=model, views=[replace(given.views[0], camera=camera)])
    tree = MergedLevels(tile_points=512, steps=0).build(given)
    draws = select("cpu")[0]
    half = model.splats.take(torch.arange(0, len(model), 2))
    full, merged, dropped = (
        draws.render(splats, camera, 0.01, False, False).maps.color
        for splats in (model.splats, tree.levels[1].splats, half)
    )
    assert len(tree.levels[1]) == len(half)
    assert psnr(full, merged) > psnr(full, dropped) + 6


def test_a_refined_level_is_nearer_to_the_full_model(tmp_path):
    given = replace(lod_input(count=800), folder=tmp_path)
    plain, taught = (MergedLevels(tile_points=400, steps=steps).build(given) for steps in (0, 60))
    draws = given.rasterizer

    def loss(level):
        pictures = [
            [draws.render(m.splats, v.camera, 0.01).maps.color for v in given.views] for m in (given.model, level)
        ]
        return float(sum((one - two).abs().mean() for one, two in zip(*pictures, strict=True)))

    assert loss(taught.levels[1]) < 0.8 * loss(plain.levels[1])
    assert [len(level) for level in taught.levels] == [800, 400]


def test_counts_halve_in_every_block_and_each_point_has_one_group():
    draw = np.random.default_rng(0)
    means, colors = draw.random((501, 3)), draw.random((501, 3))
    labels = groups(MergeCost(means, draw.random(501) + 0.1, colors, draw.normal(size=(501, 3))), 251)
    assert labels.shape == (501,) and set(labels) == set(range(251))


def test_alike_neighbours_are_merged_first():
    """Of four pairs side by side, the two of one colour each."""
    means = np.array([[0.0, 0, 0], [1, 0, 0], [20, 0, 0], [21, 0, 0], [40, 0, 0], [41, 0, 0], [60, 0, 0], [61, 0, 0]])
    colors = np.array([[0.0], [0], [0], [1], [1], [1], [1], [0]]).repeat(3, 1)
    labels = groups(MergeCost(means, np.ones(8), colors, np.zeros((8, 3))), 6)
    assert labels.tolist() == [0, 0, 1, 2, 3, 3, 4, 5]


def test_points_of_little_weight_are_merged_first():
    means = np.array([[0.0, 0, 0], [1, 0, 0], [20, 0, 0], [21, 0, 0]])
    weights = np.array([1.0, 1.0, 1.0, 1e-3])
    assert groups(MergeCost(means, weights, np.zeros((4, 3)), np.zeros((4, 3))), 3).tolist() == [0, 1, 2, 2]


def test_points_in_one_place_can_be_merged():
    labels = groups(MergeCost(np.zeros((40, 3)), np.ones(40), np.zeros((40, 3)), np.zeros((40, 3))), 20)
    assert set(labels) == set(range(20))


def test_the_cut_is_even_and_its_parts_lie_apart():
    means = np.random.default_rng(0).normal(size=(1000, 3))
    order, bounds = cut(means, 3)
    assert sorted(order) == list(range(1000)) and [len(ends) - 1 for ends in bounds] == [1, 2, 4, 8]
    assert set(np.diff(bounds[3])) == {125}
    for depth in range(3):
        assert np.array_equal(bounds[depth + 1][::2], bounds[depth])
        for first, middle, last in zip(bounds[depth], bounds[depth + 1][1::2], bounds[depth][1:], strict=False):
            one, other = means[order[first:middle]], means[order[middle:last]]
            assert any(one[:, axis].max() <= other[:, axis].min() for axis in range(3))
    assert [depth_for(n, 100) for n in (1, 100, 101, 200, 201, 100_000)] == [0, 0, 1, 1, 2, 10]


def test_parents_of_blocks():
    limits = [np.array([0, 4, 8, 12, 16]), np.array([0, 4, 8]), np.array([0, 4])]
    found = blocks(limits, [np.zeros(4), np.ones(2), np.full(1, 2.0)])
    assert [(block.level, block.first, block.parent) for block in found] == [
        (2, 0, -1), (1, 0, 0), (1, 4, 0), (0, 0, 1), (0, 4, 1), (0, 8, 2), (0, 12, 2),
    ]  # fmt: skip


def test_the_error_is_the_distance_to_what_stands_for_a_point():
    """One pair of unlike weights in each block: merged at the mean, the nearest to the heavier."""
    model, normal = plane(side=4, gap=0.1)
    given = replace(lod_input(), model=model)
    camera = looking(model, normal, 3.0)
    tree = MergedLevels(tile_points=2, steps=0).build(replace(given, views=[replace(given.views[0], camera=camera)]))
    pairs = tree.blocks.level == 1
    assert pairs.sum() == 4 and np.all(tree.blocks.error[tree.blocks.level == 0] == 0)
    assert np.all((tree.blocks.error[pairs] > 0.03) & (tree.blocks.error[pairs] < 0.1))
    assert tree.blocks.error[0] == tree.blocks.error.max()


def test_the_same_bits_on_any_number_of_threads(tmp_path):
    before = torch.get_num_threads()
    trees = []
    try:
        for threads in (1, 2):
            torch.set_num_threads(threads)
            folder = tmp_path / str(threads)
            folder.mkdir()
            trees.append(MergedLevels(tile_points=100, steps=5).build(replace(lod_input(), folder=folder)))
    finally:
        torch.set_num_threads(before)
    for one, two in zip(trees[0].levels, trees[1].levels, strict=True):
        assert all(torch.equal(value, two.params[name]) for name, value in one.params.items())
    assert np.array_equal(trees[0].blocks.error, trees[1].blocks.error)


def test_levels_that_an_interrupted_call_has_kept_are_not_made_again(tmp_path, monkeypatch):
    given, lod = replace(lod_input(), folder=tmp_path), MergedLevels(tile_points=100, steps=5)
    whole = lod.build(given)
    (tmp_path / "level2.safetensors").write_bytes(b"damaged")
    from surfkit.compress.levels import refine_levels as refine

    made = []
    once = refine._optimised
    monkeypatch.setattr(refine, "_optimised", lambda *args: made.append(args[4]) or once(*args))
    again = lod.build(given)
    assert made == [2]
    assert all(torch.equal(v, again.levels[2].params[n]) for n, v in whole.levels[2].params.items())


DENSITY = Activation(lambda raw: 1 - torch.exp(-torch.exp(raw)), lambda value: torch.log(-torch.log1p(-value)))


@dataclass(frozen=True)
class Fog(Primitive):
    """Discs whose opacity is 1 - exp(-exp(x)), with a temperature."""

    sh_degree: int = 0

    def columns(self):
        more = {
            "opacities": Column((), 0.02, DENSITY),
            "heat": Column((2,), 0.1),
            "glow": Column((3,), 0.1, shared=True),
        }
        return standard_columns(2, self.sh_degree) | more

    def init(self, cloud, generator):
        heat, glow = torch.arange(2.0 * len(cloud.xyz)).view(-1, 2), torch.zeros(3)
        turns = torch.randn(len(cloud.xyz), 4, generator=generator)
        return seeds(self.columns(), cloud) | {"quats": turns, "heat": heat, "glow": glow}

    def activate(self, params, degree):
        opacities = DENSITY.value(params["opacities"])
        return Splats("surfel", params["means"], params["quats"], params["scales"].exp(), opacities, params["sh0"])


@dataclass(frozen=True)
class Balls(Fog):
    """No rotations."""

    def columns(self):
        return {name: column for name, column in standard_columns(1, 0).items() if name != "quats"}


@dataclass(frozen=True)
class Shifted(Fog):
    """Drawn elsewhere than its column says."""

    def activate(self, params, degree):
        return replace(Fog.activate(self, params, degree), means=params["means"] + 1)


def test_columns_of_strangers(monkeypatch):
    monkeypatch.setattr("surfkit.compress.levels.moments.name_of", lambda part: type(part).__name__.lower())
    lod = MergedLevels()
    lod.refuse_unfit(Fog())
    places = SparsePoints(torch.rand(4, 3), torch.zeros(4, 3, dtype=torch.uint8), opacity=torch.full((4,), 0.2))
    model = SplatModel(Fog(), Fog().init(places, torch.Generator().manual_seed(0)))
    merged = merged_model(model, np.array([0, 0, 1, 1]), np.array([1.0, 3, 1, 1]))
    assert merged.params["heat"].tolist() == [[1.5, 2.5], [5.0, 6.0]] and merged.params["glow"].shape == (3,)
    assert 0 < float(merged.splats.opacities.max()) < 1
    with pytest.raises(BadInput, match=r"balls: .*quats is not .*lod:prune"):
        lod.refuse_unfit(Balls())
    with pytest.raises(BadInput, match="column means is not"):
        lod.refuse_unfit(Shifted())


def test_wrong_settings():
    with pytest.raises(BadInput, match="lod.tile_points is 1"):
        MergedLevels(tile_points=1)
    with pytest.raises(BadInput, match="lod.steps is -1"):
        MergedLevels(steps=-1)
