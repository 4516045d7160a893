"""Mutual nearest neighbours in torch, against all distances in float64."""

import numpy as np
import pytest
import torch
from needs import needs
from scipy.spatial.distance import cdist

from surfkit.apps.sfm import mutual as module
from surfkit.apps.sfm.mutual import Mutual, mutual, unit
from surfkit.core.check import BadInput

CPU = torch.device("cpu")


def descriptors(dtype, seed=0):
    """Two sets of 300 and 280, 200 of which are alike in another order; some are in a set twice."""
    rng = np.random.default_rng(seed)
    one = rng.uniform(0, 255, (300, 32))
    two = np.concatenate(
        [one[rng.permutation(300)[:200]] + rng.normal(0, 30, (200, 32)), rng.uniform(0, 255, (80, 32))]
    )
    one[290:] = one[:10] + rng.normal(0, 1, (10, 32))
    one, two = (values.clip(0, 255) for values in (one, two))
    return [(values.round() if dtype == np.uint8 else values / 255).astype(dtype) for values in (one, two)]


@pytest.mark.parametrize("dtype", [np.uint8, np.float16])
@pytest.mark.parametrize("ratio", [0.8, 1.0])
@pytest.mark.parametrize("at_once", [7, 4096])
def test_they_are_those_of_all_distances(dtype, ratio, at_once, monkeypatch):
    monkeypatch.setattr(module, "BATCH_DESCRIPTORS", at_once)
    one, two = descriptors(dtype)
    lengths = [values / np.linalg.norm(values.astype(np.float64), axis=1, keepdims=True) for values in (one, two)]
    away = cdist(*lengths)

    def nearest(away):
        order = np.sort(away, axis=1)
        return np.where(order[:, 0] <= ratio * order[:, 1], away.argmin(1), -1)

    there, back = nearest(away), nearest(away.T)
    expected = [(at, to) for at, to in enumerate(there) if to >= 0 and back[to] == at]
    found = mutual(unit(one, CPU), unit(two, CPU), ratio)
    assert found.tolist() == [list(pair) for pair in expected] and len(expected) > 100


def test_kornia_finds_the_same():
    kornia = needs("kornia.feature")
    one, two = (unit(values, CPU) for values in descriptors(np.uint8, 1))
    _, expected = kornia.match_smnn(one, two, 0.8)
    assert sorted(map(tuple, expected.tolist())) == sorted(map(tuple, mutual(one, two, 0.8).tolist()))


def test_too_few_to_compare_give_none():
    one = torch.eye(4)
    assert mutual(one[:1], one, 1.0).shape == mutual(one, one[:1], 1.0).shape == (0, 2)
    assert mutual(one, one, 1.0).tolist() == [[at, at] for at in range(4)]


def test_a_ratio_out_of_range_is_refused():
    with pytest.raises(BadInput, match="ratio is 1.5; .*0.1 and 1"):
        Mutual(ratio=1.5)
