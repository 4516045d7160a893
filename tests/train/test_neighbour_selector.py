"""Which views are looked into beside the one that is shown, and what a second view changes in a run."""

import math
from dataclasses import replace

import pytest
import torch

from surfkit.core.check import BadInput
from surfkit.core.schedule import LearningRate
from surfkit.losses import L1, SSIM, Reprojection, WarpedPatches
from surfkit.losses.base import Target
from surfkit.primitives import Surfel2D
from surfkit.primitives.columns import RATES
from surfkit.primitives.points import Points
from surfkit.raster.select import select
from surfkit.scene.camera import Camera
from surfkit.scene.scene import SparsePoints
from surfkit.testing.synthetic import Flight, photograph
from surfkit.train import checkpoint
from surfkit.train.neighbour_selector import NEIGHBOURS_PER_VIEW, NeighbourSelector
from surfkit.train.next_view import neighbour
from surfkit.train.stage import Stage
from surfkit.train.trainer import Trainer

PAIRED = {
    "l1": L1(),
    "ssim": SSIM(),
    "reprojection": Reprojection(start=2, every=2),
    "patches": WarpedPatches(start=2, every=4, radius=1),
}


def facing(angle: float, distance: float = 2.0, away: bool = False) -> Camera:
    """A camera that stands at an angle above the plane z = 0 and looks at its origin, or the other way."""
    a = math.radians(angle)
    back = torch.tensor([math.sin(a), 0.0, math.cos(a)], dtype=torch.float64)
    down, ahead = torch.tensor([0.0, -1.0, 0.0], dtype=torch.float64), back if away else -back
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, :3] = torch.stack([torch.linalg.cross(down, ahead), down, ahead])
    pose[:3, 3] = -pose[:3, :3] @ (distance * back)
    return Camera(pose, 60.0, 60.0, 20.0, 15.0, 40, 30)


def test_neighbours_stand_at_an_angle_see_the_same_and_are_as_far():
    cameras = [facing(0), facing(1), facing(9), facing(-11), facing(20), facing(70), facing(10, 9.0)]
    cameras += [facing(10, away=True), replace(facing(12), cx=-900.0)]
    depth = torch.full((30, 40), 2.0)
    chosen = NeighbourSelector.of(cameras).neighbours(0, depth)
    assert set(chosen[:2]) == {2, 3} and set(chosen[2:]) <= {4} and len(chosen) <= NEIGHBOURS_PER_VIEW
    assert NeighbourSelector.of(cameras[:2]).neighbours(0, depth) == [], "no parallax"
    assert NeighbourSelector.of(cameras).neighbours(0, torch.zeros(30, 40)) == [], "nothing rendered"
    assert NeighbourSelector.of(cameras[:1]).neighbours(0, depth) == []


def test_a_depth_map_of_half_the_size_shows_the_same_places():
    cameras = [facing(15)]
    whole, half = (NeighbourSelector.of(cameras).places(0, torch.full(size, 2.0)) for size in ((30, 40), (15, 20)))
    assert whole.shape == half.shape and (whole - half).abs().max() < 2 * 2.0 / 60, "two pixels of 60 at a depth of 2"


def test_views_that_cannot_show_the_places_are_left_out_and_no_others(monkeypatch):
    """300 cameras above a plane, turned this way and that, some of them with a principal point beside the picture."""
    draw, cameras = torch.Generator().manual_seed(0), []
    for x, y, turn, tilt, off in torch.rand(300, 5, generator=draw, dtype=torch.float64).tolist():
        camera, a = facing(80 * tilt - 40), 7 * turn
        about = torch.tensor([[math.cos(a), -math.sin(a), 0], [math.sin(a), math.cos(a), 0], [0, 0, 1]]).double()
        pose = camera.world_to_camera.clone()
        pose[:3, :3] = pose[:3, :3] @ about
        pose[:3, 3] -= pose[:3, :3] @ torch.tensor([20 * x, 20 * y, 0], dtype=torch.float64)
        cameras.append(replace(camera, world_to_camera=pose, cx=camera.cx + 60 * (off > 0.8)))
    selector = NeighbourSelector.of(cameras)
    asked = [(at, selector.places(at, torch.full((30, 40), 2.0))) for at in range(0, 300, 20)]
    few = [selector.worth(*pair) for pair in asked]
    assert max(len(selector.turned_to(places)) for _, places in asked) < 100
    monkeypatch.setattr(NeighbourSelector, "turned_to", lambda selector, places: torch.arange(300))
    for found, pair in zip(few, asked, strict=True):
        assert torch.allclose(found, selector.worth(*pair), atol=1e-6) and int((found > 0).sum()) > 1


def test_the_worth_of_a_view_is_that_of_its_places():
    cameras = [facing(0), facing(15, 3.0)]
    places = torch.tensor([[0.0, 0.3, -0.2, 9.0], [0.0, 0.1, 0.2, 0.0], [0.0, 0.0, 0.1, 0.0]])
    total = 0.0
    for place in places.double().T:
        pixel = cameras[1].project(place[None])[0]
        if 0 < pixel[0] < 40 and 0 < pixel[1] < 30:
            rays = [place - camera.centre for camera in cameras]
            angle = math.degrees(math.acos(rays[0] @ rays[1] / rays[0].norm() / rays[1].norm()))
            spread = 10 / 3 if angle < 10 else 10
            ratio = float(pixel[2] / cameras[0].project(place[None])[0, 2])
            total += math.exp(-((angle - 10) ** 2) / (2 * spread**2)) * min(ratio, 1 / ratio)
    assert total > 0.5
    assert float(NeighbourSelector.of(cameras).worth(0, places)[1]) == pytest.approx(total / 4, rel=1e-5)


class Counting:
    """A rasterizer that notes the cameras that it draws for."""

    def __init__(self, inner):
        self.inner, self.cameras = inner, []

    def where(self):
        return self.inner.where()

    def render(self, splats, camera, near, geometry=True, distortion=True):
        self.cameras.append(camera)
        return self.inner.render(splats, camera, near, geometry, distortion)


class Watched(Reprojection):
    """Keeps the samples it is given."""

    given: list[Target] = []

    def __call__(self, maps, target):
        self.given.append(target)
        return Reprojection.__call__(self, maps, target)


@pytest.fixture(scope="module")
def world():
    """Photographs of a synthetic scene and a cloud on its surface."""
    made = photograph(Flight(views=20, width=48, height=36, test_every=0))
    views = made.scene.train
    photos = [(made.exact[view.name].color * 255).round().to(torch.uint8) for view in views]
    xyz, rgb, normals = [], [], []
    for view in views[::2]:
        truth, pose = made.exact[view.name], view.camera.world_to_camera
        there = (truth.depth > 0) & (torch.rand(36, 48, generator=torch.Generator().manual_seed(0)) < 0.3)
        xyz.append((pose[:3, :3].T @ ((view.camera.rays(torch.float64) * truth.depth)[:, there] - pose[:3, 3:])).T)
        normals.append((pose[:3, :3].T @ truth.normal[:, there]).T)
        rgb.append((truth.color[:, there].T * 255).to(torch.uint8))
    return views, photos, SparsePoints(torch.cat(xyz).float(), torch.cat(rgb), torch.cat(normals).float())


def started(world, losses, noise=0.0, **settings):
    """A trainer and its first state: opaque surfels on the surface, or beside it by noise."""
    views, photos, cloud = world
    generator = torch.Generator().manual_seed(3)
    primitive = Surfel2D(sh_degree=0)
    params = primitive.init(cloud, generator)
    params["opacities"].fill_(2.0)
    params["means"] += noise * cloud.normals * torch.randn(len(cloud.xyz), 1, generator=generator)
    stage = Stage(**{"steps": 12, "losses": losses, "densify": None, "sh_every": 100} | settings)
    trainer = Trainer(stage, primitive, views, photos, Counting(select("cpu")[0]))
    return trainer, trainer.begin(Points.fresh(params), generator)


def test_one_more_view_is_rendered_in_steps_that_count_and_in_no_other(world):
    trainer, state = started(world, PAIRED)
    for index in range(1, 13):
        before = len(trainer.rasterizer.cameras)
        done = trainer.step(state)
        drawn = trainer.rasterizer.cameras[before:]
        assert len(drawn) == (2 if index > 2 and index % 2 == 0 else 1), index
        assert ("patches" in done.losses) == (index % 4 == 0) and drawn[0] is done.target.view.camera
        assert done.target.neighbour is None, "nothing holds the second view after the step"
    trainer, state = started(world, {"l1": L1()})
    list(trainer.run(state))
    assert len(trainer.rasterizer.cameras) == 12


def test_a_second_view_is_another_one_and_constant(world):
    Watched.given.clear()
    trainer, state = started(world, {"l1": L1(), "watched": Watched(start=0, every=1)})
    masks = [torch.full((36, 48), at % 2 == 0) for at in range(20)]
    list(replace(trainer, masks=masks).run(state))
    seconds = [target.neighbour for target in Watched.given]
    assert len(seconds) == 12 and all(seconds)
    names = [view.name for view in trainer.views]
    for target, second in zip(Watched.given, seconds, strict=True):
        assert second.view.name != target.view.name
        assert set(second.maps.present()) == {"alpha", "depth", "median", "normal"}
        assert not any(value.requires_grad for value in second.maps.present().values())
        at = names.index(second.view.name)
        assert torch.equal((second.photo * 255).round().to(torch.uint8), trainer.photos[at])
        assert second.mask is masks[at]
    assert len({target.seed for target in Watched.given}) == 12


@pytest.mark.parametrize("every", [1, 2, 4])
def test_all_good_neighbours_take_turns(world, every):
    trainer, state = started(world, PAIRED)
    splats = trainer.primitive.activate(state.points.params, 0)
    maps = trainer.rasterizer.render(splats, trainer.views[7].camera, 0.005).maps
    good = {trainer.views[at].name for at in trainer.selector.neighbours(7, maps.median)}
    turns = [
        neighbour(trainer, replace(state, index=at), splats, 7, maps).view.name for at in range(0, 24 * every, every)
    ]
    assert len(good) > 1 and set(turns) == good


class Damaged(list):
    """Photographs of which some cannot be read."""

    bad = range(1, 20, 2)

    def __getitem__(self, at):
        if at in self.bad:
            raise BadInput(f"{at}: not a whole picture")
        return super().__getitem__(at)


def test_damaged_neighbours_are_passed_over(world):
    Watched.given.clear()
    trainer, state = started(world, {"l1": L1(), "watched": Watched(start=0, every=1)})
    done = list(replace(trainer, photos=Damaged(trainer.photos)).run(state))
    good = {view.name for view in trainer.views[::2]}
    shown = [one.target.view.name for one in done]
    assert set(shown) <= good and {s.neighbour.view.name for s in Watched.given if s.neighbour} <= good
    assert len(state.skipped) == len(set(state.skipped)) > 0


def test_a_run_that_goes_on_has_the_same_bits(world, tmp_path):
    trainer, state = started(world, PAIRED)
    whole = [done.losses for done in trainer.run(state)]
    other, halfway = started(world, PAIRED)
    for done in other.run(halfway):
        if done.index == 5:
            break
    checkpoint.save(tmp_path / "state.safetensors", halfway)
    again = checkpoint.load(tmp_path / "state.safetensors")
    fresh, _ = started(world, PAIRED)
    rest = [done.losses for done in fresh.run(again)]
    assert rest == whole[5:]
    for name, value in state.points.params.items():
        assert torch.equal(value, again.points.params[name]), name


def mean_error(trainer, state, loss) -> float:
    """Of all views and their best neighbours, with all pixels."""
    splats = trainer.primitive.activate(state.points.params, 0)
    values = []
    for at, view in enumerate(trainer.views):
        maps = trainer.rasterizer.render(splats, view.camera, 0.005).maps
        second = neighbour(trainer, replace(state, index=at), splats, at, maps)
        target = Target(view, trainer.photos[at] / 255, neighbour=second)
        values.append(float(loss(maps, target)))
    return sum(values) / len(values)


@pytest.mark.parametrize(("loss", "share"), [(Reprojection, 0.75), (WarpedPatches, 0.9)], ids=["depths", "patches"])
def test_training_lowers_the_loss(world, loss, share):
    settings = {"start": 0, "every": 1, "weight": 1.0, "depth": "expected"}
    settings |= {"stride": 1} if loss is Reprojection else {"radius": 2}
    trainer, state = started(
        world, {"pair": loss(**settings)}, noise=0.015, steps=40, rates=RATES | {"means": LearningRate(1e-3)}
    )
    before = mean_error(trainer, state, loss(**settings))
    list(trainer.run(state))
    assert mean_error(trainer, state, loss(**settings)) < share * before
