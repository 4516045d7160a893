"""What a small image cache costs: the bundled example trained with caches of several sizes.

Usage: python bench/cache.py [--steps 100] [--scale 1] [--budgets auto 100MB 5MB]
"""

from __future__ import annotations

import argparse
import hashlib
import json
import tempfile
from pathlib import Path

import torch
from trained import EXAMPLE

from surfkit.cli.recipes import recipes
from surfkit.pipeline import run, with_steps
from surfkit.scene.data import Data
from surfkit.scene.memory import cache_bytes
from surfkit.scene.read import read
from surfkit.train.material import Store


def measure(data: Data, steps: int, budget: str) -> dict[str, object]:
    """Time and result of one run."""
    with tempfile.TemporaryDirectory() as folder:
        metrics = run(with_steps(recipes()["2dgs"], steps), data, Path(folder), "cpu", store=Store(budget))
        points = (Path(folder) / "point_cloud.ply").read_bytes()
    return {
        "budget": budget,
        "bytes": cache_bytes(budget),
        "seconds": metrics["seconds"],
        "cpu_seconds": metrics["cpu_seconds"],
        "psnr": metrics["images"]["psnr"],
        "points": hashlib.blake2b(points, digest_size=8).hexdigest(),
    }


def main() -> None:
    """Print a line of JSON a budget, and what the smaller ones cost compared with the first."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--steps", type=int, default=100)
    parser.add_argument("--scale", type=float, default=1)
    parser.add_argument("--budgets", nargs="+", default=["auto", "100MB", "5MB"])
    given = parser.parse_args()
    data = Data(EXAMPLE, scale=given.scale)
    held = sum(3 * view.camera.width * view.camera.height for view in read(data).train)
    print(json.dumps({"photographs_bytes": held, "steps": given.steps, "threads": torch.get_num_threads()}))
    first = None
    for budget in given.budgets:
        found = measure(data, given.steps, budget)
        first = first or found
        found["time_ratio"] = round(found["seconds"] / first["seconds"], 3)
        found["cpu_ratio"] = round(found["cpu_seconds"] / first["cpu_seconds"], 3)
        found["same_points"] = found["points"] == first["points"]
        print(json.dumps(found), flush=True)


if __name__ == "__main__":
    main()
