"""Holes of depth maps against exact planes, and what must not be filled."""

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
import torch

from surfkit.core.check import BadInput
from surfkit.depth import DepthAnythingV2, Filled, MonocularFill, PatchMatch, PlaneFill, PlaneSweep
from surfkit.depth.base import Estimate
from surfkit.depth.fill_base import Fill, FillInput
from surfkit.depth.fill_monocular import robust_line
from surfkit.depth.filled import load_estimate, save_estimate, shares_of
from surfkit.depth.prepare_depth_maps import made_from
from surfkit.scene.camera import Camera
from surfkit.testing import check_depth_estimator, check_fill
from surfkit.testing.inputs import depth_input

HEIGHT, WIDTH = 90, 120
ROWS, COLUMNS = torch.meshgrid(torch.arange(HEIGHT) + 0.5, torch.arange(WIDTH) + 0.5, indexing="ij")


def camera(z=0.0):
    """Looks along z, from so far along it."""
    pose = torch.eye(4, dtype=torch.float64)
    pose[2, 3] = -z
    return Camera(pose, 100.0, 100.0, WIDTH / 2, HEIGHT / 2, WIDTH, HEIGHT)


def plane(normal=(0.1, -0.2, 1.0), distance=40.0):
    """(H, W) inverse depth of the plane normal . X = distance, metres, as `camera()` sees it."""
    return (torch.einsum("i,ihw->hw", torch.tensor(normal), camera().rays()) / distance).float()


def hole(inverse, where, photo=None, others=()):
    """A map with holes, of a grey photograph."""
    photo = torch.full((3, HEIGHT, WIDTH), 0.5) if photo is None else photo
    kept = torch.where(where, 0, inverse)
    return FillInput(0, photo, camera(), kept, (kept > 0).float(), others)


def disc(radius=18.0, row=45.0, column=60.0):
    return (ROWS - row) ** 2 + (COLUMNS - column) ** 2 < radius**2


def errors(found, exact, where):
    """Differences of depth, metres, where something was filled."""
    there = where & (found > 0)
    return (1 / found[there] - 1 / exact[there]).abs()


def monocular(inverse):
    """What a network might say: inverse depth in a unit of its own, bent, and tilted across the photograph."""
    return 5 * inverse / inverse.max() + 2 + 0.3 * (COLUMNS / WIDTH) ** 2


def filled_by(values, given, **settings):
    return torch.from_numpy(MonocularFill(**settings).aligned(values.numpy().astype(np.float32), given))


def test_a_roof_without_texture_is_filled_to_a_centimetre_from_its_noisy_rim():
    exact, where = plane(), disc()
    noise = 1 + 2e-4 * torch.randn(HEIGHT, WIDTH, generator=torch.Generator().manual_seed(0))
    outliers = torch.rand(HEIGHT, WIDTH, generator=torch.Generator().manual_seed(1)) < 0.1
    found = PlaneFill().planes(hole(torch.where(outliers, 1.3, 1.0) * noise * exact, where))
    assert ((found > 0) == where).float().mean() > 0.99
    assert errors(found, exact, where).max() < 0.01


def test_what_is_not_a_plane_is_left_empty():
    draw = np.random.default_rng(0)
    rough = torch.from_numpy(draw.uniform(0.9, 1.1, (HEIGHT, WIDTH))).float() * plane()
    assert not (PlaneFill().planes(hole(rough, disc())) > 0).any()


def test_a_rim_at_one_side_says_little_of_the_other():
    where = COLUMNS > 40
    found = PlaneFill().planes(hole(plane(), where))
    assert not (found[:, 70:] > 0).any()


def test_a_hole_ends_where_the_colour_changes():
    """A roof before the ground: each side of the hole gets the plane of its own rim."""
    ground, roof = plane((0.0, 0.0, 1.0), 40.0), plane((0.0, 0.1, 1.0), 30.0)
    left = COLUMNS < 60
    photo = torch.where(left, 0.3, 0.6).expand(3, -1, -1)
    exact = torch.where(left, roof, ground)
    where = disc() & ((COLUMNS - 60).abs() > 2)  # pixels at the edge itself have colours between the two
    found = PlaneFill().planes(hole(exact, disc(), photo))
    assert (found[where] > 0).float().mean() > 0.95 and errors(found, exact, where).max() < 0.01


def test_a_plane_that_another_view_sees_through_is_left_out():
    exact, where = plane((0.0, 0.0, 1.0), 20.0), disc()
    behind = torch.full((HEIGHT, WIDTH), 1 / 40.0)
    given = hole(exact, where, others=[(camera(), behind)])
    assert given.is_free(exact).all() and not (PlaneFill().planes(given) > 0).any()
    nearer = [(camera(z=5.0), torch.full((HEIGHT, WIDTH), 1 / 15.0))]
    assert not given.__class__(0, given.photo, camera(), given.inverse, given.trust, nearer).is_free(exact).any()
    assert not replace(given, others=[(camera(), torch.full_like(behind, 1 / 10.0))]).is_free(exact).any()


def test_distorted_monocular_depth_is_aligned_to_a_plane():
    """Distortion that changes slowly is a scale and a shift within a patch: 10 cm at 40 m."""
    exact, where = plane(), disc(10.0)
    found = filled_by(monocular(exact), hole(exact, where))
    assert (found[where] > 0).all() and errors(found, exact, where).max() < 0.1
    whole = filled_by(monocular(exact), hole(exact, where), patch=2.0, tolerance=0.5)
    assert errors(whole, exact, where).max() > 3 * errors(found, exact, where).max()  # that is what patches are for


@pytest.mark.parametrize("wrong", [lambda c: 10 - monocular(c), lambda c: 1 / c, lambda c: torch.full_like(c, 3.0)])
def test_a_surface_that_is_inverted_or_flat_is_refused_wholly(wrong):
    exact = plane((0.6, -0.9, 1.0))
    assert not (filled_by(wrong(exact).float(), hole(exact, disc())) > 0).any()


def test_noise_is_refused():
    draw = torch.Generator().manual_seed(0)
    exact = plane((0.6, -0.9, 1.0))
    assert not (filled_by(torch.rand(HEIGHT, WIDTH, generator=draw), hole(exact, disc())) > 0).any()


def test_a_patch_with_too_few_supports_is_left_empty():
    exact = plane()
    where = (COLUMNS > 30) & (torch.rand(HEIGHT, WIDTH, generator=torch.Generator().manual_seed(0)) > 0.03)
    found = filled_by(monocular(exact), hole(exact, where | (COLUMNS > 60)), support=0.1)
    assert not (found[:, 75:] > 0).any() and (found[:, :30] > 0).all()
    assert (filled_by(monocular(exact), hole(exact, where), support=0.02)[:, 45:] > 0).any()


def test_outliers_of_stereo_do_not_move_the_fit():
    draw = np.random.default_rng(0)
    x = draw.uniform(1, 2, 400)
    y = 0.3 * x + 0.1
    y[:150] += draw.uniform(0.5, 1, 150)
    assert robust_line(x, y, np.ones(400)) == pytest.approx((0.3, 0.1), abs=1e-5)


@pytest.fixture(scope="module")
def survey(tmp_path_factory):
    return depth_input(tmp_path_factory.mktemp("survey"))


def write_maps(folder: Path, given, truth):
    """What a network might say of each photograph, in files."""
    (folder / "estimated_depths").mkdir(parents=True)
    for view in given.views:
        values = 3 / truth.exact[view.name].depth.numpy() + 1
        np.save(folder / "estimated_depths" / f"{view.name}.npy", values.astype(np.float32))
    return folder


def test_maps_of_files_fill_stereo_with_a_low_confidence(survey, tmp_path, monkeypatch):
    told = []
    monkeypatch.setattr("surfkit.depth.filled.emit", told.append)
    given, truth = survey
    given = replace(given, work=tmp_path / "work")
    stereo = PlaneSweep(longest=72)
    estimator = Filled(stereo=stereo, fill=MonocularFill(maps=str(write_maps(tmp_path, given, truth)), support=0.05))
    plain = {each.at: each for each in stereo.estimate(replace(given, work=tmp_path), range(9))}
    counts = 0
    for each in estimator.estimate(given, range(9)):
        before = plain[each.at]
        new = each.confidence == 0.3
        old_confidence = (before.confidence * 255).round() / 255
        assert torch.equal(each.inverse[~new], before.inverse[~new])
        assert torch.equal(each.confidence[~new], old_confidence[~new])
        assert (before.confidence[new] < 0.376).all()
        exact = truth.exact[given.views[each.at].name].depth.float()
        error = (1 / each.inverse[new] / exact[new] - 1).abs()
        counts += int(new.sum())
        assert error.median() < 0.02  # as far as stereo of 72 px is right
    assert counts > 100 and any("of the pixels filled" in str(line) for line in told)


def test_maps_change_with_the_files(survey, tmp_path):
    given, truth = survey
    folder = write_maps(tmp_path, given, truth)
    estimator = Filled(stereo=PlaneSweep(), fill=MonocularFill(maps=str(folder)))
    before = made_from(given, estimator)
    assert before == made_from(given, estimator) != made_from(given, PlaneSweep())
    np.save(folder / "estimated_depths" / f"{given.views[0].name}.npy", np.ones((3, 4, 5), np.float32))
    assert made_from(given, estimator) != before


def test_an_estimate_survives_the_file(tmp_path):
    draw = torch.Generator().manual_seed(0)
    normal = torch.nn.functional.normalize(torch.randn(3, 4, 5, generator=draw), dim=0)
    confidence = (torch.rand(4, 5, generator=draw) * 255).round() / 255
    first = Estimate(2, torch.rand(4, 5, generator=draw), confidence, normal)
    for found in (first, replace(first, normal=None), Estimate(2, None, None)):
        save_estimate(tmp_path / "a", found)
        again = load_estimate(tmp_path / "a", 2)
        for part in ("inverse", "confidence"):
            one, other = getattr(found, part), getattr(again, part)
            assert (one is None and other is None) or torch.equal(one, other)
        assert (found.normal is None) == (again.normal is None)
        assert found.normal is None or (found.normal - again.normal).abs().max() < 0.01


def test_contracts(survey, tmp_path):
    given, truth = survey
    maps = write_maps(tmp_path, given, truth)
    for fill in (PlaneFill(), PlaneFill(contrast=0.5), MonocularFill(maps=str(maps), patch=0.5)):
        check_fill(fill)
    check_depth_estimator(Filled(stereo=PlaneSweep(longest=72), fill=PlaneFill(contrast=0.2)))


def test_a_network_with_weights_of_a_folder_is_asked_once(survey, weights, tmp_path):
    """Random weights say nothing of the depth, and nothing is filled."""
    given, _ = survey
    fill = MonocularFill(network=DepthAnythingV2(weights=str(weights), shortest=56))
    check_fill(fill)
    stereo = PlaneSweep(longest=72)
    found = list(Filled(stereo=stereo, fill=fill).estimate(replace(given, work=tmp_path), [3, 5]))
    assert [each.at for each in found] == [3, 5] and not any((each.confidence == 0.3).any() for each in found)


@pytest.mark.parametrize(
    ("values", "said"),
    [
        (lambda given: torch.full_like(given.inverse, torch.inf), "not 0 or more"),
        (lambda given: given.inverse[:-1], "not float32 of"),
        (lambda given: torch.ones_like(given.inverse), "where no depth is trusted"),
        (lambda given: 2 * given.inverse.max() * (given.inverse.sum() > 0).float().expand(54, 72), "inverse depth of"),
        (lambda given: torch.rand(54, 72) * (given.inverse.sum() > 0), "not repeatable"),
    ],
)
def test_fills_that_are_wrong(values, said):
    with pytest.raises(AssertionError, match=said):
        check_fill(Wrong(values))


@dataclass(frozen=True)
class Wrong(Fill):
    """Says what it is told to."""

    values: Callable = torch.zeros_like

    def opened(self, given, wanted):
        return self.values


def test_it_is_what_its_parts_are():
    made = Filled()
    assert made.aligned and made.matched and made.oriented and not Filled(stereo=PlaneSweep()).oriented
    assert made.version != PatchMatch().version
    assert "Apache-2.0" in Filled(fill=MonocularFill()).notice() and made.notice() is None


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda: Filled(stereo=DepthAnythingV2()), "give an estimator that compares photographs"),
        (lambda: Filled(trust=0.5), "below sure"),
        (lambda: PlaneFill(contrast=0.0), "contrast"),
        (lambda: MonocularFill(patch=0.0), "patch"),
        (lambda: MonocularFill(maps="/nowhere").refuse_missing(), "which is no folder"),
    ],
)
def test_bad_settings_are_one_line(make, said):
    with pytest.raises(BadInput, match=said):
        make()


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        (None, "has no depth map of these photographs"),
        (lambda values: np.full_like(values, 3), "no map can be used: constant: "),
        (lambda values: values * np.nan, "no map can be used: no value in it: "),
        (lambda values: values[:, :40], "no map can be used: 40 x 54 px is not the shape of its photograph: "),
        (lambda values: np.stack([values] * 3, -1), r"no map can be used: has shape \(54, 72, 3\)"),
    ],
)
def test_maps_that_cannot_be_used_are_refused_before_stereo(survey, tmp_path, wrong, said):
    given, truth = survey
    folder = write_maps(tmp_path, given, truth)
    for path in (folder / "estimated_depths").iterdir():
        path.unlink() if wrong is None else np.save(path, wrong(np.load(path)))
    filled = Filled(stereo=PlaneSweep(longest=72), fill=MonocularFill(maps=str(folder)))
    with pytest.raises(BadInput, match=said):
        next(filled.estimate(replace(given, work=tmp_path / "work"), range(9)))
    assert not (tmp_path / "work").exists()


def test_some_maps_that_cannot_be_used_are_named_and_the_others_fill(survey, tmp_path, monkeypatch):
    told = []
    monkeypatch.setattr("surfkit.depth.fill_monocular.emit", told.append)
    given, truth = survey
    folder = write_maps(tmp_path, given, truth)
    first, second, *_ = (folder / "estimated_depths" / f"{view.name}.npy" for view in given.views)
    first.unlink()
    np.save(second, np.load(second)[:-20])
    read = MonocularFill(maps=str(folder)).from_files(given, range(9))
    assert read(0) is None and read(1) is None and all((read(at) > 0).any() for at in range(2, 9))
    names = [view.name for view in given.views]
    assert "2 of 9 photographs are not filled" in told[0].text
    assert f"no map: {names[0]}; 72 x 34 px is not the shape of its photograph: {names[1]}" in told[0].text


def test_values_below_zero_are_raised_as_they_have_any_shift(survey, tmp_path):
    given, truth = survey
    folder = write_maps(tmp_path, given, truth)
    path = folder / "estimated_depths" / f"{given.views[0].name}.npy"
    before = np.load(path)
    np.save(path, before - before.mean())
    found = MonocularFill(maps=str(folder)).from_files(given, range(9))(0).numpy()
    assert (found[np.isfinite(before)] > 0).all() and np.ptp((found - before)[np.isfinite(before)]) < 1e-6


STEEP = plane((0.6, -0.9, 1.0))


@pytest.mark.parametrize(
    ("values", "where", "said"),
    [
        (1 / STEEP, disc(10.0), "as in maps of depth: give maps of inverse depth"),
        (
            torch.rand(HEIGHT, WIDTH, generator=torch.Generator().manual_seed(0)),
            disc(10.0),
            "do not fit trusted stereo",
        ),
        (monocular(STEEP), STEEP > 0, "stereo trusts too little around them"),
        (monocular(STEEP), disc(10.0) | (STEEP > STEEP.quantile(0.9)), "beyond that of the trusted pixels"),
        (torch.where(disc(10.0), 0.0, monocular(STEEP)), disc(10.0), "the maps have no value there"),
    ],
)
def test_why_nothing_is_filled_is_told(values, where, said):
    told = []
    given = replace(hole(STEEP, where), tell=lambda why, pixels: told.append((pixels, why)))
    filled = filled_by(values, given)
    assert any(said in why for _, why in told)
    left = given.holes & (torch.as_tensor(filled) <= 0)
    assert sum(pixels for pixels, _ in told) == int(left.sum()), "each pixel has one reason, that stays empty"


def test_why_planes_fill_nothing_is_told_for_each_pixel():
    draw, told = np.random.default_rng(0), []
    rough = torch.from_numpy(draw.uniform(0.9, 1.1, (HEIGHT, WIDTH))).float() * plane()
    given = hole(rough, disc() | ((ROWS < 3) & (COLUMNS < 3)))
    PlaneFill().planes(replace(given, tell=lambda why, pixels: told.append((why, pixels))))
    assert [pixels for why, pixels in told if "lie on no plane" in why] == [int(disc().sum())]
    assert sum(pixels for _, pixels in told) == int(given.holes.sum())


def test_reasons_are_told_with_their_shares():
    assert shares_of(Counter(), 0) == ""
    found = shares_of(Counter({"few": 8, "much": 132, "some": 60}), 200)
    assert found == ", because much (66%); some (30%)"
