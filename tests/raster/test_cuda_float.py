"""The CUDA rasterizer without a number in double: how far that is from float64, where floats alone would lose most.

Scenes lie 100,000 units from the origin and are seen by images 5472 pixels wide, through long lenses too.
"""

import re
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.nn.functional import normalize

from surfkit.core.check import BadInput
from surfkit.raster.api import STANDARD, Maps, Splats
from surfkit.raster.cuda.rasterizer import GAUSSIAN, RAY, RECORD_BYTES, SURFEL, source
from surfkit.raster.native_rasterizer import NativeRasterizer
from surfkit.raster.nvrtc.cuda_source import CudaSource
from surfkit.raster.nvrtc.emulated import Emulated
from surfkit.raster.nvrtc.nvrtc import nvrtc
from surfkit.scene.camera import Camera

from .nvrtc.sources import KERNELS, SHIPPED, raster
from .scenes import NEAR, Draw, quaternions, splats
from .test_cuda import CUDA, EmulatedRasterizer, pytestmark  # noqa: F401 (the mark skips these tests too)

WIDTH, FAR_AWAY = 5472, 1e5
PIXELS, GRADIENT = 1e-3, 1e-4
OF_THE_CPU = {"reach", "fuse", "settle", "sum_by_code"}
"""Kernels that must give the bits of the CPU, which computes in double there."""
KINDS = ("surfel", "gaussian", "plane", "ray")
SCENES = {
    "far": {"focal": 20_000.0, "depth": (2, 4)},
    "near": {"focal": 3000.0, "depth": (-0.5, 0.5)},
    "grazing": {"focal": 5000.0, "is_grazing": True},
    "needle": {"focal": 20_000.0, "size": 60.0, "ratio": 300.0},
}
each_kind = pytest.mark.parametrize("kind", KINDS)
each_scene = pytest.mark.parametrize("name", SCENES)


def scene(
    kind: str,
    name: str,
    height: int = 32,
    count: int = 60,
    focal: float = 5000.0,
    depth: tuple[float, float] = (1, 3),
    size: float = 8.0,
    ratio: float = 1.0,
    is_grazing: bool = False,
) -> tuple[Splats, Camera]:
    """Splats of about `size` pixels all over an image, at depths of 10^depth; scales differ by up to `ratio`."""
    draw = Draw(5)
    turn = torch.linalg.qr(draw.normal(3, 3)).Q
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, :3] = turn * torch.sign(torch.linalg.det(turn))
    pose[:3, 3] = -pose[:3, :3] @ (torch.tensor([1.0, -0.8, 0.3]).double() * FAR_AWAY + draw.normal(3))
    view = Camera(pose, focal, 1.02 * focal, 0.47 * WIDTH, 0.55 * height, WIDTH, height)
    z = 10 ** draw.uniform(*depth, count)
    x, y = draw.uniform(0, WIDTH, count), draw.uniform(0, height, count)
    centres = torch.stack([(x - view.cx) / view.fx * z, (y - view.cy) / view.fy * z, z], 1)
    scales = (size * z / focal)[:, None] * draw.uniform(-0.5, 0.5, count, 2 if kind == "surfel" else 3).exp()
    scales[:, 0] /= ratio ** draw.uniform(0, 1, count)
    quats = draw.normal(count, 4)
    if is_grazing:
        ray = normalize(centres, dim=1)
        side = normalize(torch.linalg.cross(ray, draw.normal(count, 3)), dim=1)
        angle = torch.logspace(-2.5, -1, count).double()[:, None]
        along = angle.cos() * ray + angle.sin() * torch.linalg.cross(ray, side)
        axes = torch.stack([torch.linalg.cross(along, side), along, side], 2)[:, :, [1, 2, 0]]
        quats = quaternions(turn.T @ axes * torch.sign(torch.linalg.det(turn)))
        scales[:, 2:] *= 0.02
    given = {"centres": centres, "quats": quats, "scales": scales, "opacities": draw.uniform(0.1, 0.9, count)}
    made = splats(draw, view, "surfel" if kind == "surfel" else "gaussian", 3, **given)
    return made if kind in ("surfel", "gaussian") else replace(made, geometry=kind), view


def records(kind: str, shown: Splats, view: Camera) -> tuple[Tensor, np.ndarray]:
    """The splats that are seen, and the floats of their records."""
    drawn = CUDA._pass(shown, view, NEAR)
    floats = drawn.lists[1].numpy().view(np.float32)
    by_kind = RECORD_BYTES[{"surfel": SURFEL, "ray": RAY}.get(kind, GAUSSIAN)]
    return drawn.index, floats.reshape(len(drawn.index), by_kind // 4).astype(np.float64)


def turned(shown: Splats, view: Camera) -> tuple[Tensor, Tensor]:
    """(N, 3) centres and (N, 3, 3) axes in the camera frame, by columns, float64."""
    w, x, y, z = normalize(shown.quats.double(), dim=1).unbind(1)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    turn, shift = view.world_to_camera[:3, :3], view.world_to_camera[:3, 3]
    axes = torch.stack([torch.stack(row, 1) for row in rows], 1)
    return shown.means.double() @ turn.T + shift, turn @ axes


@each_kind
@each_scene
def test_where_splats_are_drawn(kind, name):
    shown, view = scene(kind, name, height=3648, count=300, **SCENES[name])
    index, found = records(kind, shown, view)
    assert len(index) > 250
    shown = shown.take(index)
    centres, axes = turned(shown, view)
    lens = torch.tensor([[view.fx, 0, view.cx], [0, view.fy, view.cy], [0, 0, 1]], dtype=torch.float64)
    if kind != "surfel":
        at = 24 if kind == "ray" else 17
        true = view.project(shown.means.double())[:, :2].numpy()
        assert np.abs(found[:, at : at + 2] + found[:, :2] - true).max() <= PIXELS
        return
    sides = axes[:, :, :2] * shown.scales.double()[:, None, :]
    disc = lens @ torch.cat([sides, centres[:, :, None]], 2)  # (u, v, 1) to pixels times depth
    pairs = found[:, :18].reshape(-1, 9, 2).sum(2)
    a, b, c = pairs[:, :3], pairs[:, 3:6], pairs[:, 6:]
    anchor, meets = found[:, 28:30], c[:, 2] != 0  # no ray meets a disc that is seen edge-on
    assert meets.sum() > 250
    box = disc @ torch.diag(torch.tensor([9.0, 9, -1]).double()) @ disc.mT  # of the 3-sigma contour
    low = (box[:, :2, 2] / box[:, 2:, 2]).numpy()
    assert np.abs(found[:, 35:37] + anchor - low).max() <= PIXELS
    for u, v in ((-1.0, -1.0), (-1.0, 1.0), (1.0, -1.0), (1.0, 1.0), (0.0, 0.0)):
        x, y, w = (disc @ torch.tensor([u, v, 1.0]).double()).numpy().T
        p = (x / w - anchor[:, 0])[:, None] * a + (y / w - anchor[:, 1])[:, None] * b + c
        again = (disc[meets] @ torch.from_numpy(p[meets] / p[meets, 2:])[:, :, None])[:, :, 0].numpy()
        error = again[:, :2] / again[:, 2:] - np.stack([x / w, y / w], 1)[meets]
        assert np.abs(error).max() <= PIXELS, (u, v)


@each_kind
@each_scene
def test_gradients_equal_those_of_the_cpu(kind, name):
    """By norm of an array, and for each splat by its own, which may cancel more."""
    shown, view = scene(kind, name, **SCENES[name])
    found, true = (each.render(shown, view, NEAR) for each in (CUDA, NativeRasterizer()))
    assert torch.equal(found.seen, true.seen) and found.seen.sum() > 50
    draw = Draw(2)
    total = Maps(**{key: draw.normal(*value.shape).float() for key, value in true.maps.present().items()})
    total = replace(total, median=None)  # which splat is the middle one may differ
    found, true = (each.backward(total, Maps(color=total.color)) for each in (found, true))
    for key in (*STANDARD, "signal", "chosen"):
        made, right = (getattr(each, key).double().reshape(len(shown), -1) for each in (found, true))
        error = made - right
        assert error.norm() <= GRADIENT * right.norm(), key
        assert (error.norm(dim=1) <= 1e-3 * right.norm(dim=1) + 1e-6 * right.norm()).all(), key


class Unbounded(EmulatedRasterizer):
    """Draws splats wherever they may be, far beyond their bounds."""

    CHANGES = (
        ("more = 1.0001, pad = 1e-3", "more = 2.0, pad = 300.0"),
        ("slack = 2e-3f", "slack = 20.0f"),
        ("!view.outlook.misses(kKind, (float)largest_scale(in), rounded(centre)) &&", ""),
    )

    def program(self, name: str, **defines: int) -> Emulated:
        made = source(name, **defines)
        text = made.text
        for old, new in self.CHANGES:
            assert old in text or name != "project", old  # project.cu has all files with these
            text = text.replace(old, new)
        made.__dict__["text"] = text
        return Emulated(made)


@each_kind
@each_scene
def test_no_pixel_is_lost_at_the_bounds(kind, name):
    shown, view = scene(kind, name, **SCENES[name])
    bounded, whole = (each.render(shown, view, NEAR) for each in (CUDA, Unbounded()))
    assert whole._pass.slots > 1.2 * bounded._pass.slots
    for key, value in whole.maps.present().items():
        assert torch.equal(getattr(bounded.maps, key), value), key


@each_kind
def test_no_pixel_is_lost_of_needles_far_longer_than_the_image(kind):
    """Their width is the small rest of a difference of squares of their length, here 5000 px at one sigma."""
    count, side, focal, z = 12, 192, 1000.0, 2.0
    angle = torch.linspace(0.1, 3.0, count).double()
    quats = torch.stack([(angle / 2).cos(), 0 * angle, 0 * angle, (angle / 2).sin()], 1)
    view = Camera(torch.eye(4, dtype=torch.float64), focal, focal, side / 2, side / 2, side, side)
    draw = Draw(4)
    centres = torch.cat([0.05 * draw.normal(count, 2), torch.full((count, 1), z).double()], 1)
    scales = torch.tensor([5000.0, 0.6, 0.6]).double().repeat(count, 1)[:, : 2 if kind == "surfel" else 3] * z / focal
    given = {"centres": centres, "quats": quats, "scales": scales, "opacities": draw.uniform(0.1, 0.9, count)}
    made = splats(draw, view, "surfel" if kind == "surfel" else "gaussian", 0, **given)
    made = made if kind in ("surfel", "gaussian") else replace(made, geometry=kind)
    bounded, whole = (each.render(made, view, NEAR) for each in (CUDA, Unbounded()))
    assert (whole.maps.alpha > 0).float().mean() > 0.1
    for key, value in whole.maps.present().items():
        assert torch.equal(getattr(bounded.maps, key), value), key


def test_pairs_of_floats():
    draw, count = Draw(1), 128
    a, b = draw.normal(2, count) * 10 ** draw.uniform(-6, 6, 2, count)
    b[: count // 2] = -a[: count // 2] * (1 + 1e-9 * draw.normal(count // 2))  # sums that cancel
    high = torch.stack([a, b]).float()
    low = (torch.stack([a, b]) - high.double()).float()
    x, y = (high[k].double() + low[k].double() for k in (0, 1))
    out = [torch.zeros(count, 2) for _ in range(6)]
    Emulated(CudaSource(KERNELS / "pair.cu")).launch(
        "arithmetic", 1, 128, *(torch.stack([high[k], low[k]], 1) for k in (0, 1)), *out
    )
    added, subtracted, product, ratio, root, whole = (each.double().sum(1) for each in out)
    exact = 2.0**-44
    assert ((added - (x + y)).abs() <= exact * torch.maximum(x.abs(), y.abs())).all()
    assert ((subtracted - (x - y)).abs() <= exact * torch.maximum(x.abs(), y.abs())).all()
    for found, true in ((product, x * y), (ratio, x / y), (root, x.abs())):
        assert ((found - true).abs() <= exact * true.abs()).all()
    assert torch.equal(whole, x.floor())


@pytest.fixture(scope="module")
def ptx() -> Callable[[CudaSource], dict[str, str]]:
    """Gives the PTX of each kernel of a source."""
    try:
        compiler = nvrtc()
    except BadInput as error:
        pytest.skip(str(error))

    def made(each: CudaSource) -> dict[str, str]:
        text = compiler.compile(each, f"compute_{max(compiler.architectures[0], 75)}")[0].decode(errors="replace")
        return {name: text.partition(f".entry {name}(")[2].partition(".entry ")[0] for name in each.kernels}

    return made


FILES = ("project", "forward", "backward", "gather", "contribution")


@pytest.mark.parametrize(
    ("name", "kind"), [*((name, kind) for name in FILES for kind in (SURFEL, GAUSSIAN, RAY)), ("solid", RAY)]
)
def test_the_rasterizer_has_no_instruction_in_double(ptx, name, kind):
    """And those of its kernels that must find the same join no product and sum but where the source says so: one whose
    rounding is named is not joined with another."""
    for kernel, text in ptx(raster(name, kind)).items():
        assert (".f32" in text or kernel == "list") and ".f64" not in text, kernel
        assert bool(re.search(r"\b(mul|add|sub)\.f32", text)) <= (name not in ("project", "gather")), kernel


@pytest.mark.parametrize(
    "shipped", [each for each, _ in SHIPPED if "KIND" not in each.defines], ids=lambda each: each.path.stem
)
def test_only_what_gives_the_bits_of_the_cpu_computes_in_double(ptx, shipped):
    for kernel, text in ptx(shipped).items():
        assert (".f64" in text) == (kernel in OF_THE_CPU), kernel
