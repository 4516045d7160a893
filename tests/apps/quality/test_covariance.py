"""Standard deviations of calibrations against the dense normal matrix of a small block, and against the truth."""

import numpy as np
from flight import FOCAL, NOISE_PX, fly, reconstructed
from scipy.spatial.transform import Rotation

from surfkit.apps.quality import covariance
from surfkit.apps.quality.covariance import calibration_precision, cofactors
from surfkit.apps.quality.sparse_model import SparseModel
from surfkit.apps.sfm.engine import load_engine


def dense(model):
    """(2, 2) cofactors of focal length and distortion by finite differences of all unknowns and the pseudoinverse of
    the whole normal matrix, with the seven directions of the datum left out. SIMPLE_RADIAL as its formula."""
    photos, points = len(model.names), len(model.xyz)
    focal, cx, cy, bend = model.cameras[1].params

    def observed(unknowns):
        moves, xyz = unknowns[: 6 * photos].reshape(-1, 6), model.xyz + unknowns[6 * photos : -2].reshape(-1, 3)
        turns = Rotation.from_rotvec(moves[:, :3]).as_matrix() @ model.poses[:, :, :3]
        shifts = model.poses[:, :, 3] + moves[:, 3:]
        ray = np.einsum("oij,oj->oi", turns[model.photo], xyz[model.point]) + shifts[model.photo]
        flat = ray[:, :2] / ray[:, 2:]
        f, k = (focal, bend) + unknowns[-2:]
        return (f * flat * (1 + k * (flat**2).sum(1, keepdims=True)) + (cx, cy)).ravel()

    count, columns = 6 * photos + 3 * points + 2, []
    steps = np.concatenate([np.tile([1e-6] * 3 + [1e-4] * 3, photos), np.full(3 * points, 1e-4), [1e-3, 1e-5]])
    for at, step in enumerate(steps):
        change = np.zeros(count)
        change[at] = step
        columns.append((observed(change) - observed(-change)) / (2 * step))
    matrix = np.stack(columns, 1)
    scale = np.linalg.norm(matrix, axis=0)
    values, axes = np.linalg.eigh((matrix / scale).T @ (matrix / scale))
    assert values[6] < 1e-8 * values[7], "seven directions of the datum, and no other"
    inverse = (axes[:, 7:] / values[7:]) @ axes[:, 7:].T / np.outer(scale, scale)
    return inverse[-2:, -2:]


def test_the_covariance_is_that_of_the_dense_normal_matrix():
    whole = SparseModel.of(reconstructed(fly(oblique=True)))
    block = whole.part(np.arange(7, 15), every=3)
    assert np.allclose(cofactors(block)[1], dense(block), rtol=1e-4)


def test_the_truth_lies_within_the_standard_deviations_and_the_datum_does_not_matter():
    model = reconstructed(fly(oblique=True, tilt_deg=3))
    found = calibration_precision(SparseModel.of(model), 1)
    focal, *_, bend = model.cameras[1].params
    assert 0.9 * NOISE_PX < found.sigma < 1.1 * NOISE_PX and found.is_whole
    assert found.estimated == (0, 3)
    assert np.all(np.abs([focal - FOCAL, bend]) < 3.5 * found.deviations)
    assert 0.01 < found.deviations[0] < 1 and np.allclose(np.diagonal(found.correlations), 1)
    turn = load_engine().Rotation3d(Rotation.from_euler("xyz", [10, 20, 30], degrees=True).as_quat())
    model.transform(load_engine().Sim3d(7.0, turn, np.array([5e3, -2e3, 100.0])))
    moved = calibration_precision(SparseModel.of(model), 1)
    assert np.allclose(moved.covariance, found.covariance, rtol=1e-4)


def test_a_large_model_is_sampled_and_says_so(monkeypatch):
    model = SparseModel.of(reconstructed(fly(oblique=True)))
    whole = calibration_precision(model, 1)
    monkeypatch.setattr(covariance, "MAX_PHOTOS", 12)
    monkeypatch.setattr(covariance, "MAX_OBSERVATIONS", 1500)
    part = calibration_precision(model, 1)
    assert not part.is_whole and part.photos == 12 and 0 < part.observations <= 1500
    assert np.all(part.deviations > whole.deviations)


def test_nadir_photographs_of_flat_ground_do_not_determine_the_focal_length():
    nadir, oblique = (SparseModel.of(reconstructed(fly(oblique=tilted))) for tilted in (False, True))
    weak = calibration_precision(nadir, 1)
    assert weak is None or weak.deviations[0] > 5 * calibration_precision(oblique, 1).deviations[0]


def test_two_photographs_of_few_points_have_none():
    model = SparseModel.of(reconstructed(fly(oblique=True))).part(np.arange(2))
    assert cofactors(model.part(np.arange(2), every=len(model.xyz) // 3)) is None
