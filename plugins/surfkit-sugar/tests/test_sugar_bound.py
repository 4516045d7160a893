"""Splats on triangles against planes, rotations and finite differences; the refinement of a run."""

import json
import math
import sys
from dataclasses import dataclass, replace

import numpy as np
import pytest
import surfkit_sugar
import torch
from surfkit_sugar import REFINED, AdjacentNormals, BindToMesh, BoundMesh, LevelSetPoisson, MeshBound
from surfkit_sugar.bind import colors_near
from surfkit_sugar.bound import sound
from surfkit_sugar.triangles import ellipses, frames, packed, pairs

from surfkit.core.registry import plugins
from surfkit.densify.adc import ADC
from surfkit.evaluate.geometry.surface_file import read_surface
from surfkit.io.datasets.data import Data
from surfkit.io.splats.ply import read_splats
from surfkit.mesh.poisson import require_open3d
from surfkit.mesh.simplify import require_simplification
from surfkit.plugin import BadInput, Mesh, Mesher, MeshInput, Recipe, Splats, Stage, components, evolve, hookimpl
from surfkit.primitives import Surfel2D
from surfkit.runs.blocks.train_blocks import Compute
from surfkit.runs.pipeline import load_run, run
from surfkit.runs.run_stage import Intervals
from surfkit.scene.rotations import rotations
from surfkit.testing import check
from surfkit.testing.inputs import mesh_input, splats
from surfkit.testing.synthetic import Flight, photograph, write_colmap
from surfkit.train import checkpoint

EVERY = Intervals(checkpoint=4, pictures=0)


@pytest.fixture(autouse=True, scope="module")
def offered():
    """The plugin, as if it were installed, where it is not."""
    there = BoundMesh in components(Mesher).values()
    if not there:
        plugins().register(surfkit_sugar, "sugar of this test")
    parts = Parts()
    plugins().register(parts, "parts of this test")
    yield
    plugins().unregister(parts)
    if not there:
        plugins().unregister(surfkit_sugar)


@pytest.fixture(scope="module")
def simplification():
    """Skips where meshes cannot be simplified."""
    try:
        require_simplification("this test")
    except BadInput as error:
        pytest.skip(str(error))


def needs_open3d() -> None:
    """Skips where Open3D cannot be loaded."""
    try:
        require_open3d("this test")
    except BadInput as error:
        pytest.skip(str(error))


def draws() -> torch.Generator:
    return torch.Generator().manual_seed(0)


def grid(side: int = 4) -> tuple[torch.Tensor, torch.Tensor]:
    """Vertices of a float64 square of side 1 in z = 0, and its triangles, counter-clockwise from above."""
    at = torch.linspace(0, 1, side, dtype=torch.float64)
    x, y = torch.meshgrid(at, at, indexing="ij")
    vertices = torch.stack([x.flatten(), y.flatten(), torch.zeros(side * side).double()], 1)
    rows = torch.arange(side * side).view(side, side)
    a, b, c, d = (part.flatten() for part in (rows[:-1, :-1], rows[1:, :-1], rows[1:, 1:], rows[:-1, 1:]))
    return vertices, torch.cat([torch.stack([a, b, c], 1), torch.stack([a, c, d], 1)])


def model(vertices: torch.Tensor, faces: torch.Tensor, rows: int = 3, **settings) -> tuple[MeshBound, dict]:
    primitive = MeshBound(sh_degree=0, **settings)
    begun = primitive.on(vertices, faces, rows)
    count = len(begun["means"])
    rest = {"opacities": torch.zeros(count), "sh0": torch.rand(count, 1, 3, generator=draws())}
    return primitive, begun | {name: value.to(vertices) for name, value in rest.items()} | {
        "sh_rest": vertices.new_zeros(count, 0, 3)
    }


@pytest.mark.parametrize("kind", ["gaussian", "surfel"])
def test_splats_lie_in_the_plane_z_is_2_x_plus_3_y_with_its_normal_wherever_vertices_go_in_it(kind):
    vertices, faces = grid()
    primitive, params = model(vertices, faces, draws=kind)
    moved = vertices + 0.05 * torch.randn(vertices.shape, generator=draws(), dtype=torch.float64)
    moved[:, 2] = 2 * moved[:, 0] + 3 * moved[:, 1] + 1
    turns = torch.randn(len(params["turn"]), 2, generator=draws(), dtype=torch.float64)
    found = primitive.activate(params | {"vertices": moved, "turn": turns}, 0)
    height = found.means[:, 2] - 2 * found.means[:, 0] - 3 * found.means[:, 1]
    assert torch.allclose(height, torch.ones(len(height)).double(), atol=1e-12, rtol=0)
    normal = torch.tensor([-2.0, -3, 1]).double() / math.sqrt(14)
    assert torch.allclose(rotations(found.quats)[:, :, 2], normal.expand(len(found), 3), atol=1e-12)
    assert found.kind == kind and found.scales.shape[1] == (3 if kind == "gaussian" else 2)
    if kind == "gaussian":
        assert (found.scales[:, 2] < 0.002 * found.scales[:, :2].amin(1)).all(), "flat"


def test_places_are_barycentric_and_the_first_axis_is_that_of_the_turn():
    vertices = torch.tensor([[1.0, 0, 0], [3, 0, 0], [1, 4, 0]]).double()
    primitive, params = model(vertices, torch.tensor([[0, 1, 2]]), rows=1)
    third = math.pi / 3
    direction = torch.tensor([[math.cos(third), math.sin(third)]], dtype=torch.float64)
    found = primitive.activate(params | {"place": torch.tensor([[0.25, 0.5]]).double(), "turn": 7 * direction}, 0)
    assert torch.allclose(found.means, torch.tensor([[1.5, 2.0, 0.0]]).double(), atol=1e-14)
    assert torch.allclose(rotations(found.quats)[:, :2, 0], direction, atol=1e-14, rtol=0)
    assert abs(float(rotations(found.quats)[:, 2, 0])) < 1e-14


def test_what_turns_and_moves_the_mesh_does_so_to_its_splats():
    vertices, faces = grid()
    vertices = vertices + 0.1 * torch.randn(vertices.shape, generator=draws(), dtype=torch.float64)
    primitive, params = model(vertices, faces)
    turn = rotations(torch.tensor([[0.3, -0.5, 0.7, 0.2]]).double())[0]
    before, after = primitive.activate(params, 0), primitive.activate(params | {"vertices": vertices @ turn.T + 5}, 0)
    assert torch.allclose(after.means, before.means @ turn.T + 5, atol=1e-12)
    assert torch.allclose(rotations(after.quats), turn @ rotations(before.quats), atol=1e-12)
    assert torch.equal(after.scales, before.scales)


def test_gradients_by_vertices_are_those_of_finite_differences():
    vertices, faces = grid(3)
    vertices = vertices + 0.1 * torch.randn(vertices.shape, generator=draws(), dtype=torch.float64)
    primitive, params = model(vertices, faces, rows=1)
    weights = torch.randn(len(params["means"]), 12, generator=draws(), dtype=torch.float64)

    def value(vertices, turn):
        found = primitive.activate(params | {"vertices": vertices, "turn": turn}, 0)
        seen = torch.cat([found.means, rotations(found.quats).flatten(1)], 1)
        return (weights * seen).sum() + AdjacentNormals()(found)

    leaves = [vertices.requires_grad_(), params["turn"].clone().requires_grad_()]
    assert torch.autograd.gradcheck(value, leaves, atol=1e-7)


@pytest.mark.parametrize("rows", [1, 2, 3])
def test_circles_touch_each_other_and_the_sides_and_do_not_overlap(rows):
    weights, radius = packed(rows)
    corner = torch.tensor([[0.0, 0], [1, 0], [0.5, math.sqrt(3) / 2]]).double()
    centres, sides = weights @ corner, weights * (math.sqrt(3) / 2)  # distances to the sides
    assert len(centres) == rows * (rows + 1) // 2 and torch.allclose(weights.sum(1), torch.ones(len(weights)).double())
    assert sides.min() == pytest.approx(radius) and (sides.amin(0) - radius).abs().max() < 1e-12
    if rows > 1:
        assert torch.pdist(centres).min() == pytest.approx(2 * radius)


def test_an_ellipse_is_the_image_of_the_circle_by_its_singular_values():
    along, across = torch.randn(2, 50, 3, generator=draws(), dtype=torch.float64)
    plane = frames(along, across)[:, :, :2]
    regular = torch.tensor([[1.0, 0.5], [0.0, math.sqrt(3) / 2]], dtype=torch.float64)
    change = plane.transpose(1, 2) @ torch.stack([along, across], 2) @ torch.linalg.inv(regular)
    u, s, _ = torch.linalg.svd(change)
    axes, direction = ellipses(along, across)
    assert torch.allclose(axes, s, rtol=1e-9)
    assert torch.allclose((direction * u[:, :, 0]).sum(1).abs(), torch.ones(50).double(), atol=1e-9)


def test_pairs_are_those_that_a_double_loop_finds():
    _, faces = grid()
    wanted = {
        (i, j) for i in range(len(faces)) for j in range(i) if len({*faces[i].tolist()} & {*faces[j].tolist()}) == 2
    }
    found = pairs(faces)
    assert len(found) == len(wanted) and {tuple(sorted(pair, reverse=True)) for pair in found.tolist()} == wanted
    assert len(pairs(torch.tensor([[0, 1, 2], [0, 1, 3], [0, 1, 4]]))) == 0, "an edge of three triangles is left out"


def test_adjacent_normals_of_a_fold_are_1_minus_its_cosine():
    for angle in (0.0, 0.7, 2.0):
        far = [0.0, math.cos(angle), math.sin(angle)]
        vertices = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, -1, 0], far], dtype=torch.float64)
        primitive, params = model(vertices, torch.tensor([[1, 0, 2], [0, 1, 3]]), rows=1)
        assert float(AdjacentNormals()(primitive.activate(params, 0))) == pytest.approx(1 - math.cos(angle), abs=1e-12)


def test_parts_that_need_a_mesh_say_so():
    with pytest.raises(BadInput, match="refine.0:bind-to-mesh"):
        AdjacentNormals()(splats())
    with pytest.raises(BadInput, match="mesh:bound needs splats"):
        BoundMesh().mesh(mesh_input())
    with pytest.raises(BadInput, match="cannot be moved"):
        MeshBound().moved({}, torch.zeros(0, 3))


def test_the_parts_keep_to_the_contract(simplification):
    needs_open3d()
    bound = MeshBound(sh_degree=1)
    check(bound)
    check(MeshBound(draws="surfel"))
    vertices, faces = grid()
    primitive, params = model(vertices.float(), faces)
    check(AdjacentNormals(), primitive.activate(params, 0))
    check(BindToMesh(mesher=LevelSetPoisson(octree=5, points=4_000)))


@dataclass(frozen=True)
class Plane(Mesher):
    """A level square through the splats."""

    def mesh(self, subject: MeshInput) -> Mesh:
        vertices, faces = grid(8)
        low, high = (subject.splats.means.double().quantile(share, 0) for share in (0.1, 0.9))
        places = low + vertices * (high - low)
        return Mesh(places.float().numpy(), faces.to(torch.int32).numpy())


class Parts:
    @hookimpl
    def surfkit_components(self):
        return {"plane-of-this-test": Plane}


def test_colours_are_those_of_the_splats_that_are_dense_there():
    quats = torch.tensor([[1.0, 0, 0, 0]]).double().expand(3, 4)
    means = torch.tensor([[0.0, 0, 0], [1, 0, 0], [9, 0, 0]]).double()
    scales, opacities = torch.full((3, 3), 0.5).double(), torch.tensor([0.8, 0.4, 0.9]).double()
    sh = torch.tensor([[1.0, 0, 0], [0, 1, 0], [0, 0, 1]]).double()[:, None]
    found = colors_near(Splats("gaussian", means, quats, scales, opacities, sh), torch.tensor([[0.3, 0.1, 0]]).double())
    shares = [0.8 * math.exp(-0.5 * 0.1 / 0.25), 0.4 * math.exp(-0.5 * 0.5 / 0.25)]
    wanted = torch.tensor([*shares, 0.0]).double() / sum(shares)
    assert torch.allclose(found[0, 0], wanted, atol=1e-12)


def test_slivers_and_lone_vertices_are_left_out():
    vertices = torch.tensor([[0.0, 0, 0], [1, 0, 0], [2, 0, 0], [7, 7, 7], [0, 1, 0]])
    left, faces = sound(vertices, torch.tensor([[0, 1, 2], [0, 2, 4], [4, 4, 4]]))
    assert torch.equal(left, vertices[[0, 2, 4]]) and faces.tolist() == [[0, 1, 2]]


def test_meshes_are_simplified_to_the_pixels_there_are(simplification):
    vertices, faces = grid(40)
    mesh = Mesh(vertices.float().numpy(), faces.to(torch.int32).numpy())
    views = mesh_input().views[:1]  # of 96 x 96 pixels
    assert len(BindToMesh(pixels=96 * 96 / 500).simplified(mesh, views).faces) <= 500
    assert BindToMesh(pixels=0.0).simplified(mesh, views) is mesh
    assert BindToMesh(pixels=0.5).simplified(mesh, views) is mesh


def test_recipes_that_densify_bound_splats_are_refused(simplification):
    wrong = evolve(REFINED, "refine.0.stage.densify", ADC())
    with pytest.raises(BadInput, match="refine.0.stage.densify: .*mesh-bound"):
        wrong.refuse_unfit()


@pytest.fixture(scope="module")
def data(tmp_path_factory) -> Data:
    folder = tmp_path_factory.mktemp("scene")
    write_colmap(folder, photograph(Flight(views=12, width=32, height=24, points=200)))
    return Data(folder)


RECIPE = Recipe(
    primitive=Surfel2D(sh_degree=1),
    pretrain=Stage(steps=6, densify=None, sh_every=2),
    refine=(BindToMesh(replace(BindToMesh().stage, steps=10), mesher=Plane()),),
    mesh=BoundMesh(),
)


@pytest.fixture(scope="module")
def finished(simplification, data, tmp_path_factory):
    out = tmp_path_factory.mktemp("finished") / "run"
    run(RECIPE, data, out, Compute("cpu"), EVERY)
    return out


def test_a_mesher_that_cannot_work_is_told_before_anything_is_written(data, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "open3d", None)
    with pytest.raises(BadInput, match="mesh:sugar needs .*open3d"):
        run(replace(RECIPE, refine=(BindToMesh(),)), data, tmp_path / "run", Compute("cpu"), EVERY)
    assert not (tmp_path / "run").exists()


def test_a_run_gives_the_moved_mesh_and_splats_that_lie_on_it(finished):
    loaded, state, scene = load_run(finished)
    assert loaded.last.name == "refine0" and isinstance(loaded.last.primitive, MeshBound) and state.index == 10
    params, points = state.points.all_params(), read_splats(finished / "point_cloud.ply").means
    vertices, faces = params["vertices"], params["faces"].long()
    assert len(faces) == len(points) == 98 == len(pairs(faces)) - 35, "7 x 7 squares have 133 inner edges"
    assert vertices[:, 2].max() - vertices[:, 2].min() > 1e-5, "of a level mesh"
    centres = scene.frame.to_input(vertices[faces].mean(1).double())
    assert np.allclose(points.double(), centres, atol=1e-5)
    assert torch.allclose(params["means"], vertices[faces].mean(1), atol=1e-6), "also where nothing is drawn"
    written = read_surface(finished / "mesh.ply").vertices()
    assert np.allclose(sorted(written.tolist()), sorted(scene.frame.to_input(vertices.double()).tolist()), atol=1e-5)
    metrics = json.loads((finished / "metrics.json").read_text())
    assert metrics["before"]["refine0"]["points"] == 200 and metrics["points"] == 98
    assert metrics["before"]["refine0"]["psnr"] > 5 and metrics["images"]["psnr"] > 5


def test_an_interrupted_run_goes_on_to_the_same_bits(finished, data, tmp_path, monkeypatch):
    save = checkpoint.save

    def stop(path, state):
        save(path, state)
        if path.parent.name == "refine0" and state.index == 4:
            raise KeyboardInterrupt

    monkeypatch.setattr(checkpoint, "save", stop)
    with pytest.raises(KeyboardInterrupt):
        run(RECIPE, data, tmp_path, Compute("cpu"), EVERY)
    monkeypatch.undo()
    metrics = run(RECIPE, data, tmp_path, Compute("cpu"), EVERY)
    for name in ("point_cloud.ply", "mesh.ply", "refine0/before.json"):
        assert (tmp_path / name).read_bytes() == (finished / name).read_bytes()
    assert metrics["before"] == json.loads((finished / "metrics.json").read_text())["before"]
