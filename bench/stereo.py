"""Measure the stereo estimators on a rendered city: `python bench/stereo.py`.

CPU seconds a megapixel of a view and peak memory of `patch-match`, with its defaults and with settings that take about
half the time, and of `plane-sweep`, each in a process of its own, for a group of neighbouring views that are compared
with one another alone, so that every map is made once; how complete and accurate the maps are against the exact depth
of gt/mesh.ply, in the core that this mesh covers; how far the compiled estimator is from the one in torch; and whether
1 and 2 threads give the same bits. Photographs are resized to each longest side: those that are enlarged show what it
takes, not what finer ones would give.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import torch
from fusion import Truth
from machine import cpu_seconds, save
from mesh import rss
from PIL import Image

from surfkit.depth import PatchMatch, PlaneSweep
from surfkit.depth.base import DepthEstimator, DepthInput
from surfkit.io.datasets.data import Data
from surfkit.io.datasets.read import observations, read
from surfkit.scene.scene import Frame, Scene, View

PACK = Path(__file__).resolve().parents[1].parent / "shared/data/shibuya-synth"
NATIVE, QUICK, TORCH = "patch-match", "the same, quick", "plane-sweep"
ENGINES: dict[str, Callable[..., DepthEstimator]] = {
    NATIVE: PatchMatch,
    QUICK: partial(PatchMatch, rounds=1, passes=3),
    TORCH: PlaneSweep,
}
SWEPT = 480
"""Longest side up to which the sweep is measured: its time grows with the third power."""
CORE = 110.0
"""Metres in x and y, from the origin, that the exact mesh covers on all sides."""
WITHIN = (0.25, 0.5, 1.0)
"""Metres by which depth may differ from the exact one."""
TRUSTED = 0.375
"""Least confidence of the pixels that accuracy is measured of, as in `mesh:stereo`."""
WARM = 160
"""Longest side of maps that are made before, for what is done only once in a process."""


def group(scene: Scene, count: int) -> list[View]:
    """The views whose cameras stand nearest to the one in the middle."""
    poses = [scene.frame.input_pose(view.camera.world_to_camera) for view in scene.train]
    at = np.stack([-pose[:3, :3].T @ pose[:3, 3] for pose in poses])
    middle = at[np.argmin(np.hypot(at[:, 0], at[:, 1]))]
    return [scene.train[i] for i in np.argsort(np.linalg.norm(at - middle, axis=1), kind="stable")[:count]]


def resized(view: View, side: int, folder: Path) -> View:
    """The view with a photograph of that longest side."""
    camera, path = view.camera.sized(side), folder / str(side) / Path(view.name).with_suffix(".png")
    path.parent.mkdir(parents=True, exist_ok=True)
    if not path.exists():
        with Image.open(view.path) as photo:
            photo.convert("RGB").resize((camera.width, camera.height), Image.Resampling.LANCZOS).save(path)
    return replace(view, camera=camera, path=path)


class Group:
    """Neighbouring views at one size, and what an estimator makes of them."""

    def __init__(self, pack: Path, count: int, side: int, folder: Path) -> None:
        data = Data(pack, metres_per_unit=1.0)
        self.scene, self.folder = read(data), folder
        self.tracks = observations(data, self.scene)
        self.views = [resized(view, side, folder) for view in group(self.scene, count)]
        self.pixels = sum(view.camera.width * view.camera.height for view in self.views)

    def maps(self, estimator: DepthEstimator) -> np.ndarray:
        """(V, 2, H, W) float32 inverse depth, local units, and confidence; 0 where there is none."""
        work = self.folder / "work"
        shutil.rmtree(work, ignore_errors=True)
        work.mkdir()
        given = DepthInput(self.views, self.tracks, torch.device("cpu"), work)
        size = self.views[0].camera.height, self.views[0].camera.width
        found = np.zeros((len(self.views), 2, *size), np.float32)
        for estimate in estimator.estimate(given, range(len(self.views))):
            if estimate.inverse is not None and estimate.confidence is not None:
                found[estimate.at] = torch.stack([estimate.inverse, estimate.confidence]).numpy()
        return found


def estimator_of(engine: str, side: int, best: int | None) -> DepthEstimator:
    """The estimator of an engine for maps of a longest side; `best` is a setting of patch-match, None leaves it."""
    return ENGINES[engine](longest=side, **({} if best is None or engine == TORCH else {"best": best}))


def alone(engine: str, side: int, folder: Path, options: argparse.Namespace) -> dict:
    """Time, memory, quality and digest, in a process that does nothing else; the maps go into the folder."""
    Group(options.data, 3, WARM, folder).maps(estimator_of(engine, WARM, options.best))
    some, kept = Group(options.data, options.views, side, folder), []
    before = rss()
    seconds = cpu_seconds(
        lambda: kept.append(some.maps(estimator_of(engine, side, options.best))), options.rounds, warm=0
    )
    peak, maps = rss() - before, kept[-1]
    np.save(folder / f"{engine}-{side}.npy", maps)
    return {
        "views": len(some.views),
        "megapixels of a view": round(some.pixels / len(some.views) / 1e6, 3),
        "CPU s a megapixel-view": round(seconds / (some.pixels / 1e6), 2),
        "MB": round(peak),
        **quality(some, maps, options.data),
        "digest": hashlib.sha256(np.ascontiguousarray(maps).tobytes()).hexdigest()[:16],
    }


def quality(some: Group, maps: np.ndarray, pack: Path) -> dict:
    """Shares of the pixels with an exact depth in the core: complete of all of them, accurate of those trusted."""
    truth, errors, trusted = Truth(pack / "gt/mesh.ply", 25.0), [], []
    for view, (inverse, confidence) in zip(some.views, maps, strict=True):
        exact = truth.seen(view, some.scene.frame)[0]
        core = within_core(view, exact, some.scene.frame)
        there = inverse[core] > 0
        depth = np.where(there, 1 / np.where(there, inverse[core], 1), np.inf)
        errors.append(np.abs(depth - exact[core]) / some.scene.frame.scale)
        trusted.append(there & (confidence[core] >= TRUSTED))
    error, sure = np.concatenate(errors), np.concatenate(trusted)
    return {
        "complete within m": {str(limit): round(float((error < limit).mean()), 4) for limit in WITHIN},
        "covered": round(float(sure.mean()), 4),
        "accurate within m": {str(limit): round(float((error[sure] < limit).mean()), 4) for limit in WITHIN},
        "median error m": round(float(np.median(error[sure])), 4),
    }


def within_core(view: View, depth: np.ndarray, frame: Frame) -> np.ndarray:
    """(H, W) bool, whether a pixel shows a place of the core.

    Args:
        view: That sees it.
        depth: (H, W) exact depth, local units, 0 for none.
        frame: Of the view.
    """
    pose = frame.input_pose(view.camera.world_to_camera)
    local = view.camera.rays(torch.float64).numpy() * (depth / frame.scale)
    places = np.einsum("ji,jhw->ihw", pose[:3, :3], local - pose[:3, 3, None, None])
    return (depth > 0) & (np.abs(places[:2]) <= CORE).all(0)


def apart(engine: str, side: int, threads: int, folder: Path, options: argparse.Namespace) -> dict:
    """What `alone` gives in a process of its own."""
    words = ["--part", engine, str(side), str(folder), "--threads", str(threads), "--data", str(options.data)]
    words += ["--views", str(options.views), "--rounds", str(options.rounds)]
    words += [] if options.best is None else ["--best", str(options.best)]
    calm = os.environ | {"OMP_WAIT_POLICY": "PASSIVE"}  # threads that wait would count as work
    done = subprocess.run([sys.executable, __file__, *words], stdout=subprocess.PIPE, text=True, check=True, env=calm)
    return json.loads(done.stdout.splitlines()[-1])


def agreement(folder: Path, side: int) -> dict:
    """How far the depths of both estimators lie apart where both are trusted."""
    one, other = (np.load(folder / f"{engine}-{side}.npy") for engine in (NATIVE, TORCH))
    both = (one[:, 1] >= TRUSTED) & (other[:, 1] >= TRUSTED) & (one[:, 0] > 0) & (other[:, 0] > 0)
    apart = np.abs(one[:, 0][both] / other[:, 0][both] - 1)
    return {"of the pixels": round(float(both.mean()), 4), "median relative": round(float(np.median(apart)), 5)}


def shown(label: str, row: dict) -> str:
    """A line of the table."""
    shares = [*row["complete within m"].values(), row["covered"], *row["accurate within m"].values()]
    cells = "".join(f"{share:>8.1%}" for share in shares)
    return f"{label:<18}{row['CPU s a megapixel-view']:>10.2f}{row['MB']:>7}{cells}{row['median error m']:>9.3f}"


def measured(options: argparse.Namespace, folder: Path) -> dict:
    """Everything, shown as it comes."""
    limits = "".join(f"{f'< {limit} m':>8}" for limit in WITHIN)
    print(f"{'':<18}{'CPU s/MP':>10}{'MB':>7}{limits}{'trusted':>8}{limits}{'median m':>9}", flush=True)
    found: dict = {engine: {} for engine in ENGINES}
    for side in options.sides:
        for engine in ENGINES if side <= SWEPT else (NATIVE, QUICK):
            found[engine][side] = apart(engine, side, options.threads, folder, options)
            print(shown(f"{engine} {side}", found[engine][side]), flush=True)
    least = min(options.sides)
    digests = {apart(NATIVE, least, threads, folder, options)["digest"] for threads in (1, 2)}
    found["same bits on 1 and 2 threads"] = len(digests) == 1
    if least <= SWEPT:
        found[f"both at {least}"] = agreement(folder, least)
    for name in list(found)[len(ENGINES) :]:
        print(f"{name}: {found[name]}")
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, default=PACK, help="data set in metres with exact geometry in gt/mesh.ply")
    parser.add_argument("--views", type=int, default=12, help="neighbouring views")
    parser.add_argument("--sides", type=int, nargs="+", default=[480, 960, 1920], help="longest sides, pixels")
    parser.add_argument("--rounds", type=int, default=3, help="the median of so many counts")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument(
        "--best", type=int, help="photographs that score a plane in patch-match; its default if left out"
    )
    parser.add_argument("--name", default="stereo", help="of the file in bench/results")
    parser.add_argument("--part", nargs=3, help=argparse.SUPPRESS)
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    if not (options.data / "gt/mesh.ply").exists():
        parser.error(f"{options.data}: no gt/mesh.ply there; name a data set with exact geometry by --data")
    if options.part:
        engine, side, folder = options.part
        print(json.dumps(alone(engine, int(side), Path(folder), options)))
        return
    with tempfile.TemporaryDirectory() as folder:
        figures = measured(options, Path(folder))
    about = {"data": options.data.resolve().name, "rounds": options.rounds}
    about |= {} if options.best is None else {"best of patch-match": options.best}
    print(f"wrote {save(options.name, about | figures)}")


if __name__ == "__main__":
    main()
