"""Encodings that need tables keep their contract too."""

import numpy as np
import pytest
import torch

from surfkit.compress import vectree
from surfkit.compress.colors import CHOSEN_MARK, Codes, PrincipalComponents, principal_components, vectors
from surfkit.core.check import BadInput
from surfkit.primitives import Surfel2D
from surfkit.primitives.columns import standard_columns
from surfkit.primitives.model import SplatModel
from surfkit.testing import check_encoding
from surfkit.testing.compressor_checks import column_values


@pytest.mark.parametrize("degree", [0, 1, 3])
@pytest.mark.parametrize("step", [1e-4, 0.04])
def test_principal_components(degree, step):
    columns = standard_columns(3, degree)
    tables = principal_components(vectors(column_values(columns, 200)))
    basis = tables["sh.basis"].astype(np.float64)
    assert np.abs(basis.T @ basis - np.eye(len(basis))).max() < 1e-6
    check_encoding(PrincipalComponents(step), columns, tables, near=step)


def test_the_strongest_component_comes_first():
    along = np.array([3.0, 4.0, 0]) / 5
    draw = np.random.default_rng(0)
    numbers = 10 * draw.standard_normal((500, 1)) * along + 0.1 * draw.standard_normal((500, 3)) + [1, 2, 3]
    found = principal_components(numbers)
    assert abs(found["sh.basis"][:, 0] @ along) > 0.999
    assert np.allclose(found["sh.mean"], numbers.mean(0), atol=1e-5)
    with np.errstate(all="raise"):
        huge = principal_components(np.full((5, 3), 1e30, np.float32))
    assert np.isfinite(huge["sh.basis"]).all()


@pytest.mark.parametrize("parts", [(12,), (3, 9)])
def test_codes(parts):
    columns = standard_columns(3, 1)
    numbers = vectors(column_values(columns, 200)).astype(np.float16)
    ends = np.cumsum([0, *parts]).tolist()
    cuts = enumerate(zip(ends[:-1], ends[1:], strict=True))
    tables = {f"sh.codes.{at}": np.unique(numbers[:, a:b], axis=0) for at, (a, b) in cuts}
    check_encoding(Codes(parts), columns, tables, {CHOSEN_MARK: torch.arange(200) % 3 == 0}, near=1e-3)
    with pytest.raises(BadInput, match="codebooks .*12 coefficients"):
        check_encoding(Codes((11,)), columns, tables, {CHOSEN_MARK: torch.arange(200) % 3 == 0})


def test_a_codebook_is_learnt_from_a_sample_of_many_points(monkeypatch):
    """Of two colours only, so that any sample has both."""
    monkeypatch.setattr(vectree, "CODEBOOK_POINTS", 64)
    points = Surfel2D(sh_degree=0)
    params = {name: torch.zeros(1000, *column.shape) for name, column in points.columns().items()}
    params["sh0"][:] = torch.tensor([0.25, 0.5])[torch.arange(1000) % 2][:, None, None]
    seen, plain = [], vectree.kmeans
    monkeypatch.setattr(vectree, "kmeans", lambda given, *a, **k: seen.append(len(given)) or plain(given, *a, **k))
    plan = vectree.Vectree(ratio=0.5, codes=8).plan(SplatModel(points, params), torch.arange(1000.0), 0)
    assert seen == [64] and plan.tables["sh.codes.0"].tolist() == [[0.25] * 3, [0.5] * 3]
