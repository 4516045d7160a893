"""Compare losses that learn from the depth of single photographs: `python bench/monocular.py --data PACK --scale 4`.

The maps are simulated from the exact depth of gt/mesh.ply, as no weights of a network are at hand: a power of inverse
depth with scale and shift that drift across the photograph (`fill.simulated`), and, `rough`, blurred as networks blur
edges, with some texture of the photograph in it. So the figures compare losses, and say nothing of any network.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
from fill import simulated
from fusion import Truth
from machine import save
from PIL import Image
from scipy.ndimage import gaussian_filter

from surfkit.io.datasets.data import Data
from surfkit.io.datasets.read import read

BLUR_PX, TEXTURE, TEXTURE_PX = 1.5, 0.04, 8.0
ROWS = {
    "no depth": (),
    "losses:depth": ("pretrain.losses.depth:depth",),
    "losses:patch-depth": ("pretrain.losses.patch:patch-depth",),
    "both": ("pretrain.losses.depth:depth", "pretrain.losses.patch:patch-depth"),
}


def rough(values: np.ndarray, photo: Path) -> np.ndarray:
    """(H, W) what of inverse depth remains when edges are blurred and texture shines through."""
    grey = np.asarray(Image.open(photo).convert("L").resize(values.shape[::-1]), float) / 255
    known = (values > 0).astype(float)
    blurred = gaussian_filter(values * known, BLUR_PX) / np.maximum(gaussian_filter(known, BLUR_PX), 1e-6)
    shaded = blurred * (1 + TEXTURE * (grey - gaussian_filter(grey, TEXTURE_PX)))
    return np.where(values > 0, shaded, 0).astype(np.float32)


def write_maps(options: argparse.Namespace, folder: Path) -> None:
    """A data set with the same photographs, and maps of inverse depth up to scale and shift."""
    for name in ("images", "sparse"):
        (folder / name).symlink_to((options.data / name).resolve())
    (folder / "estimated_depths").mkdir()
    scene, truth = read(Data(options.data, scale=options.scale, metres_per_unit=1.0)), Truth(options.gt, 25.0)
    for number, view in enumerate(scene.train):
        values = simulated(truth.seen(view, scene.frame)[0], np.random.default_rng(number))
        if options.maps == "rough":
            values = rough(values, options.data / "images" / view.name)
        np.save(folder / "estimated_depths" / f"{view.name}.npy", values)


def main() -> None:
    """Train each row, and compare its mesh with the truth."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--gt", type=Path, help="default: gt/mesh.ply of the data")
    parser.add_argument("--scale", type=float, default=4.0)
    parser.add_argument("--steps", type=int, default=1000)
    parser.add_argument("--tau", type=float, default=1.0)
    parser.add_argument("--threshold", type=float, default=1e-3, help="of densification, for photographs of 160 px")
    parser.add_argument("--maps", choices=("exact", "rough"), default="exact")
    parser.add_argument("--rows", nargs="+", choices=list(ROWS), default=list(ROWS))
    options = parser.parse_args()
    options.gt = options.gt or options.data / "gt/mesh.ply"
    found: dict[str, dict[str, float]] = {}
    with tempfile.TemporaryDirectory() as work:
        data = Path(work, "scene")
        data.mkdir()
        write_maps(options, data)
        for row in options.rows:
            out = Path(work, row.replace(":", "-"))
            common = ["--data", str(data), "--scale", str(options.scale), "--metres-per-unit", "1", "--test-every", "8"]
            common += ["--steps", str(options.steps), "--pretrain.densify.threshold", str(options.threshold)]
            call("train", "recipe:2dgs", *common, "--out", str(out), *ROWS[row])
            call("mesh", str(out), "mesh:tsdf")
            call("evaluate", str(out), "--gt", str(options.gt), "--tau", str(options.tau), "--draws", "1")
            metrics = json.loads((out / "metrics.json").read_text())
            scores = metrics["geometry"]
            found[row] = {"psnr": metrics["images"]["psnr"]} | {k: scores[k] for k in ("precision", "recall", "f1")}
            print(row, {key: round(value, 4) for key, value in found[row].items()}, flush=True)
    settings = {key: getattr(options, key) for key in ("scale", "steps", "tau", "threshold", "maps")}
    save(f"monocular_{options.maps}", {"data": options.data.name} | settings | {"rows": found})


def call(*words: str) -> None:
    """A command of surfkit; what it says is left out."""
    subprocess.run([sys.executable, "-m", "surfkit", *words], check=True, stdout=subprocess.DEVNULL)


if __name__ == "__main__":
    main()
