"""NeuSG against analytic surfaces: what each term pulls at, and where it ends."""

import math
from dataclasses import dataclass, replace
from types import SimpleNamespace

import pytest
import torch
from surfkit_neus.gradients import Geometry
from surfkit_sdf_splats.neusg import Guidance, NeuSG, Thin, apart, thinnest

from surfkit.plugin import BadInput, SparsePoints, Splats, Surfel2D

RADIUS = 0.5


@dataclass
class Ball:
    """The analytic distance of a sphere, as a surface: the box is the local frame, turned and twice as large."""

    radius: torch.Tensor
    alone: int = 0

    @property
    def box(self):
        turn = torch.linalg.qr(torch.randn(3, 3, generator=torch.Generator().manual_seed(4), dtype=torch.float64))[0]
        return SimpleNamespace(axes=turn, scale=2.0, holds=lambda x: (x.abs() <= 1).all(1))

    def inward(self, local):
        return (local.detach().double() @ self.box.axes.T / 2).float()

    def geometry(self, x):
        return Geometry(x.norm(dim=1) - self.radius, torch.nn.functional.normalize(x, dim=1), x[:, :0])


def gaussians(means, quats, scales=None) -> Splats:
    count = len(means)
    scales = torch.tensor([0.3, 0.02, 0.2]).repeat(count, 1) if scales is None else scales
    return Splats("gaussian", means, quats, scales, torch.full((count,), 0.9), torch.zeros(count, 1, 3))


def some(count=40, seed=0):
    draw = torch.Generator().manual_seed(seed)
    around = torch.nn.functional.normalize(torch.randn(count, 3, generator=draw), dim=1)
    return around * (0.8 + 0.4 * torch.rand(count, 1, generator=draw)), torch.randn(count, 4, generator=draw)


def test_the_scale_regularizer_makes_the_smallest_scale_smaller_and_no_other():
    scales = (0.1 + torch.rand(50, 3, generator=torch.Generator().manual_seed(1))).requires_grad_()
    Thin().__call__(gaussians(*some(50), scales)).backward()
    least = torch.zeros(50, 3).scatter_(1, scales.detach().argmin(1, keepdim=True), 1.0)
    assert torch.allclose(scales.grad, least / 50)
    flat = torch.rand(5, 2, requires_grad=True)
    assert Thin()(replace(gaussians(*some(5)), kind="surfel", scales=flat)) == 0, "discs are flat"


def test_the_normal_is_the_thinnest_axis():
    half = math.sqrt(0.5)  # a quarter turn about x takes y to z
    turned = gaussians(torch.zeros(1, 3), torch.tensor([[half, half, 0, 0]]))
    assert torch.allclose(thinnest(turned), torch.tensor([[0, 0, 1.0]]), atol=1e-6)
    cloud = SparsePoints(torch.rand(9, 3), torch.zeros(9, 3, dtype=torch.uint8))
    surfels = Surfel2D().activate(Surfel2D().init(cloud, torch.Generator().manual_seed(0)), 0)
    w, x, y, z = torch.nn.functional.normalize(surfels.quats, dim=1).unbind(1)
    third = torch.stack([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)], 1)
    assert torch.allclose(thinnest(surfels), third, atol=1e-5)


def test_the_surface_turns_tilted_gaussians_and_moves_them_onto_itself():
    means, quats = (value.requires_grad_() for value in some())
    link = Guidance(NeuSG(centres=400, to_surface=1.0, to_normal=1.0), Ball(torch.tensor(RADIUS)))

    def tilt():
        out = torch.nn.functional.normalize(means.detach(), dim=1)
        return 1 - (thinnest(gaussians(means.detach(), quats.detach())) * out).sum(1).abs()

    before, optimizer = tilt(), torch.optim.Adam([means, quats], 0.02)
    for seed in range(300):
        optimizer.zero_grad()
        link.agreement(gaussians(means, quats), seed).backward()
        optimizer.step()
    assert before.mean() > 0.3 and tilt().median() < 1e-3 and tilt().mean() < 0.05
    assert (means.detach().norm(dim=1) - 2 * RADIUS).abs().mean() < 0.03, "the box is half as large"


def test_gradients_by_the_centres_are_those_of_the_distance():
    means, quats = some()
    means.requires_grad_()
    method = NeuSG(centres=4000, to_surface=1.0, to_normal=0.0)
    link = Guidance(method, Ball(torch.tensor(RADIUS)))
    (found,) = torch.autograd.grad(link.agreement(gaussians(means, quats), 7), means)
    rows = torch.randint(40, (4000,), generator=torch.Generator().manual_seed(7))
    (exact,) = torch.autograd.grad((means[rows].norm(dim=1) / 2 - RADIUS).abs().mean(), means)
    assert torch.allclose(found, exact, atol=1e-6)


def test_gaussians_guide_the_surface():
    radius = torch.tensor(0.3, requires_grad=True)
    means, quats = some()
    means = 2 * RADIUS * torch.nn.functional.normalize(means, dim=1)
    link = Guidance(NeuSG(), Ball(radius))
    link.agreement(gaussians(means, quats), 0)
    assert set(link.shared) == {"points", "normals"} and link.shared["points"].item() == pytest.approx(0.2, abs=1e-5)
    assert torch.autograd.grad(link.shared["points"], radius)[0] < 0, "a larger sphere is nearer to them"
    far = Guidance(NeuSG(), Ball(radius))
    far.agreement(gaussians(10 * means, quats), 0)
    assert far.shared["points"] == 0, "outside the box nothing is known"


def test_agreement_is_nothing_where_gaussians_lie_in_a_plane():
    normal = torch.tensor([[0.0, 0, 1]]).repeat(6, 1)
    far, tilt = apart(torch.zeros(6), 2 * normal, torch.zeros(6, 3), -normal)
    assert torch.equal(far, torch.zeros(6)) and torch.allclose(tilt, torch.zeros(6)), "normals have no sign"


@pytest.mark.parametrize("wrong", [{"centres": 0}, {"thin": -1.0}, {"points": -1.0}, {"to_normal": float("nan")}])
def test_settings_that_make_no_sense_are_refused(wrong):
    with pytest.raises(BadInput, match=next(iter(wrong))):
        NeuSG(**wrong)
