"""Depth that is compared patch by patch, against an evaluation in numpy, patch after patch, in double precision."""

import numpy as np
import pytest
import torch

from surfkit.core.check import BadInput
from surfkit.io.datasets.depth_prior import DepthPrior
from surfkit.losses.base import Target
from surfkit.losses.depth import DepthRegression
from surfkit.losses.patch_depth import FLAT, KNOWN_SHARE, PatchDepth, patches
from surfkit.raster.api import Maps
from surfkit.scene.camera import Camera
from surfkit.scene.scene import View
from surfkit.testing import check_loss

SIZE, TYPICAL = (37, 51), 0.4
CAMERA = Camera(torch.eye(4, dtype=torch.float64), 30.0, 30.0, 25.0, 18.0, SIZE[1], SIZE[0])


def target(inverse: torch.Tensor, confidence: torch.Tensor | None = None, seed: int = 0) -> Target:
    known = (inverse > 0).float() if confidence is None else confidence
    return Target(View("a", CAMERA, None), torch.zeros(3, *SIZE), DepthPrior(inverse, known, TYPICAL), seed=seed)


def relief(seed: int = 0) -> torch.Tensor:
    """(H, W) inverse depth of a sloping ground with steps."""
    draw = torch.Generator().manual_seed(seed)
    down, across = torch.meshgrid(*(torch.arange(float(size)) for size in SIZE), indexing="ij")
    steps = torch.rand(8, 11, generator=draw).repeat_interleave(5, 0).repeat_interleave(5, 1)[: SIZE[0], : SIZE[1]]
    return 0.4 + 0.002 * down + 0.001 * across + 0.1 * steps


def by_hand(median: torch.Tensor, given: Target, side: int, first: tuple[int, int]) -> float:
    d, p, w = (t.double().numpy() for t in (median, given.prior.inverse, given.prior.confidence))
    w = w * ((d > 0) & (p > 0))
    pair = [np.where(w > 0, 1 / np.where(d > 0, d, 1), 0) / TYPICAL, np.where(w > 0, p, 0) / TYPICAL]
    of_all = [np.sqrt(np.average((x - np.average(x, weights=w)) ** 2, weights=w) + FLAT**2) for x in pair]
    total = weights = 0.0
    for top in range(first[0], SIZE[0] - side + 1, side):
        for left in range(first[1], SIZE[1] - side + 1, side):
            here = np.s_[top : top + side, left : left + side]
            some = w[here]
            if some.sum() < KNOWN_SHARE * side * side:
                continue
            apart = [x[here] - np.average(x[here], weights=some) for x in pair]
            local = [a / np.sqrt(np.average(a**2, weights=some) + FLAT**2) for a in apart]
            wide = [a / s for a, s in zip(apart, of_all, strict=True)]
            total += (some * ((local[0] - local[1]) ** 2 + (wide[0] - wide[1]) ** 2) / 2).sum()
            weights += some.sum()
    return total / weights


@pytest.mark.parametrize(("side", "seed", "first"), [(8, 0, (0, 0)), (8, 3 + 8 * 5, (3, 5)), (16, 7 + 16 * 2, (7, 2))])
def test_it_is_the_mean_over_patches(side, seed, first):
    draw = torch.Generator().manual_seed(1)
    median = 1 / (relief() + 0.02 * torch.randn(SIZE, generator=draw))
    median[torch.rand(SIZE, generator=draw) < 0.1] = 0
    inverse = relief(2)
    inverse[10:30, 20:40] = 0  # some patches know nothing
    given = target(inverse, torch.rand(SIZE, generator=draw) * (inverse > 0), seed)
    found = PatchDepth(patch=side, depth="median")(Maps(median=median), given).item()
    assert found == pytest.approx(by_hand(median, given, side, first), rel=1e-4)


def test_patches_are_squares_of_the_picture_that_lie_elsewhere_with_another_seed():
    picture = torch.arange(SIZE[0] * SIZE[1]).reshape(SIZE)
    for seed in (0, 3 + 8 * 5, 2**62 + 11):
        found = patches(picture, 8, seed)
        assert len(found.unique()) == found.numel()
        top, left = found[0, 0] // SIZE[1], found[0, 0] % SIZE[1]
        assert (found[0].reshape(8, 8) == picture[top : top + 8, left : left + 8]).all()
    assert not torch.equal(patches(picture, 8, 0), patches(picture, 8, 1))


def test_another_scale_and_shift_in_each_patch_is_little_of_an_error_where_one_for_all_leaves_much():
    inverse, draw = relief(), torch.Generator().manual_seed(7)
    scale, shift = (
        torch.rand(5, 7, generator=draw).repeat_interleave(8, 0).repeat_interleave(8, 1)[: SIZE[0], : SIZE[1]]
        for _ in range(2)
    )
    monocular = inverse * (0.85 + 0.3 * scale) + 0.2 * shift
    near, wrong = Maps(median=1 / inverse), Maps(median=1 / relief(3))
    patch, whole = PatchDepth(depth="median", patch=8), DepthRegression()
    shares = [loss(near, target(monocular)).item() / loss(wrong, target(monocular)).item() for loss in (patch, whole)]
    assert shares[0] < 0.1 and shares[1] > 0.5, shares
    assert patch(near, target(3 * inverse + 0.2)).item() < 1e-3 * patch(wrong, target(3 * inverse + 0.2)).item()


def test_gradients_lead_to_the_relief_of_the_estimate():
    leaf = torch.full(SIZE, 2.0).requires_grad_()
    loss, given = PatchDepth(depth="median"), target(2 * relief() + 0.3)
    adam = torch.optim.Adam([leaf], 0.01)
    for index in range(300):
        adam.zero_grad()
        value = loss(Maps(median=leaf), target(given.prior.inverse, seed=977 * index))
        value.backward()
        adam.step()
    assert value.item() < 0.05
    assert np.corrcoef((1 / leaf.detach()).flatten(), relief().flatten())[0, 1] > 0.9


def test_the_sight_of_a_flat_wall_is_no_error():
    wall = torch.full(SIZE, 0.5)
    noisy = 1 / (wall + 1e-5 * torch.randn(SIZE, generator=torch.Generator().manual_seed(0)))
    assert PatchDepth(depth="median")(Maps(median=noisy), target(wall)).item() < 0.01


def test_nothing_to_compare_is_no_loss_and_holes_have_no_gradient():
    median = 1 / relief()
    for given in (target(torch.zeros(SIZE)), Target(View("a", CAMERA, None), torch.zeros(3, *SIZE))):
        leaf = median.clone().requires_grad_()
        loss = PatchDepth(depth="median")(Maps(median=leaf), given)
        loss.backward()
        assert loss.item() == 0 and not leaf.grad.any()
    inverse = relief(1)
    inverse[:9] = 0
    leaf = median.clone().requires_grad_()
    PatchDepth(depth="median")(Maps(median=leaf), target(inverse)).backward()
    assert torch.isfinite(leaf.grad).all() and not leaf.grad[:9].any() and leaf.grad[9:].any()


def test_it_keeps_what_is_asked_of_losses_also_in_pictures_smaller_than_a_patch():
    check_loss(PatchDepth(), SIZE)
    check_loss(PatchDepth(depth="median"), (5, 7))


@pytest.mark.parametrize(
    ("wrong", "why"),
    [({"end": 0.0}, "both must be above 0"), ({"patch": 3}, "give 4 or more"), ({"scale_band": (2.0, 3.0)}, "band")],
)
def test_wrong_settings_are_refused(wrong, why):
    with pytest.raises(BadInput, match=why):
        PatchDepth(**wrong)
