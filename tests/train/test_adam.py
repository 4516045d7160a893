import math

import pytest
import torch

from surfkit.core.check import BadInput
from surfkit.core.schedule import LearningRate
from surfkit.primitives.points import Points
from surfkit.raster import native
from surfkit.train.adam import UPDATED, adam_step


def gradients(count: int, seed: int) -> dict[str, torch.Tensor]:
    draw = torch.Generator().manual_seed(seed)
    scale = 10.0 ** torch.randint(-8, 1, (count, 1), generator=draw)
    return {"means": torch.randn(count, 3, generator=draw) * scale, "opacities": torch.randn(count, generator=draw)}


def test_agrees_with_torch_when_rows_are_added():
    start = gradients(7, 99)
    points = Points.fresh({name: value.clone() for name, value in start.items()})
    theirs = {name: torch.nn.Parameter(value.clone()) for name, value in start.items()}
    rates = {"means": 0.01, "opacities": 0.3}
    theirs_adam = torch.optim.Adam([{"params": [p], "lr": rates[n]} for n, p in theirs.items()], eps=1e-15)
    for index in range(1, 40):
        if index == 20:
            extra = gradients(3, 98)
            points = points.append(extra)
            theirs, theirs_adam = grown(theirs, theirs_adam, extra, rates)
        grads = gradients(len(points), index)
        adam_step(points, grads, rates, index)
        for name, parameter in theirs.items():
            parameter.grad = grads[name].clone()
        theirs_adam.step()
    for name, parameter in theirs.items():
        assert torch.allclose(points.params[name], parameter, rtol=1e-5, atol=1e-5)
        assert not torch.equal(points.params[name][:7], start[name])


def grown(theirs, adam, extra, rates):
    """torch's optimiser with rows added to its parameters and zeros to its moments."""
    new = {name: torch.nn.Parameter(torch.cat([p.detach(), extra[name]])) for name, p in theirs.items()}
    new_adam = torch.optim.Adam([{"params": [p], "lr": rates[n]} for n, p in new.items()], eps=1e-15)
    for name, parameter in new.items():
        state = adam.state[theirs[name]]
        pad = {k: torch.cat([state[k], torch.zeros_like(extra[name])]) for k in ("exp_avg", "exp_avg_sq")}
        new_adam.state[parameter] = {"step": state["step"].clone(), **pad}
    return new, new_adam


def test_columns_without_a_gradient_stay():
    points = Points.fresh({"means": torch.ones(2, 3), "sh_rest": torch.ones(2, 15, 3)})
    adam_step(points, {"means": torch.ones(2, 3)}, {"means": 0.1, "sh_rest": 0.1}, 1)
    assert points.params["sh_rest"].eq(1).all() and torch.allclose(points.params["means"], torch.tensor(0.9))


def test_rates_run_along_a_line_in_the_logarithm():
    rate = LearningRate(1e-2, 1e-6)
    assert math.isclose(rate.at(500, 1000), 1e-4) and math.isclose(rate.at(1000, 1000), 1e-6)
    assert LearningRate(0.5).at(1, 10) == LearningRate(0.5).at(10, 10) == 0.5 and LearningRate(0.0).at(3, 10) == 0


@pytest.mark.parametrize("ends", [(-1.0, None), (0.0, 1.0), (1.0, 0.0)])
def test_rates_that_make_no_sense_are_refused(ends):
    with pytest.raises(BadInput):
        LearningRate(*ends)


def wide(count: int, seed: int) -> dict[str, torch.Tensor]:
    """Gradients of columns of several widths."""
    draw = torch.Generator().manual_seed(seed)
    return {"sh_rest": torch.randn(count, 15, 3, generator=draw), **gradients(count, seed)}


RATES = {"sh_rest": 0.02, "means": 0.01, "opacities": 0.3}


def test_all_rows_are_the_whole_step():
    start = wide(700, 1)
    whole, rows = (Points.fresh({name: value.clone() for name, value in start.items()}) for _ in range(2))
    for index in range(1, 6):
        grads = wide(700, 10 + index)
        adam_step(whole, grads, RATES, index)
        adam_step(rows, grads, RATES, index, torch.arange(700))
    for one, other in ((whole.params, rows.params), (whole.exp_avg_sq, rows.exp_avg_sq)):
        assert all(torch.equal(one[name], other[name]) for name in one)


@pytest.mark.parametrize("compiled", [True, False])
def test_some_rows_against_torch_with_gradients_of_zero(compiled, monkeypatch):
    """The second moments are those of torch in every step in which a point is updated; the first ones do not fade."""
    if compiled and native.module() is None:
        pytest.skip("surfkit was installed without its compiled part")
    if not compiled:
        monkeypatch.setattr(native, "module", lambda: None)
    count, draw = 900, torch.Generator().manual_seed(4)
    points = Points.fresh({name: value.clone() for name, value in wide(count, 2).items()})
    theirs = {name: torch.nn.Parameter(value.clone()) for name, value in points.params.items()}
    adam = torch.optim.Adam([{"params": [p], "lr": RATES[n]} for n, p in theirs.items()], eps=1e-15)
    first = {name: torch.zeros_like(value) for name, value in theirs.items()}
    for index in range(1, 30):
        shown = torch.rand(count, generator=draw) < (0.3 if index % 5 else 0.95)
        rows, grads, before = shown.nonzero()[:, 0], wide(count, 100 + index), copied(points)
        adam_step(points, {name: grad[rows] for name, grad in grads.items()}, RATES, index, rows)
        for name, parameter in theirs.items():
            parameter.grad = torch.where(shown.view(-1, *[1] * (grads[name].dim() - 1)), grads[name], 0.0)
        adam.step()
        for name, value in points.params.items():
            first[name][rows] = 0.9 * first[name][rows] + 0.1 * grads[name][rows]
            second = points.exp_avg_sq[name][rows]
            assert torch.allclose(second, adam.state[theirs[name]]["exp_avg_sq"][rows], rtol=1e-4)
            assert torch.allclose(points.exp_avg[name], first[name], rtol=1e-4, atol=1e-6)
            root = (second.double() / (1 - 0.999**index)).sqrt() + 1e-15
            step = RATES[name] * first[name][rows].double() / (1 - 0.9**index) / root
            assert torch.allclose(value[rows], (before[name][rows] - step).float(), rtol=1e-4, atol=1e-5)
            assert torch.equal(value[~shown], before[name][~shown])
        assert points.stats[UPDATED][rows].eq(index).all() and not points.stats[UPDATED].gt(index).any()


def copied(points: Points) -> dict[str, torch.Tensor]:
    return {name: value.clone() for name, value in points.params.items()}


def test_a_gradient_moves_a_point_as_far_as_a_whole_step_does():
    """With gradients of one size, every tenth step: the same, but for a few steps of momentum."""
    ways = [Points.fresh({"means": torch.zeros(1, 3)}) for _ in range(2)]
    for index in range(1, 4001):
        shown = index % 10 == 0
        grad = {"means": torch.full((1, 3), float(shown))}
        adam_step(ways[0], grad, {"means": 1e-3}, index)
        if shown:
            adam_step(ways[1], grad, {"means": 1e-3}, index, torch.tensor([0]))
    whole, rows = (float(way.params["means"][0, 0]) for way in ways)
    assert whole < -1.0 and rows == pytest.approx(whole, rel=0.05)


def test_no_row_is_no_change():
    points = Points.fresh({"means": torch.ones(2, 3)})
    adam_step(points, {"means": torch.ones(0, 3)}, {"means": 0.1}, 3, torch.zeros(0, dtype=torch.int64))
    assert points.params["means"].eq(1).all() and not points.exp_avg["means"].any()


def test_a_step_for_all_after_one_for_some():
    """Points that were left out before have second moments that have faded, once."""
    points = Points.fresh({"means": torch.zeros(2, 1)})
    one = {"means": torch.ones(1, 1)}
    adam_step(points, one, {"means": 0.1}, 1, torch.tensor([0]))
    adam_step(points, one, {"means": 0.1}, 2, torch.tensor([1]))
    adam_step(points, {"means": torch.zeros(2, 1)}, {"means": 0.1}, 3)
    adam_step(points, one, {"means": 0.1}, 4, torch.tensor([0]))
    wanted = torch.tensor([[1e-3 * 0.999**3 + 1e-3], [1e-3 * 0.999]])
    assert torch.allclose(points.exp_avg_sq["means"], wanted, rtol=1e-5)


@pytest.mark.parametrize("gap", [300, 667])
def test_momentum_of_long_ago_does_not_run_away(gap):
    """A point that few views show, of which nothing is left to see after its first gradients."""
    ways = [Points.fresh({"means": torch.zeros(1, 1)}) for _ in range(2)]
    for index in range(1, 20_001):
        shown = index % gap == 0
        grad = {"means": torch.full((1, 1), float(shown and index <= 8 * gap))}
        adam_step(ways[0], grad, {"means": 1.0}, index)
        if shown:
            adam_step(ways[1], grad, {"means": 1.0}, index, torch.tensor([0]))
    whole, rows = (float(way.params["means"]) for way in ways)
    assert whole < -100 and 1.5 * whole < rows < 0.3 * whole


def test_some_rows_after_steps_for_all():
    """What all have had is not taken for steps that were missed."""
    ways = [Points.fresh({"means": torch.zeros(3, 1)}) for _ in range(2)]
    for index in range(1, 400):
        for way in ways:
            adam_step(way, {"means": torch.ones(3, 1)}, {"means": 1.0}, index)
    adam_step(ways[0], {"means": torch.ones(3, 1)}, {"means": 1.0}, 400)
    adam_step(ways[1], {"means": torch.ones(3, 1)}, {"means": 1.0}, 400, torch.arange(3))
    assert torch.equal(ways[0].params["means"], ways[1].params["means"])
