"""Similarities against ones that are known, with noise and with positions that are wrong."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from surfkit.apps.sfm import similarity
from surfkit.apps.sfm.similarity import fit_robustly, umeyama
from surfkit.io.datasets.topocentric import Similarity


def known(count, seed=0, noise=0.0):
    rng = np.random.default_rng(seed)
    xyz = rng.normal(0, 1, (count, 3)) * (3, 2, 0.5)
    truth = Similarity(Rotation.from_rotvec([0.3, -1.2, 2.0]).as_matrix(), 40.0, np.array([310.0, -20.0, 95.0]))
    return xyz, truth.points(xyz) + rng.normal(0, noise, xyz.shape), truth


def same(found, truth, by):
    assert found.scale == pytest.approx(truth.scale, rel=by)
    np.testing.assert_allclose(found.turn, truth.turn, atol=by)
    np.testing.assert_allclose(found.move, truth.move, atol=by * 100)


def test_exact_positions_give_the_exact_similarity():
    xyz, onto, truth = known(5)
    same(umeyama(xyz, onto, np.ones(5)), truth, 1e-9)
    weights = np.array([1.0, 2, 0.5, 3, 0])
    same(umeyama(xyz, onto + np.eye(5)[4][:, None] * 50, weights), truth, 1e-9)  # no weight, no say


def test_positions_in_a_plane_are_not_mirrored():
    xyz, _, truth = known(6)
    xyz[:, 2] = 0
    same(umeyama(xyz, truth.points(xyz), np.ones(6)), truth, 1e-9)


@pytest.mark.parametrize("wrong", [0, 1, 7])
def test_wrong_positions_are_found(wrong):
    xyz, onto, truth = known(20, noise=3.0)
    rng = np.random.default_rng(5)
    onto[:wrong] += rng.normal(0, 1, (wrong, 3)) * 300 + 100
    fit = fit_robustly(xyz, onto)
    assert np.flatnonzero(~fit.inside).tolist() == list(range(wrong))
    best = umeyama(xyz[wrong:], onto[wrong:], np.ones(20 - wrong))
    same(fit.similarity, best, 1e-9)
    assert 2 < fit.sigma.mean() < 4
    assert np.linalg.norm(fit.similarity.points(xyz) - truth.points(xyz), axis=1).mean() < 3


def test_exact_positions_are_trusted_more():
    xyz, onto, truth = known(16, noise=0.0)
    sigma = np.where(np.arange(16) < 8, 0.02, 5.0)
    onto += np.random.default_rng(1).normal(0, 1, onto.shape) * sigma[:, None]
    error = [
        np.linalg.norm(fit.similarity.points(xyz) - truth.points(xyz), axis=1).mean()
        for fit in (fit_robustly(xyz, onto, sigma), fit_robustly(xyz, onto))
    ]
    assert error[0] < 0.1 < error[1]


def test_too_few_positions_give_no_similarity():
    xyz, onto, _ = known(4)
    assert fit_robustly(xyz[:3], onto[:3]) is None
    assert fit_robustly(xyz, onto).inside.all()


def test_small_residuals_are_not_held_against_a_position():
    xyz, onto, _ = known(12)
    onto[3] += 0.01  # of others that fit to the last bit
    assert np.flatnonzero(~fit_robustly(xyz, onto).inside).tolist() == [3]
    assert fit_robustly(xyz, onto, least=0.05).inside.all()


def test_of_many_positions_a_part_is_searched_and_all_decide(monkeypatch):
    xyz, onto, truth = known(20_000, noise=2.0)
    wrong = np.arange(20_000) % 5 < 2
    onto[wrong] += 400
    seen, plain = [], similarity.umeyama
    monkeypatch.setattr(similarity, "umeyama", lambda *given: seen.append(len(given[0])) or plain(*given))
    fit = fit_robustly(xyz, onto)
    assert (fit.inside == ~wrong).mean() > 0.998 and not fit.inside[wrong].any()
    same(fit.similarity, truth, 1e-3)
    assert sum(count > similarity.MAX_CONSENSUS_POSITIONS for count in seen) <= similarity.CONCENTRATION_STEPS


def test_the_same_draws_give_the_same_bits():
    xyz, onto, _ = known(30, noise=2.0)
    one, two = (fit_robustly(xyz, onto, seed=3) for _ in range(2))
    assert (one.residuals == two.residuals).all()


def mixed(count, accurate, seed, noise=(0.02, 3.0)):
    """Positions of which the first few are exact; what the others and the whole say of them is known."""
    rng = np.random.default_rng(seed)
    sigma = np.where(np.arange(count) < accurate, *noise)
    xyz = rng.normal(0, 1, (count, 3)) * (100, 80, 30)
    return xyz, xyz + rng.normal(0, 1, xyz.shape) * sigma[:, None], sigma


@pytest.mark.parametrize("count, accurate", [(30, 5), (60, 6), (60, 1), (60, 2), (40, 20), (30, 26)])
def test_a_few_exact_positions_among_many_poor_ones_decide(count, accurate):
    origin = np.zeros((1, 3))
    kept, ours, best = [], [], []
    for seed in range(5):
        xyz, onto, sigma = mixed(count, accurate, seed)
        fit = fit_robustly(xyz, onto, sigma, seed)
        kept.append(fit.inside[:accurate].mean())
        ours.append(np.linalg.norm(fit.similarity.points(origin)))
        best.append(np.linalg.norm(umeyama(xyz, onto, 1 / sigma**2).points(origin)))
    assert np.mean(kept) > 0.97 and np.median(ours) < 1.3 * np.median(best) + 0.005


def test_a_wrong_one_among_a_few_exact_positions_is_found():
    for seed in range(5):
        xyz, onto, sigma = mixed(60, 6, seed)
        onto[2] += (15, -20, 10)
        fit = fit_robustly(xyz, onto, sigma, seed)
        assert np.flatnonzero(~fit.inside[:6]).tolist() == [2]
        good = np.arange(60) != 2
        same(fit.similarity, umeyama(xyz[good], onto[good], 1 / sigma[good] ** 2), 2e-3)


def test_exact_positions_that_are_all_wrong_are_left_out():
    """Heights above the ellipsoid among heights above sea level."""
    xyz, onto, sigma = mixed(60, 6, 0)
    onto[:6] += (0, 0, 40)
    fit = fit_robustly(xyz, onto, sigma)
    assert not fit.inside[:6].any() and fit.inside[6:].mean() > 0.95


def test_positions_less_exact_than_they_state_are_weighed_by_their_residuals():
    """A reconstruction is bent by more than receivers are off."""
    xyz, onto, sigma = mixed(60, 8, 0)
    onto += np.random.default_rng(9).normal(0, 0.3, onto.shape)
    fit = fit_robustly(xyz, onto, sigma)
    assert fit.inside[:8].all() and 0.15 < np.median(fit.spread[:8]) < 0.6 and np.median(fit.spread[8:]) > 2
