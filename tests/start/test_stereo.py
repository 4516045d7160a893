"""Points of depth maps: on the surface, even, as many as wanted, and the sparse ones only where there are none."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial import cKDTree
from torch.nn.functional import normalize

from surfkit.core.check import BadInput
from surfkit.core.events import Warned
from surfkit.core.registry import components
from surfkit.io.datasets.depth_prior import DepthPrior
from surfkit.scene.scene import SparsePoints
from surfkit.start.base import Start, StartInput
from surfkit.start.depth_points import normals_of
from surfkit.start.simple_starts import RandomStart, SparseStart
from surfkit.start.splat_start import SplatStart
from surfkit.start.stereo_start import StereoStart, pixel_size
from surfkit.start.voxels import Samples, VoxelAccumulator, apart, thin, thin_to
from surfkit.testing.synthetic import SURFACES, Flight, photograph


@pytest.fixture(scope="module")
def farm():
    """A grid of photographs of a ground with a box and a sphere, of which all is known."""
    return photograph(Flight(kind="grid", views=9, width=160, height=120, points=600, test_every=0))


def known(farm, normals=True, spoilt=None, **changes):
    """What a start is given, with exact priors."""
    priors = []
    for at, view in enumerate(farm.scene.train):
        exact = farm.exact[view.name]
        inverse = torch.where(exact.depth > 0, 1 / exact.depth, 0).float()
        prior = DepthPrior(inverse, (inverse > 0).float(), 0.7, exact.normal.float() if normals else None)
        priors.append(spoilt(at, prior) if spoilt else prior)
    photos = [(farm.exact[view.name].color * 255).round().to(torch.uint8) for view in farm.scene.train]
    return replace(StartInput(farm.scene, photos, None, priors, torch.Generator().manual_seed(0)), **changes)


def surface(farm, xyz):
    """Distances to the true surface, metres, and true normals there (the gradient of the distance)."""
    places = farm.scene.frame.to_input(np.asarray(xyz, np.float64))
    each = np.stack([shape.distance(places) for shape in SURFACES])
    return each.min(0), each.argmin(0), places


def metres(farm, local):
    return local / farm.scene.frame.scale


def test_registered_names():
    known = {"sparse": SparseStart, "stereo": StereoStart, "random": RandomStart, "splats": SplatStart}
    assert known.items() <= components(Start).items(), "packages may offer more"


def test_sparse_is_the_cloud_of_the_scene(farm):
    assert SparseStart().cloud(known(farm)) is farm.scene.cloud
    assert SparseStart().expected(7, 100) == 7


@pytest.mark.parametrize("normals", [True, False])
def test_points_lie_on_the_surface_with_its_normals_and_colours(farm, normals):
    start = StereoStart(spacing_px=2.0)
    fused = start.fused(known(farm, normals))
    distance, which, places = surface(farm, fused.xyz)
    pixel = metres(farm, pixel_size(farm.scene, known(farm).priors[0]))
    assert len(fused) > 3_000
    assert np.median(distance[which == 0]) < 1e-4 and (distance < 0.05 * pixel).mean() > 0.9
    assert distance.max() < 3 * pixel  # means over an edge
    ball = SURFACES[2]
    true = np.zeros_like(places)
    true[which == 0] = (0, 0, 1)
    true[which == 2] = ((places - ball.centre) / ball.radius)[which == 2]
    away = (places[:, 2] > 0.3) | (np.abs(places[:, 0] + 4) > 4)  # not on the box, nor at its foot
    rows = (which != 1) & away
    cosine = (fused.normals[rows] * true[rows]).sum(1)
    assert np.median(cosine) > 0.9999 and (cosine > 0.99).mean() > 0.9
    looked = known(farm)
    for at, view in enumerate(farm.scene.train[:3]):  # where a photograph shows a point, it has the point's colour
        pixels = view.camera.project(torch.from_numpy(fused.xyz)).numpy()
        inside = (pixels[:, 0] > 1) & (pixels[:, 0] < 159) & (pixels[:, 1] > 1) & (pixels[:, 1] < 119)
        x, y = pixels[inside, :2].astype(int).T
        seen = np.abs(1 / looked.priors[at].inverse[y, x].numpy() - pixels[inside, 2]) < 0.01
        shown = looked.photos[at][:, y, x].T.numpy()[seen]
        assert seen.sum() > 500 and np.median(np.abs(shown - fused.rgb[inside][seen])) < 3


def test_slopes_of_a_plane_are_its_normal_exactly(farm):
    view = farm.scene.train[4]
    exact = farm.exact[view.name]
    found = normals_of(view.camera, (1 / exact.depth).float())
    has_any = found.abs().sum(0) > 0
    level = (exact.normal * exact.normal[:, :1, :1]).sum(0) > 1 - 1e-9  # ground and roof
    around = [level.roll(shift, dim) for shift in (-1, 1) for dim in (0, 1)]
    plane = has_any & level & torch.stack(around).all(0)
    assert plane.sum() > 2_000 and not has_any[0].any() and not has_any[:, -1].any()
    assert ((found * exact.normal).sum(0)[plane] > 1 - 1e-5).all()


@pytest.mark.parametrize("wanted", [150, 1_000, 6_000])
def test_as_many_points_as_wanted_evenly(farm, wanted):
    fused = StereoStart(points=wanted).fused(known(farm))
    assert 0.98 * wanted <= len(fused) <= wanted
    near = cKDTree(fused.xyz).query(fused.xyz, k=2)[0][:, 1] / fused.size
    assert near.min() >= 0.5 and np.median(near) > 0.6 and np.quantile(near, 0.99) < 2
    exact = known(farm).priors[0].inverse  # every place that a map shows has a point near by
    view = farm.scene.train[0]
    places = view.camera.rays(torch.float64) / exact
    world = (view.camera.world_to_camera[:3, :3].T @ (places.flatten(1) - view.camera.world_to_camera[:3, 3:])).T
    gap = cKDTree(fused.xyz).query(world.numpy())[0] / fused.size.max()
    assert gap.max() < 2.5


def test_auto_is_so_many_pixels_apart_and_at_most_so_many(farm):
    given = known(farm)
    three, six = (StereoStart(spacing_px=px).fused(given) for px in (3.0, 6.0))
    assert 3 < len(three) / len(six) < 5
    near = cKDTree(three.xyz).query(three.xyz, k=2)[0][:, 1]
    assert 0.6 < np.median(near) / (3 * pixel_size(farm.scene, given.priors[0])) < 1.1
    assert 0.98 * 500 <= len(StereoStart(most=500).fused(given)) <= 500


def test_sparse_points_only_where_depth_maps_have_none(farm):
    """The maps know nothing of what is north of the middle."""

    def half(at, prior):
        view = farm.scene.train[at]
        places = view.camera.rays(torch.float64) / prior.inverse
        shift = view.camera.world_to_camera[:3, 3:]
        world = (view.camera.world_to_camera[:3, :3].T @ (places.flatten(1) - shift)).view(3, *prior.inverse.shape)
        return replace(prior, confidence=torch.where(world[1] < 0, prior.confidence, 0.2))

    start = StereoStart(points=2_000)
    cloud, stereo = start.cloud(known(farm, spoilt=half)), start.fused(known(farm, spoilt=half))
    sparse = farm.scene.cloud
    assert (stereo.xyz[:, 1] < 0.01).all()
    assert torch.equal(cloud.xyz[: len(stereo)], torch.from_numpy(stereo.xyz).float())
    added = cloud.xyz[len(stereo) :]
    assert 0.8 < len(added) / float((sparse.xyz[:, 1] > 0).sum()) < 1  # but for two voxels along the border
    assert cKDTree(stereo.xyz).query(added.numpy())[0].min() > 2 * stereo.size.min()
    assert cloud.opacity[: len(stereo)].unique() == 0.5 and (cloud.opacity[len(stereo) :] == 0.1).all()
    assert torch.allclose(cloud.normals.norm(dim=1), torch.ones(len(cloud.xyz))) and cloud.rgb.dtype == torch.uint8
    for own, share in ((slice(None, len(stereo)), 0.65), (slice(len(stereo), None), 4.0)):  # each among its own kind
        near = cKDTree(cloud.xyz[own].numpy()).query(cloud.xyz[own].numpy(), k=4)[0][:, 1:]
        np.testing.assert_allclose(cloud.size[own].numpy(), share * np.sqrt((near**2).mean(1)), rtol=1e-4)
    again = start.cloud(known(farm, spoilt=half))
    assert all(torch.equal(value, vars(again)[name]) for name, value in vars(cloud).items() if torch.is_tensor(value))


def test_maps_may_show_all_sparse_points(farm):
    given = known(farm)
    stereo = StereoStart(points=2_000).fused(given)
    some = torch.from_numpy(stereo.xyz[:5]).float()
    for count in (5, 0):
        cloud = SparsePoints(some[:count], torch.zeros(count, 3, dtype=torch.uint8))
        begun = StereoStart(points=2_000).cloud(replace(given, scene=replace(given.scene, cloud=cloud)))
        assert len(begun.xyz) == len(begun.size) == len(stereo)


def test_masked_damaged_and_missing_ones_give_no_points(farm):
    class Photos(list):
        def __getitem__(self, at):
            if at == 2:
                raise BadInput("not a whole picture")
            return super().__getitem__(at)

    given = known(farm, spoilt=lambda at, prior: None if at in (0, 1) else prior)
    black = torch.zeros(120, 160, dtype=torch.bool)
    masks = [black if at != 8 else None for at in range(9)]
    fused = StereoStart(points=500).fused(replace(given, masks=masks, photos=Photos(given.photos)))
    only = StereoStart(points=500).fused(replace(given, priors=[*[None] * 8, given.priors[8]]))
    assert len(fused) and np.array_equal(fused.xyz, only.xyz)


def test_without_any_trusted_pixel_the_sparse_points_begin(farm):
    blind = known(farm, spoilt=lambda at, prior: replace(prior, confidence=0 * prior.confidence))
    assert StereoStart().cloud(blind) is farm.scene.cloud


@pytest.mark.parametrize("few", [1, 2, 3])
def test_a_few_points_are_no_noise(farm, few):
    """Too few to have others near by, they were taken for noise, and depth maps for blind."""
    for start in (StereoStart(points=few), StereoStart(most=few)):
        assert 0 < len(start.fused(known(farm))) <= few
    assert start.limited(1).most == 1


def test_fewer_points_than_asked_for_are_told(farm, monkeypatch):
    said = []
    monkeypatch.setattr("surfkit.start.stereo_start.emit", said.append)

    def told(start):
        said.clear()
        count = len(start.fused(known(farm)))
        start.cloud(known(farm))
        return count, [event.text for event in said if isinstance(event, Warned)]

    count, (note,) = told(StereoStart(points=10_000_000))
    assert note.startswith("start.points is 10,000,000") and f" {count:,}," in note
    assert not told(StereoStart(points=1_000))[1] and not told(StereoStart())[1]


def plane(count, rng, z=0.0):
    xyz = np.concatenate([rng.uniform(-1, 1, (count, 2)), np.full((count, 1), z)], axis=1)
    up = np.broadcast_to([0.0, 0.0, 1.0], xyz.shape)
    return Samples(xyz, np.full((count, 3), 99.0), up, rng.uniform(0.5, 1, count), np.full(count, 1e-3))


def test_memory_is_bounded_and_nothing_is_lost_by_it():
    rng = np.random.default_rng(0)
    parts = [plane(20_000, rng) for _ in range(6)]
    kept = VoxelAccumulator(1e-3, 5_000)
    for part in parts:
        kept.add(part)
    voxels = kept.settle()
    assert len(voxels) <= 5_000 and voxels.side == 1e-3 * 2 ** round(np.log2(voxels.side / 1e-3))
    weight = np.concatenate([part.weight for part in parts])
    assert voxels.sums[:, 0].sum() == pytest.approx(weight.sum(), rel=1e-5)
    mean = (weight[:, None] * np.concatenate([part.xyz for part in parts])).sum(0) / weight.sum()
    np.testing.assert_allclose(voxels.sums[:, 1:4].sum(0) / voxels.sums[:, 0].sum(), mean, atol=1e-5)
    assert 0.98 * 700 <= len(thin_to(voxels, 700)) <= 700


def test_what_is_far_lies_in_larger_voxels_and_gives_way_to_what_was_seen_nearby():
    rng = np.random.default_rng(0)
    near, far = plane(40_000, rng), plane(40_000, rng, z=0.0)
    near = Samples(**{name: value[near.xyz[:, 0] < 0] for name, value in vars(near).items()})
    far = replace(far, grain=np.full(40_000, 0.16))
    kept = VoxelAccumulator(0.02, 1 << 20)
    kept.add(near)
    kept.add(far)
    found = thin(kept.settle(), 0.02)
    fine = found.size == 0.02
    assert set(np.unique(found.size)) == {0.02, 0.16}
    assert (found.xyz[fine, 0] < 0).all() and (found.xyz[~fine, 0] > -0.16).all()
    assert 25 < (~fine).sum() < 200 and fine.sum() > 3_000


def test_lonely_points_are_noise(farm):
    def stray(at, prior):
        if at != 4:
            return prior
        inverse = prior.inverse.clone()
        inverse[60, 80] *= 2.5  # one pixel in mid-air
        return replace(prior, inverse=inverse)

    start = StereoStart(points=3_000)
    dirty, clean = start.fused(known(farm, spoilt=stray)), start.fused(known(farm))
    assert surface(farm, dirty.xyz)[0].max() < 3 * surface(farm, clean.xyz)[0].max() < 1
    assert 0.98 * 3_000 <= len(dirty) <= 3_000


def test_of_two_near_points_the_heavier_stays():
    xyz = np.array([[0, 0, 0], [0.4, 0, 0], [0.8, 0, 0], [5, 0, 0]], float)
    assert apart(xyz, np.array([3.0, 2, 1, 1]), 0.5).tolist() == [True, False, True, True]
    assert apart(xyz, np.array([1.0, 2, 1, 1]), 0.5).tolist() == [False, True, False, True]
    assert apart(xyz[:0], np.zeros(0), 0.5).tolist() == []


def test_random_points_fill_the_box(farm):
    cloud = RandomStart(points=3_000).cloud(known(farm))
    assert len(cloud.xyz) == 3_000 and RandomStart(points=9).expected(1, 1) == 9
    seen, eyes = farm.scene.cloud.xyz, torch.stack([view.camera.centre for view in farm.scene.train]).float()
    both = torch.cat([seen, eyes])
    assert (cloud.xyz >= both.amin(0) - 1e-6).all() and (cloud.xyz <= both.amax(0) + 1e-6).all()
    assert (cloud.xyz.amax(0) - cloud.xyz.amin(0) > 0.8 * (both.amax(0) - both.amin(0))).all()


def test_opacities_and_normals_of_a_cloud_are_those_of_the_splats():
    from surfkit.primitives import Gaussian3D, Surfel2D
    from surfkit.primitives.base import rotated

    draw = torch.Generator().manual_seed(0)
    normals = normalize(torch.randn(9, 3, generator=draw), dim=1)
    cloud = SparsePoints(torch.rand(9, 3), torch.zeros(9, 3, dtype=torch.uint8), normals, torch.linspace(0.1, 0.9, 9))
    cloud = replace(cloud, size=torch.linspace(1, 9, 9))
    for primitive in (Surfel2D(), Gaussian3D()):
        splats = primitive.activate(primitive.init(cloud, draw), 0)
        assert torch.allclose(splats.opacities, torch.linspace(0.1, 0.9, 9), atol=1e-6)
        assert torch.allclose(splats.scales, torch.linspace(1, 9, 9)[:, None])
    surfels = Surfel2D().activate(Surfel2D().init(cloud, draw), 0)
    z = torch.tensor([0.0, 0.0, 1.0]).expand(9, 3)
    assert torch.allclose(rotated(z, surfels.quats), normals, atol=1e-5)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"points": 0}, "start.points is 0"),
        ({"spacing_px": 0.0}, "start.spacing_px is"),
        ({"size": 0.0}, "start.size is"),
        ({"opacity": 1.0}, "start.opacity"),
        ({"min_confidence": 0.0}, "start.min_confidence"),
        ({"size": float("inf")}, "start.size is inf"),
        ({"spacing_px": float("inf")}, "start.spacing_px is inf"),
        ({"spacing_px": 1e-9}, "start.spacing_px is 1e-09"),
        ({"most": 0}, "start.most is 0"),
    ],
)
def test_settings_that_make_no_sense(settings, message):
    with pytest.raises(BadInput, match=message):
        StereoStart(**settings)
    with pytest.raises(BadInput, match="start.points is -1"):
        RandomStart(points=-1)
