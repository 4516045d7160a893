"""What it costs to write and to read models as `.surfkit` files: time, peak memory, bytes.

    python bench/compress.py [--points 1000000] [--compressors lossless float16 packed vectree] [--out NAME]

The model is made up: surfels on a terrain with blocks on it, with radii, opacities and spherical harmonics distributed
as training leaves them. It is written to disk first and mapped from there, as models that do not fit into memory are.
Each compressor runs in a process of its own, so that its peak of memory is its own. The memory of the process is
counted without pages mapped from files, which the system takes back when it needs them.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import torch
from machine import save

NAMES = ("lossless", "float16", "packed", "vectree")
CHUNK = 1 << 20
"""Points that are made up at a time."""


def made_up(count: int, seed: int) -> dict[str, torch.Tensor]:
    """Columns of `count` surfels of degree 3 as training leaves them."""
    draw = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> torch.Tensor:
        return torch.randn(count, *shape, generator=draw)

    def uniform(*shape: int) -> torch.Tensor:
        return torch.rand(count, *shape, generator=draw)

    xy = 4 * uniform(2) - 2
    block = (torch.sin(9 * xy[:, 0]) * torch.sin(7 * xy[:, 1]) > 0.4).float()
    z = 0.1 * torch.sin(2 * xy[:, 0]) + 0.3 * block * uniform() ** 0.3 + 0.002 * normal()
    size = math.log(0.004) + 0.7 * normal(1)
    level = torch.stack([torch.sin(3 * xy[:, 0]), torch.cos(4 * xy[:, 1]), block - 0.5], 1)
    strength = torch.exp(0.8 * normal(1, 1))
    spread = torch.tensor([0.07] * 3 + [0.045] * 5 + [0.03] * 7)[:, None]
    shared = normal(15, 1)  # the three colours vary together
    return {
        "means": torch.cat([xy, z[:, None]], 1),
        "scales": size + 0.5 * normal(2),
        "quats": torch.tensor([1.0, 0, 0, 0]) + torch.stack([normal(), 0.4 * normal(), 0.4 * normal(), normal()], 1),
        "opacities": 2.2 * normal() + 0.3,
        "sh0": (0.7 * level + 0.35 * normal(3))[:, None],
        "sh_rest": strength * spread * (0.8 * shared + 0.4 * normal(15, 3)),
    }


def write_columns(folder: Path, count: int) -> None:
    """The model on disk, an .npy a column, made piece by piece."""
    for at, start in enumerate(range(0, count, CHUNK)):
        part = made_up(min(CHUNK, count - start), at)
        for name, value in part.items():
            if not start:
                np.lib.format.open_memmap(folder / f"{name}.npy", "w+", np.float32, (count, *value.shape[1:]))
            whole = np.load(folder / f"{name}.npy", mmap_mode="r+")
            whole[start : start + len(value)] = value.numpy()


def mapped(folder: Path) -> Any:
    """The model, its columns mapped from disk."""
    from surfkit.primitives.model import SplatModel
    from surfkit.primitives.surfel2d import Surfel2D

    names = ("means", "scales", "quats", "opacities", "sh0", "sh_rest")
    params = {name: torch.from_numpy(np.load(folder / f"{name}.npy", mmap_mode="c")) for name in names}
    return SplatModel(Surfel2D(), params, 3)


def own_memory() -> int:
    """Bytes of memory of this process, without pages of files."""
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith("RssAnon:"):
            return int(line.split()[1]) << 10
    return 0


@contextmanager
def measured(what: str, figures: dict[str, float]) -> Iterator[None]:
    """Within, time and memory are measured."""
    before = peak = own_memory()
    ended = threading.Event()

    def watch() -> None:
        nonlocal peak
        while not ended.wait(0.01):
            peak = max(peak, own_memory())

    watcher = threading.Thread(target=watch)
    watcher.start()
    wall, cpu = time.perf_counter(), time.process_time()
    try:
        yield
    finally:
        seconds, used = time.perf_counter() - wall, time.process_time() - cpu
        ended.set()
        watcher.join()
        figures[f"{what}, wall seconds"] = round(seconds, 2)
        figures[f"{what}, CPU seconds"] = round(used, 2)
        figures[f"{what}, peak MB added"] = round((peak - before) / 1e6, 1)


def one(name: str, folder: Path, rounds: int) -> dict[str, float]:
    """Figures of one compressor, in this process."""
    from surfkit.compress.base import Compressor
    from surfkit.compress.container import ModelFile, write_model
    from surfkit.core.registry import find

    figures: dict[str, float] = {}
    model, path, compressor = mapped(folder), folder / f"{name}.surfkit", find(Compressor, name)()
    importance = None
    if compressor.needs_importance:
        importance = torch.rand(len(model), generator=torch.Generator().manual_seed(0)) ** 4
    with measured("plan", figures):
        plan = compressor.plan(model, importance, 0)
    with measured("write", figures):
        write_model(path, model, plan, compressor)
    figures["bytes"] = path.stat().st_size
    figures["bytes a point"] = round(path.stat().st_size / max(1, len(model)), 2)
    del model, plan
    best = fastest(rounds, lambda: ModelFile(path).read())
    figures |= {f"read, {key}": value for key, value in best.items()}
    with measured("read again", figures):
        kept = ModelFile(path).read()
    del kept
    path.unlink()
    return figures


def fastest(rounds: int, action: Callable[[], object]) -> dict[str, float]:
    """Wall and CPU seconds of the fastest of some calls."""
    times = []
    for _ in range(rounds):
        wall, cpu = time.perf_counter(), time.process_time()
        action()
        times.append((time.perf_counter() - wall, time.process_time() - cpu))
    return {"wall seconds": round(min(t for t, _ in times), 2), "CPU seconds": round(min(c for _, c in times), 2)}


def main() -> None:
    """Run it."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--points", type=int, default=1_000_000)
    parser.add_argument("--compressors", nargs="+", default=list(NAMES), choices=NAMES)
    parser.add_argument("--rounds", type=int, default=3, help="Times that each file is read.")
    parser.add_argument("--out", default="compress", help="Name of the file in bench/results.")
    parser.add_argument("--one", type=Path, help=argparse.SUPPRESS)
    chosen = parser.parse_args()
    if chosen.one:
        print(json.dumps(one(chosen.compressors[0], chosen.one, chosen.rounds)))
        return
    figures: dict[str, Any] = {"points": chosen.points}
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        write_columns(folder, chosen.points)
        for name in chosen.compressors:
            words = [sys.executable, __file__, "--one", temporary, "--compressors", name]
            run = subprocess.run(
                [*words, "--rounds", str(chosen.rounds)], stdout=subprocess.PIPE, text=True, env=os.environ, check=True
            )
            figures[name] = json.loads(run.stdout)
            print(name, figures[name], flush=True)
    print(f"wrote {save(chosen.out, figures)}")


if __name__ == "__main__":
    main()
