"""The reference rasterizer against plain loops, finite differences, quadrature and identities."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch

from surfkit.raster.api import ALONG_RAYS, Maps, Splats
from surfkit.raster.projection import colors, footprints, gaussians, sh_basis
from surfkit.raster.reference import Reference, draw

from .plain import evaluate, harmonics, rotation
from .scenes import (
    CASES,
    NEAR,
    PRIMITIVE_KINDS,
    Draw,
    axis_camera,
    camera,
    crop,
    double,
    leaves,
    make,
    plain,
    quaternions,
    rows,
    splats,
)

MAPS = ("color", "alpha", "depth", "median", "normal", "distortion")
each_case = pytest.mark.parametrize(("name", "kind"), CASES)


@cache
def small(name: str, kind: str):
    """Some 60 splats of a scene in float64, through a window of 24 x 20 pixels about the camera's axis."""
    drawn, view = make(name, kind)
    return rows(double(drawn), slice(0, 60)), crop(view, 24, 20, 16, 14)


@cache
def looped(name: str, kind: str):
    return evaluate(*small(name, kind), NEAR)


@each_case
def test_maps_equal_a_plain_loop(name, kind):
    drawn = draw(*small(name, kind), NEAR)
    assert drawn.near_threshold.double().mean() < 0.03
    expected = looped(name, kind).maps
    assert len(looped(name, kind).blended) > 20
    for key, value in drawn.maps.present().items():
        error = (value - torch.from_numpy(expected[key])).abs() * ~drawn.near_threshold
        # Where a ray nearly lies in the disc's plane, a rounding moves the hit by 1e7 times as much. The loop takes
        # B^2 / 4A from C as it stands in GOF's paper, and what is left is small against both.
        assert error.max() < {("edge_on", "surfel"): 1e-7}.get((name, kind), 1e-8 if kind in ALONG_RAYS else 1e-10), key


@each_case
@pytest.mark.parametrize("powers", [(0.5, 0.5), (1.0, 1.0), (0.8, 0.3)])
def test_contribution_equals_a_sum_over_what_is_blended(name, kind, powers):
    shown, view = small(name, kind)
    if draw(shown, view, NEAR).near_threshold.any() and name == "edge_on":
        pytest.skip("a pixel sits on a threshold")
    total, count = np.zeros(len(shown)), np.zeros(len(shown), dtype=int)
    for _, _, index, alpha, open_ in looped(name, kind).blended:
        total[index] += alpha ** powers[0] * open_ ** powers[1]
        count[index] += 1
    made, hits = Reference().contribution(shown, view, NEAR, *powers)
    assert hits.tolist() == count.tolist()
    assert np.abs(made.numpy() - total).max() < 1e-7


@each_case
def test_culling_does_not_change_a_pixel(name, kind):
    shown, view = make(name, kind)
    shown = rows(double(shown), slice(0, 40))
    culled, whole = draw(shown, view, NEAR), draw(shown, view, NEAR, cull=False)
    for key, value in culled.maps.present().items():
        assert (value - getattr(whole.maps, key)).abs().max() < 1e-12, key
    assert torch.equal(culled.seen, whole.seen)
    assert not (culled.seen & ~culled.footprints.drawn).any()


@each_case
def test_everything_is_finite(name, kind):
    shown, view = small(name, kind)
    render = Reference().render(shown, view, NEAR)
    draws = Draw(0)
    gradients = render.backward(
        Maps(**{key: draws.normal(*value.shape) for key, value in render.maps.present().items()})
    )
    values = {**render.maps.present(), **gradients.tensors(), "signal": gradients.signal, "radii": render.radii}
    for key, value in values.items():
        assert torch.isfinite(value).all(), key
    assert gradients.means.abs().sum() > 0


@pytest.mark.parametrize("kind", PRIMITIVE_KINDS)
def test_a_splat_at_the_centre_of_the_camera_gives_finite_gradients(kind):
    shown, view = make("plain", kind, degree=3)
    shown = rows(double(shown), slice(0, 8))
    view = replace(axis_camera(24, 20), world_to_camera=torch.eye(4, dtype=torch.float64))
    shown.means[:4] = torch.tensor([0.1, 0.1, 1.5]).double()
    shown.means[4:] = 0
    render = Reference().render(shown, view, NEAR)
    gradients = render.backward(Maps(**{key: torch.ones_like(value) for key, value in render.maps.present().items()}))
    assert all(torch.isfinite(value).all() for value in gradients.tensors().values())
    assert gradients.means[:4].abs().sum() > 0
    assert not gradients.means[4:].any()


@pytest.mark.parametrize("share", [1e-4, 1e-8, 1e-12, 1e-16, 1e-20])
@pytest.mark.parametrize(("kind", "antialias"), [("surfel", False), ("gaussian", False), ("gaussian", True)])
def test_float32_stays_finite_for_splats_of_almost_no_size(kind, antialias, share):
    shown, view = make("plain", kind)
    shown, view = replace(rows(shown, slice(0, 50)), antialias=antialias), crop(view, 24, 20, 16, 14)
    render = Reference().render(replace(shown, scales=share * shown.scales), view, NEAR)
    assert antialias or render.seen.sum() > 5
    made, draws = render.maps.present(), Draw(0)
    gradients = render.backward(Maps(**{key: draws.normal(*value.shape).float() for key, value in made.items()}))
    assert all(torch.isfinite(value).all() for value in [*made.values(), *gradients.tensors().values()])


@pytest.mark.parametrize("length", [1e-25, 1e25])
@pytest.mark.parametrize("kind", PRIMITIVE_KINDS)
def test_the_length_of_a_quaternion_does_not_count(kind, length):
    shown, view = make("plain", kind)
    maps = [Reference().render(replace(shown, quats=q), view, NEAR).maps for q in (shown.quats, length * shown.quats)]
    assert maps[0].alpha.max() > 0.1
    assert (maps[0].color - maps[1].color).abs().max() < 1e-4


@pytest.mark.parametrize("kind", PRIMITIVE_KINDS)
def test_hidden_splats_are_seen(kind):
    """Seen says where the footprint is, as in the native rasterizer; densification averages over it."""
    count, scales = 6, torch.tensor([3.0, 3.0, 0.3])[: 2 if kind == "surfel" else 3]
    means = torch.linspace(1, 2, count)[:, None] * torch.tensor([0.0, 0.0, 1.0])
    means[-1] += torch.tensor([90.0, 0.0, 0.0])  # beside the image
    quats = torch.tensor([[1.0, 0.0, 0.0, 0.0]]).expand(count, 4)
    wall = Splats(kind, means, quats, scales.expand(count, -1), torch.full((count,), 0.999), torch.zeros(count, 1, 3))
    render = Reference().render(wall, axis_camera(24, 20), NEAR)
    assert not Reference().contribution(wall, axis_camera(24, 20), NEAR, 1, 1)[1][2:].any()  # two of 0.99 end a ray
    assert render.seen.tolist() == 5 * [True] + [False]
    assert ((render.radii > 0) == render.seen).all()


@pytest.mark.parametrize("kind", PRIMITIVE_KINDS)
def test_the_graph_of_a_view_holds_nothing_per_splat_and_pixel(kind):
    """Or a view of ordinary size would not fit into memory where there is no compiler."""
    shown, view = make("faint", kind)
    held = []

    def keep(tensor):
        held.append(tensor.numel())
        return tensor

    with torch.autograd.graph.saved_tensors_hooks(keep, lambda tensor: tensor):
        draw(leaves(shown), view, NEAR)
    assert held and max(held) <= max(48 * len(shown), 10 * view.width * view.height)


def test_spherical_harmonics_equal_legendre_functions():
    directions = torch.nn.functional.normalize(Draw(1).normal(50, 3), dim=1)
    expected = np.stack([harmonics(direction, 3) for direction in directions.numpy()])
    for count in (1, 4, 9, 16):
        assert np.abs(sh_basis(directions, count).numpy() - expected[:, :count]).max() < 1e-12


def test_spherical_harmonics_are_orthonormal():
    heights, weights = np.polynomial.legendre.leggauss(8)
    around = 2 * np.pi * np.arange(16) / 16
    z, azimuth = (torch.from_numpy(a.ravel()) for a in np.meshgrid(heights, around, indexing="ij"))
    level = (1 - z * z).sqrt()
    basis = sh_basis(torch.stack([level * azimuth.cos(), level * azimuth.sin(), z], 1), 16)
    area = torch.from_numpy(np.repeat(weights, 16) * 2 * np.pi / 16)
    assert torch.allclose(basis.T @ (area[:, None] * basis), torch.eye(16).double(), atol=1e-12)


def few(kind: str, degree: int, antialias: bool = False, pixels: float = 8.0, geometry: str = "axis"):
    """Three splats of some pixels over 4 x 3 pixels, away from every threshold, the median inside."""
    draws = Draw(5)
    view = replace(crop(camera(draws), 4, 3), cx=1.7, cy=1.9, fx=26.0, fy=28.0)
    skew = 0.4 * draws.normal(3, 3, 3)
    tilted = torch.linalg.matrix_exp(skew - skew.transpose(1, 2))  # of discs that face the camera
    made = double(splats(
        draws, view, kind, degree,
        quats=quaternions(view.world_to_camera[:3, :3].T @ tilted),
        centres=torch.tensor([[0.02, -0.03, 1.0], [-0.03, 0.02, 1.3], [0.03, 0.01, 1.7]]).double(),
        scales=pixels / 27 * draws.uniform(0.6, 1.4, 3, 2 if kind == "surfel" else 3),
        opacities=torch.tensor([0.35, 0.6, 0.7]).double(),
    ))  # fmt: skip
    if kind == "gaussian":
        made.scales[:, 2] *= 0.3
    return Splats(kind, *made.tensors().values(), antialias=antialias, geometry=geometry), view


@pytest.mark.parametrize(
    ("kind", "antialias", "geometry"),
    [
        ("surfel", False, "axis"),
        ("gaussian", False, "axis"),
        ("gaussian", True, "axis"),
        ("gaussian", False, "plane"),
        ("gaussian", False, "ray"),
        ("gaussian", False, "solid"),
    ],
)
def test_gradcheck_of_every_map_for_every_parameter(kind, antialias, geometry):
    shown, view = few(kind, 1, antialias, geometry=geometry)
    drawn = draw(shown, view, NEAR)
    assert not drawn.near_threshold.any()
    assert all(value.abs().max() > 1e-3 for value in drawn.maps.present().values())
    assert drawn.seen.all()

    def maps(*tensors):
        return tuple(draw(Splats(kind, *tensors, antialias, geometry=geometry), view, NEAR).maps.present().values())

    assert torch.autograd.gradcheck(maps, tuple(leaves(shown).tensors().values()), atol=1e-7, rtol=1e-5)


def test_gradcheck_of_the_colour_of_degree_3():
    shown, view = few("surfel", 3)

    def seen(means, *sh):
        return colors(Splats("surfel", means, shown.quats, shown.scales, shown.opacities, *sh), view)

    tensors = leaves(shown).tensors()
    assert torch.autograd.gradcheck(seen, (tensors["means"], tensors["sh0"], tensors["sh_rest"]))


def test_gradients_of_the_low_pass_filter():
    """Discs below a pixel: the filter's centre carries the gradient, the depth is that of the disc's plane.

    The depth is checked near the middle, where it is not clamped: the limits count as constants.
    """
    shown, view = few("surfel", 0, pixels=0.6)
    assert draw(shown, view, NEAR).maps.alpha.max() > 0.3

    def maps(*tensors):
        made = draw(Splats("surfel", *tensors), view, NEAR).maps
        return made.color, made.alpha, made.depth[1:, 1:3]

    assert torch.autograd.gradcheck(maps, tuple(leaves(shown).tensors().values()), atol=1e-6, rtol=1e-4)


def test_depth_of_a_gaussian_is_where_its_density_on_the_ray_is_largest():
    """To first order about the centre: half the offset leaves a quarter of the error."""
    from scipy.optimize import minimize_scalar

    shown, view = make("plain", "gaussian")
    shown = rows(double(shown), slice(0, 6))
    prints = gaussians(shown, view, NEAR)
    pose = view.world_to_camera
    for i in range(len(shown)):
        lone = gaussians(rows(shown, slice(i, i + 1)), view, NEAR)
        axes = (pose[:3, :3] @ turned(shown.quats[i])).numpy()
        centre = (pose[:3, :3] @ shown.means[i] + pose[:3, 3]).numpy()
        precision = axes @ np.diag(shown.scales[i].numpy() ** -2) @ axes.T
        errors = []
        for step in (0.0, 0.02, 0.01):
            x, y = (prints.screen[i] + step * torch.tensor([0.8, -0.6]).double()).tolist()
            ray = np.array([(x - view.cx) / view.fx, (y - view.cy) / view.fy, 1.0])

            def distance(z, ray=ray, centre=centre, precision=precision):
                return (z * ray - centre) @ precision @ (z * ray - centre)

            bounds = (0.5 * centre[2], 1.5 * centre[2])
            true = minimize_scalar(distance, bounds=bounds, method="bounded", options={"xatol": 1e-12}).x
            depth = lone.at(torch.tensor([0]), *torch.tensor([[x], [y]]).double(), torch.zeros(2).double())[1].item()
            errors.append(abs(depth - true))
        assert errors[0] < 1e-7
        assert errors[2] < 0.3 * errors[1] + 1e-7 and errors[1] < 2e-3


@pytest.mark.parametrize("geometry", ["plane", "ray"])
def test_the_normal_of_an_ellipsoid_is_that_of_the_plane_of_largest_densities_on_parallel_rays(geometry):
    """Rays along a pixel's one, or along that through the centre; the largest density is searched numerically."""
    from scipy.optimize import minimize_scalar

    shown, view = few("gaussian", 0, geometry=geometry)
    prints, pose = footprints(shown, view, NEAR), view.world_to_camera
    for i in range(len(shown)):
        axes = (pose[:3, :3] @ turned(shown.quats[i])).numpy()
        centre, scales = (pose[:3, :3] @ shown.means[i] + pose[:3, 3]).numpy(), shown.scales[i].numpy()
        x, y = (prints.screen[i] + (geometry == "ray") * torch.tensor([1.6, -1.2]).double()).tolist()
        ray, met = np.array([(x - view.cx) / view.fx, (y - view.cy) / view.fy, 1.0]), []
        for start in np.array([[0, 0, 0], [0.1, 0, 0], [0, 0.1, 0]]):

            def rho(z, start=start, ray=ray, axes=axes, centre=centre, scales=scales):
                return (((start + z * ray - centre) @ axes / scales) ** 2).sum()

            found = minimize_scalar(rho, bounds=(0.1, 3.0), method="bounded", options={"xatol": 1e-12})
            met.append(start + found.x * ray)
            if geometry == "ray" and not start.any():
                at, here = torch.tensor([[x], [y]], dtype=torch.float64), torch.tensor([i])
                made_rho, depth, _ = prints.at(here, *at, torch.zeros(2).double())
                assert made_rho.item() == pytest.approx(found.fun, rel=1e-9)
                assert depth.item() == pytest.approx(found.x, abs=1e-6)
        wanted = np.cross(met[1] - met[0], met[2] - met[0])
        wanted *= -np.sign(wanted @ ray) / np.linalg.norm(wanted)
        assert abs((met[0] - centre) @ wanted) < 1e-6  # the plane goes through the centre
        made = prints.normals(here, *at)[0, 0] if geometry == "ray" else prints.normal[i]
        assert np.abs(made.detach().numpy() - wanted).max() < 1e-5


def test_along_rays_a_small_ellipsoid_far_away_looks_as_its_projection():
    """EWA is the limit: without dilation and with the axis' footprint, the farther the nearer."""
    errors = []
    for far in (1.0, 4.0):
        shown, view = few("gaussian", 0, geometry="ray")
        shown = replace(shown, means=view.centre + far * (shown.means - view.centre))
        prints, pose = footprints(shown, view, NEAR), view.world_to_camera
        local = shown.means @ pose[:3, :3].T + pose[:3, 3]
        screen = prints.screen[:, None] + 0.5 / far * torch.tensor([[1.0, 2.0], [-2.0, 1.0]]).double()
        for i in range(len(shown)):
            x, y, z = local[i].tolist()
            turn = pose[:3, :3] @ turned(shown.quats[i])
            lens = torch.tensor([[view.fx / z, 0, -view.fx * x / z**2], [0, view.fy / z, -view.fy * y / z**2]])
            half = lens.double() @ turn * shown.scales[i]
            offset = screen[i] - prints.screen[i]
            flat = torch.einsum("pi,ij,pj->p", offset, torch.linalg.inv(half @ half.T), offset)
            exact = prints.at(torch.tensor([i]), *screen[i].T, torch.zeros(2).double())[0][0]
            errors.append(((exact - flat).abs() / flat).max().item())
    assert max(errors[3:]) < 0.3 * max(errors[:3]) < 0.3


def turned(quat):
    return torch.from_numpy(rotation(quat.numpy()))


def weighted(maps: Maps, by: dict) -> torch.Tensor:
    return sum((by[key] * value).sum() for key, value in maps.present().items())


def cotangents(view, seed: int = 7) -> dict:
    draws, size = Draw(seed), (view.height, view.width)
    return {key: draws.normal(*((3, *size) if key in ("color", "normal") else size)) for key in MAPS}


@pytest.mark.parametrize("geometry", ["axis", "plane", "ray"])
def test_the_signal_of_gaussians_is_the_slope_of_a_shift_on_the_screen(geometry):
    """Moving the principal point moves every splat on the screen and changes nothing else.

    But for the normals along rays, which hang on the pixel and not on where the splat lies: they say nothing of it.
    """
    shown, view = few("gaussian", 2, geometry=geometry)
    by = cotangents(view)
    if geometry == "ray":
        by["normal"] = torch.zeros_like(by["normal"])
    for which in (slice(0, 1), slice(1, 2), slice(2, 3), slice(0, 3)):
        some = rows(shown, which)
        gradients = Reference().render(some, view, NEAR).backward(Maps(**by), Maps(color=by["color"]))
        for axis, name, size in ((0, "cx", view.width), (1, "cy", view.height)):
            h = 1e-5
            moved = [draw(some, replace(view, **{name: getattr(view, name) + s}), NEAR).maps for s in (h, -h)]
            slope = (weighted(moved[0], by) - weighted(moved[1], by)) / (2 * h) * size / 2
            assert gradients.signal[:, axis].sum().item() == pytest.approx(slope.item(), rel=1e-6, abs=1e-7)
            slope = ((moved[0].color - moved[1].color) * by["color"]).sum() / (2 * h) * size / 2
            assert gradients.chosen[:, axis].sum().item() == pytest.approx(slope.item(), rel=1e-6, abs=1e-7)


def test_the_signal_of_surfels_is_the_slope_of_a_sideways_move():
    """A move of the mean along the image plane by h changes T_u.z (or T_v.z) by f h and, at degree 0, nothing else."""
    shown, view = few("surfel", 0)
    by = cotangents(view)
    pose = view.world_to_camera
    gradients = Reference().render(shown, view, NEAR).backward(Maps(**by))
    for i in range(len(shown)):
        z = (pose[:3, :3] @ shown.means[i] + pose[:3, 3])[2]
        for axis, focal, size in ((0, view.fx, view.width), (1, view.fy, view.height)):
            values = []
            for h in (1e-5, -1e-5):
                means = shown.means.clone()
                means[i] += h * pose[axis, :3]
                values.append(weighted(draw(replace(shown, means=means), view, NEAR).maps, by))
            slope = (values[0] - values[1]) / 2e-5 / focal * z * size / 2
            assert gradients.signal[i, axis].item() == pytest.approx(slope.item(), rel=1e-6, abs=1e-7)


@pytest.mark.parametrize("kind", PRIMITIVE_KINDS)
def test_absolute_signals_are_sums_over_single_pixels(kind):
    shown, view = make("plain", kind, 0)
    shown, view = double(rows(shown, slice(0, 12))), crop(view, 20, 14, 20, 16)  # two tiles wide
    given, render = cotangents(view), Reference().render(shown, view, NEAR)
    found = render.backward(Maps(**given), Maps(**given), absolute=True).chosen
    total = torch.zeros_like(found)
    for y in range(view.height):
        for x in range(view.width):
            mask = torch.zeros(view.height, view.width, dtype=torch.float64)
            mask[y, x] = 1
            total += render.backward(Maps(**{key: value * mask for key, value in given.items()})).signal.abs()
    assert (found > 0).any()
    assert torch.allclose(found, total, rtol=1e-9, atol=1e-12)


def test_fewer_maps_are_the_same_maps():
    shown, view = plain("surfel", 0, 1)
    whole = Reference().render(shown, view, NEAR).maps.present()
    assert tuple(whole) == MAPS
    for wanted, names in (({"distortion": False}, MAPS[:5]), ({"geometry": False}, MAPS[:2])):
        made = Reference().render(shown, view, NEAR, **wanted).maps.present()
        assert tuple(made) == names
        assert all(torch.equal(value, whole[name]) for name, value in made.items())


@pytest.mark.parametrize("kind", PRIMITIVE_KINDS)
def test_no_splats_and_splats_behind_the_camera_give_black(kind):
    shown, view = make("plain", kind)
    behind = shown.means - 5 * view.world_to_camera[2, :3].float()
    for some in (rows(shown, slice(0, 0)), replace(shown, means=behind)):
        render = Reference().render(some, view, NEAR)
        assert not any(value.any() for value in render.maps.present().values())
        assert not render.seen.any() and not render.radii.any()
        gradients = render.backward(Maps(color=torch.ones(3, 47, 61)))
        assert gradients.means.shape == some.means.shape and not gradients.means.any()
