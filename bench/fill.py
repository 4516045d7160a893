"""Measure what fills the holes of stereo: `python bench/fill.py --data PACK --scale 4`, or `--rendered`.

Of the depth maps: the share of pixels that stereo does not trust, the share that each fill fills, and the errors there
against the exact depth of gt/mesh.ply, beside those of trusted pixels and of what stereo itself guesses where a fill
fills. Of runs of `recipe:surface-short` with so many steps: F1 against the same mesh.

The monocular maps are simulated: exact inverse depth under a smooth distortion that is unknown to the fill, a power of
it, with a scale and a shift that drift across the photograph. No network is as good, so the figures of
`fill:monocular` are an upper bound and no measurement of any network.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
import torch
import trimesh
from fusion import Truth
from machine import save
from scipy.ndimage import gaussian_filter
from stereo import within_core

from surfkit.depth import Filled, MonocularFill, PatchMatch, PlaneFill
from surfkit.depth.base import DepthInput, Estimate
from surfkit.depth.fill_base import Fill
from surfkit.depth.filled import load_estimate, stereo_path
from surfkit.io.datasets.data import Data
from surfkit.io.datasets.depth_files import write_map, write_record
from surfkit.io.datasets.read import observations, read
from surfkit.scene.scene import Scene, View
from surfkit.testing.synthetic import Box, Flight, Sphere, photograph, write_colmap

STEREO = PatchMatch(passes=3, rounds=1)
"""Of `recipe:surface-short`, at the full size of the photographs, which are small."""
WITHIN = (0.25, 0.5, 1.0)
"""Metres by which depth may differ from the exact one."""


def rendered(folder: Path) -> Path:
    """A data set of a ground, a box and a ball, with its exact mesh; metres."""
    write_colmap(folder, photograph(Flight("grid", 25, 160, 120, points=1500, test_every=0)), tracks=True)
    box, ball = Box(), Sphere()
    bounds = trimesh.creation.box(bounds=[box.low, box.high])
    ground = trimesh.creation.box(bounds=[(-12, -12, -1), (12, 12, 0)])
    sphere = trimesh.creation.icosphere(5, ball.radius).apply_translation(ball.centre)
    (folder / "gt").mkdir()
    trimesh.util.concatenate([ground, bounds, sphere]).export(folder / "gt/mesh.ply")
    return folder


def simulated(exact: np.ndarray, draw: np.random.Generator) -> np.ndarray:
    """(H, W) what a network might say of exact depth (H, W), 0 for none."""
    inverse = np.where(exact > 0, 1 / np.maximum(exact, 1e-9), 0)
    drift = [gaussian_filter(draw.normal(size=exact.shape), exact.shape[1] / 5) for _ in range(2)]
    scale, shift = (0.05 * each / each.std() for each in drift)
    values = (inverse / np.median(inverse[inverse > 0])) ** 1.3 * (1 + scale) + shift + 0.5
    return np.where(exact > 0, values, 0).astype(np.float32)


def of_maps(options: argparse.Namespace, maps: Path, fills: dict[str, Fill]) -> dict:
    """Shares and errors of the depth maps of some views."""
    data = Data(options.data, scale=options.scale, metres_per_unit=1.0)
    scene = read(data)
    beside(options.data, maps.parent / "none")
    views, truth = scene.train, Truth(options.data / "gt/mesh.ply", 25.0)
    exact = [truth.seen(view, scene.frame)[0] for view in views]
    (maps / "estimated_depths").mkdir()
    for view, depth in zip(views, exact, strict=True):
        path = maps / "estimated_depths" / f"{view.name}.npy"
        np.save(path, simulated(depth, np.random.default_rng(len(view.name))))
    given = DepthInput(views, observations(data, scene), torch.device("cpu"), maps / "work")
    found = {}
    for name, fill in fills.items():
        place = beside(options.data, maps.parent / name)
        errors: dict[str, list[np.ndarray]] = {"trusted": [], "filled": [], "guess of stereo there": []}
        pixels, holes = 0, 0
        estimator = Filled(stereo=STEREO, fill=fill)
        for each in estimator.estimate(given, range(len(views))):
            before = load_estimate(stereo_path(given, each.at), each.at)
            keep(place, scene, views[each.at], each)
            if name == "planes":
                keep(maps.parent / "none", scene, views[each.at], before)
            if each.inverse is None or before.inverse is None:
                continue
            core = within_core(views[each.at], exact[each.at], scene.frame)
            sure = ((before.inverse > 0) & (before.confidence >= estimator.sure)).numpy()
            new = ~sure & (each.inverse != before.inverse).numpy()
            pixels, holes = pixels + core.sum(), holes + (core & ~sure).sum()
            for key, values, where in zip(
                errors, (each.inverse, each.inverse, before.inverse), (sure, new, new), strict=True
            ):
                depth = 1 / np.maximum(values.numpy()[core & where], 1e-9)
                errors[key].append(np.abs(depth - exact[each.at][core & where]) / scene.frame.scale)
        joined = {key: np.concatenate(parts) for key, parts in errors.items()}
        found[name] = {
            "holes, share of the pixels": round(float(holes / pixels), 4),
            "filled, share of the pixels": round(float(len(joined["filled"]) / pixels), 4),
        } | {key: errors_of(error) for key, error in joined.items()}
        print(name, json.dumps(found[name]), flush=True)
    return found


def beside(data: Path, folder: Path) -> Path:
    """A data set with the same photographs, and depth maps of its own."""
    folder.mkdir()
    for name in ("images", "sparse"):
        (folder / name).symlink_to((data / name).resolve())
    write_record(folder, {"estimator": {"use": "filled"}, "aligned": True})
    return folder


def keep(folder: Path, scene: Scene, view: View, found: Estimate) -> None:
    """Write the map of a view, in the units of the data set."""
    if found.inverse is not None and found.confidence is not None:
        normal = None if found.normal is None else found.normal.numpy()
        write_map(folder, view.name, (found.inverse * scene.frame.scale).numpy(), found.confidence.numpy(), normal)


def errors_of(error: np.ndarray) -> dict:
    """Of some pixels, metres."""
    if not len(error):
        return {}
    shares = {f"within {limit} m": round(float((error < limit).mean()), 4) for limit in WITHIN}
    return shares | {"median m": round(float(np.median(error)), 4)}


def of_runs(options: argparse.Namespace, folder: Path) -> dict:
    """F1 of runs."""
    found = {}
    for name in ("none", "planes", "monocular"):
        out = folder / f"run-{name}"
        common = ["--data", str(folder / name), "--scale", str(options.scale), "--metres-per-unit", "1"]
        common += ["--steps", str(options.steps), "--seed", "0", "--out", str(out)]
        call("train", "recipe:surface-short", *common)
        call("evaluate", str(out), "--gt", str(options.data / "gt/mesh.ply"), "--tau", str(options.tau), "--draws", "1")
        geometry = json.loads((out / "metrics.json").read_text())["geometry"]
        found[name] = geometry
        print(name, json.dumps(found[name])[:1500], flush=True)
    return found


def call(*words: str) -> None:
    """A command of surfkit; what it says is shown."""
    subprocess.run([sys.executable, "-m", "surfkit", *words], check=True, stdout=subprocess.DEVNULL)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, help="data set in metres with exact geometry in gt/mesh.ply")
    parser.add_argument("--rendered", action="store_true", help="a made-up scene instead")
    parser.add_argument("--scale", type=float, default=4.0)
    parser.add_argument("--steps", type=int, default=400, help="of the runs; 0 makes none")
    parser.add_argument("--tau", type=float, default=0.5, help="metres, of F1")
    parser.add_argument("--name", default="fill", help="of the file in bench/results")
    options = parser.parse_args()
    torch.set_num_threads(1)
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        if options.rendered:
            options.data, options.scale = rendered(folder / "rendered"), 1.0
        elif options.data is None:
            parser.error("name a data set by --data, or give --rendered")
        maps = folder / "maps"
        maps.mkdir()
        fills = {"planes": PlaneFill(), "monocular": MonocularFill(maps=str(maps))}
        figures = {"data": options.data.name, "scale": options.scale, "maps": of_maps(options, maps, fills)}
        if options.steps:
            figures |= {"steps": options.steps, "tau m": options.tau, "runs": of_runs(options, folder)}
    print(f"wrote {save(options.name, figures)}")


if __name__ == "__main__":
    main()
