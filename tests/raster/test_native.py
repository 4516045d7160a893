"""The native rasterizer against the reference in float64, and against itself with other threads and kernels."""

from dataclasses import replace

import pytest
import torch
from needs import needs_native
from torch import Tensor

from surfkit.core.check import BadInput
from surfkit.raster import native
from surfkit.raster.api import ALONG_RAYS, ALPHA_MIN, MAPS, STANDARD, Maps, Render, Splats
from surfkit.raster.native_rasterizer import NativeRasterizer
from surfkit.raster.projection import footprints
from surfkit.raster.reference import Reference, draw
from surfkit.raster.ssim import ssim
from surfkit.scene.camera import Camera

from .cases import FORWARD, Case, added, case, different_gradients, different_maps, true_gradients
from .scenes import CASES, NEAR, PRIMITIVE_KINDS, SCENES, Draw, camera, double, make, rows

pytestmark = needs_native
each_case = pytest.mark.parametrize(("name", "kind"), CASES)


def rendered(c: Case) -> Render:
    return NativeRasterizer().render(c.splats, c.view, NEAR)


@each_case
def test_maps_equal_the_reference(name, kind):
    c = case(name, kind)
    assert c.clear.double().mean() > 0.97
    assert c.true.maps.alpha.max() > 0.1
    assert not different_maps(rendered(c).maps, c.true.maps, c.clear)


@pytest.mark.parametrize("degree", range(4))
@pytest.mark.parametrize("kind", PRIMITIVE_KINDS)
def test_every_degree_of_the_colour(kind, degree):
    c = case("plain", kind, degree)
    assert c.splats.sh.shape[1] == (degree + 1) ** 2
    render = rendered(c)
    assert not different_maps(render.maps, c.true.maps, c.clear)
    total = Maps(color=c.cotangents["color"])
    assert not different_gradients(render.backward(total), c.true.backward(total))


@each_case
def test_gradients_equal_the_reference_for_each_map(name, kind):
    c = case(name, kind)
    render, wrong = rendered(c), {}
    for key, value in c.cotangents.items():
        total = Maps(**{key: value})
        found = render.backward(total, total)
        # One is the sum of the pixels' shares, the other comes from moments; without dilation those may be steep.
        assert (found.chosen - found.signal).norm() <= (1e-5 if kind in ALONG_RAYS else 1e-6) * found.signal.norm(), key
        if errors := different_gradients(found, true_gradients(name, kind)[key], c.allowed):
            wrong[key] = errors
    assert not wrong


@each_case
def test_gradients_and_chosen_signals_equal_the_reference_for_all_maps(name, kind):
    c = case(name, kind)
    render, total, each = rendered(c), Maps(**c.cotangents), true_gradients(name, kind)
    true, half = added(each.values()), Maps(**{key: 0.5 * value for key, value in c.cotangents.items()})
    for chosen, signal in ((Maps(color=total.color), each["color"].signal), (half, 0.5 * true.signal)):
        assert not different_gradients(render.backward(total, chosen), replace(true, chosen=signal), c.allowed)
        assert (signal - true.signal).norm() > 0.1 * true.signal.norm()


@each_case
def test_gradients_of_the_first_rows_are_those_of_all(name, kind):
    """To the bit: what gets no gradient hides others as before. Also of the reference."""
    c = case(name, kind)
    total, rows = Maps(**c.cotangents), len(c.splats) // 2
    for render in [rendered(c)] + [c.true] * (name == "tiny"):  # the reference is slow
        for chosen, absolute in ((None, False), (Maps(color=total.color), False), (total, False), (total, True)):
            whole = render.backward(total, chosen, absolute)
            part = render.backward(total, chosen, absolute, rows)
            for key in (*STANDARD, "signal", "chosen"):
                value, wanted = getattr(part, key), getattr(whole, key)
                assert (value is None) == (wanted is None) and (value is None or torch.equal(value, wanted[:rows])), key
            none = render.backward(total, chosen, absolute, 0)
            assert none.means.shape == (0, 3) and none.signal.shape == (0, 2)


@each_case
def test_absolute_signals_equal_the_reference(name, kind):
    c = case(name, kind)
    render, total, true = rendered(c), Maps(**c.cotangents), added(true_gradients(name, kind).values())
    for chosen in (Maps(color=c.cotangents["color"]), total):
        found = render.backward(total, chosen, absolute=True)
        signal = c.true.backward(Maps(), chosen, absolute=True).chosen
        assert not different_gradients(found, replace(true, chosen=signal), c.allowed)
        assert (found.chosen >= 0.99 * render.backward(total, chosen).chosen.abs() - 1e-5).all()


@each_case
def test_seen_and_radii_equal_the_reference(name, kind):
    c = case(name, kind)
    render = rendered(c)
    assert not (c.true.seen & ~render.seen).any()
    assert not render.radii[~render.seen].any()
    error = (render.radii - c.true.radii).abs()[c.true.seen]
    assert (error <= 1e-2 + 1e-3 * c.true.radii[c.true.seen]).all()


@each_case
def test_contribution_equals_the_reference(name, kind):
    c = case(name, kind)
    for powers in ((0.5, 0.5), (0.8, 0.3)):
        total, count = NativeRasterizer().contribution(c.splats, c.view, NEAR, *powers)
        true_total, true_count = Reference().contribution(double(c.splats), c.view, NEAR, *powers)
        near = int((~c.clear).sum())  # pixels at which either may count one more or less
        assert ((count - true_count).abs() <= near).all()
        assert ((total - true_total).abs() <= 1e-4 * (1 + true_total) + near).all()


@pytest.mark.parametrize("kind", PRIMITIVE_KINDS)
def test_contribution_is_exact_away_from_thresholds(kind):
    shown, view = make("plain", kind)
    for i in range(40):
        one = rows(shown, slice(i, i + 1))
        if draw(double(one), view, NEAR).near_threshold.any():
            continue
        for powers in ((0.5, 0.5), (1.0, 1.0), (0.8, 0.3)):
            total, count = NativeRasterizer().contribution(one, view, NEAR, *powers)
            true_total, true_count = Reference().contribution(double(one), view, NEAR, *powers)
            assert torch.equal(count, true_count)
            assert (total - true_total).abs() <= 1e-5 * (1 + true_total)


@each_case
def test_opacity_before_points_equals_the_reference(name, kind):
    """Points on the splats, before and behind them, anywhere in a pixel, outside and behind the camera."""
    c = case(name, kind)
    draws = Draw(3)
    near_by = c.splats.means.double().repeat(3, 1) + 0.1 * draws.normal(3 * len(c.splats), 3)
    around = 3 * draws.normal(200, 3)
    points = torch.cat([near_by, around])
    found = NativeRasterizer().opacity_before(c.splats, c.view, NEAR, points)
    exact = Reference().opacity_before(double(c.splats), c.view, NEAR, points)
    assert torch.equal(found.isnan(), exact.isnan())
    inside = ~exact.isnan()
    assert 20 < inside.sum() < len(points)
    error = (found.double() - exact).abs()[inside]
    risky = error > 1e-4  # a splat at the limit of opacity, or at the point's own depth
    assert risky.double().mean() < 0.01 and error.median() < 1e-6


@pytest.mark.parametrize("kind", PRIMITIVE_KINDS)
def test_opacity_before_a_point_behind_everything_is_that_of_the_image(kind):
    shown, view = make("plain", kind)
    rays = view.rays(torch.float64).flatten(1).T * 50
    points = (rays - view.world_to_camera[:3, 3]) @ view.world_to_camera[:3, :3]
    found = NativeRasterizer().opacity_before(shown, view, NEAR, points)
    alpha = NativeRasterizer().render(shown, view, NEAR, geometry=False).maps.alpha.flatten()
    assert ((found - alpha).abs() < 2e-4).all()  # the image stops at a transmittance of 1e-4
    points = (rays / 50 * (2 * NEAR) - view.world_to_camera[:3, 3]) @ view.world_to_camera[:3, :3]
    assert not NativeRasterizer().opacity_before(shown, view, NEAR, points).any()


@pytest.mark.parametrize("kind", PRIMITIVE_KINDS)
def test_backward_is_linear(kind):
    c = case("opaque", kind)
    render = rendered(c)
    first = Maps(**{key: c.cotangents[key] for key in MAPS[:3]})
    second = Maps(**{key: c.cotangents[key] for key in MAPS[3:]})
    one, two, both = (render.backward(maps) for maps in (first, second, Maps(**c.cotangents)))
    assert both.chosen is None
    assert not different_gradients(both, added([one, two]))


@pytest.mark.parametrize("kind", PRIMITIVE_KINDS)
def test_fewer_maps_are_the_same_maps(kind):
    c = case("faint", kind)
    whole = rendered(c)
    only = Maps(color=c.cotangents["color"], alpha=c.cotangents["alpha"])
    for wanted, names in (({"distortion": False}, MAPS[:5]), ({"geometry": False}, MAPS[:2])):
        render = NativeRasterizer().render(c.splats, c.view, NEAR, **wanted)
        assert tuple(render.maps.present()) == names
        for key, value in render.maps.present().items():
            assert (value - getattr(whole.maps, key)).abs().max() < 1e-6, key
        assert not different_gradients(render.backward(only, only), whole.backward(only, only))


def test_a_cotangent_of_a_map_that_was_not_made_is_refused():
    c = case("plain", "surfel")
    render = NativeRasterizer().render(c.splats, c.view, NEAR, geometry=False)
    with pytest.raises(BadInput, match="cotangent of depth"):
        render.backward(Maps(depth=c.cotangents["depth"]))
    with pytest.raises(BadInput, match="cotangent of color: shape"):
        render.backward(Maps(color=c.cotangents["color"][:, 1:]))


def crowd(kind: str) -> tuple[Splats, Camera]:
    """Splats of all scenes, several pieces of work for the threads, over several tiles."""
    parts = [make(name, kind, 1, seed)[0] for seed in range(3) for name in SCENES]
    joined = [torch.cat(tensors) for tensors in zip(*(part.tensors().values() for part in parts), strict=True)]
    return replace(make("plain", kind)[0], **dict(zip(STANDARD, joined, strict=True))), camera(Draw(2), 149, 97)


def everything(shown: Splats, view: Camera) -> dict[str, Tensor]:
    """Every number that the native module makes of a view."""
    render = NativeRasterizer().render(shown, view, NEAR)
    draws = Draw(4)
    total = Maps(**{key: draws.normal(*value.shape).float() for key, value in render.maps.present().items()})
    gradients = render.backward(total, Maps(color=total.color))
    summed, count = NativeRasterizer().contribution(shown, view, NEAR, 0.5, 0.5)
    leads = NativeRasterizer().leading(shown, view, NEAR)
    image = render.maps.color.clamp(0, 1).requires_grad_()
    similar = ssim(image, image.detach().flip(2))
    similar.backward()
    made = {**render.maps.present(), **{f"d {key}": value for key, value in gradients.tensors().items()}}
    made |= {"signal": gradients.signal, "chosen": gradients.chosen, "seen": render.seen, "radii": render.radii}
    return made | {"sum": summed, "count": count, "leads": leads, "ssim": similar.detach(), "d ssim": image.grad}


@pytest.fixture
def threads():
    """`torch.set_num_threads`, set back afterwards."""
    before = torch.get_num_threads()
    yield torch.set_num_threads
    torch.set_num_threads(before)


@pytest.mark.parametrize("kind", (*PRIMITIVE_KINDS, *ALONG_RAYS))
def test_the_number_of_threads_does_not_change_a_bit(kind, threads):
    shown, view = crowd(kind)
    made = {}
    for number in (1, 2, 5):
        threads(number)
        made[number] = everything(shown, view)
    assert len(shown) > 1500 and made[1]["seen"].sum() > 500
    for number in (2, 5):
        different = [key for key, value in made[1].items() if not same_bits(value, made[number][key])]
        assert not different, f"{number} threads"


def same_bits(a: Tensor, b: Tensor) -> bool:
    """Equal, a NaN too: another test's concern."""
    return a.numpy().tobytes() == b.numpy().tobytes()


@pytest.fixture
def kernels():
    """`use_kernels` of the module, set back afterwards."""
    before = native.module().kernels_in_use()
    yield native.module().use_kernels
    native.module().use_kernels(before)


@pytest.mark.parametrize("compiled", native.module().kernels() if native.module() else [])
@each_case
def test_every_compilation_of_the_kernels_equals_the_reference(name, kind, compiled, kernels):
    kernels(compiled)
    assert native.module().kernels_in_use() == compiled
    c = case(name, kind)
    render = rendered(c)
    assert not different_maps(render.maps, c.true.maps, c.clear)
    true = added(true_gradients(name, kind).values())
    assert not different_gradients(render.backward(Maps(**c.cotangents)), true, c.allowed)


@pytest.mark.parametrize("kind", PRIMITIVE_KINDS)
def test_compilations_agree_on_a_larger_view(kind, kernels):
    """The scenes above compare each with the reference; this one adds tiles cut by the border and long lists."""
    shown, view = crowd(kind)
    made, radii = [], []
    for compiled in native.module().kernels():
        kernels(compiled)
        render = NativeRasterizer().render(shown, view, NEAR)
        made.append(render.maps.present())
        radii.append(render.radii)
    assert all(torch.equal(radii[0], other) for other in radii[1:])
    assert made[0]["alpha"].mean() > 0.5
    for key, value in made[0].items():
        for other in made[1:]:
            apart = (value - other[key]).abs() > FORWARD * max(1.0, value.abs().max().item())
            assert apart.double().mean() < 3e-3, key  # a few pixels sit on a threshold


@pytest.mark.parametrize("kind", (*PRIMITIVE_KINDS, *ALONG_RAYS))
def test_culling_never_loses_a_pixel(kind):
    """One splat at a time, of every scene, against the alpha of the reference at every pixel."""
    for name in [name for name, k in CASES if k == kind]:
        shown, view = make(name, kind, 0, seed=21)
        exact = double(shown)
        prints = footprints(exact, view, NEAR)
        rays = view.rays(torch.float64)
        x, y = (rays[0] * view.fx + view.cx).flatten(), (rays[1] * view.fy + view.cy).flatten()
        rho, _, opacity = prints.at(torch.arange(len(shown)), x, y, torch.zeros(2).double())
        raw = opacity * torch.exp(-rho / 2) * prints.drawn[:, None]
        for i in range(len(shown)):
            made = NativeRasterizer().render(rows(shown, slice(i, i + 1)), view, NEAR, geometry=False).maps.alpha
            lost = (made.flatten() == 0) & (raw[i] > (1 + 1e-4) * ALPHA_MIN)
            assert not lost.any(), f"{name}: splat {i} at {lost.nonzero()[:3, 0].tolist()}"


@pytest.mark.parametrize("kind", (*PRIMITIVE_KINDS, *ALONG_RAYS))
def test_what_only_grazes_the_image_is_seen(kind):
    """Splats of every size around the rim: those that reach a pixel are drawn, most of the others are left out."""
    draws, count = Draw(5), 1_500
    view = replace(camera(draws), cx=9.0)
    z = draws.uniform(0.6, 4.0, count)
    x, y = (draws.uniform(-120, size + 120, count) for size in (view.width, view.height))
    local = torch.stack([(x - view.cx) / view.fx * z, (y - view.cy) / view.fy * z, z], -1)
    means = (local - view.world_to_camera[:3, 3]) @ view.world_to_camera[:3, :3]
    columns = 2 if kind == "surfel" else 3
    scales = torch.exp(draws.uniform(-1.0, 3.7, count, columns)) * (z / view.fx)[:, None]
    given = (means, draws.normal(count, 4), scales, draws.uniform(0.05, 1.0, count), torch.zeros(count, 1, 3))
    shown = Splats("surfel" if kind == "surfel" else "gaussian", *(value.float() for value in given))
    shown = replace(shown, geometry=kind if kind in ALONG_RAYS else "axis")
    prints = footprints(double(shown), view, NEAR)
    rays = view.rays(torch.float64)
    at = [(rays[k] * f + c).flatten() for k, f, c in ((0, view.fx, view.cx), (1, view.fy, view.cy))]
    rho, _, opacity = prints.at(torch.arange(count), *at, torch.zeros(2).double())
    reaches = ((opacity * torch.exp(-rho / 2)).amax(1) > (1 + 1e-4) * ALPHA_MIN) & prints.drawn
    seen = NativeRasterizer().render(shown, view, NEAR, geometry=False).seen
    assert not (reaches & ~seen).any()
    assert 100 < reaches.sum() <= seen.sum() < 2 * reaches.sum()


@pytest.mark.parametrize("kind", PRIMITIVE_KINDS)
@pytest.mark.parametrize(
    ("name", "value", "words"),
    [("scales", float("nan"), "not finite"), ("means", float("inf"), "not finite"), ("scales", -1.0, "not positive"),
     ("quats", 0.0, "zero"), ("opacities", float("nan"), "not finite"), ("sh0", float("nan"), "not finite")],
)  # fmt: skip
def test_bad_values_are_refused_with_their_row(kind, name, value, words):
    shown, view = make("plain", kind)
    # A splat that would be drawn: the module reads the colour of no other.
    row = int(case("plain", kind).true.seen.nonzero()[9, 0])
    tensor = getattr(shown, name).clone()
    tensor[row] = value
    with pytest.raises(BadInput, match=f"splats.{name}: 1 of 70 .*{words}.*row {row}$"):
        NativeRasterizer().render(replace(shown, **{name: tensor}), view, NEAR)


def test_values_beyond_float32_are_refused():
    shown, view = make("plain", "surfel")
    exact = double(shown)
    exact.scales[5] = 1e-60
    with pytest.raises(BadInput, match="row 5 .*float32"):
        NativeRasterizer().render(exact, view, NEAR)


@pytest.mark.parametrize("kind", PRIMITIVE_KINDS)
def test_no_splats_and_splats_behind_the_camera_give_black(kind):
    shown, view = make("plain", kind)
    behind = shown.means - 5 * view.world_to_camera[2, :3].float()
    for some in (rows(shown, slice(0, 0)), replace(shown, means=behind)):
        render = NativeRasterizer().render(some, view, NEAR)
        assert not any(value.any() for value in render.maps.present().values())
        assert not render.seen.any() and not render.radii.any()
        gradients = render.backward(Maps(color=torch.ones(3, 47, 61)))
        assert gradients.means.shape == some.means.shape and not gradients.means.any()
        total, count = NativeRasterizer().contribution(some, view, NEAR, 0.5, 0.5)
        assert len(total) == len(count) == len(some) and not count.any()


@pytest.mark.parametrize("kind", PRIMITIVE_KINDS)
@pytest.mark.parametrize("size", [(1, 1), (16, 16), (17, 15), (33, 2), (3, 50)])
def test_images_of_any_size(kind, size):
    shown, view = make("plain", kind, 1)
    view = view.resized(*size)
    exact = double(shown)
    drawn, render = draw(exact, view, NEAR), NativeRasterizer().render(shown, view, NEAR)
    assert not different_maps(render.maps, drawn.maps, ~drawn.near_threshold)
    total = Maps(color=(Draw(1).normal(3, size[1], size[0]) * ~drawn.near_threshold).float())
    assert not different_gradients(render.backward(total), Reference().render(exact, view, NEAR).backward(total))


@pytest.mark.parametrize("kind", PRIMITIVE_KINDS)
def test_what_is_seen_and_gradients_need_no_look_at_the_maps(kind):
    """A view is drawn when its maps are asked for, by the way back too."""
    shown, view = make("plain", kind, 2)
    total = Maps(color=Draw(2).normal(3, view.height, view.width).float())
    blind, looked = (NativeRasterizer().render(shown, view, NEAR) for _ in range(2))
    assert torch.equal(blind.seen, looked.seen)
    assert looked.maps.color.any() and looked.maps is looked.maps
    found, expected = blind.backward(total).tensors(), looked.backward(total).tensors()
    assert all(torch.equal(found[name], value) and value.any() for name, value in expected.items())


@pytest.mark.parametrize("kind", PRIMITIVE_KINDS)
def test_a_splat_at_the_centre_of_the_camera_changes_nothing(kind):
    shown, view = make("plain", kind, 3)
    shown.means[3] = view.centre.float()
    render = NativeRasterizer().render(shown, view, NEAR)
    gradients = render.backward(Maps(color=torch.ones(3, 47, 61)))
    assert not render.seen[3] and not gradients.means[3].any()
    assert all(torch.isfinite(value).all() for value in gradients.tensors().values())


@pytest.mark.parametrize("kind", PRIMITIVE_KINDS)
def test_near_hides_what_is_closer(kind):
    shown, view = make("plain", kind)
    pose = view.world_to_camera
    z = shown.means.double() @ pose[2, :3] + pose[2, 3]
    near = z.median().item() + 1e-4
    render, true = (r.render(s, view, near) for r, s in ((NativeRasterizer(), shown), (Reference(), double(shown))))
    assert not render.seen[z <= near].any() and render.seen[z > near].any()
    clear = ~draw(double(shown), view, near).near_threshold
    assert not different_maps(render.maps, true.maps, clear)


@pytest.mark.parametrize("compiled", native.module().kernels() if native.module() else [])
@pytest.mark.parametrize("count", [1, 3, 33, 550])
def test_surfels_do_not_depend_on_those_beside_them(count, compiled, kernels):
    """Several are computed at once: in another order, beside others and beside some that are not drawn, they are the
    same to the bit."""
    kernels(compiled)
    shown, view = crowd("surfel")
    moved = 1e-3 * torch.randn(len(shown), 3, generator=torch.Generator().manual_seed(1))
    shown = replace(shown, means=shown.means + moved)  # no two at one depth
    splats = shown.take(NativeRasterizer().render(shown, view, NEAR).seen.nonzero()[:count, 0])
    count = len(splats)
    faint = replace(splats.take(torch.arange(min(count, 5))), opacities=torch.full((min(count, 5),), 0.5 * ALPHA_MIN))
    order = torch.randperm(count, generator=torch.Generator().manual_seed(0))
    other = joined(faint, splats.take(order))
    plain, mixed = (NativeRasterizer().render(some, view, NEAR) for some in (splats, other))
    total = Maps(color=plain.maps.color - 0.5, median=plain.maps.median - 0.5)
    assert plain.seen.any() and not mixed.seen[: len(faint)].any()
    assert torch.equal(mixed.radii[len(faint) :], plain.radii[order])
    back = mixed.backward(total).tensors()
    for name, value in plain.backward(total).tensors().items():
        found = back[name]
        assert torch.equal(found[len(faint) :], value[order]), name
        assert not found[: len(faint)].any(), name


def joined(*parts: Splats) -> Splats:
    return replace(parts[0], **{name: torch.cat([getattr(part, name) for part in parts]) for name in STANDARD})
