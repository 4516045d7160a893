"""People and cars that move: what they do to a run, and what leaving them out makes of it.

    python bench/transients.py            # writes bench/results/transients.json
    python bench/transients.py --only 0.15 --settings none "robust --pretrain.transients.start 3000"

Variants of a rendered survey (shibuya-synth), with seeds that never change: boxes and ellipses with stripes or noise
cover a share of the pixels of every photograph that is not held out, at other places in each. Photographs that are held
out stay clean. Each variant is trained with each setting of `pretrain.transients`, one run after the other; "masks" are
those that cover the objects and nothing else, which is as well as anything could do.

Printed, and kept: PSNR and SSIM on the clean held-out photographs. The variant of share 0 shows what leaving out costs
where nothing moves.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
from light import PACK
from machine import save
from PIL import Image

from surfkit.core.codec import read_json
from surfkit.io.datasets.raw_dataset import load_pycolmap

SHARES = (0.0, 0.05, 0.15)
SETTINGS = ("none", "robust --pretrain.transients.radius-px 2", "masks")
"""Photographs of 80 px have objects of 5 to 13; a larger radius overlooks many of them."""
SIDES = (0.06, 0.16)
"""Of an object, as shares of the photograph's longer side."""
TEST_EVERY = 8
TRUTH = "objects"
"""Folder of masks that cover the objects and nothing else."""


def covered(pixels: np.ndarray, share: float, draw: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """(H, W, 3) uint8, a photograph with objects that cover at least this share of it, and little more; where, (H, W)
    bool."""
    found, under = pixels.copy(), np.zeros(pixels.shape[:2], bool)
    height, width = under.shape
    y, x = np.mgrid[:height, :width]
    while under.mean() < share:
        half = draw.uniform(*SIDES, 2) * max(height, width) / 2
        middle = draw.uniform(0, 1, 2) * (height, width)
        away = np.abs(np.stack([y, x], -1) + 0.5 - middle) / half
        inside = (away.max(-1) if draw.random() < 0.5 else (away**2).sum(-1)) <= 1
        colors = draw.integers(0, 256, (2, 3))
        stripes = (np.sin((x * draw.uniform(-1, 1) + y * draw.uniform(-1, 1)) * draw.uniform(0.05, 0.5)) + 1) / 2
        texture = stripes[..., None] * colors[0] + (1 - stripes[..., None]) * colors[1]
        texture += draw.normal(0, 10, (*under.shape, 1))
        found[inside] = texture.clip(0, 255)[inside].round().astype(np.uint8)
        under |= inside
    return found, under


def write_variant(pack: Path, to: Path, share: float) -> None:
    """A data set with objects in the photographs that are trained on."""
    names = sorted(path.name for path in (pack / "images").iterdir())
    for folder in ("images", TRUTH):
        (to / folder).mkdir(parents=True)
    for at, name in enumerate(names):
        with Image.open(pack / "images" / name) as photo:
            pixels = np.asarray(photo.convert("RGB"))
        if at % TEST_EVERY:
            pixels, under = covered(pixels, share, np.random.default_rng([7, at]))
            Image.fromarray(np.where(under, 0, 255).astype(np.uint8)).save(to / TRUTH / f"{Path(name).stem}.png")
        Image.fromarray(pixels).save(to / "images" / name, quality=97, subsampling=0)
    model = load_pycolmap().Reconstruction(str(pack / "sparse/0"))
    (to / "sparse/0").mkdir(parents=True)
    model.write(str(to / "sparse/0"))


def train(data: Path, out: Path, setting: str, options: argparse.Namespace) -> dict[str, float]:
    """Figures of a run, whose messages go to a file beside it."""
    chosen, *more = setting.split()
    words = [f"recipe:{options.recipe}", "--data", str(data), "--out", str(out), "--scale", str(options.scale)]
    words += ["--steps", str(options.steps), "--test-every", str(TEST_EVERY), "--device", "cpu"]
    words += ["--masks", TRUTH] if chosen == "masks" else [f"pretrain.transients:{chosen}", *more]
    words += ["--pretrain.densify.threshold", "1e-3", "mesh:none"]  # few points, as the photographs have few pixels
    begun = time.monotonic()
    with open(out.with_suffix(".txt"), "w") as log:
        subprocess.run([sys.executable, "-m", "surfkit", "train", *words], check=True, stdout=log, stderr=log)
    images = read_json(out / "metrics.json", dict[str, Any])["images"]
    return {"psnr": images["psnr"], "ssim": images["ssim"], "seconds": round(time.monotonic() - begun, 1)}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, default=PACK)
    parser.add_argument("--only", nargs="+", type=float, default=list(SHARES))
    parser.add_argument("--settings", nargs="+", default=list(SETTINGS))
    parser.add_argument("--recipe", default="2dgs")
    parser.add_argument("--scale", type=float, default=8.0)
    parser.add_argument("--steps", type=int, default=1200)
    parser.add_argument("--work", type=Path, help="folder for data sets and runs; a temporary one if left out")
    parser.add_argument("--name", default="transients", help="of the file in bench/results")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        work, found = options.work or Path(temporary), {}
        for share in options.only:
            data = work / f"share-{share:g}"
            if not data.exists():
                write_variant(options.data, data, share)
            for setting in options.settings:
                if setting == "masks" and not share:
                    continue
                row = train(data, work / f"run-{len(found)}", setting, options)
                found[f"{share:g}, {setting}"] = row
                print(f"{share:g}, {setting}", {name: round(value, 4) for name, value in row.items()}, flush=True)
    about = {"recipe": options.recipe, "steps": options.steps, "scale": options.scale}
    print(f"wrote {save(options.name, {**about, 'runs': found})}")


if __name__ == "__main__":
    main()
