import math

import numpy as np
import pytest
import torch

from surfkit.core.check import BadInput
from surfkit.core.registry import components
from surfkit.primitives import Flat3D, Gaussian3D, Surfel2D
from surfkit.primitives.base import Primitive, rotated
from surfkit.primitives.edit import Edit, apply
from surfkit.primitives.init import LONE_POINT_SIZE, MIN_POINT_SIZE, gaps
from surfkit.primitives.points import Points
from surfkit.runs.run_notes import collect_notes
from surfkit.scene.scene import SparsePoints

ALL = [Surfel2D(), Gaussian3D(), Flat3D()]
names = dict(ids=lambda part: type(part).__name__)


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def cloud(count: int = 50, normals: bool = False) -> SparsePoints:
    draw = generator(1)
    unit = torch.nn.functional.normalize(torch.randn(count, 3, generator=draw), dim=-1) if normals else None
    xyz = torch.randn(count, 3, generator=draw)
    return SparsePoints(xyz, torch.randint(0, 256, (count, 3), generator=draw, dtype=torch.uint8), unit)


def matrix(quat: np.ndarray) -> np.ndarray:
    """Rotation matrix from scipy, independent of ours."""
    from scipy.spatial.transform import Rotation

    return Rotation.from_quat(np.roll(quat, -1)).as_matrix()


def test_registered_names():
    known = {"flat3d": Flat3D, "gaussian3d": Gaussian3D, "surfel2d": Surfel2D}
    assert known.items() <= components(Primitive).items(), "packages may offer more"


@pytest.mark.parametrize("primitive", ALL, **names)
def test_init_gives_the_columns_and_the_splats_the_rasterizer_expects(primitive):
    params = primitive.init(cloud(), generator())
    axes = 3 if isinstance(primitive, Gaussian3D) else 2
    assert {name: tuple(value.shape[1:]) for name, value in params.items()} == {
        "means": (3,), "scales": (axes,), "quats": (4,), "opacities": (), "sh0": (1, 3), "sh_rest": (15, 3),
    }  # fmt: skip
    assert all(len(v) == 50 and v.dtype == torch.float32 and v.isfinite().all() for v in params.values())
    splats = primitive.activate(params, 0)
    assert splats.scales.shape == (50, 2 if splats.kind == "surfel" else 3) and (splats.scales > 0).all()
    assert torch.allclose(splats.opacities, torch.tensor(0.1))
    rgb = splats.sh[:, 0] / (2 * math.sqrt(math.pi)) + 0.5  # the constant harmonic, from its definition
    assert torch.allclose(rgb, cloud().rgb / 255, atol=1e-6)


@pytest.mark.parametrize("primitive", ALL, **names)
@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_shape_uses_the_harmonics_in_use_and_carries_their_gradient(primitive, degree):
    params = {k: v.requires_grad_() for k, v in primitive.init(cloud(5), generator()).items()}
    with torch.no_grad():
        params["sh_rest"].copy_(torch.arange(5 * 45.0).view(5, 15, 3))
    splats = primitive.activate(params, degree)
    assert splats.sh.shape == (5, (degree + 1) ** 2, 3)
    assert torch.equal(splats.sh[:, 1:], params["sh_rest"][:, : (degree + 1) ** 2 - 1])
    assert degree == 0 or splats.sh_rest.data_ptr() == params["sh_rest"].data_ptr(), "most of a point was copied"
    sum(value.sum() for value in splats.tensors().values()).backward()
    assert torch.allclose(params["scales"].grad, params["scales"].detach().exp())
    assert torch.allclose(params["opacities"].grad, torch.tensor(0.09))
    if degree:
        assert params["sh_rest"].grad.sum() == 5 * 3 * ((degree + 1) ** 2 - 1)


@pytest.mark.parametrize("degree", [-1, 4])
def test_degrees_that_do_not_exist_are_refused(degree):
    with pytest.raises(BadInput, match=f"sh_degree is {degree}"):
        Surfel2D(sh_degree=degree)


def test_degree_zero_trains():
    params = Gaussian3D(sh_degree=0).init(cloud(4), generator())
    assert params["sh_rest"].shape == (4, 0, 3) and Gaussian3D(sh_degree=0).activate(params, 0).sh.shape == (4, 1, 3)


def test_flat_gaussians_stay_flat():
    params = Flat3D(thickness=0.01).init(cloud(), generator())
    params["scales"][:, 0] += 2
    scales = Flat3D(thickness=0.01).activate(params, 0).scales
    assert torch.allclose(scales[:, 2], 0.01 * scales[:, 1]) and (scales.argmin(-1) == 2).all()
    planes = Flat3D(thickness=0.0).activate(params, 0).scales
    assert (planes[:, 2] > 0).all() and (planes[:, 2] ** 2 + planes[:, 1] ** 2 == planes[:, 1] ** 2).all()
    for wrong in (1.5, -0.1):
        with pytest.raises(BadInput, match=f"thickness is {wrong}"):
            Flat3D(thickness=wrong)


def test_ellipsoids_may_begin_thin_along_the_normals_of_the_cloud():
    given = cloud(normals=True)
    thin = Gaussian3D(first_thickness=0.1).init(given, torch.Generator())
    axes = rotated(torch.tensor([[0.0, 0.0, 1.0]]).expand(50, 3), thin["quats"])
    assert torch.allclose((axes * given.normals).sum(1).abs(), torch.ones(50), atol=1e-5)
    scales = thin["scales"].exp()
    assert torch.allclose(scales[:, 2], 0.1 * scales[:, 0]) and torch.equal(scales[:, 0], scales[:, 1])
    balls = Gaussian3D().init(given, torch.Generator())
    assert torch.equal(balls["scales"][:, :2], thin["scales"][:, :2]) and not balls["scales"].std(1).any()
    with collect_notes() as notes:
        anyhow = Gaussian3D(first_thickness=0.1).init(cloud(), torch.Generator())
        assert not anyhow["scales"].std(1).any(), "no normals, no thin axis"
        Gaussian3D().init(cloud(), torch.Generator())
    assert len(notes.texts) == 1 and "first_thickness: the start knows no normals" in notes.texts[0]
    for wrong in (0.0, 1.5, float("nan")):
        with pytest.raises(BadInput, match=r"primitive\.first_thickness is"):
            Gaussian3D(first_thickness=wrong)


@pytest.mark.parametrize("primitive", [Surfel2D(), Flat3D()], **names)
def test_discs_face_the_normals_of_the_cloud(primitive):
    given = cloud(normals=True)
    given.normals[0], given.normals[1] = torch.tensor([0.0, 0.0, -1.0]), torch.tensor([0.0, 0.0, 1.0])
    quats = primitive.init(given, generator())["quats"].double().numpy()
    third = np.stack([matrix(quat)[:, 2] for quat in quats])
    assert np.allclose(third, given.normals.numpy(), atol=1e-5)


def test_random_discs_face_every_way():
    quats = Surfel2D().init(cloud(2000), generator())["quats"]
    normals = rotated(torch.tensor([[0.0, 0.0, 1.0]]).expand(2000, 3), quats)
    assert normals.mean(0).abs().max() < 0.06
    assert torch.allclose((normals.T @ normals) / 2000, torch.eye(3) / 3, atol=0.03)


def test_rotated_agrees_with_a_rotation_matrix():
    quats, vectors = torch.randn(20, 4, generator=generator()), torch.randn(20, 3, generator=generator(1))
    wanted = np.stack([matrix(q) @ v for q, v in zip(quats.double().numpy(), vectors.double().numpy(), strict=True)])
    assert np.allclose(rotated(vectors, quats).numpy(), wanted, atol=1e-5)


def test_gaps_are_root_mean_square_distances_to_three_neighbours():
    xyz = torch.randn(40, 3, generator=generator())
    square = torch.cdist(xyz.double(), xyz.double()).fill_diagonal_(math.inf) ** 2
    assert torch.allclose(gaps(xyz).double(), square.topk(3, largest=False).values.mean(-1).sqrt(), rtol=1e-5)


@pytest.mark.parametrize(
    ("xyz", "wanted"),
    [
        ([[1, 2, 3]], [LONE_POINT_SIZE]),
        ([[0, 0, 0], [0, 0, 2]], [2, 2]),
        ([[1, 1, 1]] * 5, [LONE_POINT_SIZE] * 5),
        ([[0, 0, 0]] * 4 + [[3, 4, 0]], [5] * 5),
        ([[0, 0, 0], [0, 0, 1e-9]], [MIN_POINT_SIZE] * 2),
    ],
)
def test_gaps_of_degenerate_clouds(xyz, wanted):
    assert torch.allclose(gaps(torch.tensor(xyz, dtype=torch.float64)), torch.tensor(wanted, dtype=torch.float32))


@pytest.mark.parametrize("count", [1, 2])
@pytest.mark.parametrize("primitive", ALL, **names)
def test_init_of_tiny_clouds(primitive, count):
    assert all(value.isfinite().all() for value in primitive.init(cloud(count), generator()).values())


def test_init_of_an_empty_cloud_says_what_to_do():
    with pytest.raises(BadInput, match="no sparse points"):
        Surfel2D().init(cloud(0), generator())


@pytest.mark.parametrize("primitive", ALL, **names)
def test_children_are_drawn_from_their_parent(primitive):
    parents = {name: value.repeat(20000, *[1] * (value.dim() - 1)) for name, value in row(primitive).items()}
    twins = primitive.split(parents, generator())
    assert len(twins["means"]) == 40000
    offset = (twins["means"] - parents["means"][0]).double()
    axes = torch.from_numpy(matrix(parents["quats"][0].double().numpy()))
    scales = primitive.activate(parents, 0).scales[0].double()
    scales = torch.cat([scales, scales.new_zeros(3 - len(scales))])
    wanted = axes @ (scales**2).diag() @ axes.T
    assert torch.allclose(offset.T @ offset / 40000, wanted, atol=0.03 * float(wanted.max()))
    assert offset.mean(0).abs().max() < 0.02 * scales.max()
    if isinstance(primitive, Surfel2D):
        assert (offset @ axes[:, 2]).abs().max() < 1e-5, "children must lie in the plane of a disc"
    assert torch.allclose(twins["scales"].exp() * 1.6, parents["scales"].exp().repeat(2, 1))
    for name in ("quats", "opacities", "sh0", "sh_rest"):
        assert torch.equal(twins[name], torch.cat([parents[name]] * 2))


def row(primitive: Primitive) -> dict[str, torch.Tensor]:
    params = primitive.init(cloud(10), generator())
    params["scales"] += torch.arange(params["scales"].shape[1])  # an ellipse, not a circle
    params["quats"] = torch.randn(10, 4, generator=generator(5))
    return {name: value[:1] for name, value in params.items()}


def edited(seed: int = 0) -> tuple[Points, Points]:
    primitive = Surfel2D(sh_degree=1)
    points = Points.fresh(primitive.init(cloud(8), generator()))
    for size, group in enumerate((points.exp_avg, points.exp_avg_sq)):
        for name in group:
            group[name] += torch.arange(1.0, 9).view(-1, *[1] * (group[name].dim() - 1)) * (size + 1)
    points.stat("x").copy_(torch.arange(8.0))
    rows = torch.arange(8)
    edit = Edit(drop=rows == 0, clone=(rows == 3) | (rows == 5), split=rows == 6)
    return points, apply(primitive, points, edit, generator(seed))


def test_apply_moves_moments_and_statistics_with_their_rows():
    before, after = edited()
    kept = [1, 2, 3, 4, 5, 7]
    assert len(after) == 6 + 2 + 2
    for name, value in before.params.items():
        assert torch.equal(after.params[name][:6], value[kept])
        assert torch.equal(after.params[name][6:8], value[[3, 5]]), "clones are exact copies"
        for old, new in ((before.exp_avg, after.exp_avg), (before.exp_avg_sq, after.exp_avg_sq)):
            assert torch.equal(new[name][:6], old[name][kept]) and not new[name][6:].any()
    assert after.stat("x").tolist() == [1, 2, 3, 4, 5, 7, 0, 0, 0, 0]


def test_apply_repeats_itself_and_draws_from_the_generator():
    assert torch.equal(edited()[1].params["means"], edited()[1].params["means"])
    assert not torch.equal(edited(0)[1].params["means"], edited(1)[1].params["means"])


def test_apply_of_an_empty_edit_changes_nothing():
    before, _ = edited()
    none = torch.zeros(8, dtype=torch.bool)
    after = apply(Surfel2D(sh_degree=1), before, Edit(none, none, none), generator())
    assert all(torch.equal(after.params[name], value) for name, value in before.params.items())


def test_max_opacity_caps_and_forgets():
    before, _ = edited()
    before.params["opacities"].copy_(torch.linspace(-9, 9, 8))
    after = apply(Surfel2D(sh_degree=1), before, Edit(max_opacity=0.01), generator())
    assert torch.allclose(after.params["opacities"].sigmoid(), before.params["opacities"].sigmoid().clamp_max(0.01))
    assert not after.exp_avg["opacities"].any() and not after.exp_avg_sq["opacities"].any()
    assert after.exp_avg["means"].any() and before.params["opacities"].max() == 9


@pytest.mark.parametrize("primitive", [Surfel2D(), Gaussian3D(), Flat3D()])
def test_activations_have_the_same_bits_on_any_number_of_threads(primitive):
    """More points than one thread takes, and not a whole number of vectors for each of several."""
    before, count = torch.get_num_threads(), 36_482
    params = primitive.init(cloud(4), generator())
    params = {name: value[:1].expand(count, *value.shape[1:]).clone() for name, value in params.items()}
    params["opacities"] = 3 * torch.randn(count, generator=generator())
    params["scales"] = torch.randn(count, params["scales"].shape[1], generator=generator())
    found = []
    try:
        for threads in (1, 2, 3):
            torch.set_num_threads(threads)
            raw = {name: value.clone().requires_grad_() for name, value in params.items()}
            splats = primitive.activate(raw, 0)
            loss = (splats.opacities * params["opacities"]).sum() + (splats.scales * 0.5).sum()
            gradients = torch.autograd.grad(loss, [raw["opacities"], raw["scales"]])
            found.append([splats.opacities.detach(), splats.scales.detach(), *gradients])
    finally:
        torch.set_num_threads(before)
    for other in found[1:]:
        assert all(torch.equal(a, b) for a, b in zip(found[0], other, strict=True))
