"""Whether levels of detail are what they should be."""

from __future__ import annotations

import numpy as np
import torch

from surfkit.compress.levels.lod_tree import LodBlocks, LodTree
from surfkit.primitives.model import SplatModel

SLACK = 1e-9
"""By which a box may lie outside that of its parent, as a share of the size of the root's."""


def fault(tree: LodTree, model: SplatModel) -> str | None:
    """What is wrong with a tree as the levels of detail of a model; None if nothing is."""
    sizes = np.array([len(level) for level in tree.levels])
    return _wrong_levels(tree, model, sizes) or _wrong_tree(tree.blocks, sizes) or _wrong_boxes(tree.blocks)


def _wrong_levels(tree: LodTree, model: SplatModel, sizes: np.ndarray) -> str | None:
    if not len(sizes) or sizes[0] != len(model) or not np.array_equal(np.sort(tree.order), np.arange(len(model))):
        return f"its first level has not each of the {len(model):,} points of the model once"
    wanted = tree.sizes_of(len(model))
    if wanted is not None and wanted != sizes.tolist():
        return f"its levels have {', '.join(map(str, sizes))} points, and those of a tree {', '.join(map(str, wanted))}"
    shapes = {name: (value.shape[1:], value.dtype) for name, value in model.params.items()}
    shared = model.primitive.shared()
    for number, level in enumerate(tree.levels):
        found = {name: (value.shape[1:], value.dtype) for name, value in level.params.items()}
        counts = {len(value) for name, value in level.params.items() if name not in shared}
        if found != shapes or level.primitive != model.primitive or len(counts) != 1:
            return f"level {number} has other columns or another primitive than the model"
        if not all(bool(torch.isfinite(value).all()) for value in level.params.values()):
            return f"level {number} has values that are not finite"
    if (np.diff(sizes) > 0).any():
        return f"a level has more points than the one before: {', '.join(map(str, sizes))}"
    if not all(
        torch.equal(v[tree.order], tree.levels[0].params[n]) for n, v in model.params.items() if n not in shared
    ):
        return "its first level has other values than the model"
    return None


def _wrong_tree(blocks: LodBlocks, sizes: np.ndarray) -> str | None:
    if {len(value) for value in (blocks.level, blocks.first, blocks.last, blocks.parent, blocks.error)} != {
        len(blocks)
    }:
        return "the columns of its blocks have different lengths"
    parents = blocks.parent[1:]
    if len(blocks) == 0 or blocks.parent[0] != -1 or ((parents < 0) | (parents > np.arange(len(parents)))).any():
        return "the first block is not the root, or a parent does not come before its children"
    if (blocks.level < 0).any() or (blocks.level >= len(sizes)).any():
        return "a block is of a level that is not there"
    if ((blocks.first < 0) | (blocks.first > blocks.last) | (blocks.last > sizes[blocks.level])).any():
        return "a block has rows that are not there"
    leaves = blocks.is_leaf.nonzero()[0]
    spans = sorted(zip(blocks.first[leaves].tolist(), blocks.last[leaves].tolist(), strict=True))
    ends = [0, *(last for _, last in spans)]
    if blocks.level[leaves].any() or [first for first, _ in spans] != ends[:-1] or ends[-1] != sizes[0]:
        return "the blocks without children do not hold each point of the first level once"
    if blocks.error[leaves].any():
        return "a block without children has an error above 0"
    return None


def _wrong_boxes(blocks: LodBlocks) -> str | None:
    boxes, count = (blocks.low, blocks.high), len(blocks)
    if any(box.shape != (count, 3) for box in boxes) or blocks.reach.shape != (count,):
        return "the columns of its blocks have different lengths"
    if not all(np.isfinite(value).all() for value in (*boxes, blocks.error, blocks.reach)):
        return "a box or an error is not finite"
    up, slack = blocks.parent[1:], SLACK * float((blocks.high[0] - blocks.low[0]).max())
    if (blocks.low[up] > blocks.low[1:] + slack).any() or (blocks.high[up] < blocks.high[1:] - slack).any():
        return "a box lies outside that of its parent"
    if (blocks.error[up] < blocks.error[1:]).any():
        return "the error of a block is below that of its children"
    return None
