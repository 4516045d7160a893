"""The count explosion of CityGaussianV2, section 3.2, on a scene made for it."""

import math
from dataclasses import replace

import torch

from surfkit.core.schedule import LearningRate
from surfkit.densify import ADC, Elongation
from surfkit.losses.photometric import SSIM
from surfkit.primitives import Surfel2D
from surfkit.primitives.columns import RATES
from surfkit.primitives.points import Points
from surfkit.train.stage import Stage

NEEDLES = 8


def grown(begin, truth, filters) -> list[tuple[int, int]]:
    """Points, and needles among them, after each of twelve edits.

    On the left, discs that explain the photographs; on the right, where those are black, needles that nothing but
    their place can change: however many there are, each keeps its gradient.
    """
    densify = ADC(threshold=0.02, start=5, until=1_000, every=10, cull_opacity=0.0, reset_every=1_000, filters=filters)
    rates = {name: LearningRate(1e-5 if name == "means" else 0.0) for name in RATES}
    losses = {"ssim": SSIM(weight=1.0)}  # its gradient, unlike that of L1, is small where little is wrong
    stage = Stage(steps=120, losses=losses, densify=densify, rates=rates, sh_every=1_000)
    trainer, state = begin(stage, Surfel2D(sh_degree=0))
    left = truth.means[:, 0] < -0.05
    discs = replace(truth, **{name: value[left] for name, value in truth.tensors().items()})
    renders = [trainer.rasterizer.render(discs, view.camera, stage.near).maps.color for view in trainer.views]
    trainer = replace(trainer, photos=[(render * 255).round().byte() for render in renders])
    params = {name: value[: int(left.sum()) + NEEDLES].clone() for name, value in state.points.params.items()}
    raw = {
        "means": discs.means, "quats": discs.quats, "scales": discs.scales.log(),
        "opacities": discs.opacities.logit(), "sh0": discs.sh0,
    }  # fmt: skip
    for name, value in raw.items():
        params[name][:-NEEDLES] = value
    params["means"][-NEEDLES:] = torch.tensor([[0.3, y, 0.0] for y in torch.linspace(-0.2, 0.2, NEEDLES)])
    params["quats"][-NEEDLES:] = torch.tensor([1.0, 0, 0, 0])
    params["scales"][-NEEDLES:] = torch.tensor([math.log(0.08), math.log(0.08 * 0.004)])
    params["opacities"][-NEEDLES:] = 0.0
    params["sh0"][-NEEDLES:] = 1.0
    state.points = Points.fresh(params)
    counts = []
    for done in trainer.run(state):
        if done.index % 10 == 0:
            scales = state.points.params["scales"].exp()
            counts.append((len(state.points), int((scales.amin(1) < 0.01 * scales.amax(1)).sum())))
    return counts


def test_needles_multiply_without_end_unless_they_are_filtered(begin, tiny):
    free, held = (grown(begin, tiny.truth, filters) for filters in ((), (Elongation(),)))
    assert held == [held[0]] * 12 and held[0][1] == NEEDLES, "what is filtered stays as it is"
    needles = [count for _, count in free]
    assert needles[:2] == [2 * NEEDLES, needles[1]] and needles[-1] >= 8 * NEEDLES
    assert free[-1][0] > 5 * held[-1][0], "and they make the discs beside them multiply"
