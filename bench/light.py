"""Photographs as cameras take them: what changing light does to a run, and what models of appearance make of it.

    python bench/light.py            # writes bench/results/light.json
    python bench/light.py --only same all --recipe surface-short --scale 2 --steps 300 --gt TRUTH --name light_surface

Variants of a rendered survey (shibuya-synth), with seeds that never change; beside each is its truth, as light.json:

    same        the photographs as they are
    exposure    each photograph with -1.5 to 1.5 stops, red and blue each with -15 to 15 %
    vignetting  half the light in the corners, after 1 - r^2 / 2
    cameras     two cameras, named in EXIF, with other response curves, take turns
    all         all of them
    unclipped   all of them, with half the range of exposure, and so dark that no white is cut off
    restored    unclipped, brought back to one light by the truth: what is lost then, no model of light can bring back

Light is changed as in a camera: sRGB is decoded, multiplied, limited to 1, encoded, and put through the response curve.
Each variant is trained without and with each appearance, one run after the other, on every photograph that is not held
out. Printed, and kept: PSNR and SSIM on held-out photographs, as they are and with colours aligned; PSNR against those
of the unchanged survey, as the scene itself is the same; and how far exposures, vignetting and response curves are from
the truth, but for what no one can know: a factor that all photographs share, and a curve. With --gt the mesh is
measured too. --cost measures only what a step takes: medians of CPU seconds of all threads, for 200,000 splats.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import torch
from machine import cpu_seconds, save
from PIL import Image
from scenes import city

import surfkit
from surfkit.appearance import CameraResponse
from surfkit.core.codec import read_json
from surfkit.evaluate.images.measure_images import aligned_halves
from surfkit.io.datasets.raw_dataset import load_pycolmap
from surfkit.raster.api import Maps
from surfkit.raster.native_rasterizer import NativeRasterizer
from surfkit.raster.psnr import psnr
from surfkit.raster.ssim import ssim
from surfkit.runs.photo_light import LightRecord
from surfkit.scene.photos import read_photo
from surfkit.scene.response import curved, falloff
from surfkit.scene.srgb import from_linear, linear

PACK = Path(__file__).resolve().parents[1].parent / "shared/data/shibuya-synth"
VARIANTS = {
    "same": (),
    "exposure": ("exposure",),
    "vignetting": ("vignetting",),
    "cameras": ("cameras",),
    "all": ("exposure", "vignetting", "cameras"),
    "unclipped": ("exposure", "vignetting", "cameras", "unclipped"),
    "restored": ("exposure", "vignetting", "cameras", "unclipped", "restored"),
}
STOPS, BALANCE, CORNER = 1.5, 0.15, 0.5
RESPONSES = {"A": 0.85, "B": 1.2}
"""Exponents of the cameras' response curves, which follow the sRGB curve."""
APPEARANCES = ("none", "exposure", "camera-response")


def truth_of(names: list[str], parts: tuple[str, ...]) -> dict[str, Any]:
    """What is done to each photograph: stops of each channel, the light left in the corners, and its camera."""
    draw = np.random.default_rng(7)
    found = {}
    for at, name in enumerate(names):
        stops, red, blue = draw.uniform(-STOPS, STOPS), *draw.uniform(1 - BALANCE, 1 + BALANCE, 2)
        gains = stops + np.log2([red, 1.0, blue])
        if "unclipped" in parts:
            gains = (gains - STOPS) / 2 - np.log2(1 + BALANCE)
        camera = "AB"[at % 2] if "cameras" in parts else "A"
        found[name] = {
            "stops": gains.tolist() if "exposure" in parts else [0.0] * 3,
            "corner": CORNER if "vignetting" in parts else 1.0,
            "camera": camera,
            "exponent": RESPONSES[camera] if "cameras" in parts else 1.0,
        }
    return found


def changed(pixels: np.ndarray, how: dict[str, Any]) -> np.ndarray:
    """(H, W, 3) uint8, a photograph with its light changed."""
    light = linear(pixels / 255.0) * factor(pixels, how)
    return (from_linear(light.clip(0, 1)) ** how["exponent"] * 255).round().astype(np.uint8)


def restored(pixels: np.ndarray, how: dict[str, Any]) -> np.ndarray:
    """(H, W, 3) uint8, the other way round."""
    light = linear((pixels / 255.0) ** (1 / how["exponent"])) / factor(pixels, how)
    return (from_linear(light.clip(0, 1)) * 255).round().astype(np.uint8)


def factor(pixels: np.ndarray, how: dict[str, Any]) -> np.ndarray:
    """(H, W, 3) of the light of a photograph."""
    height, width = pixels.shape[:2]
    y, x = np.mgrid[:height, :width] + 0.5
    r2 = ((x - width / 2) ** 2 + (y - height / 2) ** 2) / (width**2 + height**2) * 4
    return np.exp2(how["stops"]) * (1 - (1 - how["corner"]) * r2)[..., None]


def write_variant(pack: Path, to: Path, parts: tuple[str, ...]) -> dict[str, Any]:
    """A data set with its light changed; what was done, by photograph."""
    names = sorted(path.name for path in (pack / "images").iterdir())
    truth = truth_of(names, parts)
    (to / "images").mkdir(parents=True)
    for name in names:
        with Image.open(pack / "images" / name) as photo:
            pixels = np.asarray(photo.convert("RGB"))
        exif = Image.Exif()
        exif[0x010F], exif[0x0110] = "surfkit", f"camera {truth[name]['camera']}"
        made = Image.fromarray(changed(pixels, truth[name]) if parts else pixels)
        made.save(to / "images" / name, quality=97, subsampling=0, exif=exif)
        if "restored" in parts:
            with Image.open(to / "images" / name) as photo:
                back = restored(np.asarray(photo), truth[name])
            Image.fromarray(back).save(to / "images" / name, quality=100, subsampling=0, exif=exif)
    model = load_pycolmap().Reconstruction(str(pack / "sparse/0"))
    model.extract_colors_for_all_images(str(to / "images"))  # as a program that found the points would have had them
    (to / "sparse/0").mkdir(parents=True)
    model.write(str(to / "sparse/0"))
    (to / "light.json").write_text(json.dumps(truth, indent=1) + "\n")
    return truth


def train(data: Path, out: Path, appearance: str, options: argparse.Namespace) -> None:
    """A run of the recipe, whose messages go to a file beside it."""
    words = [f"recipe:{options.recipe}", "--data", str(data), "--out", str(out), "--scale", str(options.scale)]
    words += ["--steps", str(options.steps), "--test-every", "8", "--device", "cpu", "--seed", str(options.seed)]
    words += [f"pretrain.appearance:{appearance}", *["mesh:none"] * (options.gt is None)]
    commands = [["train", *words]]
    if options.gt is not None:
        commands.append(["evaluate", str(out), "--gt", str(options.gt), "--tau", "0.5", "--draws", "1"])
    with open(out.with_suffix(".txt"), "w") as log:
        for command in commands:
            subprocess.run([sys.executable, "-m", "surfkit", *command], check=True, stdout=log, stderr=log)


def recovered(out: Path, truth: dict[str, Any]) -> dict[str, float]:
    """How far light.json of `camera-response` is from the truth.

    Exposures as shares of the light, each channel of each photograph, but for a factor that all photographs share; the
    light that vignetting leaves, as a share of that in the middle; and colours of one camera as the other would have
    shown them, which the gains and the curves of cameras decide together. Nothing where colours stay as they are.
    """
    record = read_json(out / "light.json", LightRecord)
    if not record.is_used:
        return {}
    photographs, cameras = record.photographs, list(record.cameras)
    stops, true = (
        np.array([each[name] for name in photographs])
        for each in (
            {name: one.stops for name, one in photographs.items()},
            {name: truth[name]["stops"] for name in photographs},
        )
    )
    off = stops - true
    off = 2 ** (off - off.mean(0)) - 1
    found = {"exposure rms": rms(off), "exposure 90 %": float(np.percentile(np.abs(off), 90))}
    corner, r2 = truth[next(iter(photographs))]["corner"], np.linspace(0, 1, 101)
    left = np.array([2 ** -falloff(camera.falloff, r2) for camera in record.cameras.values()]) - (1 - (1 - corner) * r2)
    found |= {"vignetting rms": rms(left), "vignetting worst": float(np.abs(left).max())}
    if len(cameras) > 1:
        taken = np.array([cameras.index(one.camera) for one in photographs.values()])
        exponents = [next(truth[n]["exponent"] for n, one in photographs.items() if one.camera == c) for c in cameras]
        gains = [[values[taken == row].mean() for row in (0, 1)] for values in (stops, true)]
        fine = np.linspace(0, 1, 10001)
        tone = [curved(fine, record.cameras[camera].curve) for camera in cameras]
        colors = np.linspace(0.05, 0.9, 50)
        both = [
            np.interp(brighter(np.interp(colors, tone[0], fine), gains[0]), fine, tone[1]),
            brighter(colors ** (1 / exponents[0]), gains[1]) ** exponents[1],
        ]
        found["one camera as the other, rms"] = rms(both[0] - both[1])
    return found


def brighter(color: np.ndarray, gains: list[float]) -> np.ndarray:
    """Colours before the response curve of the first camera, as the second camera would have them."""
    return from_linear((linear(color) * 2 ** (gains[1] - gains[0])).clip(0, 1))


def rms(values: np.ndarray) -> float:
    """The root of the mean square."""
    return float(np.sqrt((values**2).mean()))


def against(out: Path, plain: Path) -> float:
    """PSNR of the held-out views against the photographs of the unchanged survey, with colours aligned."""
    result, found = surfkit.open(out), []
    for view in result.dataset.scene.held_out:
        photo = read_photo(plain / "images" / view.name, (view.camera.width, view.camera.height)) / 255
        halves = aligned_halves(result.render(view).need("color").clamp(0, 1), photo)
        assert halves is not None, "without masks, both halves count"
        found.append(psnr(*halves))
    return float(np.mean(found))


def costs(rounds: int) -> dict[str, dict[str, float]]:
    """CPU seconds of a step (render, L1 and SSIM, backward) by size, and of `camera-response` in it."""
    numbers = torch.tensor([0.3, 0.2, 0.1, 0.5, 0.2, 0.1, 0.01, 0.0, 0.2, -0.1, 0.05])
    found = {}
    for width, height in ((1600, 1200), (800, 608), (400, 304)):
        splats, camera = city(width=width, height=height)
        photo = torch.rand(3, height, width)

        def step(splats=splats, camera=camera, photo=photo) -> None:
            render = NativeRasterizer().render(splats, camera, 0.2)
            shown = render.maps.need("color").clone().requires_grad_()
            loss = 0.8 * (shown - photo).abs().mean() + 0.2 * (1 - ssim(shown, photo))
            render.backward(Maps(color=torch.autograd.grad(loss, shown)[0]))

        def respond(camera=camera, photo=photo) -> None:
            CameraResponse().of_scene(numbers, photo, camera)

        row = {"step": cpu_seconds(step, rounds), "camera-response": cpu_seconds(respond, rounds)}
        found[f"{width} x {height}"] = {name: round(value, 5) for name, value in row.items()}
        print(f"{width} x {height}: " + ", ".join(f"{name} {value * 1e3:.1f} CPU-ms" for name, value in row.items()))
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, default=PACK)
    parser.add_argument("--only", nargs="+", choices=list(VARIANTS), default=list(VARIANTS))
    parser.add_argument("--appearances", nargs="+", default=list(APPEARANCES))
    parser.add_argument("--recipe", default="2dgs")
    parser.add_argument("--scale", type=float, default=4.0)
    parser.add_argument("--steps", type=int, default=600)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--gt", type=Path, help="truth of the mesh, which is made and measured with it; none else")
    parser.add_argument("--work", type=Path, help="folder for data sets and runs; a temporary one if left out")
    parser.add_argument("--name", default="light", help="of the file in bench/results")
    parser.add_argument("--cost", action="store_true", help="only what a step takes")
    options = parser.parse_args()
    if options.cost:
        print(f"wrote {save('light_cost', costs(11))}")
        return
    with tempfile.TemporaryDirectory() as temporary:
        work, found = options.work or Path(temporary), {}
        for variant in options.only:
            data = work / variant
            if not data.exists():
                write_variant(options.data, data, VARIANTS[variant])
            truth = read_json(data / "light.json", dict[str, Any])
            for appearance in options.appearances:
                out = work / f"{variant}-{appearance}"
                train(data, out, appearance, options)
                row = {"against the unchanged": against(out, options.data)}
                metrics = read_json(out / "metrics.json", dict[str, Any])
                images = metrics["images"]
                row |= {name: images[name] for name in ("psnr", "psnr_aligned", "ssim", "ssim_aligned")}
                if options.gt is not None:
                    row |= {name: metrics["geometry"][name] for name in ("precision", "recall", "f1")}
                if appearance == "camera-response":
                    row |= recovered(out, truth)
                found[f"{variant}, {appearance}"] = row
                print(variant, appearance, {name: round(value, 4) for name, value in row.items()}, flush=True)
    print(f"wrote {save(options.name, {'recipe': options.recipe, 'steps': options.steps, 'runs': found})}")


if __name__ == "__main__":
    main()
