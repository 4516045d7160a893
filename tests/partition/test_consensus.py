"""Agreement of blocks: on convex problems it comes to the minimum of all terms together, solved in numpy."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch

from surfkit.core.check import BadInput
from surfkit.losses.base import RegularizerInput
from surfkit.losses.consensus import Consensus, column
from surfkit.partition.admm import ConsensusState, PointCopies, agree, columns_after, common, mean_copies
from surfkit.testing.inputs import splats

IDS = [[0, 1, 2, 3, 5], [1, 2, 4, 5], [2, 3, 5, 6]]
"""Of 7 points: 0, 4 and 6 in one block each, 1 and 3 in two, 2 and 5 in all three."""


def problem(seed=0):
    """Of each block and each of its points: a symmetric 3 x 3 matrix A and c of the term (x - c) A (x - c) / 2."""
    draws = np.random.default_rng(seed)
    found = []
    for ids in IDS:
        roots = draws.normal(size=(len(ids), 3, 3))
        found.append((roots @ roots.transpose(0, 2, 1) + 0.2 * np.eye(3), draws.normal(size=(len(ids), 3))))
    return found


def joint(terms):
    """(7, 3) the minimum of all terms."""
    left, right = np.zeros((7, 3, 3)), np.zeros((7, 3))
    for ids, (a, c) in zip(IDS, terms, strict=True):
        for row, at in enumerate(ids):
            left[at] += a[row]
            right[at] += a[row] @ c[row]
    return np.linalg.solve(left, right[:, :, None])[:, :, 0]


def rounds(terms, rule, count):
    """Copies after some rounds, in each of which every block finds the minimum of its terms exactly; rho by round."""
    stats, before, history = [{} for _ in IDS], None, []
    for number in range(count + 1):
        copies = []
        for ids, (a, c), known in zip(IDS, terms, stats, strict=True):
            rho = known.get(column("rho", "means"), torch.zeros(len(ids))).double().numpy() / 3  # a mean over 3 numbers
            pull = known[column("z", "means")] - known[column("u", "means")] if known else torch.zeros(len(ids), 3)
            left = a + rho[:, None, None] * np.eye(3)
            right = (a @ c[:, :, None])[:, :, 0] + rho[:, None] * pull.numpy()
            x = np.linalg.solve(left, right[:, :, None])[:, :, 0]
            copies.append(PointCopies(torch.tensor(ids), {"means": torch.from_numpy(x)}))
        if number < count:
            before = agree(copies, rule, before, (number + 1) * rule.every)
            stats = [columns_after(c, known, before, rule) for c, known in zip(copies, stats, strict=True)]
            history.append(before.rho["means"])
    return copies, history


@pytest.mark.parametrize(("strong", "until"), [(20.0, 0), (0.02, 100_000), (2e4, 100_000)])
def test_blocks_come_to_the_joint_minimum(strong, until):
    """With a fitting rho as it is, and with one a thousand times too small or too large that is balanced."""
    terms = problem()
    copies, history = rounds(terms, Consensus(strong=strong, every=1, balance_until=until), 300)
    true = joint(terms)
    for block in copies:
        assert np.allclose(block.params["means"].numpy(), true[block.ids.numpy()], atol=1e-6)
    assert len(set(history)) == (1 if until == 0 else len(set(history))) and (until == 0 or history[0] != history[-1])


def test_without_agreement_they_would_not():
    terms = problem()
    alone, _ = rounds(terms, Consensus(strong=20.0, every=1, balance_until=0), 0)
    assert max(float((a.params["means"] - torch.from_numpy(joint(terms)[a.ids])).abs().max()) for a in alone) > 0.5


def test_what_is_common_and_its_mean():
    blocks = [PointCopies(torch.tensor(ids), {"v": torch.rand(len(ids), 2, 3)}) for ids in IDS]
    ids = common([block.ids for block in blocks])
    assert ids.tolist() == [1, 2, 3, 5]
    means, counts = mean_copies(blocks, torch.arange(8))
    assert counts.tolist() == [1, 2, 3, 2, 1, 3, 1, 0] and not means["v"][7].any()
    for at in range(7):
        copies = [b.params["v"][b.ids.tolist().index(at)] for b in blocks if at in b.ids.tolist()]
        assert torch.allclose(means["v"][at], torch.stack(copies).mean(0))
    assert agree(blocks, Consensus(), None, 200).rho == {"v": 1e4 / 4}


def test_blocks_without_common_points():
    blocks = [
        PointCopies(torch.tensor([0, 1]), {"v": torch.rand(2)}),
        PointCopies(torch.tensor([2]), {"v": torch.rand(1)}),
    ]
    found = agree(blocks, Consensus(), None, 200)
    assert not len(found.ids) and not columns_after(blocks[0], {}, found, Consensus())[column("rho", "v")].any()


def test_rho_follows_the_residuals_of_each_parameter():
    """Differences of 3 and 1 among copies; means that have moved by hardly anything, and by far."""
    ids = torch.tensor([4, 9])
    blocks = [PointCopies(ids, {"a": torch.tensor([s, s]), "b": torch.tensor([[s], [s]])}) for s in (1.0, -1.0)]
    z = {"a": torch.zeros(2), "b": torch.full((2, 1), 100.0)}
    before = ConsensusState(ids, z, {"a": 2.0, "b": 2.0})
    assert agree(blocks, Consensus(balance_until=50), before, 50).rho == {"a": 4.0, "b": 1.0}
    assert agree(blocks, Consensus(balance_until=50), before, 51).rho == {"a": 2.0, "b": 2.0}
    near = ConsensusState(ids, {"a": torch.full((2,), 0.5), "b": torch.full((2, 1), 0.5)}, before.rho)
    assert agree(blocks, Consensus(), near, 50).rho == {"a": 2.0, "b": 2.0}, "2 and 1 are alike"
    known = {column("rho", "a"): torch.tensor([1.0, 1.0]), column("u", "a"): torch.tensor([0.5, 0.0])}
    after = columns_after(blocks[0], known, ConsensusState(ids, z, {"a": 4.0, "b": 1.0}), Consensus(relaxation=1.5))
    assert after[column("rho", "a")].tolist() == [2.0, 2.0] and after[column("u", "a")].tolist() == [1.0, 0.75]


def test_the_term_is_as_written():
    """Half of rho times the mean square of x + u - z of each point, summed; gradients reach the raw parameters."""
    draws, shapes = torch.Generator().manual_seed(0), {"means": (3,), "opacities": (), "sh_rest": (0, 3), "sh0": (1, 3)}
    x = {name: torch.randn(60, *s, generator=draws, dtype=torch.float64).requires_grad_() for name, s in shapes.items()}
    stats = {}

    def stat(name, *shape):
        return stats.setdefault(name, torch.randn(60, *shape, generator=draws, dtype=torch.float64))

    stats[column("rho", "sh0")] = torch.zeros(60)
    given = RegularizerInput(5, 10, None, SimpleNamespace(), None, stat, x)
    value = Consensus().in_step(splats(), given)
    wanted = 0.0
    for name in ("means", "opacities"):
        rho, u, z = (stats[column(what, name)].numpy() for what in ("rho", "u", "z"))
        for i in range(60):
            wanted += rho[i] / 2 * np.mean((x[name].detach().numpy()[i] + u[i] - z[i]) ** 2)
    assert float(value) == pytest.approx(wanted)
    means = torch.autograd.grad(value, x["means"])[0]
    rho, u, z = (stats[column(what, "means")] for what in ("rho", "u", "z"))
    assert torch.allclose(means, rho[:, None] * (x["means"] + u - z).detach() / 3)


def test_bad_settings():
    for bad in ({"every": 0}, {"strong": 0.0}, {"weak": -1.0}, {"relaxation": 2.0}, {"balance": 1.0}):
        with pytest.raises(BadInput, match="consensus."):
            Consensus(**bad)
