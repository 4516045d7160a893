"""Measure training and drawing on a GPU: `python bench/gpu.py`, or `bench/gpu.sh` for the tests too.

For surfels and ellipsoids, at 1600 x 1200: milliseconds of each part of a step at 1, 5 and 10 million points, pictures
a second, bytes of a point, what the decomposed gradient costs; the same scene with gsplat, where that is installed; how
long a photograph takes to the GPU; a pass of PatchMatch, fusing a depth map, and k-means; and a training on
examples/boruszyn beside the same on the CPU. Medians after a warm-up. With `--device native` the CPU stands in, to try
this program out.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import torch
from machine import RESULTS, save
from scenes import city

from surfkit.compress.cuda.codes import GpuSearch
from surfkit.compress.cuda.codes import sums as gpu_sums
from surfkit.compress.kmeans import nearest, sums
from surfkit.depth.cuda.passes import GpuPasses
from surfkit.depth.native_patch_match import GreyImage, MatchingSettings, Planes, improve
from surfkit.mesh.cuda.gpu_grid import GpuGrid
from surfkit.mesh.lattice import FusionImage, Lattice
from surfkit.mesh.native_grid import grid
from surfkit.raster.api import Maps, Splats
from surfkit.raster.base import Rasterizer
from surfkit.raster.select import select
from surfkit.raster.ssim import ssim
from surfkit.scene.camera import Camera
from surfkit.train.adam import update
from surfkit.train.uploads import uploaded

KINDS = {"surfel": "2dgs", "gaussian": "3dgs"}
SIZE = (1600, 1200)
NEAR = 0.2
SCENE = Path(__file__).parents[1] / "examples" / "boruszyn"


def milliseconds(action: Callable[[], object], rounds: int, device: torch.device) -> float:
    """Median wall time of calling `action`, until the device has done it, after two calls to warm up."""
    times = []
    for index in range(rounds + 2):
        _wait(device)
        began = time.perf_counter()
        action()
        _wait(device)
        if index > 1:
            times.append(time.perf_counter() - began)
    return round(1e3 * sorted(times)[len(times) // 2], 3)


def scene(kind: str, count: int, device: torch.device) -> tuple[Splats, Camera]:
    """Splats with harmonics of degree 3, whose size falls with their number so that as much is drawn."""
    splats, camera = city(kind, count, *SIZE)
    smaller = (200_000 / count) ** 0.5
    rest = 0.05 * torch.randn(count, 15, 3)
    tensors = {**splats.tensors(), "scales": splats.scales * smaller, "sh_rest": rest}
    return splats.with_named({name: value.to(device) for name, value in tensors.items()}), camera


def parts_of(rasterizer: Rasterizer, kind: str, count: int, rounds: int) -> dict[str, float]:
    """Milliseconds of each part of a step, pictures a second, and bytes of a point while it is trained."""
    device = rasterizer.where()
    splats, camera = scene(kind, count, device)
    photo = torch.rand(3, camera.height, camera.width, device=device)
    render = rasterizer.render(splats, camera, NEAR)
    cotangents = Maps(**{name: torch.randn_like(value) for name, value in render.maps.present().items()})
    color = Maps(color=cotangents.color)
    moments = {name: (torch.zeros_like(v), torch.zeros_like(v)) for name, v in splats.tensors().items()}
    values = {name: v.clone() for name, v in splats.tensors().items()}

    def picture(geometry: bool = True) -> Maps:
        return rasterizer.render(splats, camera, NEAR, geometry, geometry).maps

    def losses() -> torch.Tensor:
        shown = render.maps.color.clone().requires_grad_()
        return torch.autograd.grad(0.8 * (shown - photo).abs().mean() + 0.2 * (1 - ssim(shown, photo)), shown)[0]

    def adam() -> None:
        for name, value in values.items():
            update(value, value, *moments[name], 1e-9, 1)

    def step() -> None:
        drawn = rasterizer.render(splats, camera, NEAR)
        drawn.maps.color, losses(), drawn.backward(cotangents, color), adam()

    actions = {
        "project and sort": lambda: rasterizer.render(splats, camera, NEAR, False, False).seen,
        "all maps": picture,
        "colour alone": lambda: picture(False),
        "backward": lambda: render.backward(cotangents),
        "backward with the decomposed gradient": lambda: render.backward(cotangents, color),
        "L1 and SSIM": losses,
        "Adam": adam,
        "contribution": lambda: rasterizer.contribution(splats, camera, NEAR, 0.5, 0.5),
        "whole step": step,
    }
    figures = {name: milliseconds(action, rounds, device) for name, action in actions.items()}
    figures["pictures a second"] = round(1e3 / figures["colour alone"], 1)
    if device.type == "cuda":
        torch.cuda.reset_peak_memory_stats(device)
        step()
        figures["bytes a point"] = round(torch.cuda.max_memory_allocated(device) / count)
    return figures


def peer(kind: str, count: int, rounds: int, device: torch.device) -> dict[str, float | str]:
    """The same scene with gsplat, forward and backward; why not, where it cannot be had."""
    try:
        import gsplat
    except ImportError as error:
        return {"skipped": f"gsplat cannot be imported: {error}"}
    splats, camera = scene(kind, count, device)
    scales = splats.scales if kind == "gaussian" else torch.cat([splats.scales, splats.scales[:, :1]], 1)
    given = [splats.means, splats.quats, scales, splats.opacities, splats.sh]
    leaves = [value.clone().requires_grad_() for value in given]
    lens = torch.tensor([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1.0]], device=device)
    pose = camera.world_to_camera.float().to(device)
    draw = gsplat.rasterization if kind == "gaussian" else gsplat.rasterization_2dgs

    def forward() -> tuple:
        return draw(*leaves, pose[None], lens[None], *SIZE, near_plane=NEAR, sh_degree=3, render_mode="RGB+ED")

    def both() -> None:
        color, alpha = forward()[:2]
        torch.autograd.grad((color * color.detach()).sum() + alpha.sum(), leaves)

    with torch.no_grad():
        alone = milliseconds(forward, rounds, device)
    return {
        "version": gsplat.__version__,
        "all maps": alone,
        "forward and backward": milliseconds(both, rounds, device),
    }


def upload(device: torch.device, rounds: int) -> float:
    """Milliseconds from a photograph of 12 megapixels in memory to the device."""
    photo = torch.randint(0, 256, (3, 3000, 4000), dtype=torch.uint8)
    return milliseconds(lambda: uploaded(photo, device), rounds, device)


def matching(device: torch.device, rounds: int) -> dict[str, float]:
    """Milliseconds of a pass of PatchMatch with 16 photographs of 1600 x 1200 pixels, and of moving its planes."""
    draw, pose = np.random.default_rng(0), torch.eye(4, dtype=torch.float64)
    value = draw.integers(0, 256, SIZE[::-1]).astype(np.uint8)
    seen = []
    for at in range(17):
        pose = pose.clone()
        pose[0, 3] = -0.01 * at
        camera = Camera(pose, 1000.0, 1000.0, SIZE[0] / 2, SIZE[1] / 2, *SIZE)
        seen.append(GreyImage(camera, np.roll(value, -10 * at, 1)))
    planes = Planes.at(draw.uniform(0.5, 1.5, value.shape).astype(np.float32), 16)
    planes.each[:] = draw.integers(0, 256, planes.each.shape)
    known = [torch.full(value.shape, 1.0, device=device)] * 16
    terms = MatchingSettings(0.2, 2, 80, 0.25, 0.015, 0.2, 15, 1.5, samples=32, best=2, window=7, survey=False)
    use = GpuPasses(device).improve if device.type == "cuda" else improve

    def moved() -> None:
        for part in (planes.value, planes.cost, planes.each):
            torch.from_numpy(part.copy()).to(device).cpu()

    return {
        "a pass": milliseconds(lambda: use(seen[0], seen[1:], planes, terms, 0, known), rounds, device),
        "planes to and fro": milliseconds(moved, rounds, device),
    }


def fusing(device: torch.device, rounds: int) -> float:
    """Milliseconds of fusing a depth map of 1600 x 1200 pixels of the size of a voxel, after a first one."""
    lattice, pose = Lattice(0.01, 0.04), torch.eye(4, dtype=torch.float64)
    camera = Camera(pose, 1000.0, 1000.0, SIZE[0] / 2, SIZE[1] / 2, *SIZE)
    depth = np.linspace(9, 11, SIZE[0], dtype=np.float32)[None].repeat(SIZE[1], 0)
    seen = FusionImage(depth, np.full_like(depth, 32 << 24, np.uint32), camera)
    into = GpuGrid(lattice, device) if device.type == "cuda" else grid(lattice)
    return milliseconds(lambda: into.fuse(seen, True), rounds, device)


def clustering(device: torch.device, rounds: int) -> dict[str, float]:
    """Milliseconds of the search and of the sums of an iteration of k-means over 400,000 vectors, with 8,192 codes."""
    vectors = torch.randn(400_000, 45)
    there, weights = vectors.to(device), torch.ones(len(vectors), dtype=torch.float64, device=device)
    index = (torch.arange(len(vectors), dtype=torch.int32) % 8192).to(device)
    if device.type == "cuda":
        search = GpuSearch(vectors[:8192], device)
        find, add = lambda: search.nearest(there, there), lambda: gpu_sums(there, weights, index, 8192)
    else:
        find, add = lambda: nearest(vectors, vectors[:8192]), lambda: sums(there, weights, index, 8192)
    return {"nearest": milliseconds(find, rounds, device), "sums": milliseconds(add, rounds, device)}


def training(device: str, recipe: str, steps: int) -> dict[str, float]:
    """PSNR, number of points and seconds of a recipe, through the command line."""
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "run"
        words = [f"recipe:{recipe}", "--data", SCENE, "--scale", 4, "--steps", steps, "--device", device, "--out", out]
        words += ["--test-every", 8]  # with every recipe, as for the figures before
        began = time.perf_counter()
        subprocess.run([sys.executable, "-m", "surfkit.cli", "train", *map(str, words)], check=True)
        metrics = json.loads((out / "metrics.json").read_text())
        seconds = round(time.perf_counter() - began, 1)
        return {"seconds": seconds, "psnr": metrics["images"]["psnr"], "points": metrics["points"]}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--device", default="cuda")
    parser.add_argument("--points", type=int, nargs="+", default=[1_000_000, 5_000_000, 10_000_000])
    parser.add_argument("--rounds", type=int, default=7)
    parser.add_argument("--steps", type=int, default=1000)
    parser.add_argument("--recipes", nargs="*", default=["2dgs", "citygs2"])
    parser.add_argument("--name", default="gpu", help="the result is NAME.json")
    parser.add_argument("--out", type=Path, default=RESULTS, help="its folder")
    parser.add_argument("--go-on", action="store_true", help="keep what the result of an interrupted call has")
    options = parser.parse_args()
    rasterizer, title = select(options.device)
    path, figures = options.out / f"{options.name}.json", {"device": title}
    if options.go_on and path.exists() and (known := json.loads(path.read_text())["figures"])["device"] == title:
        figures = known
    for name, measure in measurements(rasterizer, options).items():
        if name not in figures:
            figures[name] = measure()
            print(name, json.dumps(figures[name]), flush=True)
            print(save(options.name, figures, options.out), flush=True)


def measurements(rasterizer: Rasterizer, options: argparse.Namespace) -> dict[str, Callable[[], object]]:
    """What is measured, by name: what tells most comes first, and gsplat last, as it may compile for minutes."""
    device, rounds = rasterizer.where(), options.rounds

    def trained(recipe: str) -> dict[str, object]:
        where = (options.device, "cpu") if device.type == "cuda" else (options.device,)
        return {each: training(each, recipe, options.steps) for each in where}

    scenes = {f"{name}, {count:,} points": (kind, count) for kind, name in KINDS.items() for count in options.points}
    return {
        **{f"{name}, ms": partial(parts_of, rasterizer, *it, rounds) for name, it in scenes.items()},
        "upload of 12 MP, ms": partial(upload, device, rounds),
        "fusing a view, ms": partial(fusing, device, rounds),
        "k-means, ms": partial(clustering, device, rounds),
        "matching a view, ms": partial(matching, device, rounds),
        **{f"{name}, with gsplat, ms": partial(peer, *it, rounds, device) for name, it in scenes.items()},
        **{recipe: partial(trained, recipe) for recipe in options.recipes},
    }


def _wait(device: torch.device) -> None:
    if device.type == "cuda":
        torch.cuda.synchronize(device)


if __name__ == "__main__":
    main()
