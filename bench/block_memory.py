"""How much memory a block takes, and the merge, as the scene around the block grows.

    python bench/block_memory.py [--tiles 1 4 16] [--points 100000] [--steps 8]

Scenes of 1, 4 and 16 tiles, each with as many cameras, points and pixels, and one block to a tile. The coarse model
is made up: the sparse points, as they begin. Then one block is tuned by `surfkit train-block`, and the blocks are
merged (each of them as it was given) and opened again, each in a process of its own, of which the peak is what the
system tells. A block is tuned on the cameras that stand inside it, so that it has the same to do in every scene.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
from machine import save
from PIL import Image

SIDE_M, ACROSS, MARGIN_M = 100.0, 5, 2.5
"""Metres of a tile, cameras along it, and metres of points around the scene, so that views on its rim show no less."""
WIDTH, HEIGHT = 640, 480
HERE = Path(__file__).parents[1]
PROGRAM = "import surfkit.apps.train_block, surfkit.core.memory as m"

MAKE = """
import sys, torch
from dataclasses import replace
from pathlib import Path
from surfkit.runs.blocks.block import BlocksRecord, load_blocks
from surfkit.runs.blocks.train_blocks import extract_views
from surfkit.cli.recipes import recipes
from surfkit.core.codec import write_json
from surfkit.runs.folder import Run
from surfkit.runs.run_stage import Intervals
from surfkit.partition import CoarseModel, QuantileGrid
from surfkit.partition.plan import PartitionPlan, blocks_of
from surfkit.primitives.points import Points
from surfkit.raster.select import select
from surfkit.io.datasets.data import Data
from surfkit.io.datasets.read import read
from surfkit.train import checkpoint
from surfkit.train.data_cache import CacheSettings
from surfkit.train.stage import Stage
from surfkit.train.state import StageState
from surfkit.train.view_order import ViewOrder
from surfkit.runs.context import RunContext

out, across, steps = Path(sys.argv[2]), int(sys.argv[3]), int(sys.argv[4])
data = Data(Path(sys.argv[1]), test_every=0)
stage = Stage(steps=steps, densify=None, sh_every=1)
recipe = replace(recipes()["2dgs"], pretrain=stage, tune=stage, partition=QuantileGrid((across, across)), mesh=None)
this, scene = Run(out, recipe, data), read(data)
params = recipe.primitive.init(scene.cloud, torch.Generator().manual_seed(0))
state = StageState(Points.fresh(params), ViewOrder(len(scene.train)), torch.Generator(), index=steps, sh_degree=3)
checkpoint.save(this.pretrain.checkpoint, state)
sight = CoarseModel(recipe.primitive.activate(params, 0), scene.train, select("cpu")[0], stage.near)
cells = recipe.partition.cells(sight)
inside = torch.nn.functional.one_hot(cells.owner(sight.centres), cells.count).bool()
write_json(out / "recipe.json", recipe)
write_json(out / "run.json", {"data": data})
plan = PartitionPlan(cells, blocks_of(sight, cells, inside, inside))
write_json(out / "blocks" / "plan.json", BlocksRecord(steps, plan))
extract_views(RunContext(this, scene, sight.rasterizer, Intervals(), CacheSettings()), load_blocks(this, plan))
"""

FINISH = """
import sys
from dataclasses import replace
from pathlib import Path
from surfkit.runs.blocks.block import load_blocks, read_plan
from surfkit.runs.pipeline import opened
from surfkit.primitives.points import Points
from surfkit.raster.select import select
from surfkit.io.datasets.read import read
from surfkit.train import checkpoint
from surfkit.train.data_cache import CacheSettings
from surfkit.train.state import StageState
from surfkit.train.view_order import ViewOrder
from surfkit.runs.run_stage import Intervals
from surfkit.runs.blocks.worker import BlockStart
from surfkit.runs.context import RunContext
import torch

this = opened(Path(sys.argv[1]))
ctx = RunContext(this, read(this.data), select("cpu")[0], Intervals(pictures=0), CacheSettings("100MB"))
for block in load_blocks(this, read_plan(this).plan):
    views = tuple(view for view in ctx.scene.train if view.name in set(block.planned.views))
    begun = BlockStart(ctx, block, views)()
    steps = this.recipe.tune.steps
    points, degree = Points.fresh(begun.params), begun.sh_degree
    state = StageState(points, ViewOrder(len(views)), torch.Generator(), index=steps, sh_degree=degree)
    checkpoint.save(block.stage.checkpoint, state)
    block.write(status="done", step=steps, steps=steps)
"""


def write_data(folder: Path, across: int, points: int) -> None:
    """A survey of `across` x `across` tiles with `points` points each: cameras that look down, COLMAP files."""
    draw, cameras, side = np.random.default_rng(0), across * ACROSS, across * SIDE_M
    (folder / "images").mkdir(parents=True)
    patches = draw.integers(0, 256, (HEIGHT // 16, WIDTH // 16, 3), np.uint8)
    Image.fromarray(patches).resize((WIDTH, HEIGHT)).save(folder / "images" / "0.jpg", quality=90)
    model = folder / "sparse" / "0"
    model.mkdir(parents=True)
    lens = np.array([4 * WIDTH, 4 * WIDTH, WIDTH / 2, HEIGHT / 2])  # 25 m x 19 m on the ground, from 100 m
    head = [np.uint64(1), np.uint32(1), np.int32(1), np.array([WIDTH, HEIGHT], np.uint64), lens]
    (model / "cameras.bin").write_bytes(b"".join(part.tobytes() for part in head))
    with open(model / "images.bin", "wb") as file:
        file.write(np.uint64(cameras**2).tobytes())
        for at in range(cameras**2):
            if at:
                os.link(folder / "images" / "0.jpg", folder / "images" / f"{at}.jpg")
            x, y = (SIDE_M / ACROSS * (0.5 + place) for place in divmod(at, cameras))
            pose = np.array([0, 1, 0, 0, -x, y, 100.0])  # turned over, to look down
            file.write(np.uint32(at + 1).tobytes() + pose.tobytes() + np.uint32(1).tobytes())
            file.write(f"{at}.jpg".encode() + b"\0" + np.uint64(0).tobytes())
    fields = [("id", "u8"), ("xyz", "f8", 3), ("rgb", "u1", 3), ("error", "f8"), ("tracks", "u8")]
    rows = np.zeros(points * across**2, fields)
    rows["id"], rows["rgb"], rows["error"] = np.arange(1, len(rows) + 1), 128, 0.5
    rows["xyz"] = draw.uniform([-MARGIN_M, -MARGIN_M, -1], [side + MARGIN_M, side + MARGIN_M, 1], (len(rows), 3))
    (model / "points3D.bin").write_bytes(np.uint64(len(rows)).tobytes() + rows.tobytes())


def peak_mb(*words: str) -> float:
    """Most memory that a Python process held, MB."""
    process = subprocess.Popen([sys.executable, *words], cwd=HERE / "bench", stderr=subprocess.PIPE, text=True)
    said = process.stderr.read()
    _, status, usage = os.wait4(process.pid, 0)
    if status:
        raise SystemExit(f"{' '.join(words)[:200]}: status {status}\n{said[-2000:]}")
    return usage.ru_maxrss / 1e3


def measured(tiles: int, points: int, steps: int) -> dict[str, float]:
    """Peaks of one scene, MB, and sizes."""
    across = round(tiles**0.5)
    block = str((across // 2) * across + across // 2)  # in the middle, as far as there is one
    with tempfile.TemporaryDirectory() as place:
        data, out = Path(place) / "data", Path(place) / "run"
        write_data(data, across, points)
        subprocess.run([sys.executable, "-c", MAKE, str(data), str(out), str(across), str(steps)], check=True)
        tuned = peak_mb("-m", "surfkit.cli", "train-block", str(out), block, "--device", "cpu", "--cache", "100MB")
        parts = [json.loads(line) for line in (out / "blocks" / f"{int(block):03}" / "events.jsonl").open()]
        begun = next(line["points"] for line in parts if line["event"] == "StageBegan")
        coarse = (out / "pretrain" / "checkpoint.safetensors").stat().st_size / 1e6
        subprocess.run([sys.executable, "-c", FINISH, str(out)], check=True)
        merging = peak_mb("block_memory.py", "--merge", str(out))
    return {"tuning": tuned, "merging": merging, "points of the block": begun, "coarse checkpoint": coarse}


def merge(out: Path) -> None:
    """Put the blocks of a run together, as its driver does."""
    from surfkit.io.datasets import extract
    from surfkit.raster.select import select
    from surfkit.runs.blocks.block import load_blocks, read_plan
    from surfkit.runs.blocks.merge_blocks import merge_blocks
    from surfkit.runs.blocks.worker import open_coarse_model
    from surfkit.runs.context import RunContext
    from surfkit.runs.pipeline import opened
    from surfkit.runs.run_stage import Intervals
    from surfkit.train.data_cache import CacheSettings

    run = opened(out)
    blocks = load_blocks(run, read_plan(run).plan)
    scene = extract.load(blocks[0].views_file).scene  # the driver has read the data set for other reasons
    ctx = RunContext(run, scene, select("cpu")[0], Intervals(pictures=0), CacheSettings("100MB"))
    assert merge_blocks(ctx, blocks, open_coarse_model(run))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--tiles", type=int, nargs="*", default=[1, 4, 16])
    parser.add_argument("--points", type=int, default=100_000, help="of a tile")
    parser.add_argument("--steps", type=int, default=8)
    parser.add_argument("--merge", type=Path, help=argparse.SUPPRESS)
    chosen = parser.parse_args()
    if chosen.merge is not None:
        return merge(chosen.merge)
    figures: dict[str, float] = {"program MB": peak_mb("-c", PROGRAM)}
    for tiles in chosen.tiles:
        for name, value in measured(tiles, chosen.points, chosen.steps).items():
            figures[f"{tiles} tiles: {name}" + (" MB" if "points" not in name else "")] = value
            print(f"{tiles} tiles: {name} {value:.0f}", flush=True)
    most, least = (figures[f"{tiles} tiles: tuning MB"] for tiles in (max(chosen.tiles), min(chosen.tiles)))
    figures["tuning, most tiles against one"] = most / least
    print(f"{most / least:.3f} of the memory; wrote {save('block_memory', figures)}")
    return None


if __name__ == "__main__":
    main()
