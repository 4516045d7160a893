"""What a small image cache costs: the bundled example trained with caches of several sizes, in turns.

    python bench/cache.py [--steps 100] [--scale 1] [--rounds 3] [--budgets auto 100MB 5MB 5MB+copies]

A budget that ends in "+copies" also keeps the photographs on disk as they are used. The ratios are those of runs of the
same round, the median of all rounds: the first one makes the copies. Exits 1 if any result differs from the others.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import shutil
import statistics
import sys
import tempfile
from pathlib import Path

from machine import save
from trained import EXAMPLE

from surfkit.cli.recipes import recipes
from surfkit.io.datasets.data import Data
from surfkit.io.datasets.read import read
from surfkit.runs.blocks.train_blocks import Compute
from surfkit.runs.pipeline import Intervals, run
from surfkit.runs.recipe import with_steps
from surfkit.train.data_cache import CacheSettings

TIMES = ("seconds", "cpu_seconds")


def measure(data: Data, steps: int, budget: str) -> dict[str, object]:
    """Times and result of one run."""
    cache, _, copies = budget.partition("+")
    with tempfile.TemporaryDirectory() as folder:
        recipe, caches = with_steps(recipes()["2dgs"], steps), CacheSettings(cache, bool(copies))
        metrics = run(recipe, data, Path(folder), Compute("cpu"), Intervals(pictures=0), caches)
        points = (Path(folder) / "point_cloud.ply").read_bytes()
    found = {name: metrics[name] for name in TIMES}
    return found | {"psnr": metrics["images"]["psnr"], "points": hashlib.blake2b(points, digest_size=8).hexdigest()}


def main() -> int:
    """Print a line of JSON a run, and what the budgets cost compared with the first."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--steps", type=int, default=100)
    parser.add_argument("--scale", type=float, default=1)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--budgets", nargs="+", default=["auto", "100MB", "5MB", "5MB+copies"])
    given = parser.parse_args()
    found: dict[str, list[dict]] = {budget: [] for budget in given.budgets}
    with tempfile.TemporaryDirectory() as folder:
        data = Data(Path(shutil.copytree(EXAMPLE, Path(folder) / "data")), scale=given.scale)
        held = sum(3 * view.camera.width * view.camera.height for view in read(data).train)
        for _ in range(given.rounds):
            for budget, runs in found.items():
                runs.append(measure(data, given.steps, budget))
                print(json.dumps({"budget": budget, **runs[-1]}), flush=True)
    figures: dict[str, object] = {"photographs bytes": held, "steps": given.steps, "rounds": given.rounds}
    for budget, runs in found.items():
        for name in TIMES:
            pairs = zip(runs, found[given.budgets[0]], strict=True)
            figures[f"{budget}: {name} ratio"] = round(statistics.median(a[name] / b[name] for a, b in pairs), 3)
    results = {each["points"] for runs in found.values() for each in runs}
    figures["same result"] = len(results) == 1
    print(json.dumps(figures, indent=2))
    print(f"wrote {save('cache', figures)}")
    return 0 if len(results) == 1 else 1


if __name__ == "__main__":
    sys.exit(main())
