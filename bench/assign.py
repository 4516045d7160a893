"""How far the two ways to assign views agree, and what each costs.

    python bench/assign.py DATA [DATA ...] [--steps 300] [--scale 2]

`ssim-difference` is the paper's and draws each view once whole and once without every block that it shows; with
`picture-share` one pass over the view is enough. Both look at the same coarse model, half-way through a short training,
cut by the paper's grid and into 3 x 3 cells of equally many points. What is counted are pairs of a view and a block
whose camera is not inside: the others join anyhow. Times are CPU times of all threads, and only their ratio tells.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import dataclass
from pathlib import Path

import torch
from machine import save
from torch import Tensor
from trained import halfway

from surfkit.core.tree import evolve
from surfkit.io.datasets.data import Data
from surfkit.partition import CoarseModel, ContractedGrid, Partition, PictureShare, QuantileGrid, SSIMDifference
from surfkit.study.recipes.city import CITY_COARSE

CUTS: dict[str, Partition] = {"contracted 2x2": ContractedGrid((2, 2)), "quantile 3x3": QuantileGrid((3, 3))}
THRESHOLDS = [at / 1_000 for at in (1, 2, 3, 4, 5, 6, 8, 10, 12, 15, 20, 25, 30, 35, 40, 45, 50, 60, 80, 100, 150)]


@dataclass(frozen=True)
class Case:
    """One coarse model, cut once.

    Attributes:
        difference: (V, B) of the paper.
        share: (V, B) of the cheaper way.
        inside: (V, B) bool, cameras in their blocks.
        seconds: What each took.
    """

    difference: Tensor
    share: Tensor
    inside: Tensor
    seconds: tuple[float, float]

    def joins(self, threshold: float) -> tuple[Tensor, Tensor]:
        """(P,) bool each: which pairs of a view and a block outside of which it stands both ways choose."""
        there = ~self.inside
        return self.difference[there] > SSIMDifference().threshold, self.share[there] > threshold


def coarse_model(path: Path, steps: int, scale: float) -> CoarseModel:
    """A scene half-way through a training of so many steps, and its views."""
    losses = {name: loss for name, loss in CITY_COARSE.pretrain.losses.items() if name != "depth"}
    trainer, state = halfway(evolve(CITY_COARSE, "pretrain.losses", losses), 2 * steps, Data(path, scale=scale))
    splats = trainer.primitive.activate(state.points.params, state.sh_degree)
    return CoarseModel(splats, trainer.views, trainer.rasterizer, trainer.stage.near)


def compared(sight: CoarseModel, way: Partition) -> Case:
    """Both ways, one after the other."""
    cells = way.cells(sight)
    owner, seconds, found = cells.owner(sight.splats.means), [], []
    ways: tuple[SSIMDifference | PictureShare, ...] = (SSIMDifference(), PictureShare())
    for assign in ways:
        began = time.process_time()
        found.append(assign.measure(sight, owner, cells.count))
        seconds.append(time.process_time() - began)
    inside = torch.nn.functional.one_hot(cells.owner(sight.centres), cells.count).bool()
    return Case(*found, inside, tuple(seconds))


def overlap(cases: list[Case], threshold: float) -> float:
    """Pairs that both choose, as a share of those that either does."""
    both = either = 0
    for case in cases:
        a, b = case.joins(threshold)
        both, either = both + int((a & b).sum()), either + int((a | b).sum())
    return both / max(1, either)


def described(case: Case) -> dict[str, float]:
    """One case at the threshold that is set."""
    threshold = PictureShare().threshold
    a, b = case.joins(threshold)
    blocks = case.inside.shape[1]
    best = max(THRESHOLDS, key=lambda at: overlap([case], at))
    return {
        "pairs": len(a),
        "both choose": int((a & b).sum()),
        "only ssim-difference": int((a & ~b).sum()),
        "only picture-share": int((b & ~a).sum()),
        "agree on, of all": float((a == b).float().mean()),
        "agree on, of what either chooses": overlap([case], threshold),
        "best threshold": best,
        "agree there, of what either chooses": overlap([case], best),
        "views per block by ssim-difference": float(a.sum() + case.inside.sum()) / blocks,
        "views per block by picture-share": float(b.sum() + case.inside.sum()) / blocks,
        "CPU time of picture-share to ssim-difference": case.seconds[1] / case.seconds[0],
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("data", type=Path, nargs="+")
    parser.add_argument("--steps", type=int, default=300)
    parser.add_argument("--scale", type=float, default=2.0)
    chosen = parser.parse_args()
    figures: dict[str, float] = {}
    cases: list[Case] = []
    for path in chosen.data:
        sight = coarse_model(path, chosen.steps, chosen.scale)
        for name, way in CUTS.items():
            cases.append(compared(sight, way))
            for what, value in described(cases[-1]).items():
                figures[f"{path.name}, {name}: {what}"] = value
                print(f"{path.name}, {name}: {what} {value:.4g}", flush=True)
    for threshold in THRESHOLDS:
        figures[f"all, picture-share above {threshold}: agree on, of what either chooses"] = overlap(cases, threshold)
        print(f"above {threshold}: {overlap(cases, threshold):.3f} of what either chooses")
    figures["all: best threshold"] = max(THRESHOLDS, key=lambda at: overlap(cases, at))
    seconds = torch.tensor([case.seconds for case in cases])
    figures["all: CPU time of picture-share to ssim-difference"] = float((seconds[:, 1] / seconds[:, 0]).median())
    print(f"best {figures['all: best threshold']}; wrote {save('assign', figures)}")


if __name__ == "__main__":
    main()
