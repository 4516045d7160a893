"""Splats far from all others spoil few of a compressed PLY, and a note says how many."""

import numpy as np
import pytest
import torch

from surfkit.io.splats.bits import outlying_order
from surfkit.io.splats.compressed_ply import CompressedPLY
from surfkit.runs.run_notes import collect_notes

from .models import table

SIZE = 0.05


def core(count, far):
    """Splats of one size in a cube of 40 units, the first ones bright, and some far away between them in the file."""
    draw = torch.Generator().manual_seed(3)
    means = 40 * torch.rand(count + len(far), 3, generator=draw) - 20
    at = torch.linspace(0, count + len(far) - 1, len(far)).long()
    means[at] = torch.tensor(far, dtype=torch.float32)
    logits = torch.linspace(4, -4, len(means))
    scales = torch.full((len(means), 3), np.log(SIZE))
    return table(count=len(means), degree=0, means=means, log_scales=scales, opacity_logits=logits), at


def errors(path, splats):
    """(N,) distance of each splat to the nearest that was written."""
    found = CompressedPLY().read(path).means.double()
    return torch.cdist(splats.means.double(), found).min(1).values.numpy()


@pytest.mark.parametrize(
    "far",
    [
        [(9e4, 4e4, 2e3)],
        [(9e4 * np.cos(k), 9e4 * np.sin(k), 1e3 * k) for k in range(40)],
        [(2e3 * 3.0**k, -1e3 * 3.0**k, 5.0) for k in range(12)],
    ],
    ids=["one", "around", "ever farther"],
)
def test_those_far_away_share_chunks(tmp_path, far):
    splats, at = core(3000, far)
    with collect_notes() as notes:
        CompressedPLY().write(tmp_path / "a.compressed.ply", splats)
    off = errors(tmp_path / "a.compressed.ply", splats)
    off[at] = 0
    spoiled = np.flatnonzero(off > SIZE)
    assert len(spoiled) <= 3000 % 256, "what is left of whole chunks, and no more"
    dimmest = np.argsort(splats.opacity_logits.numpy())[: 3000 % 256 + len(far)]
    assert set(spoiled) <= set(dimmest.tolist()), "those that are seen least"
    (note,) = notes.texts
    assert "splats are moved by more than their size, up to " in note and "far from the others" in note


def test_whole_chunks_stay_whole(tmp_path):
    splats, at = core(12 * 256, [(9e4, 4e4, 2e3)])
    with collect_notes() as notes:
        CompressedPLY().write(tmp_path / "a.compressed.ply", splats)
    assert errors(tmp_path / "a.compressed.ply", splats).max() < SIZE and notes.texts == []


def test_the_order_of_splats_without_outliers_is_the_curve():
    draw = np.random.default_rng(0)
    for means in (draw.normal(size=(2000, 3)), np.zeros((700, 3)), draw.uniform(size=(5, 3)), np.zeros((0, 3))):
        order = outlying_order(means, np.ones(len(means)), 256)
        assert sorted(order) == list(range(len(means)))
    means = draw.uniform(-1, 1, size=(2000, 3))
    near = np.linalg.norm(np.diff(means[outlying_order(means, np.ones(2000), 256)], axis=0), axis=1)
    assert np.median(near) < 0.25, "neighbours follow one another"
