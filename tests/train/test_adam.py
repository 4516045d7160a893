import math

import pytest
import torch

from surfkit.core.check import BadInput
from surfkit.core.schedule import LearningRate
from surfkit.primitives.points import Points
from surfkit.train.adam import adam_step


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
