"""Pixels by the number of training views that see what they show, against exact rays."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from surfkit.evaluate.images import view_counts
from surfkit.evaluate.images.region_metrics import by_views, measure_parts
from surfkit.evaluate.images.view_counts import DepthSource, count_views
from surfkit.raster.api import Maps
from surfkit.testing.synthetic import SURFACES, Flight, photograph

SYNTHETIC = photograph(Flight(views=12, width=320, height=240, points=20, test_every=4))
SCENE = SYNTHETIC.scene


def exact_depth(view):
    return SYNTHETIC.exact[view.name].depth.float()


def first_hit(eye, rays):
    return np.min([shape.hit(np.broadcast_to(eye, rays.shape), rays)[0] for shape in SURFACES], axis=0)


def brute(view):
    """(H, W) training views that a straight line joins to what a pixel shows."""
    pose = SCENE.frame.input_pose(view.camera.world_to_camera)
    rays = view.camera.rays(torch.float64).flatten(1).T.numpy() @ pose[:3, :3]
    eye = -pose[:3, :3].T @ pose[:3, 3]
    far = first_hit(eye, rays)
    known = np.isfinite(far)
    places = eye + np.where(known, far, 0)[:, None] * rays
    counts = np.zeros(len(rays), int)
    for other in SCENE.train:
        there = SCENE.frame.input_pose(other.camera.world_to_camera)
        local = places @ there[:3, :3].T + there[:3, 3]
        with np.errstate(divide="ignore", invalid="ignore"):
            x = other.camera.fx * local[:, 0] / local[:, 2] + other.camera.cx
            y = other.camera.fy * local[:, 1] / local[:, 2] + other.camera.cy
        inside = (local[:, 2] > 0) & (x >= 0) & (x < other.camera.width) & (y >= 0) & (y < other.camera.height)
        centre = -there[:3, :3].T @ there[:3, 3]
        counts += known & inside & (first_hit(centre, places - centre) > 1 - 1e-6)
    return counts.reshape(view.camera.height, view.camera.width), known.reshape(view.camera.height, view.camera.width)


@pytest.mark.parametrize("through", [True, False])
def test_counts_are_those_of_exact_rays(through):
    found = list(count_views(SCENE.held_out, SCENE.train, DepthSource(exact_depth, "exact", 0.01, through)))
    assert [sight.view.name for sight in found] == [view.name for view in SCENE.held_out]
    for sight in found:
        counts, known = brute(sight.view)
        assert np.array_equal(torch.isfinite(sight.places[..., 0]).numpy(), known)
        assert len(np.unique(counts)) > 4 and not sight.counts.numpy()[~known].any()
        assert (sight.counts.numpy() == counts).mean() > 0.95
        for least in (2, 5, 8):
            assert ((sight.counts.numpy() >= least) == (counts >= least)).mean() > 0.98


def test_rendered_depth_that_disagrees_does_not_see():
    """Of three views that have the wrong depth, no place is seen; a true surface further off hides nothing."""
    wrong = {view.name for view in SCENE.train[:3]}

    def depth_of(view):
        return exact_depth(view) * (9.0 if view.name in wrong else 1.0)

    def counts(train, through):
        return next(iter(count_views(SCENE.held_out[:1], train, DepthSource(depth_of, "", 0.01, through)))).counts

    right = SCENE.train[3:]
    assert torch.equal(counts(SCENE.train, False), counts(right, False))
    assert (counts(SCENE.train, True) - counts(right, True)).float().mean() > 1


def test_batches_do_not_change_what_is_found(monkeypatch):
    depths = DepthSource(exact_depth, "exact", 0.01, False)
    whole = list(count_views(SCENE.held_out, SCENE.train, depths))
    monkeypatch.setattr(view_counts, "BATCH_BYTES", 1)
    asked = []
    parts = list(
        count_views(
            SCENE.held_out, SCENE.train, DepthSource(lambda v: asked.append(v) or exact_depth(v), "", 0.01, False)
        )
    )
    assert all(torch.equal(a.counts, b.counts) for a, b in zip(whole, parts, strict=True))
    assert len(asked) == len(SCENE.held_out) * (1 + len(SCENE.train))


def test_figures_of_parts():
    """A render that is wrong by 0.1 wherever fewer than 5 views look."""
    depths = DepthSource(exact_depth, "exact", 0.01, False)
    counts = {sight.view.name: sight.counts for sight in count_views(SCENE.held_out, SCENE.train, depths)}
    photos = {view.name: torch.full((3, 240, 320), 102, dtype=torch.uint8) for view in SCENE.held_out}

    def draw(view):
        return Maps(color=torch.where(counts[view.name] >= 5, 0.4, 0.5).expand(3, -1, -1))

    keep = torch.ones(240, 320, dtype=torch.bool)
    keep[:, :40] = False
    for mask in (None, keep):
        found = measure_parts(
            count_views(SCENE.held_out, SCENE.train, depths),
            by_views((5, 9)),
            draw,
            lambda sight: photos[sight.view.name],
            lambda sight, mask=mask: mask,
        )
        kept = torch.stack([c[mask if mask is not None else slice(None)].flatten() for c in counts.values()])
        assert found["5"]["psnr"] == pytest.approx(100) and found["<5"]["psnr"] == pytest.approx(20, abs=1e-3)
        assert found["5"]["share"] == pytest.approx(float((kept >= 5).float().mean()))
        assert found["9"]["share"] + found["<9"]["share"] == pytest.approx(1)
        assert 20 < found["<9"]["psnr"] < 100


def test_large_photographs_are_looked_at_smaller():
    view = SCENE.held_out[0]
    large = replace(view, camera=view.camera.resized(1600, 1200))

    def depth_of(small):
        assert small.camera.width == 800
        return torch.ones(small.camera.height, small.camera.width)

    sight = next(iter(count_views([large], [large], DepthSource(depth_of, "", 0.01, False))))
    assert sight.counts.shape == (600, 800) and (sight.counts == 1).all()
    half = torch.zeros(600, 800, dtype=torch.bool)
    half[:, :400] = True
    assert sight.full(half).shape == (1200, 1600) and int(sight.full(half).sum()) == 800 * 1200
