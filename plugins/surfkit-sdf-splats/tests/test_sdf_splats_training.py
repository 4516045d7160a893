"""Training: a ball is found from its pictures, an interruption changes nothing, and bad input is told."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import surfkit_sdf_splats
import torch
from surfkit_neus.box import scene_box
from surfkit_neus.field import Networks
from surfkit_neus.hashgrid import Grid
from surfkit_neus.render import Samples
from surfkit_octree.anchors import Anchors
from surfkit_octree.growth import AnchorGrowth
from surfkit_octree.start import AnchorVoxels
from surfkit_sdf_splats.branches import train
from surfkit_sdf_splats.gsdf import GSDF
from surfkit_sdf_splats.neusg import NeuSG

from surfkit.cli import main
from surfkit.core.registry import plugins
from surfkit.io.datasets.data import Data
from surfkit.plugin import (
    ADC,
    BadInput,
    Camera,
    Frame,
    Gaussian3D,
    MethodInput,
    Scene,
    SparsePoints,
    Stage,
    StepDone,
    View,
    components,
    evolve,
    hookimpl,
)
from surfkit.raster.select import select
from surfkit.runs.methods.base import Method
from surfkit.start.simple_starts import SparseStart
from surfkit.study.ablation import build, offered_tables
from surfkit.testing import check
from surfkit.testing.synthetic import Flight, photograph, write_colmap

RADIUS = 0.6
FIELD = dict(
    grid=Grid(levels=4, table_bits=12, coarsest=8, finest=64),
    background=Grid(levels=2, table_bits=10, coarsest=4, finest=16),
    networks=Networks(width=16, features=7),
    samples=Samples(even=8, surface=8, rounds=2, beyond=4),
    cells=24,
    rate=5e-3,
    grid_rate=2e-2,
    warm_up=5,
)


@pytest.fixture(autouse=True, scope="module")
def offered():
    """The plugin, as if it were installed, where it is not."""
    torch.set_num_threads(1)
    there = NeuSG in components(Method).values()
    if not there:
        plugins().register(surfkit_sdf_splats, "sdf-splats of this test")
    yield
    if not there:
        plugins().unregister(surfkit_sdf_splats)


def neusg(steps: int, rays: int = 64) -> NeuSG:
    surface = replace(NeuSG().surface, **FIELD, rays=rays, steps=steps, anneal=steps // 4)
    return NeuSG(splats=Stage(steps=steps, densify=ADC(start=5, every=10, until=steps)), surface=surface, centres=128)


def gsdf(steps: int, rays: int = 64, densify=None) -> GSDF:
    alone = steps // 4
    surface = replace(GSDF().surface, **FIELD, rays=rays, steps=steps - alone, first_level=2, every=15)
    densify = densify or ADC(start=5, every=10, until=steps)
    splats = replace(GSDF().splats, steps=steps, densify=densify, regularizers={}, rates={})
    return GSDF(splats=splats, surface=surface, guided=(steps - alone) // 2, depth=0.1, normal=0.1)


def facing(centre: torch.Tensor, side: int) -> Camera:
    """A camera that looks at 0."""
    z = -centre / centre.norm()
    x = torch.nn.functional.normalize(torch.linalg.cross(torch.tensor([0.1, 0.2, 1.0]).double(), z), dim=0)
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, :3] = torch.stack([x, torch.linalg.cross(z, x), z])
    pose[:3, 3] = -pose[:3, :3] @ centre
    return Camera(pose, 1.2 * side, 1.2 * side, side / 2, side / 2, side, side)


def ball(folder: Path, side: int = 24, anchors: bool = False) -> MethodInput:
    """A sphere, coloured by its normal, before black; 14 views from all around, and points within 0.05 of it."""
    draw = torch.Generator().manual_seed(3)
    centres = torch.nn.functional.normalize(torch.randn(14, 3, generator=draw, dtype=torch.float64), dim=1) * 2
    views = tuple(View(f"{at}", facing(centre, side), Path(f"{at}")) for at, centre in enumerate(centres))

    def photo(at: int) -> torch.Tensor:
        camera = views[at].camera
        seen = torch.einsum("ij,jhw->ihw", camera.world_to_camera[:3, :3].T, camera.rays(torch.float64))
        a, b = seen.square().sum(0), (seen * camera.centre[:, None, None]).sum(0)
        root = b.square() - a * (camera.centre.square().sum() - RADIUS**2)
        place = seen * ((-b - root.clamp_min(0).sqrt()) / a) + camera.centre[:, None, None]
        return (255 * torch.where(root > 0, 0.5 + 0.4 * place / RADIUS, 0.0)).round().to(torch.uint8)

    around = torch.nn.functional.normalize(torch.randn(400, 3, generator=draw), dim=1)
    xyz = around * (RADIUS + 0.1 * torch.rand(400, 1, generator=draw) - 0.05)
    cloud = SparsePoints(xyz, (255 * (0.5 + 0.4 * around)).to(torch.uint8))
    folder.mkdir(exist_ok=True)
    return MethodInput(
        scene=Scene("ball", views, (), cloud, Frame(np.zeros(3), 1.0)),
        photo=photo,
        mask=lambda at: None,
        priors=None,
        folder=folder,
        used={
            "primitive": Anchors(feature=8, offsets=4, hidden=8) if anchors else Gaussian3D(sh_degree=0),
            "start": AnchorVoxels(levels=1) if anchors else SparseStart(),
        },
        seed=0,
        device=torch.device("cpu"),
        rasterizer=select("cpu")[0],
        budget_bytes=2**30,
        checkpoint_every=10,
    )


METHODS = {"neusg": neusg, "gsdf": gsdf}


def away(field, given: MethodInput) -> float:
    """Mean distance of a field at the sphere, local units."""
    box = scene_box(given.scene, 0.1)
    true = box.inward(RADIUS * torch.nn.functional.normalize(given.scene.cloud.xyz, dim=1)).float()
    with torch.no_grad():
        return float(field(true)[0].abs().mean()) * box.scale


@pytest.mark.parametrize("kind", METHODS)
def test_a_ball_is_found_from_its_pictures(kind, tmp_path):
    method, given = METHODS[kind](100), ball(tmp_path)
    method.refuse_unfit(given)
    box = scene_box(given.scene, method.surface.margin)
    begun = method.surface.begin(box, 0, given.device).field
    made = method.reconstruct(given)
    state = train(method, given, box)[1]
    assert away(begun, given) > 0.15 and away(state.field, given) < 0.3 * away(begun, given)
    lengths = np.linalg.norm(made.mesh.vertices, axis=1)
    assert np.median(np.abs(lengths - RADIUS)) < 0.05 and len(made.mesh.faces) > 500
    view, photo = given.scene.train[0], given.photo(0).float() / 255
    shown = given.rasterizer.render(made.splats.splats, view.camera, made.splats.near, True, False).maps
    assert (shown.color - photo).square().mean() < 0.25 * photo.square().mean(), "the splats draw the photographs"


def test_points_and_normals_of_the_splats_guide_the_surface(tmp_path):
    found = []
    for at, method in enumerate((neusg(30), replace(neusg(30), points=0.0, normals=0.0))):
        given = ball(tmp_path / str(at))
        box = scene_box(given.scene, method.surface.margin)
        found.append(away(train(method, given, box)[1].field, given))
    assert found[0] < 0.7 * found[1]


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


@pytest.mark.parametrize("kind", ["neusg", "gsdf", "anchors"])
def test_a_resumed_run_has_the_same_bits(kind, tmp_path):
    growth = AnchorGrowth(start=4, every=5, until=24, shown=0.1, threshold=1e-6)
    method = gsdf(24, 16, growth) if kind == "anchors" else METHODS[kind](24, 16)
    states = []
    for name, at in (("whole", None), ("twice", 17)):
        given = ball(tmp_path / name, 16, kind == "anchors")
        box, stop = scene_box(given.scene, 0.1), Stop(at)
        plugins().register(stop)
        try:
            if at is not None:
                with pytest.raises(KeyboardInterrupt):
                    train(method, given, box)
            states.append(train(method, given, box))
        finally:
            plugins().unregister(stop)
    assert stop.seen == [*range(1, 18), *range(11, 25)], "from the checkpoint of step 10"
    (one, first), (two, second) = states
    assert len(one.points) != len(given.scene.cloud.xyz), "some were added or dropped"
    for a, b in zip(one.points.groups, two.points.groups, strict=True):
        assert a.keys() == b.keys() and all(torch.equal(a[name], b[name]) for name in a)
    fields = first.parameters(), second.parameters()
    assert all(torch.equal(fields[0][name], fields[1][name]) for name in fields[0])
    assert len(list(given.folder.glob("surface-*"))) == 2, "older states of the surface are gone"


@pytest.mark.parametrize("kind", METHODS)
def test_it_keeps_the_contract_of_methods(kind, tmp_path):
    write_colmap(tmp_path / "data", photograph(Flight(views=6, width=24, height=18, points=150)))
    check(METHODS[kind](8, 16), Data(tmp_path / "data"), tmp_path / "runs")


def test_data_and_parts_that_do_not_fit_are_refused(tmp_path):
    given, method = ball(tmp_path), neusg(8)
    with pytest.raises(BadInput, match="no Gaussians"):
        method.refuse_unfit(ball(tmp_path, anchors=True))
    with pytest.raises(BadInput, match="method.splats"):
        replace(method, splats=replace(method.splats, losses={})).refuse_unfit(given)
    with pytest.raises(BadInput, match="anchors"):
        gsdf(8, densify=AnchorGrowth()).refuse_unfit(given)
    few = replace(given.scene, cloud=SparsePoints(torch.zeros(3, 3), torch.zeros(3, 3, dtype=torch.uint8)))
    with pytest.raises(BadInput, match="3 sparse points"):
        method.refuse_unfit(replace(given, scene=few))


@pytest.mark.parametrize("kind", METHODS)
def test_the_recipes_from_the_command_line(kind, tmp_path, capsys):
    write_colmap(tmp_path / "data", photograph(Flight(kind="grid", views=8, width=32, height=24, points=200)))
    out = tmp_path / "run"
    words = ["train", f"recipe:{kind}", "--data", str(tmp_path / "data"), "--steps", "12", "--out", str(out)]
    small = {"rays": 32, "cells": 24, "grid.levels": 4, "grid.table-bits": 10, "networks.width": 16}
    words += [word for name, value in small.items() for word in (f"--method.surface.{name}", str(value))]
    stop = Stop(7)
    plugins().register(stop)
    try:
        assert main(words) == 130
    finally:
        plugins().unregister(stop)
    assert main(words) == 0
    metrics = json.loads((out / "metrics.json").read_text())
    assert metrics["images"]["psnr"] > 5 and metrics["steps"] == 12 and (out / "mesh.ply").exists()
    (out / "metrics.json").unlink()
    assert main(words) == 0, "measured again"
    assert json.loads((out / "metrics.json").read_text())["images"]["psnr"] == metrics["images"]["psnr"]
    capsys.readouterr()


def test_rows_of_the_comparison():
    recipes = build(offered_tables()["methods"])
    assert isinstance(recipes["NeuSG"].method, NeuSG) and isinstance(recipes["GSDF"].method, GSDF)
    changed = evolve(recipes["GSDF"], "method.splats.losses.l1.weight", 0.5)
    assert changed.method.splats.losses["l1"].weight == 0.5
