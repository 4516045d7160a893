"""Measure the CPU rasterizer on 200,000 splats at 800 x 608 with every map: `python bench/raster.py`.

One figure a line: `surfel2d blend CPU-s 0.41` is forward and backward of the blending, gradients of every splat
included. Medians of process CPU time over all threads, after a warm-up.
"""

from __future__ import annotations

import argparse

import torch
from machine import cpu_seconds, save
from scenes import city

from surfkit.raster.api import MAPS, Maps
from surfkit.raster.native import module
from surfkit.raster.native_rasterizer import NativeRasterizer, Pass
from surfkit.raster.ssim import ssim
from surfkit.train.adam import update

NAMES = {"surfel": "surfel2d", "gaussian": "gaussian3d"}
NEAR = 0.2


def parts_of(kind: str, rounds: int) -> dict[str, float]:
    """CPU seconds of each part of one training step, and of the whole."""
    splats, camera = city(kind)
    photo = torch.rand(3, camera.height, camera.width)
    render = NativeRasterizer().render(splats, camera, NEAR)
    maps = render.maps.present()
    cotangents = Maps(**{name: torch.randn_like(value) for name, value in maps.items()})
    color_only = Maps(color=cotangents.color)
    native, threads = render._pass.native, torch.get_num_threads()
    columns = {**splats.tensors(), "sh_rest": torch.zeros(len(splats), 15, 3)}
    moments = {name: (torch.zeros_like(v), torch.zeros_like(v)) for name, v in columns.items()}

    def losses() -> torch.Tensor:
        color = render.maps.color.clone().requires_grad_()
        loss = 0.8 * (color - photo).abs().mean() + 0.2 * (1 - ssim(color, photo))
        return torch.autograd.grad(loss, color)[0]

    def adam() -> None:
        for name, value in columns.items():
            update(value.clone() if name == "means" else value, value * 0, *moments[name], 1e-6, 1)

    parts = {
        "project and bin": lambda: Pass(splats, camera, NEAR),
        "forward": lambda: native.forward(2, [maps[name] for name in MAPS], threads),
        "backward": lambda: render.backward(cotangents),
        "backward with a second cotangent": lambda: render.backward(cotangents, color_only),
        "backward of colour alone": lambda: render.backward(color_only),
        "L1 and SSIM": losses,
        "Adam (59 values a splat)": adam,
        "contribution": lambda: NativeRasterizer().contribution(splats, camera, NEAR, 0.5, 0.5),
    }
    figures = {name: cpu_seconds(action, rounds) for name, action in parts.items()}
    figures["blend"] = figures["forward"] + figures["backward"]
    whole = ("project and bin", "blend", "L1 and SSIM", "Adam (59 values a splat)")
    figures["whole step"] = sum(figures[name] for name in whole)
    return figures


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rounds", type=int, default=7)
    parser.add_argument("--threads", type=int, default=torch.get_num_threads())
    parser.add_argument("--all-kernels", action="store_true", help="also AVX2 and the baseline")
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    kept: dict[str, dict] = {}
    for kernels in module().kernels() if options.all_kernels else [module().kernels_in_use()]:
        module().use_kernels(kernels)
        for kind, name in NAMES.items():
            figures = parts_of(kind, options.rounds)
            label = f"{name} {kernels}" if options.all_kernels else name
            for part, seconds in figures.items():
                print(f"{label} {part} CPU-s {seconds:.3f}", flush=True)
            kept[f"{name} {kernels}"] = {part: round(seconds, 4) for part, seconds in figures.items()}
    module().use_kernels(module().kernels()[0])
    print(f"wrote {save('raster', kept)}")


if __name__ == "__main__":
    main()
