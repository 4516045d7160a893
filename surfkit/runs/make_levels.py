"""From a trained run to its levels of detail: made, kept in the run folder, read again, and measured."""

from __future__ import annotations

import hashlib
import json
import shutil
import time
from collections.abc import Callable
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
import safetensors.numpy
import safetensors.torch
import torch
from safetensors import SafetensorError

from surfkit.compress.levels.base import LevelsOfDetail, LodInput
from surfkit.compress.levels.lod_tree import LodBlocks, LodTree
from surfkit.compress.levels.splat_tree import SplatTree
from surfkit.compress.levels.validate_levels import fault
from surfkit.core.check import BadInput
from surfkit.core.codec import dump, read_json, read_keys, write_json
from surfkit.core.events import FileWritten, Warned, emit
from surfkit.core.files import replacing
from surfkit.core.registry import name_of
from surfkit.evaluate.images.measure_images import Draw, evaluate_views, frames_per_second
from surfkit.io.datasets.masks import mask_cache
from surfkit.primitives.drawing import drawn_by
from surfkit.primitives.model import SplatModel
from surfkit.raster.api import Splats
from surfkit.raster.base import Rasterizer
from surfkit.runs.context import RunContext
from surfkit.runs.folder import Run
from surfkit.runs.methods.base import Reconstruction
from surfkit.runs.run_method import splats_of
from surfkit.scene.available_memory import cache_bytes
from surfkit.scene.photos import photo_cache
from surfkit.scene.scene import Scene, View

BLOCKS = "blocks.safetensors"
"""In the folder of the levels: the tree, and the order of the points of the model."""
TREES: dict[str, type[LodTree]] = {kind.selects: kind for kind in (LodTree, SplatTree)}
"""What levels are read as, by what lod.json says is selected; blocks, where an older one says nothing."""
UNFINISHED_PREFIX = "unfinished-"
"""How folders begin in which a component keeps what it has made so far."""
PHOTOS_AHEAD = 8
"""Photographs in memory while levels are measured."""


def make_wanted_levels(ctx: RunContext, made: Reconstruction) -> None:
    """Make the levels of detail that the recipe wants; that they cannot be had is told, and costs no measurements."""
    run = ctx.run
    assert run.recipe.lod is not None
    try:
        make_levels(run, run.recipe.lod, made, ctx.scene, ctx.rasterizer, cache_bytes("auto"))
    except BadInput as error:
        emit(Warned(f"no levels of detail: {error}; `{run.to_paste('lod')}` tries again with other settings"))


def make_levels(
    run: Run, lod: LevelsOfDetail, made: Reconstruction, scene: Scene, rasterizer: Rasterizer, budget_bytes: int
) -> dict[str, Any]:
    """Make the levels of detail of a run, write them into its folder, and return what lod.json says.

    What a component keeps is found again when the same levels are made after an interruption.

    Args:
        run: The run.
        lod: How.
        made: What the run has come to.
        scene: Its data.
        rasterizer: What draws.
        budget_bytes: Memory for pictures.

    Raises:
        BadInput: The run has no splats, or levels of them cannot be made.
    """
    began, model = time.perf_counter(), splats_of(run, made)
    lod.refuse_unfit(model.primitive)
    folder = run.lod / f"{UNFINISHED_PREFIX}{_digest(run, lod, model)}"
    for left in run.lod.glob(f"{UNFINISHED_PREFIX}*"):
        if left != folder:
            shutil.rmtree(left)
    folder.mkdir(parents=True, exist_ok=True)
    draws = drawn_by(model.primitive, rasterizer)
    tree = lod.build(LodInput(model, scene.train, draws, scene.frame, run.recipe.seed, folder, budget_bytes))
    if (wrong := fault(tree, model)) is not None:
        raise BadInput(f"lod:{name_of(lod)} returned levels that cannot be used: {wrong}")
    _forget(run)
    files = list(_write(run.lod, tree))
    record = {
        "lod": lod,
        "selects": tree.selects,
        "steps": made.last_steps,
        "points": [len(level) for level in tree.levels],
        "blocks": len(tree.blocks),
        "files": files,
        "seconds": round(time.perf_counter() - began, 2),
    }
    write_json(run.lod_record, record)
    emit(FileWritten(run.lod_record, "facts of the levels of detail"))
    shutil.rmtree(folder)
    return dump(record)


def _digest(run: Run, lod: LevelsOfDetail, model: SplatModel) -> str:
    """Of all that levels are made from."""
    digest = hashlib.sha256(json.dumps([dump(lod), dump(model.primitive), run.recipe.seed, model.near]).encode())
    for name, value in sorted(model.params.items()):
        digest.update(name.encode())
        digest.update(np.ascontiguousarray(value.detach().cpu().numpy()).data)
    return digest.hexdigest()[:16]


def _forget(run: Run) -> None:
    """Delete levels that were made before, the record first, and what was measured of them."""
    run.lod_record.unlink(missing_ok=True)
    for path in run.lod.glob("*.safetensors"):
        path.unlink()
    if run.metrics.exists() and "lod" in (metrics := read_json(run.metrics, dict[str, Any])):
        del metrics["lod"]
        write_json(run.metrics, metrics)


def _write(folder: Path, tree: LodTree) -> list[str]:
    """Write the tree and each level after the first, and give the names of the files."""
    arrays = {field.name: getattr(tree.blocks, field.name) for field in fields(LodBlocks)}
    content = {BLOCKS: safetensors.numpy.save(arrays | {"order": tree.order})}
    for number, level in enumerate(tree.levels[1:], 1):
        params = {name: value.detach().cpu().contiguous() for name, value in level.params.items()}
        content[f"level{number}.safetensors"] = safetensors.torch.save(params)
    for name, data in content.items():
        with replacing(folder / name) as file:
            file.write(data)
        emit(FileWritten(folder / name, "levels of detail"))
    return list(content)


def has_levels(run: Run, steps: int) -> bool:
    """Whether the levels that a recipe wants are there, made from splats of so many steps; it may want none."""
    if run.recipe.lod is None:
        return True
    if not run.lod_record.exists():
        return False
    record = _record(run)
    return record["steps"] == steps and all((run.lod / name).exists() for name in record["files"])


def _record(run: Run) -> dict[str, Any]:
    hints = {"files": tuple[str, ...], "steps": int, "points": tuple[int, ...], "selects": str | None}
    again = f"delete it, and `{run.to_paste('lod')}` makes the levels again"
    record = read_keys(run.lod_record, hints, again)
    if (selects := record["selects"] or LodTree.selects) not in TREES:
        raise BadInput(f"{run.lod_record}: selects is {selects!r}, not {' or '.join(TREES)}; {again}")
    return record | {"selects": selects}


def load_levels(run: Run, model: SplatModel) -> LodTree:
    """The levels of detail of a run.

    Args:
        run: The run.
        model: Its splats, which are the first level.

    Raises:
        BadInput: There are none, they are damaged, or of another model.
    """
    again = f"`{run.to_paste('lod')}` makes them"
    if not run.lod_record.exists():
        raise BadInput(f"{run.out}: there are no levels of detail; {again}")
    record = _record(run)
    points = record["points"]
    try:
        arrays = safetensors.numpy.load_file(run.lod / BLOCKS)
        order = arrays.pop("order")
        blocks = LodBlocks(**arrays)
        names = [run.lod / f"level{number}.safetensors" for number in range(1, len(points))]
        coarse = [safetensors.torch.load_file(path) for path in names]
        if len(order) != len(model):
            raise BadInput(f"{run.lod}: made from {len(order):,} points, and the run has {len(model):,}; {again}")
        first = model.take(torch.from_numpy(order))
        levels = (first, *(SplatModel(model.primitive, params, model.sh_degree, model.near) for params in coarse))
        tree = TREES[record["selects"]](order, levels, blocks)
        wrong = fault(tree, model)
    except (OSError, SafetensorError, KeyError, TypeError, IndexError) as error:
        raise BadInput(f"{run.lod}: damaged ({' '.join(str(error).split())}); {again}") from error
    if wrong is not None:
        raise BadInput(f"{run.lod}: damaged ({wrong}); {again}")
    return tree


def measure_levels(
    made: Reconstruction, tree: LodTree, scene: Scene, rasterizer: Rasterizer, pixels: float
) -> dict[str, Any]:
    """Size, quality and speed of each level where all views show it, and of blocks that are selected for each view.

    Args:
        made: What the levels were made of.
        tree: The levels.
        scene: With held-out views for the quality; without any, training views are drawn for the speed alone.
        rasterizer: What draws.
        pixels: Largest error of blocks, or largest size of splats, that are selected, pixels.

    Returns:
        For metrics.json: "levels", a list from the finest on, and "selected", each with "points" and "bytes" that are
        drawn for a view, "psnr", "ssim" and "fps"; "pixels".
    """
    draws, model = drawn_by(tree.levels[0].primitive, rasterizer), tree.levels[0]
    shared = model.primitive.shared()
    row_bytes = sum(v[:1].numel() * v.element_size() for name, v in model.params.items() if name not in shared)

    def drawing(splats_of_view: Callable[[View], Splats]) -> Draw:
        return lambda view: draws.render(splats_of_view(view), view.camera, model.near, False, False).maps

    def always(splats: Splats) -> Callable[[View], Splats]:
        return lambda view: splats

    def measured(points: float, draw: Draw) -> dict[str, Any]:
        return {"points": round(points), "bytes": round(points * row_bytes), **_measure(scene, made, draw)}

    rows = []
    for level in tree.levels:
        rows.append(measured(len(level), drawing(always(level.splats.detached()))))
    views = scene.held_out or scene.train
    counts = [len(tree.seen(view.camera, pixels)) for view in views]
    selected = measured(float(np.mean(counts)), drawing(lambda view: tree.seen(view.camera, pixels)))
    return {"levels": rows, "selected": selected, "pixels": pixels}


def _measure(scene: Scene, made: Reconstruction, draw: Draw) -> dict[str, Any]:
    """PSNR and SSIM of held-out views, and frames per second."""
    views = scene.held_out
    if not views:
        return {"psnr": None, "ssim": None, "fps": frames_per_second(scene.train, draw)}
    ahead = PHOTOS_AHEAD * max(3 * view.camera.width * view.camera.height for view in views)
    shown, masks = made.photographed(draw), mask_cache(views, ahead)
    found = evaluate_views(views, photo_cache(views, ahead), shown, timed=draw, masks=masks)
    return {"psnr": found["images"]["psnr"], "ssim": found["images"]["ssim"], "fps": found["fps"]}
