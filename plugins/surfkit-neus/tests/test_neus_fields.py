"""The hash grid, the gradients, the weights and the box against independent formulas."""

import math

import pytest
import torch
from surfkit_neus.box import SceneBox, camera_rays, crossing, scene_box
from surfkit_neus.field import BackgroundField, Networks, SurfaceField, contracted
from surfkit_neus.gradients import analytic, numerical
from surfkit_neus.hashgrid import Grid, HashGrid
from surfkit_neus.losses import color_loss, curvature_loss, depth_loss, eikonal_loss
from surfkit_neus.sampling import beyond_samples, even_samples, importance_samples, surface_samples
from surfkit_neus.weights import section_alphas, section_ends, weights_of

from surfkit.plugin import BadInput, Camera, Frame, Scene, SparsePoints, View

SMALL = Grid(levels=4, features=3, table_bits=9, coarsest=3, finest=24)


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def plain_encoding(table, x, grid, reach):
    """The encoding by its definition: one position, level, corner and feature at a time, in Python numbers."""
    growth = (grid.finest / grid.coarsest) ** (1 / (grid.levels - 1))
    found, start = [], 0
    for level in range(grid.levels):
        side = math.floor(grid.coarsest * growth**level + 1e-6)
        rows = min((side + 1) ** 3, 2**grid.table_bits)
        place = [(value / (2 * reach) + 0.5) * side for value in x]
        low = [min(math.floor(p), side - 1) for p in place]
        sums = [0.0] * grid.features
        for corner in range(8):
            at, weight = [], 1.0
            for axis in range(3):
                upper = corner >> axis & 1
                at.append(low[axis] + upper)
                share = place[axis] - low[axis]
                weight *= share if upper else 1 - share
            if (side + 1) ** 3 <= 2**grid.table_bits:
                row = at[0] + (side + 1) * (at[1] + (side + 1) * at[2])
            else:
                row = (at[0] ^ at[1] * 2654435761 ^ at[2] * 805459861) % rows
            for feature in range(grid.features):
                sums[feature] += weight * table[start + row][feature]
        found += sums
        start += rows
    return found


def test_the_grid_is_that_of_its_definition_with_its_gradients():
    encoding = HashGrid(SMALL, 1.5, generator()).double()
    with torch.no_grad():
        encoding.table.copy_(torch.randn(encoding.table.shape, generator=generator(1), dtype=torch.float64))
    assert (24 + 1) ** 3 > 2**9 > (3 + 1) ** 3, "levels with a hash and levels without"
    x = 3 * torch.rand(40, 3, generator=generator(2), dtype=torch.float64) - 1.5
    x[0], x[1] = 1.5, -1.5  # the last corner and the first
    table = encoding.table.tolist()
    wanted = torch.tensor([plain_encoding(table, p, SMALL, 1.5) for p in x.tolist()], dtype=torch.float64)
    assert torch.allclose(encoding(x), wanted, atol=1e-12)
    x = x[2:].requires_grad_()
    cotangent = torch.randn(len(x), 12, generator=generator(3), dtype=torch.float64)
    gradient, of_table = torch.autograd.grad((encoding(x) * cotangent).sum(), (x, encoding.table))
    step = 1e-7
    for axis in range(3):
        there = [(p + sign * step * torch.eye(3, dtype=torch.float64)[axis]).tolist() for sign in (1, -1) for p in x]
        made = [plain_encoding(table, p, SMALL, 1.5) for p in there]
        up, down = torch.tensor(made, dtype=torch.float64).view(2, len(x), -1)
        assert torch.allclose(gradient[:, axis], ((up - down) / (2 * step) * cotangent).sum(1), atol=1e-5)
    row = int(of_table.abs().sum(1).argmax())
    table[row][1] += 1e-3
    moved = torch.tensor([plain_encoding(table, p, SMALL, 1.5) for p in x.tolist()], dtype=torch.float64)
    change = ((moved - encoding(x).detach()) * cotangent).sum()
    assert float(change) == pytest.approx(1e-3 * float(of_table[row, 1]), rel=1e-6), "it is linear in the table"


def test_gradients_of_gradients_reach_the_table():
    encoding = HashGrid(SMALL, 1.0, generator()).double()
    with torch.no_grad():
        encoding.table.copy_(torch.randn(encoding.table.shape, generator=generator(1), dtype=torch.float64))
    x = (1.9 * torch.rand(5, 3, generator=generator(2), dtype=torch.float64) - 0.95).requires_grad_()

    def slope(table):
        made = torch.func.functional_call(encoding, {"table": table}, (x,))
        return torch.autograd.grad(made.square().sum(), x, create_graph=True)[0]

    table = encoding.table.detach().requires_grad_()
    (found,) = torch.autograd.grad(slope(table).sum(), table)
    row = int(found.abs().sum(1).argmax())
    moved = [table.detach().clone() for _ in range(2)]
    moved[0][row, 0] += 1e-5
    moved[1][row, 0] -= 1e-5
    difference = (slope(moved[0]).sum() - slope(moved[1]).sum()) / 2e-5
    assert float(found[row, 0]) == pytest.approx(float(difference.detach()), rel=1e-5)


def test_levels_that_are_not_used_yet_are_zero_and_learn_nothing():
    encoding = HashGrid(SMALL, 1.0, generator())
    x = torch.rand(30, 3, generator=generator(1))
    some, every = encoding(x, 2), encoding(x)
    assert torch.equal(some[:, :6], every[:, :6]) and not some[:, 6:].any() and every[:, 6:].any()
    some.sum().backward()
    assert not encoding.table.grad[sum(SMALL.rows[:2]) :].any()


def wave(x, levels=None):
    """A function with known derivatives."""
    return (2 * x[:, 0]).sin() * x[:, 1] + x[:, 2] ** 2, x[:, :0]


def test_both_gradients_agree_with_the_formula():
    x = torch.rand(50, 3, generator=generator(), dtype=torch.float64)
    wanted = torch.stack([2 * (2 * x[:, 0]).cos() * x[:, 1], (2 * x[:, 0]).sin(), 2 * x[:, 2]], 1)
    exact, near = analytic(wave, x), numerical(wave, x, 1e-3)
    assert torch.allclose(exact.gradient, wanted, atol=1e-12) and exact.laplacian is None
    assert torch.allclose(near.gradient, wanted, atol=1e-5) and torch.equal(near.sdf, exact.sdf)
    assert torch.allclose(near.laplacian, 2 - 4 * (2 * x[:, 0]).sin() * x[:, 1], atol=1e-4)
    apart = [float((numerical(wave, x, h).gradient - wanted).abs().max()) for h in (0.1, 0.05)]
    assert 3.5 < apart[0] / apart[1] < 4.5, "an error of the second order in the step"


def test_opacity_of_a_section_is_the_closed_form_also_deep_inside():
    front, back = torch.rand(2, 500, generator=generator(), dtype=torch.float64) - 0.5
    for s in (5.0, 64.0, 300.0):
        phi = [1 / (1 + torch.exp(-s * f)) for f in (front, back)]
        wanted = ((phi[0] - phi[1]) / phi[0]).clamp_min(0)
        assert torch.allclose(section_alphas(front, back, s), wanted, atol=1e-9)
    deep = section_alphas(torch.tensor([-3.0, -1e4]), torch.tensor([-3.1, -2e4]), 1e6)
    assert torch.isfinite(deep).all() and (deep == 1).all()


def along(t, surface, angle):
    """Signed distance of a plane that a ray meets at `surface` under an angle, and its slope."""
    return (surface - t) * math.cos(angle), -math.cos(angle)


@pytest.mark.parametrize("angle", [0.0, 0.9])
@pytest.mark.parametrize("s", [50.0, 400.0])
def test_weights_have_their_maximum_and_their_mean_at_the_surface(angle, s):
    edges = torch.linspace(0, 2, 801, dtype=torch.float64)[None]
    middle, length = 0.5 * (edges[:, 1:] + edges[:, :-1]), edges.diff(dim=1)
    distance, slope = along(middle, 1.234, angle)
    front, back = section_ends(distance, torch.full_like(middle, slope), length, 1.0)
    assert torch.allclose(front, along(edges, 1.234, angle)[0][:, :-1]), "the ends of the section are met"
    weights, left = weights_of(section_alphas(front, back, s))
    assert float(weights.sum()) == pytest.approx(1 - float(left), rel=1e-9) and float(left) < 1e-6
    phi = torch.sigmoid(s * along(edges, 1.234, angle)[0])  # the logistic density, integrated over each section
    assert torch.allclose(weights, -phi.diff(dim=1) / phi[:, :1], atol=1e-10), "unbiased"
    assert float(middle[0, weights.argmax()]) == pytest.approx(1.234, abs=0.003)
    assert float((weights * middle).sum()) == pytest.approx(1.234, abs=1e-3)


def test_a_ray_through_a_sphere_sees_its_front():
    t = torch.linspace(0, 4, 4001, dtype=torch.float64)[None]
    sdf = ((t - 2) ** 2 + 0.3**2).sqrt() - 1  # passes the centre at 0.3
    weights = weights_of(section_alphas(sdf[:, :-1], sdf[:, 1:], 300.0))[0]
    middle = 0.5 * (t[:, 1:] + t[:, :-1])
    hit = 2 - math.sqrt(1 - 0.09)
    assert float((weights * middle).sum()) == pytest.approx(hit, abs=2e-3)
    assert float(weights[middle > 2].sum()) < 1e-6, "where the distance rises there is no weight"


def test_slopes_that_rise_weigh_less_and_less():
    ends = [section_ends(torch.zeros(1), torch.tensor([0.4]), torch.ones(1), anneal) for anneal in (0.0, 0.5, 1.0)]
    assert [float(front - back) for front, back in ends] == pytest.approx([0.3, 0.15, 0.0])


def test_samples_gather_at_the_surface_and_stay_sorted():
    near, far = torch.tensor([0.5, 1.0]), torch.tensor([2.5, 2.0])
    even = even_samples(near, far, 9, None)
    assert torch.allclose(even[:, 0], near) and torch.allclose(even[:, -1], far)
    moved = even_samples(near, far, 9, generator())
    assert (moved >= near[:, None]).all() and (moved <= far[:, None]).all() and (moved.diff(dim=1) >= 0).all()
    surface = torch.tensor([[1.7], [1.2]])
    t = surface_samples(even, lambda t: surface - t, 32, 4)
    assert t.shape == (2, 41) and (t.diff(dim=1) >= 0).all()
    assert (((t - surface).abs() < 0.1).sum(1) >= 20).all()
    assert surface_samples(even, lambda t: surface - t, 0, 4) is even


def test_importance_samples_invert_the_distribution():
    t = torch.tensor([[0.0, 1.0, 3.0, 4.0]]).double()
    found = importance_samples(t, torch.tensor([[1.0, 0.0, 3.0]]).double(), 4000)[0]
    assert ((found < 1).double().mean() - 0.25).abs() < 1e-3 and ((found > 3).double().mean() - 0.75).abs() < 1e-3
    assert torch.allclose(found[found > 3].mean(), torch.tensor(3.5).double(), atol=1e-2)


def test_samples_beyond_the_box_are_even_in_the_inverse_distance():
    t = beyond_samples(torch.tensor([2.0]), 4, None)[0]
    assert (
        torch.allclose(1 / t, torch.tensor([0.5, 0.4, 0.3, 0.2, 0.1])) and (beyond_samples(t, 4, generator()) > 0).all()
    )
    x = 10 * torch.randn(200, 3, generator=generator())
    inside = x.abs().amax(1) <= 1
    short = contracted(x)
    assert torch.equal(short[inside], x[inside]) and (short.abs() < 2).all()
    assert torch.allclose(short.abs().amax(1)[~inside], 2 - 1 / x.abs().amax(1)[~inside])


def test_rays_enter_and_leave_the_box_where_they_should():
    halves = torch.tensor([1.0, 0.5, 0.2], dtype=torch.float64)
    origin = torch.tensor([[0, 0, 2.0], [0, 0, 0.1], [3, 3, 3.0], [0, 0, 2.0]], dtype=torch.float64)
    direction = torch.tensor([[0, 0, -1.0], [1, 0, 0], [0, 0, 1], [0.6, 0, -0.8]], dtype=torch.float64)
    near, far = crossing(origin, direction, halves)
    assert near[:2].tolist() == pytest.approx([1.8, 0.01]) and far[:2].tolist() == pytest.approx([2.2, 1.0])
    assert near[2] == far[2] > 0 and near[3] == far[3] == pytest.approx(1.6), "those that miss it"


def survey(points: int = 500, cameras=((0, 0, 1), (0.5, 0, 1.2), (0, 0.5, 1.1))) -> Scene:
    """Cameras above flat ground that slopes."""
    draw = generator()
    xyz = torch.rand(points, 3, generator=draw) * torch.tensor([4.0, 2.0, 0.1])
    turn = torch.linalg.qr(torch.randn(3, 3, generator=draw, dtype=torch.float64))[0]
    turn *= torch.linalg.det(turn)
    views = []
    for at, place in enumerate(cameras):
        pose = torch.eye(4, dtype=torch.float64)
        centre = turn @ (torch.tensor(place, dtype=torch.float64) + torch.tensor([2.0, 1.0, 1.0]))
        pose[:3, 3] = -centre
        views.append(View(f"{at}", Camera(pose, 40.0, 40.0, 16.0, 12.0, 32, 24), None))
    cloud = SparsePoints((xyz.double() @ turn.T).float(), torch.zeros(points, 3, dtype=torch.uint8))
    return Scene("slope", tuple(views), (), cloud, Frame.of_positions(xyz.numpy()))


def test_the_scene_box_lies_along_the_ground_with_the_cameras_above():
    scene = survey()
    box = scene_box(scene, 0.0)
    assert box.shape == "plane" and torch.linalg.det(box.axes) == pytest.approx(1)
    assert box.scale == pytest.approx(2, rel=0.05) and box.halves.tolist() == pytest.approx([1, 0.5, 0.1], rel=0.05)
    x = box.inward(scene.cloud.xyz)
    assert 0.9 < float(box.holds(x).double().mean()) < 1, "but for outliers"
    assert abs(float(x[:, 2].median()) - box.level) < 1e-6
    assert torch.allclose(box.outward(x), scene.cloud.xyz.double(), atol=1e-6)
    assert all(box.inward(view.camera.centre[None])[0, 2] > 0.2 for view in scene.train)
    around = [(x, y, 0) for x, y in ((3, 0), (-3, 0), (0, 3), (0, -3))]
    assert scene_box(survey(cameras=around), 0.0).shape == "sphere"


def test_rays_go_through_the_pixels_they_are_of():
    scene = survey()
    box, camera = scene_box(scene, 0.1), scene.train[1].camera
    pixels = torch.tensor([0, 31, 400, 767])
    rays = camera_rays(camera, box, pixels)
    t = torch.full((4, 1), 0.7)
    u, v, z = camera.project(box.outward(rays.at(t)[:, 0])).unbind(1)
    assert torch.allclose(u.float(), pixels % 32 + 0.5, atol=1e-4)
    assert torch.allclose(v.float(), torch.div(pixels, 32, rounding_mode="floor") + 0.5, atol=1e-4)
    assert torch.allclose(z.float(), 0.7 * rays.depth, atol=1e-6)


def test_a_scene_without_a_size_is_refused():
    with pytest.raises(BadInput, match="9 sparse points"):
        scene_box(survey(9), 0.1)
    scene = survey()
    flat = Scene("dot", scene.train, (), SparsePoints(torch.zeros(50, 3), scene.cloud.rgb[:50]), scene.frame)
    with pytest.raises(BadInput, match="lie in one place"):
        scene_box(flat, 0.1)


def test_the_field_begins_as_its_shape():
    x = 2 * torch.rand(100, 3, generator=generator()) - 1
    for shape, level, wanted in (("plane", 0.3, x[:, 2] - 0.3), ("sphere", -0.5, x.norm(dim=1) - 0.5)):
        field = SurfaceField(SMALL, Networks(width=16), shape, level, 20.0, generator(1))
        found = analytic(field, x)
        assert torch.allclose(found.sdf, wanted, atol=1e-6)
        assert torch.allclose(found.gradient.norm(dim=1), torch.ones(100), atol=1e-4)
        assert field.sharpness.item() == pytest.approx(20, rel=1e-5)
    with torch.no_grad():
        field.log_sharpness.fill_(1e3)
    assert field.sharpness.item() == pytest.approx(1e6), "no Inf"
    density, color = BackgroundField(SMALL, Networks(width=16), generator())(20 * x, x)
    assert (density >= 0).all() and ((color >= 0) & (color <= 1)).all()


def test_losses():
    ones = torch.ones(4, 3)
    assert float(color_loss(ones, 0.5 * ones, torch.tensor([1.0, 0, 1, 0]))) == 0.5
    assert float(color_loss(ones, 0.5 * ones, torch.zeros(4))) == 0, "all masked"
    gradient = torch.tensor([[3.0, 0, 0], [0, 1, 0], [9, 9, 9]])
    inside = torch.tensor([True, True, False])
    assert float(eikonal_loss(gradient, inside)) == pytest.approx(2)
    assert float(curvature_loss(torch.tensor([2.0, -4, 99]), inside)) == 3
    zero = torch.zeros(3, 3, requires_grad=True)
    eikonal_loss(zero, inside).backward()
    assert torch.isfinite(zero.grad).all()
    assert float(depth_loss(torch.tensor([1.5, 9]), torch.tensor([1.0, 0]), torch.ones(2))) == 0.5
    assert float(depth_loss(torch.ones(2), torch.zeros(2), torch.ones(2))) == 0


@pytest.mark.parametrize("wrong", [{"levels": 0}, {"features": 0}, {"table_bits": 60}, {"coarsest": 600}])
def test_grids_that_make_no_sense_are_refused(wrong):
    with pytest.raises(BadInput, match="finest" if "coarsest" in wrong else next(iter(wrong))):
        Grid(**wrong)


def test_the_box_is_plain_data():
    box = SceneBox(torch.zeros(3), torch.eye(3), 2.0, torch.tensor([1.0, 0.5, 0.2]), "plane", 0.0)
    assert box.holds(torch.tensor([[0.9, 0.4, 0.1], [0.9, 0.6, 0.1]])).tolist() == [True, False]
