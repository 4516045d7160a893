"""How near the estimate of `surfkit doctor` is to what a run takes, once its number of points is known.

Trains, then estimates with the points that the run ended with: what is left is the error of the measurement, and not
that of the rule of thumb for points. Times compare only on a machine that does nothing else.

Usage: python bench/doctor.py [--data examples/boruszyn] [--steps 1000] [--scale 4]
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import tempfile
from pathlib import Path

from trained import EXAMPLE

from surfkit.apps.doctor.examine import examine
from surfkit.apps.doctor.forecast import ProbePlan, forecast
from surfkit.cli.recipes import recipes
from surfkit.core.memory import peak_memory_bytes
from surfkit.io.datasets.data import Data
from surfkit.runs.blocks.train_blocks import Compute
from surfkit.runs.pipeline import run
from surfkit.runs.recipe import with_steps
from surfkit.runs.run_stage import Intervals


def real(data: Data, steps: int, answer: multiprocessing.Queue) -> None:
    """One run, in a process of its own, so that its peak of memory is its own too."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        metrics = run(with_steps(recipes()["2dgs"], steps), data, folder, Compute("cpu"), Intervals(pictures=0))
        disk = sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())
    answer.put({**{key: metrics[key] for key in ("points", "seconds")}, "memory": peak_memory_bytes(), "disk": disk})


def main() -> None:
    """Print what was estimated, what it was, and the ratios."""
    words = argparse.ArgumentParser(description=__doc__)
    words.add_argument("--data", type=Path, default=EXAMPLE)
    words.add_argument("--steps", type=int, default=1_000)
    words.add_argument("--scale", type=float, default=4)
    asked = words.parse_args()
    data, ctx = Data(asked.data, scale=asked.scale), multiprocessing.get_context("spawn")
    answer = ctx.Queue()
    process = ctx.Process(target=real, args=(data, asked.steps, answer))
    process.start()
    was = answer.get()
    process.join()
    recipe = with_steps(recipes()["2dgs"], asked.steps)
    free, _ = forecast(data, recipe, examine(data, recipe), ProbePlan())
    found, _ = forecast(data, recipe, examine(data, recipe), ProbePlan(points=was["points"]))
    told = {"points": free.points, "seconds": found.seconds, "memory": found.memory_bytes, "disk": found.run_bytes}
    ratios = {key: round(told[key] / was[key], 3) for key in told}
    print(json.dumps({"estimated": told, "was": was, "ratio": ratios}, indent=2))


if __name__ == "__main__":
    main()
