"""What differs from the render is left out: against numpy and scipy, and on a picture with a box in it."""

from dataclasses import dataclass, replace
from fractions import Fraction

import numpy as np
import pytest
import torch
from scipy.ndimage import correlate, uniform_filter

from surfkit.appearance import Exposure
from surfkit.core.check import BadInput
from surfkit.losses import L1, SSIM, Robust
from surfkit.losses.base import ignoring
from surfkit.losses.transients import Transients, inliers_of, kept_areas
from surfkit.raster.api import Maps
from surfkit.testing import inputs
from surfkit.train.image_appearance import ImageAppearance, first_appearances
from surfkit.train.loss_gradients import loss_gradients, without_transients
from surfkit.train.stage import Stage

SIZE = (61, 90)
BOX, CORE = np.s_[21:45, 30:60], np.s_[24:42, 33:57]


def by_hand(residual, share, mask, radius):
    """The mask of `Robust`, in numpy and scipy."""
    counts = np.ones(residual.shape, bool) if mask is None else mask
    inlier = residual <= np.sort(residual[counts])[round(share * counts.sum()) - 1]
    for side, least in ((3, Fraction(1, 2)), (2 * radius + 1, Fraction(3, 5))):
        box = np.ones((side, side), int)
        inside, of = (correlate(each.astype(int), box, mode="constant") for each in (inlier & counts, counts))
        inlier = inside * least.denominator >= of * least.numerator
    return inlier


@pytest.mark.parametrize("masked", [False, True])
@pytest.mark.parametrize(("share", "radius"), [(0.5, 8), (0.7, 4), (0.8, 1), (0.9, 3), (0.95, 100)])
def test_the_mask_is_that_of_numpy_and_scipy(share, radius, masked):
    draw = np.random.default_rng(radius)
    residual = uniform_filter(draw.random(SIZE), 5).astype(np.float32)
    mask = draw.random(SIZE) > 0.3 if masked else None
    given, known = torch.from_numpy(residual), None if mask is None else torch.from_numpy(mask)
    found = kept_areas(inliers_of(given, share, known), known, radius).numpy()
    assert np.array_equal(found, by_hand(residual, share, mask, radius))
    assert radius > 9 or 0.02 < (~found).mean() < 0.98, "there is something to find"


def with_a_box(seed=0):
    """A photograph of smooth colours, with a box of others in it; a render that is off a little everywhere, and far
    off at thin edges."""
    draw = torch.Generator().manual_seed(seed)
    y, x = torch.meshgrid(torch.arange(SIZE[0]), torch.arange(SIZE[1]), indexing="ij")
    scene = torch.stack([x / 100, y / 70, 0.5 + 0.3 * torch.sin(x / 9)])
    color = scene + 0.02 * torch.randn(3, *SIZE, generator=draw)
    color[:, :, ::15] += 0.4
    photo = scene.clone()
    photo[(slice(None), *BOX)] = torch.tensor([0.9, 0.05, 0.1])[:, None, None]
    return color, replace(inputs.target(SIZE, draw), photo=photo)


def test_a_box_is_left_out_and_little_else():
    color, target = with_a_box()
    kept = Robust(start=0).kept(color, target, 1, 100)
    box = torch.zeros(SIZE, dtype=torch.bool)
    box[BOX] = True
    assert (~kept[CORE]).all() and (~kept[box]).float().mean() > 0.95, "the box is left out but for its corners"
    around = torch.zeros_like(box)
    around[BOX[0].start - 8 : BOX[0].stop + 8, BOX[1].start - 8 : BOX[1].stop + 8] = True
    assert kept[~around].float().mean() > 0.98, "thin edges and noise stay"
    assert kept[around & ~box].float().mean() > 0.6, "and so does most of what is around it"


def test_only_after_the_first_steps_and_not_of_all_pixels():
    color, target = with_a_box()
    assert Robust(start=10).kept(color, target, 10, 100) is None
    assert Robust(start=10).kept(color, target, 11, 100) is not None
    assert Robust(inliers=1.0, start=0).kept(color, target, 11, 100) is None


def test_what_a_mask_covers_says_nothing_of_the_rest():
    color, target = with_a_box()
    mask = torch.ones(SIZE, dtype=torch.bool)
    mask[:, :12] = False
    found = []
    for under in (0.0, 5.0):
        masked = replace(target, photo=torch.where(mask, target.photo, under), mask=mask)
        found.append(Robust(start=0).kept(color, masked, 1, 100) & mask)
    assert torch.equal(*found)
    assert not found[0][CORE].any() and found[0].float().mean() > 0.6
    assert Robust(start=0).kept(color, replace(target, mask=torch.zeros_like(mask)), 1, 100).shape == SIZE


@dataclass(frozen=True)
class LeftHalf(Transients):
    """Leaves out what is left of the middle, and says which colours it was shown."""

    def kept(self, color, target, index, steps):
        shown.append(color)
        return torch.arange(color.shape[2]).expand(color.shape[1:]) >= color.shape[2] // 2


shown: list[torch.Tensor] = []


def test_masks_are_joined_and_colours_are_those_of_the_photograph():
    shown.clear()
    color, target = with_a_box()
    upper = torch.arange(SIZE[0])[:, None].expand(SIZE) < 30
    stage = Stage(transients=LeftHalf(), appearance=Exposure())
    table = first_appearances(stage.appearance, 1, None)
    table["value"] += 0.1
    light = ImageAppearance(stage.appearance, table, 0, 0.0, target.view.camera)
    mask = without_transients(stage, 1, Maps(color=color), replace(target, mask=upper), light).mask
    assert torch.equal(mask, upper & (torch.arange(SIZE[1]) >= SIZE[1] // 2))
    assert torch.equal(shown[0], light.shown(color).detach()) and not torch.equal(shown[0], color)
    assert not shown[0].requires_grad
    assert without_transients(Stage(), 1, Maps(color=color), target, light) is target


def test_nothing_is_learnt_from_what_is_left_out_by_any_photometric_loss():
    color, target = with_a_box()
    stage = Stage(transients=Robust(start=0))
    found = without_transients(stage, 1, Maps(color=color), target, None)
    for name, loss in {"l1": L1(), "ssim": SSIM()}.items():
        _, total, _ = loss_gradients({name: loss}, stage.signal, {name: 1.0}, Maps(color=color), found, None)
        assert (total.color[:, ~found.mask] == 0).all() and (~found.mask[CORE]).all()
        assert (total.color[:, found.mask] != 0).float().mean() > 0.5
        plain = loss_gradients({name: loss}, stage.signal, {name: 1.0}, Maps(color=color), target, None)[1]
        assert (plain.color[:, ~found.mask] != 0).float().mean() > 0.9
    kept, held = ignoring(Maps(color=color), found)
    assert L1()(kept, held) < 0.5 * L1()(Maps(color=color), target)


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ({"inliers": 0.4}, "inliers is 0.4; it must lie between 0.5 and 1"),
        ({"inliers": 80.0}, "inliers is 80; it must lie"),
        ({"inliers": float("nan")}, "inliers is nan"),
        ({"radius_px": 0}, "radius_px is 0; it must lie between 1 and 1000"),
        ({"start": -1}, "start is -1; it must lie"),
    ],
)
def test_settings_that_make_no_sense_are_refused(settings, said):
    with pytest.raises(BadInput) as caught:
        Robust(**settings)
    assert said in str(caught.value) and "\n" not in str(caught.value)
