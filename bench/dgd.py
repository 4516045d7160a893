"""What the decomposed gradient costs: `python bench/dgd.py`.

The same half-trained scene takes steps with the gradient of all losses and with that of SSIM apart, in turns; one
figure a line: `dgd overhead 0.04` is the median of the ratio of paired steps less one, by CPU time of all threads.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import replace

import torch
from machine import save
from trained import copied, halfway

from surfkit.densify.signal import AbsGradient, LossGradient
from surfkit.study.recipes import SURFELS
from surfkit.train.state import StageState
from surfkit.train.trainer import Trainer

SIGNALS = {
    "all losses": LossGradient(),
    "dgd": LossGradient(terms=("ssim",), boost=0.9),
    "dgd of ssim and normal": LossGradient(terms=("ssim", "normal")),
    "abs-gradient": AbsGradient(),
}


def seconds(trainer: Trainer, state: StageState) -> float:
    """CPU seconds of one step on copied points."""
    state = copied(state)
    began = time.process_time()
    trainer.step(state)
    return time.process_time() - began


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rounds", type=int, default=60)
    options = parser.parse_args()
    trainer, state = halfway(SURFELS, 1_000)
    # Normals take part; nothing is edited.
    losses = trainer.stage.losses | {"normal": replace(trainer.stage.losses["normal"], start=0)}
    stage = replace(trainer.stage, losses=losses, densify=None)
    trainers = {name: replace(trainer, stage=replace(stage, signal=signal)) for name, signal in SIGNALS.items()}
    times: dict[str, list[float]] = {name: [] for name in trainers}
    for index in range(options.rounds + 3):
        for name, each in trainers.items():
            state.order.at = index % len(state.order.queue)  # the same photograph for all
            taken = seconds(each, state)
            times[name] += [taken] * (index >= 3)
    plain = torch.tensor(times["all losses"])
    figures = {"step CPU-s": float(plain.median()), "points": len(state.points)}
    for name, taken in times.items():
        if name != "all losses":
            figures[f"{name} overhead"] = float((torch.tensor(taken) / plain).median() - 1)
    for name, value in figures.items():
        print(f"{name} {value:.4g}")
    print(f"wrote {save('dgd', figures)}")


if __name__ == "__main__":
    main()
