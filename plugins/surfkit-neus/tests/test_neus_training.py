"""Training: shapes are found, the contract is kept, an interruption changes nothing, and bad input is told."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import surfkit_neus
import torch
from surfkit_neus.batches import Batches
from surfkit_neus.box import scene_box
from surfkit_neus.field import Networks
from surfkit_neus.hashgrid import Grid
from surfkit_neus.mesh import field_mesh
from surfkit_neus.method import Neuralangelo, NeuS
from surfkit_neus.render import Look, Samples
from surfkit_neus.train import CHECKPOINT, make_step, train

from surfkit.cli import main
from surfkit.core.registry import plugins
from surfkit.io.datasets.data import Data
from surfkit.io.datasets.depth_prior import DepthPrior
from surfkit.plugin import (
    BadInput,
    Camera,
    Frame,
    MethodInput,
    Scene,
    SparsePoints,
    StepDone,
    View,
    components,
    hookimpl,
)
from surfkit.raster.select import select
from surfkit.runs.methods.base import Method
from surfkit.study.ablation import build, offered_tables
from surfkit.testing import check
from surfkit.testing.synthetic import Flight, photograph, write_colmap

SMALL = dict(
    grid=Grid(levels=4, table_bits=12, coarsest=8, finest=64),
    background=Grid(levels=2, table_bits=10, coarsest=4, finest=16),
    networks=Networks(width=16, features=7),
    samples=Samples(even=8, surface=8, rounds=2, beyond=4),
    rays=64,
    cells=24,
    rate=5e-3,
    grid_rate=2e-2,
)
RADIUS = 0.6


@pytest.fixture(autouse=True, scope="module")
def offered():
    """The plugin, as if it were installed, where it is not."""
    torch.set_num_threads(1)
    there = NeuS in components(Method).values()
    if not there:
        plugins().register(surfkit_neus, "neus of this test")
    yield
    if not there:
        plugins().unregister(surfkit_neus)


def facing(centre: torch.Tensor, side: int) -> Camera:
    """A camera that looks at 0."""
    z = -centre / centre.norm()
    x = torch.nn.functional.normalize(torch.linalg.cross(torch.tensor([0.1, 0.2, 1.0]).double(), z), dim=0)
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, :3] = torch.stack([x, torch.linalg.cross(z, x), z])
    pose[:3, 3] = -pose[:3, :3] @ centre
    return Camera(pose, 1.2 * side, 1.2 * side, side / 2, side / 2, side, side)


def hits(camera: Camera) -> torch.Tensor:
    """(H, W) camera z of the sphere, 0 beside it."""
    seen = camera.rays(torch.float64)
    direction = torch.einsum("ij,jhw->ihw", camera.world_to_camera[:3, :3].T, seen)
    a, b = direction.square().sum(0), (direction * camera.centre[:, None, None]).sum(0)
    root = b.square() - a * (camera.centre.square().sum() - RADIUS**2)
    return torch.where(root > 0, (-b - root.clamp_min(0).sqrt()) / a, 0.0)


def ball(folder: Path, side: int = 24, masks: bool = False, priors: bool = False) -> MethodInput:
    """A sphere, coloured by its normal, before black; 14 views from all around."""
    draw = torch.Generator().manual_seed(3)
    centres = torch.nn.functional.normalize(torch.randn(14, 3, generator=draw, dtype=torch.float64), dim=1) * 2
    views = tuple(View(f"{at}", facing(centre, side), Path(f"{at}")) for at, centre in enumerate(centres))

    def photo(at: int) -> torch.Tensor:
        camera, z = views[at].camera, hits(views[at].camera)
        turn = camera.world_to_camera[:3, :3].T
        place = torch.einsum("ij,jhw->ihw", turn, camera.rays(torch.float64) * z) + camera.centre[:, None, None]
        return (255 * torch.where(z > 0, 0.5 + 0.4 * place / RADIUS, 0.0)).round().to(torch.uint8)

    def prior(at: int) -> DepthPrior:
        z = hits(views[at].camera).float()
        inverse = torch.where(z > 0, 1 / z.clamp_min(1e-6), 0.0)
        return DepthPrior(inverse, (z > 0).float(), 0.5)

    xyz = RADIUS * torch.nn.functional.normalize(torch.randn(400, 3, generator=draw), dim=1)
    scene = Scene("ball", views, (), SparsePoints(xyz, torch.zeros(400, 3, dtype=torch.uint8)), Frame(np.zeros(3), 1.0))
    return MethodInput(
        scene=scene,
        photo=photo,
        mask=(lambda at: torch.zeros(side, side, dtype=torch.bool)) if masks else lambda at: None,
        priors=[prior(at) for at in range(14)] if priors else None,
        folder=folder,
        used={},
        seed=0,
        device=torch.device("cpu"),
        rasterizer=select("cpu")[0],
        budget_bytes=2**30,
        checkpoint_every=20,
    )


def on_the_sphere(given: MethodInput) -> torch.Tensor:
    """(400, 3) positions on it, in the scene box."""
    return scene_box(given.scene, 0.1).inward(given.scene.cloud.xyz).float()


def away(state, given: MethodInput) -> float:
    """Mean distance of the field at the sphere, local units."""
    with torch.no_grad():
        return float(state.field(on_the_sphere(given))[0].abs().mean()) * scene_box(given.scene, 0.1).scale


@pytest.mark.parametrize("kind", [NeuS, Neuralangelo])
def test_a_sphere_is_found_from_its_pictures(kind, tmp_path):
    more = {"anneal": 15} if kind is NeuS else {"every": 15, "first_level": 2}
    method = kind(**SMALL, steps=60, warm_up=5, **more)
    given = ball(tmp_path)
    box = scene_box(given.scene, 0.1)
    assert box.shape == "sphere"
    before = away(method.begin(box, 0, given.device), given)
    made = method.reconstruct(given)
    state = train(method, given, box)
    assert before > 0.15 and away(state, given) < 0.4 * before
    lengths = np.linalg.norm(made.mesh.vertices, axis=1)
    assert np.median(lengths) == pytest.approx(RADIUS, abs=0.08) and len(made.mesh.faces) > 500
    a, b, c = (made.mesh.vertices[made.mesh.faces[:, i]] for i in range(3))
    assert ((np.cross(b - a, c - a) * a).sum(1) > 0).mean() > 0.95, "faces look outwards"
    assert np.abs(made.mesh.colors / 255 - 0.5 - 0.4 * made.mesh.vertices / RADIUS).mean() < 0.15
    view, photo = given.scene.train[0], given.photo(0).float() / 255
    maps = made.draw(view)
    assert (maps.color - photo).square().mean() < 0.25 * (photo - photo.mean((1, 2), keepdim=True)).square().mean()
    z = hits(view.camera)
    inner = z > 0.95 * float(z[z > 0].min())
    inner &= z < float(z[z > 0].quantile(0.5))
    assert (maps.expected_depth() - z)[inner].abs().median() < 0.12 and (maps.median - z)[inner].abs().median() < 0.12
    facing_camera = maps.normal[2][inner] / maps.alpha[inner].clamp_min(1e-3)
    assert facing_camera.median() < -0.8, "towards the camera, in its frame"


@pytest.mark.parametrize("extra", [{"points": 1.0}, {"prior": 5.0}])
def test_points_and_depth_priors_draw_the_surface_to_them(extra, tmp_path):
    plain = NeuS(**SMALL, steps=25, warm_up=0, anneal=0)
    found = []
    for at, method in enumerate((plain, replace(plain, **extra))):
        given = ball(tmp_path / str(at), priors=True)
        given.folder.mkdir()
        found.append(away(train(method, given, scene_box(given.scene, 0.1)), given))
    assert found[1] < 0.92 * found[0]


def test_masked_pixels_teach_no_colour(tmp_path):
    given = ball(tmp_path, masks=True)
    method = NeuS(**SMALL, steps=5, eikonal=0.0)
    state = method.begin(scene_box(given.scene, 0.1), 0, given.device)
    before = {name: value.detach().clone() for name, value in state.parameters().items()}
    told = make_step(method, state, Batches(given, scene_box(given.scene, 0.1), 64, 4))
    assert told["color"] == 0
    assert all(torch.equal(before[name], value.detach()) for name, value in state.parameters().items())


class Stop:
    """Interrupts a run after a step, as Ctrl-C does."""

    def __init__(self, index):
        self.index, self.seen = index, []

    @hookimpl
    def surfkit_event(self, event):
        if isinstance(event, StepDone):
            self.seen.append(event.index)
            if self.seen.count(self.index) == 1 and event.index == self.index:
                raise KeyboardInterrupt


@pytest.mark.parametrize("kind", [NeuS, Neuralangelo])
def test_a_resumed_run_has_the_same_bits(kind, tmp_path):
    method, states = (
        kind(**SMALL | {"rays": 16}, steps=30, **({"every": 5, "first_level": 2} if kind is Neuralangelo else {})),
        [],
    )
    for name, at in (("whole", None), ("twice", 25)):
        given = ball(tmp_path / name)
        given.folder.mkdir()
        box, stop = scene_box(given.scene, 0.1), Stop(at)
        plugins().register(stop)
        try:
            if at is not None:
                with pytest.raises(KeyboardInterrupt):
                    train(method, given, box)
            states.append(train(method, given, box))
        finally:
            plugins().unregister(stop)
    assert stop.seen == [*range(1, 26), *range(21, 31)], "from the checkpoint of step 20"
    whole, twice = ((s.parameters(), s.moments) for s in states)
    assert all(torch.equal(whole[0][name], twice[0][name]) for name in whole[0])
    assert all(torch.equal(a, b) for name in whole[1] for a, b in zip(whole[1][name], twice[1][name], strict=True))


@pytest.mark.parametrize("kind", [NeuS, Neuralangelo])
def test_it_keeps_the_contract_of_methods(kind, tmp_path):
    write_colmap(tmp_path / "data", photograph(Flight(views=6, width=24, height=18, points=150)))
    check(kind(**SMALL, steps=4), Data(tmp_path / "data"), tmp_path / "runs")


def test_schedules():
    neus, angelo = NeuS(), Neuralangelo()
    assert neus.rates(250, ["a.table", "b"]) == pytest.approx({"a.table": 5e-3, "b": 5e-4}, rel=1e-6), "warm-up"
    assert neus.rates(500, ["b"])["b"] == pytest.approx(1e-3) and neus.slowed(30_000) == pytest.approx(0.05)
    assert neus.slowed(15_250) == pytest.approx(0.525) and neus.look(2_500) == Look(anneal=0.5)
    assert neus.look(9_000).anneal == 1 and neus.look(9_000).step is None
    assert [angelo.levels(i) for i in (1, 300, 301, 900, 901, 30_000)] == [4, 4, 5, 6, 7, 8]
    sides = [angelo.look(i).step for i in (1, 301, 30_000)]
    assert sides == pytest.approx([2 / 70, 2 / 115, 2 / 512]), "the cell of the last level that is used"
    assert [angelo.slowed(i) for i in (18_000, 18_001, 24_001)] == pytest.approx([1, 0.1, 0.01])


def test_the_field_is_meshed_where_views_see_it(tmp_path):
    given = ball(tmp_path)
    box = scene_box(given.scene, 0.1)
    state = NeuS(**SMALL).begin(box, 0, given.device)
    whole = field_mesh(state.field, box, given.scene.train, Look(), 24, 4096)
    assert np.linalg.norm(whole.vertices, axis=1) == pytest.approx(0.5 * box.scale, abs=0.03), "the initial sphere"
    near = [replace(v, camera=replace(v.camera, cx=-2.0)) for v in given.scene.train[:1]]  # sees half of it
    assert 0 < len(field_mesh(state.field, box, near, Look(), 24, 4096).faces) < 0.8 * len(whole.faces)


@pytest.mark.parametrize("wrong", [{"rays": 0}, {"cells": 1}, {"rate": 0.0}, {"eikonal": -1.0}, {"sharpness": 0.0}])
def test_settings_that_make_no_sense_are_refused(wrong):
    with pytest.raises(BadInput, match=next(iter(wrong))):
        NeuS(**wrong)


def test_settings_of_the_schedules_are_checked_too():
    for wrong in ({"first_level": 9}, {"every": 0}, {"curvature": -1.0}):
        with pytest.raises(BadInput, match=next(iter(wrong))):
            Neuralangelo(**wrong)
    for part, wrong in ((Samples, {"even": 1}), (Networks, {"width": 0}), (NeuS, {"slowest": 2.0})):
        with pytest.raises(BadInput, match=next(iter(wrong))):
            part(**wrong)


def test_data_that_do_not_fit_are_refused(tmp_path):
    given, method = ball(tmp_path), NeuS(**SMALL)
    method.refuse_unfit(given)
    with pytest.raises(BadInput, match="no depth maps"):
        replace(method, prior=1.0).refuse_unfit(given)
    with pytest.raises(BadInput, match="lower method.rays"):
        method.refuse_unfit(replace(given, budget_bytes=1000))
    few = replace(given.scene, cloud=SparsePoints(torch.zeros(3, 3), torch.zeros(3, 3, dtype=torch.uint8)))
    with pytest.raises(BadInput, match="3 sparse points"):
        method.refuse_unfit(replace(given, scene=few))
    assert not method.needs_prior and replace(method, prior=1.0).needs_prior


def test_damaged_checkpoints_are_told(tmp_path):
    given, method = ball(tmp_path), NeuS(**SMALL, steps=2)
    box = scene_box(given.scene, 0.1)
    train(method, given, box)
    with pytest.raises(BadInput, match="another shape"):
        train(replace(method, networks=Networks(width=8, features=7)), given, box)
    path = given.folder / CHECKPOINT
    path.write_bytes(path.read_bytes()[:-100])
    with pytest.raises(BadInput, match="damaged"):
        train(method, given, box)


def test_the_recipes_from_the_command_line(tmp_path, capsys):
    write_colmap(tmp_path / "data", photograph(Flight(kind="grid", views=8, width=32, height=24, points=200)))
    out = tmp_path / "run"
    words = ["train", "recipe:neus", "--data", str(tmp_path / "data"), "--steps", "20", "--out", str(out)]
    small = [
        "--method.rays",
        "32",
        "--method.cells",
        "24",
        "--method.grid.levels",
        "4",
        "--method.grid.table-bits",
        "10",
    ]
    small += ["--method.samples.even", "8", "--method.samples.surface", "8", "--method.networks.width", "16"]
    stop = Stop(12)
    plugins().register(stop)
    try:
        assert main([*words, *small]) == 130
    finally:
        plugins().unregister(stop)
    assert main([*words, *small]) == 0
    metrics = json.loads((out / "metrics.json").read_text())
    assert metrics["images"]["psnr"] > 8 and metrics["steps"] == 20 and (out / "mesh.ply").exists()
    (out / "metrics.json").unlink()
    assert main([*words, *small]) == 0 and stop.seen[-1] == 12, "measured again without a step"
    assert json.loads((out / "metrics.json").read_text())["images"]["psnr"] == metrics["images"]["psnr"]
    capsys.readouterr()


def test_rows_of_the_comparison():
    rows = {row.label: row for row in offered_tables()["methods"].rows}
    assert rows["NeuS"].paper == {"psnr": 14.46, "ssim": 0.227, "lpips": 0.688} and not rows["Neuralangelo"].paper
    recipes = build(offered_tables()["methods"])
    assert isinstance(recipes["NeuS"].method, NeuS) and isinstance(recipes["Neuralangelo"].method, Neuralangelo)
