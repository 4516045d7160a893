"""Bytes against loss of the same model in every format and with every compressor that needs no photographs.

    python bench/rate.py RUN [RUN ...] [--factors 1 0.7 0.5] [--out NAME]

For each run: bytes a point, the change of the mean PSNR on held-out photographs, and the mean PSNR of the renders
against those of the model itself.
"""

from __future__ import annotations

import argparse
import statistics
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path

import torch
from machine import save
from torch import Tensor

from surfkit.compress.base import Compressor
from surfkit.compress.container import read_model, write_model
from surfkit.compress.lossless import Float16
from surfkit.compress.packed import Packed
from surfkit.core.registry import find
from surfkit.io.splats.base import Format
from surfkit.primitives.drawing import drawn_by
from surfkit.primitives.model import SplatModel, primitive_of
from surfkit.raster.base import Rasterizer
from surfkit.raster.psnr import psnr
from surfkit.runs.context import RunContext
from surfkit.runs.pipeline import loaded
from surfkit.runs.run_method import splats_of
from surfkit.scene.photos import view_photo

FORMATS = ("ply", "compressed-ply", "splat", "spz", "sog")


def written(
    ctx: RunContext, model: SplatModel, factors: list[float], folder: Path
) -> Iterator[tuple[str, Path, Callable]]:
    """Name of each way, the file that it wrote, and what reads the model in it."""
    frame, table = ctx.scene.frame, model.primitive.table(model.params).in_input_frame(ctx.scene.frame)
    for name in FORMATS:
        form = find(Format, name)()
        path = folder / f"{name}{form.suffix}"
        form.write(path, table, frame)

        def read(form: Format = form, path: Path = path) -> SplatModel:
            found = form.read(path).in_local_frame(frame)
            primitive = primitive_of(found)
            params = primitive.from_table(found, torch.Generator().manual_seed(0))
            return SplatModel(primitive, params, found.sh_degree, model.near)

        yield name, path, read
    ways: dict[str, Compressor] = {"float16": Float16()}
    ways |= {
        "packed" if factor == 1 else f"packed, errors x {factor:g}": Packed().coarser(factor) for factor in factors
    }
    for name, compressor in ways.items():
        path = folder / "model.surfkit"
        write_model(path, model, compressor.plan(model, None, 0), compressor, frame)
        yield name, path, partial(first_of, path)


def first_of(path: Path) -> SplatModel:
    """The model in a `.surfkit` file."""
    return read_model(path)[0]


def renders(model: SplatModel, ctx: RunContext, rasterizer: Rasterizer) -> list[Tensor]:
    """Held-out views, clamped."""
    draws = drawn_by(model.primitive, rasterizer)
    with torch.no_grad():
        maps = [draws.render(model.splats, view.camera, model.near, False, False).maps for view in ctx.scene.held_out]
    return [each.color.clamp(0, 1) for each in maps]


def main() -> None:
    """Print a table, and keep it."""
    words = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    words.add_argument("runs", nargs="+", type=Path)
    words.add_argument("--factors", nargs="+", type=float, default=[1.0, 0.7, 0.5])
    words.add_argument("--out", default="rate")
    given = words.parse_args()
    figures = {}
    for run in given.runs:
        with loaded(run, "cpu") as (ctx, made), tempfile.TemporaryDirectory() as folder:
            model = splats_of(ctx.run, made)
            model = replace(model, params={name: value.detach() for name, value in model.params.items()})
            photos = [view_photo(view).float() / 255 for view in ctx.scene.held_out]
            own = renders(model, ctx, ctx.rasterizer)
            before = statistics.mean(map(psnr, own, photos))
            print(f"{run.name}: {len(model):,} points, {before:.3f} dB")
            rows = {}
            for name, path, read in written(ctx, model, given.factors, Path(folder)):
                after = renders(read(), ctx, ctx.rasterizer)
                rows[name] = {
                    "bytes": path.stat().st_size,
                    "bytes a point": round(path.stat().st_size / len(model), 2),
                    "change of PSNR": round(statistics.mean(map(psnr, after, photos)) - before, 4),
                    "PSNR against its own renders": round(statistics.mean(map(psnr, after, own)), 2),
                }
                print(f"  {name:24}" + "  ".join(f"{value:>12}" for value in rows[name].values()), flush=True)
            figures[run.name] = {"points": len(model), "PSNR": round(before, 3), "ways": rows}
    print(save(given.out, figures))


if __name__ == "__main__":
    main()
