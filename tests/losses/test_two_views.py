"""Losses between two views, on planes that are known exactly, in double precision."""

import math
from dataclasses import replace

import pytest
import torch

from surfkit.core.check import BadInput
from surfkit.losses import Reprojection, WarpedPatches, warped_patches
from surfkit.losses.base import Neighbour, Target
from surfkit.losses.two_views import Opposite, agreement, round_trip, sampled, spread
from surfkit.raster.api import Maps
from surfkit.scene.camera import Camera
from surfkit.scene.scene import View

HEIGHT, WIDTH, FOCAL = 36, 44, 60.0
LOSSES = [Reprojection(depth="median", stride=1), WarpedPatches(depth="median")]


def pose(angle: float = 0.0, x: float = 0.0, y: float = 0.0) -> torch.Tensor:
    """World to camera: turned about the vertical axis by so many degrees, then moved."""
    c, s = math.cos(math.radians(angle)), math.sin(math.radians(angle))
    rotation = torch.tensor([[c, 0, -s], [0, 1, 0], [s, 0, c]], dtype=torch.float64)
    result = torch.eye(4, dtype=torch.float64)
    result[:3, :3], result[:3, 3] = rotation, -rotation @ torch.tensor([x, y, 0.0], dtype=torch.float64)
    return result


def camera(world_to_camera: torch.Tensor, focal: float = FOCAL) -> Camera:
    return Camera(world_to_camera, focal, focal * 1.02, WIDTH / 2 - 1.3, HEIGHT / 2 + 0.7, WIDTH, HEIGHT)


FIRST = camera(pose())
SECOND = camera(pose(4.0, 0.18, -0.05), 57.0)
BESIDE = camera(pose(0.0, 0.1))
NORMAL, OFFSET = torch.tensor([0.25, -0.15, -0.95], dtype=torch.float64), -1.9
FRONTAL = torch.tensor([0.0, 0.0, -1.0], dtype=torch.float64)


def look(eye: Camera, normal=NORMAL, offset=OFFSET) -> tuple[torch.Tensor, Maps]:
    """Photograph and maps of the textured plane normal . x = offset of the world."""
    rotation, shift = eye.world_to_camera[:3, :3], eye.world_to_camera[:3, 3]
    normal = normal / normal.norm()
    local = rotation @ normal
    rays = eye.rays(torch.float64)
    depth = (offset + local @ shift) / torch.einsum("c,chw->hw", local, rays)
    x, y, z = (rotation.T @ ((rays * depth).flatten(1) - shift[:, None])).view(3, HEIGHT, WIDTH)
    waves = [(33 * x + 7 * y).sin(), (12 * x - 37 * y + z).cos(), (25 * x + 29 * y).sin()]
    photo = 0.5 + 0.15 * torch.stack([waves[0] + waves[1], waves[1] - waves[2], waves[0] + waves[2]])
    flat = local[:, None, None].expand(3, HEIGHT, WIDTH)
    alpha = torch.full_like(depth, 0.8)
    return photo, Maps(alpha=alpha, depth=alpha * depth, median=depth, normal=alpha * flat)


def scene(second=SECOND, normal=NORMAL, mask=None) -> tuple[Maps, Target]:
    """Exact maps of the first view, and a sample with the second as its neighbour."""
    (photo, maps), (other, theirs) = look(FIRST, normal), look(second, normal)
    neighbour = Neighbour(View("b", second, None), other, theirs, mask)
    return maps, Target(View("a", FIRST, None), photo, neighbour=neighbour, seed=5)


def moved(maps: Maps, factor: float) -> Maps:
    """The same maps with all depths times a factor."""
    return replace(maps, depth=maps.depth * factor, median=maps.median * factor)


def tilted(maps: Maps, by: float) -> Maps:
    return replace(maps, normal=maps.normal + by * torch.tensor([0.8, 0.0, 0.0]).double()[:, None, None])


@pytest.mark.parametrize("which", ["median", "expected"])
def test_exact_depth_is_no_error(which):
    maps, target = scene()
    assert Reprojection(depth=which, stride=1)(maps, target).item() < 1e-9
    exact = WarpedPatches(depth=which)(maps, target).item()
    assert exact < 0.01, "what is left is that pixels are interpolated"
    for factor in (0.95, 1.05):
        assert Reprojection(depth=which, stride=1)(moved(maps, factor), target).item() > 0.1
        assert WarpedPatches(depth=which)(moved(maps, factor), target).item() > 5 * exact
    for by in (-0.5, 0.5):
        assert WarpedPatches(depth=which)(tilted(maps, by), target).item() > 2 * exact


@pytest.mark.parametrize("factor", [0.99, 0.995, 1.005, 1.01])
def test_the_error_of_a_frontal_plane_is_the_difference_of_the_disparities(factor):
    maps, target = scene(BESIDE, FRONTAL)
    error = FOCAL * 0.1 / -OFFSET * abs(1 / factor - 1)
    value = Reprojection(depth="median", stride=1)(moved(maps, factor), target).item()
    assert value == pytest.approx(math.exp(-error) * error, rel=1e-9)
    limited = Reprojection(depth="median", stride=1, limit=0.9 * error)(moved(maps, factor), target)
    assert limited.item() == 0, "all are taken for occluded"


@pytest.mark.parametrize("loss", LOSSES, ids=lambda loss: type(loss).__name__)
def test_the_gradient_leads_to_the_true_depth(loss):
    maps, target = scene()
    for factor, sign in ((0.95, -1), (1.05, 1)):
        leaf = (maps.median * factor).requires_grad_()
        loss(replace(maps, median=leaf), target).backward()
        pulled = leaf.grad != 0
        assert (leaf.grad * sign).sum() > 0 and pulled.sum() > 100
        assert (leaf.grad[pulled] * sign > 0).double().mean() > 0.75


def test_the_gradient_leads_to_the_true_normal():
    maps, target = scene()
    for by in (-0.5, 0.5):
        leaf = tilted(maps, by).normal.requires_grad_()
        WarpedPatches(depth="median")(replace(maps, normal=leaf), target).backward()
        assert leaf.grad[0].sum() * by > 0


def test_the_way_there_and_back_has_the_gradient_of_finite_differences():
    maps, target = scene()
    at = torch.arange(200, HEIGHT * WIDTH, 7)
    rays = FIRST.rays(torch.float64).flatten(1)[:, at]
    draw = torch.Generator().manual_seed(0)
    wavy = 1 + 0.02 * torch.rand(HEIGHT, WIDTH, generator=draw, dtype=torch.float64)
    opposite = Opposite.of(replace(target.neighbour, maps=replace(maps, median=maps.median * wavy)), "median")
    depth = (maps.median.flatten()[at] * 1.01).requires_grad_()
    valid = round_trip(depth, rays, FIRST, opposite)[1]
    assert valid.sum() > 50

    def error(depth):
        return round_trip(depth, rays, FIRST, opposite)[0][valid]

    assert torch.autograd.gradcheck(error, depth)


def test_the_loss_is_that_of_constant_weights():
    maps, target = scene()
    maps = moved(maps, 1.01)
    rays, opposite = FIRST.rays(torch.float64).flatten(1), Opposite.of(target.neighbour, "median")
    weight, counts = agreement(*round_trip(maps.median.flatten(), rays, FIRST, opposite), 1.0)
    leaf = maps.median.clone().requires_grad_()
    Reprojection(depth="median", stride=1)(replace(maps, median=leaf), target).backward()
    way = torch.rand(HEIGHT, WIDTH, generator=torch.Generator().manual_seed(0), dtype=torch.float64)

    def frozen(step):
        error, _ = round_trip((maps.median + step * way).flatten(), rays, FIRST, opposite)
        return float((weight * error).sum() / counts.sum())

    assert float((leaf.grad * way).sum()) == pytest.approx((frozen(1e-6) - frozen(-1e-6)) / 2e-6, rel=1e-5)


def test_the_gradient_of_patches_is_that_of_finite_differences(monkeypatch):
    monkeypatch.setattr(warped_patches, "agreement", lambda error, valid, limit: (valid.double(), valid))
    maps, target = scene()
    maps = tilted(moved(maps, 1.01), 0.1)
    draw = torch.Generator().manual_seed(0)
    leaves = [value.clone().requires_grad_() for value in (maps.median, maps.normal)]
    loss = WarpedPatches(depth="median", pixels=60, radius=2)
    loss(replace(maps, median=leaves[0], normal=leaves[1]), target).backward()
    for name, leaf in zip(("median", "normal"), leaves, strict=True):
        way = torch.rand(leaf.shape, generator=draw, dtype=torch.float64) - 0.3
        ends = [loss(replace(maps, **{name: leaf.detach() + h * way}), target).item() for h in (-1e-6, 1e-6)]
        assert float((leaf.grad * way).sum()) == pytest.approx((ends[1] - ends[0]) / 2e-6, rel=1e-4), name


def test_exposure_makes_no_difference_to_patches():
    maps, target = scene()
    maps = moved(maps, 1.05)
    darker = replace(target.neighbour, photo=0.55 * target.neighbour.photo + 0.1)
    values = [
        WarpedPatches(depth="median")(maps, given).item() for given in (target, replace(target, neighbour=darker))
    ]
    assert values[0] > 0.01 and values[1] == pytest.approx(values[0], rel=1e-6)


def occluded(target: Target) -> tuple[Target, torch.Tensor]:
    """Something flat stands before the neighbour's right half, and which of its pixels it hides."""
    hidden = torch.zeros(HEIGHT, WIDTH, dtype=torch.bool)
    hidden[:, WIDTH // 2 :] = True
    given = target.neighbour
    maps = replace(given.maps, median=torch.where(hidden, 0.7, given.maps.median))
    return replace(target, neighbour=replace(given, maps=maps, photo=torch.where(hidden, 0.3, given.photo))), hidden


@pytest.mark.parametrize("loss", LOSSES, ids=lambda loss: type(loss).__name__)
def test_what_the_neighbour_does_not_see_does_not_count(loss):
    maps, target = scene()
    for way in ("occluded", "masked", "hole", "out of sight"):
        given, hidden = occluded(target)
        if way == "masked":
            near = target.neighbour.maps.median
            wrong = replace(given.neighbour.maps, median=torch.where(hidden, 1.01 * near, near))
            given = replace(given, neighbour=replace(given.neighbour, maps=wrong, mask=~hidden))
        elif way == "hole":
            holes = replace(given.neighbour.maps, median=torch.where(hidden, 0.0, target.neighbour.maps.median))
            given = replace(given, neighbour=replace(given.neighbour, maps=holes))
        elif way == "out of sight":
            half = replace(SECOND, width=WIDTH // 2)
            crop = replace(
                given.neighbour.maps, **{n: v[..., : WIDTH // 2] for n, v in given.neighbour.maps.present().items()}
            )
            seen = replace(given.neighbour, view=View("b", half, None), maps=crop)
            given = replace(given, neighbour=replace(seen, photo=given.neighbour.photo[..., : WIDTH // 2]))
        leaf = maps.median.clone().requires_grad_()
        value = loss(replace(maps, median=leaf), given)
        value.backward()
        rotation, shift = SECOND.world_to_camera[:3, :3], SECOND.world_to_camera[:3, 3:]
        there = rotation @ (FIRST.rays(torch.float64) * maps.median).flatten(1) + shift
        column = (SECOND.fx * there[0] / there[2] + SECOND.cx).view(HEIGHT, WIDTH)
        assert not leaf.grad[column > WIDTH / 2 + 0.5].any() and torch.isfinite(leaf.grad).all(), way
        if isinstance(loss, WarpedPatches):
            assert leaf.grad.any(), way
        else:
            assert value.item() < 1e-9, way


def test_patches_that_reach_under_the_mask_of_the_view_do_not_count():
    maps, target = scene()
    mask = torch.ones(HEIGHT, WIDTH, dtype=torch.bool)
    mask[8:20, 10:24] = False
    right, wrong = (torch.where(mask, target.photo, value) for value in (target.photo, torch.zeros(())))
    loss = WarpedPatches(depth="median")
    values = [loss(maps, replace(target, photo=photo, mask=mask)).item() for photo in (right, wrong)]
    assert values[0] == values[1] and loss(maps, replace(target, photo=wrong)).item() > values[0] + 0.01


@pytest.mark.parametrize("loss", LOSSES, ids=lambda loss: type(loss).__name__)
def test_a_neighbour_that_looks_away_teaches_nothing(loss):
    away = camera(pose(180.0, 0.1))
    maps, target = scene()
    given = replace(target, neighbour=replace(target.neighbour, view=View("b", away, None)))
    leaf = maps.median.clone().requires_grad_()
    value = loss(replace(maps, median=leaf), given)
    value.backward()
    assert value.item() == 0 and not leaf.grad.any()


def test_patches_without_texture_or_room_do_not_count():
    maps, target = scene()
    plain = replace(target, photo=torch.full_like(target.photo, 0.4))
    assert WarpedPatches(depth="median")(moved(maps, 1.01), plain).item() == 0
    assert WarpedPatches(depth="median", radius=20)(moved(maps, 1.01), target).item() == 0, "larger than the picture"


def test_pixels_are_spread_evenly_and_never_twice():
    hits = torch.zeros(10, 13)
    for seed in range(600):
        y, x = spread((10, 13), 4, seed)
        assert len({*zip(y.tolist(), x.tolist(), strict=True)}) == len(y)
        hits[y, x] += 1
    assert (hits / 600 - 1 / 16).abs().max() < 0.04
    assert torch.equal(torch.stack(spread((10, 13), 4, 3)), torch.stack(spread((10, 13), 4, 3)))
    assert len(spread((10, 13), 1, 0)[0]) == 130


@pytest.mark.parametrize("pixels", [1, 7, 100, 5_000])
def test_no_more_patches_than_asked_for(pixels):
    _, target = scene()
    loss = WarpedPatches(pixels=pixels)
    counts = [len(loss.centres(replace(target, seed=seed))) for seed in range(20)]
    room = (HEIGHT - 6) * (WIDTH - 6)
    assert max(counts) <= pixels and sum(counts) / 20 > 0.4 * min(pixels, room)


def test_samples_are_those_between_the_centres_of_pixels():
    image = torch.arange(12.0).view(3, 4)
    at = torch.tensor([[0.5, 1.0, 3.5, 9.0], [0.5, 1.0, 2.5, 1.0]])
    assert sampled(image, at).tolist() == pytest.approx([0.0, 2.5, 11.0, 0.0], abs=1e-6)


def test_samples_and_their_gradients_are_those_of_torch():
    draw = torch.Generator().manual_seed(5)
    image = torch.rand(11, 17, generator=draw, dtype=torch.float64)
    at = torch.rand(2, 6, 50, generator=draw, dtype=torch.float64) * torch.tensor([23.0, 17.0])[:, None, None] - 3
    weights, found = torch.rand(6, 50, generator=draw, dtype=torch.float64), []
    for way in ("own", "torch"):
        place = at.clone().requires_grad_()
        grid = 2 * place.flatten(1).T / torch.tensor([17.0, 11.0]) - 1
        given = {"mode": "bilinear", "align_corners": False}
        values = (
            sampled(image, place)
            if way == "own"
            else torch.nn.functional.grid_sample(image[None, None], grid[None, None], **given).view(6, 50)
        )
        found.append((values.detach(), *torch.autograd.grad((values * weights).sum(), place)))
    assert all(torch.allclose(a, b, atol=1e-12) for a, b in zip(*found, strict=True))
    assert (found[0][0] == 0).any() and (found[0][0] > 0).any(), "some lie outside"


def test_places_that_are_none_are_outside():
    far = torch.tensor([[torch.nan, torch.inf, -1e30, 1e30, 2.0], [2.0, 2.0, torch.nan, 2.0, -torch.inf]])
    assert torch.equal(sampled(torch.ones(4, 4), far), torch.zeros(5))


def test_only_some_steps_count():
    for loss in (Reprojection(start=4, every=3), WarpedPatches(start=4, every=3)):
        assert [index for index in range(13) if loss.weight_at(index, 12)] == [6, 9, 12]
    for settings in ({"weight": -1.0}, {"weight": float("inf")}, {"every": 0}, {"limit": 0.0}):
        for kind in (Reprojection, WarpedPatches):
            with pytest.raises(BadInput, match="give 0 or more"):
                kind(**settings)
    with pytest.raises(BadInput, match="stride 0"):
        Reprojection(stride=0)
    for settings in ({"pixels": 0}, {"radius": 0}):
        with pytest.raises(BadInput, match="both must be 1 or more"):
            WarpedPatches(**settings)
