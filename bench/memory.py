"""Trains on thousands of large photographs, and shows what the memory is taken by.

    python bench/memory.py [--images 10000] [--width 5472] [--height 3648] [--steps 60] [--limit 4GiB]

The photographs are a few JPEG files under thousands of names (hard links), over a plain of random points. The training
is a process of its own, which may not have more address space than the limit, and a cache as it is by default.
Exits 1 if it failed or held more.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from machine import save
from PIL import Image

DISTINCT = 8
"""Files that there really are."""
GRAIN = 16
"""Pixels of a patch of their texture."""


def write_data(folder: Path, images: int, width: int, height: int, points: int) -> None:
    """A survey: cameras 100 m above a plain, that look straight down."""
    draw = np.random.default_rng(0)
    (folder / "images").mkdir(parents=True)
    for at in range(min(DISTINCT, images)):
        patches = draw.integers(0, 256, (height // GRAIN + 1, width // GRAIN + 1, 3), np.uint8)
        picture = Image.fromarray(patches).resize((width, height), Image.Resampling.BICUBIC)
        picture.save(folder / "images" / name(at), quality=90)
    for at in range(DISTINCT, images):
        os.link(folder / "images" / name(at % DISTINCT), folder / "images" / name(at))
    side = int(np.ceil(np.sqrt(images)))
    lines = []
    for at in range(images):
        x, y = 20.0 * (at % side), 20.0 * (at // side)
        lines.append(f"{at + 1} 0 1 0 0 {-x} {y} 100 1 {name(at)}\n\n")  # turned over, to look down
    model = folder / "sparse" / "0"
    model.mkdir(parents=True)
    lens = f"1 PINHOLE {width} {height} {width} {width} {width / 2} {height / 2}\n"
    xyz = draw.uniform([0, 0, -2], [20 * side, 20 * side, 2], (points, 3))
    rows = (f"{i} {x:.3f} {y:.3f} {z:.3f} 128 128 128 0.5\n" for i, (x, y, z) in enumerate(xyz, 1))
    (model / "cameras.txt").write_text(lens)
    (model / "images.txt").write_text("".join(lines))
    (model / "points3D.txt").write_text("".join(rows))


def name(at: int) -> str:
    """Of a photograph."""
    return f"{at:05}.jpg"


def main() -> int:
    """Run it."""
    from surfkit.scene.available_memory import cache_bytes

    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    for flag, default in {"images": 10_000, "width": 5472, "height": 3648, "points": 200_000, "steps": 60}.items():
        parser.add_argument(f"--{flag}", type=int, default=default)
    parser.add_argument("--limit", default="4GiB")
    parser.add_argument("--words", nargs="*", default=[], help="further words for surfkit train")
    chosen = parser.parse_args()
    limit = cache_bytes(chosen.limit)
    with tempfile.TemporaryDirectory() as place:
        data, out = Path(place) / "data", Path(place) / "run"
        write_data(data, chosen.images, chosen.width, chosen.height, chosen.points)
        words = f"train recipe:2dgs --steps {chosen.steps} --pictures-every 0 --device cpu --test-every 1000".split()
        command = [sys.executable, "-m", "surfkit.cli", *words, "--data", str(data), "--out", str(out), *chosen.words]
        start = time.monotonic()
        done = subprocess.run(
            command,
            preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_AS, (limit, limit)),
            check=False,
        )
        seconds = time.monotonic() - start
        if done.returncode:
            return 1
        metrics = json.loads((out / "metrics.json").read_text())
        record = json.loads((out / "run.json").read_text())
    held = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss * 1024
    report = {
        "images": chosen.images, "pixels": chosen.width * chosen.height, "steps": metrics["steps"], "limit": limit,
        "peak": held, "parts": metrics["memory_bytes"], "seconds": round(seconds, 1), "notes": record["notes"],
        "seconds_of_steps": metrics["seconds"],
    }  # fmt: skip
    for part, count in report["parts"].items():
        print(f"{part:>12} {count / 1e6:8.0f} MB")
    print(f"{chosen.images} images, {held / 1e6:.0f} MB at most, limit {limit / 1e6:.0f} MB, {seconds:.0f} s")
    print(f"wrote {save('memory', report)}")
    return 0 if held <= limit else 1


if __name__ == "__main__":
    sys.exit(main())
