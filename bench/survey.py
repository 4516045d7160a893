"""What one pass over all views costs that trim, prune and compression share: `python bench/survey.py`.

Against an epoch of training on the same half-trained scene, whole, and without the way back (photograph, render,
losses) and the optimiser. One figure a line, ratios of CPU time of all threads, medians over rounds in turns.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from dataclasses import replace

import torch
from machine import save
from trained import copied, halfway

from surfkit.losses.base import Target
from surfkit.study.recipes import SURFELS
from surfkit.train.view_order import ViewContributions


def taken(action: Callable[[], object]) -> float:
    """CPU seconds of an action."""
    began = time.process_time()
    action()
    return time.process_time() - began


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rounds", type=int, default=7)
    options = parser.parse_args()
    trainer, state = halfway(SURFELS, 1_000)
    losses = trainer.stage.losses | {"normal": replace(trainer.stage.losses["normal"], start=0)}
    trainer = replace(trainer, stage=replace(trainer.stage, losses=losses, densify=None))
    splats = trainer.primitive.activate(state.points.params, trainer.primitive.sh_degree)

    def contributions() -> None:
        ViewContributions(trainer.views, trainer.rasterizer, splats, trainer.stage.near).contributions()

    def forward() -> None:
        for at, view in enumerate(trainer.views):
            sample = Target(view, trainer.photos[at].to(torch.float32).div_(255))
            maps = trainer.rasterizer.render(splats, view.camera, trainer.stage.near, True, False).maps
            sum(loss(maps, sample) for name, loss in losses.items() if name != "distortion")

    def epoch() -> None:
        fresh = copied(state)
        for _ in trainer.views:
            trainer.step(fresh)

    times = {action: [] for action in (contributions, forward, epoch)}
    for index in range(options.rounds + 1):
        for action, kept in times.items():
            kept += [taken(action)] * (index > 0)
    cost = {action.__name__: float(torch.tensor(kept).median()) for action, kept in times.items()}
    figures = {
        "survey CPU-s": cost["survey"],
        "views": len(trainer.views),
        "points": len(state.points),
        "of an epoch": cost["survey"] / cost["epoch"],
        "of an epoch without backward": cost["survey"] / cost["forward"],
    }
    for name, value in figures.items():
        print(f"survey {name} {value:.4g}" if not name.startswith("survey") else f"{name} {value:.4g}")
    print(f"wrote {save('survey', figures)}")


if __name__ == "__main__":
    main()
