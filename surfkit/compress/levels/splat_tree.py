"""A binary tree of splats, cut by size on the screen (Kerbl et al. 2024, A Hierarchical 3D Gaussian Representation).

The leaves are the splats of a model, in an order in which every node has neighbours below it. A level is one depth of
the tree, so who is whose parent follows from the number of leaves: node i has children 2i and 2i + 1 of the level
below, and the nodes of level 1 have one or two leaves each.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from itertools import product
from typing import ClassVar

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import normalize

from surfkit.compress.levels.cut import depth_for, halves
from surfkit.compress.levels.lod_tree import LodTree, outside
from surfkit.raster.api import CUTOFF, Splats
from surfkit.scene.camera import Camera
from surfkit.scene.rotations import numpy_quaternions

BOX_SIGMAS = 3.0
"""How far the box of a leaf reaches beyond its centre, in its largest scale."""
LEAST_STEP = 1.1
"""By which a node counts as larger than its children, at least."""


def leaf_ends(count: int) -> np.ndarray:
    """(B + 1,) bounds of the leaves of each of the B nodes of level 1, of `count` leaves: one or two each."""
    ends = np.array([0, count])
    for _ in range(depth_for(count, 2)):
        ends = halves(ends)
    return ends


def level_sizes(count: int) -> list[int]:
    """Nodes of each level of a tree with `count` leaves, those first, the root last; each has at most those before."""
    depth = depth_for(count, 2)
    return [count, *(2**left for left in range(depth, -1, -1))]


@dataclass(frozen=True)
class NodeBoxes:
    """Boxes of the K nodes of a level.

    Attributes:
        low, high: (K, 3) float32 corners of a box around all leaves below, BOX_SIGMAS standard deviations wide.
        size: (K,) float32, the longest side of the box, but at least LEAST_STEP times that of the children: where these
            are as large as their parent, there would be no way between them.
        reach: (K,) float32, how far a splat of the node or below it extends at most beyond its centre.
    """

    low: np.ndarray
    high: np.ndarray
    size: np.ndarray
    reach: np.ndarray

    def granularity(self, rows: np.ndarray, camera: Camera) -> np.ndarray:
        """(R,) pixels that some nodes cover at the nearest place of their boxes; inf within the box.

        It is always above that of a child: the child is smaller, and its box not nearer.
        """
        low, high, centre = self.low[rows], self.high[rows], camera.centre.numpy()
        apart = np.maximum(np.maximum(low - centre, centre - high), 0.0)
        distance = np.sqrt((apart * apart).sum(1))
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.where(distance > 0, self.size[rows] * max(camera.fx, camera.fy) / distance, np.inf)


def boxes_of(levels: list[Splats]) -> list[NodeBoxes]:
    """Of each level of a tree, given by its activated splats, the leaves first."""
    found: list[NodeBoxes] = []
    for level, splats in enumerate(levels):
        longest = splats.scales.detach().amax(1).float().cpu().numpy()
        reach = np.float32(CUTOFF) * longest
        if level == 0:
            means = splats.means.detach().float().cpu().numpy()
            half = np.float32(BOX_SIGMAS) * longest[:, None]
            found.append(NodeBoxes(means - half, means + half, 2 * half[:, 0], reach))
            continue
        below = found[-1]
        starts = leaf_ends(len(levels[0]))[:-1] if level == 1 else np.arange(0, len(below.reach), 2)
        low, high = np.minimum.reduceat(below.low, starts), np.maximum.reduceat(below.high, starts)
        largest, farthest = (np.maximum.reduceat(each, starts) for each in (below.size, below.reach))
        size = np.maximum((high - low).max(1), np.float32(LEAST_STEP) * largest)
        found.append(NodeBoxes(low, high, size, np.maximum(reach, farthest)))
    return found


@dataclass(frozen=True)
class Cut:
    """What stands for the leaves at one granularity: K nodes, of which each leaf is or lies below exactly one.

    Attributes:
        nodes, parents: (K,) int64 rows of `LodTree.joined`; the root is its own parent.
        share: (K,) float32 from 0, where a node is drawn as its parent, to 1, where it is drawn as it is.
    """

    nodes: Tensor
    parents: Tensor
    share: Tensor

    def __len__(self) -> int:
        return len(self.nodes)

    def take(self, rows: Tensor) -> Cut:
        """Those of a mask (K,) bool."""
        return Cut(self.nodes[rows], self.parents[rows], self.share[rows])


@dataclass(frozen=True)
class SplatTree(LodTree):
    """Levels of detail that are a binary tree of splats: what a camera is shown is chosen splat by splat.

    `blocks` are as those of other levels of detail, for programs that load what they draw.
    """

    selects: ClassVar[str] = "splats"

    @classmethod
    def sizes_of(cls, count: int) -> list[int] | None:
        """See `LodTree.sizes_of`."""
        return level_sizes(count)

    @cached_property
    def boxes(self) -> list[NodeBoxes]:
        """Of the nodes of each level."""
        return boxes_of([level.splats for level in self.levels])

    @cached_property
    def starts(self) -> np.ndarray:
        """(L + 1,) where the levels begin in `joined`, and its end."""
        return np.concatenate([[0], np.cumsum([len(level) for level in self.levels])])

    @cached_property
    def parents(self) -> Tensor:
        """(M,) int64 of all nodes, as rows of `joined`; the root is its own."""
        found = [self.starts[1] + np.repeat(np.arange(len(self.levels[1])), np.diff(leaf_ends(len(self.levels[0]))))]
        found += [self.starts[k + 1] + np.arange(len(self.levels[k])) // 2 for k in range(1, len(self.levels) - 1)]
        return torch.from_numpy(np.concatenate([*found, [self.starts[-1] - 1]]))

    @cached_property
    def heirs(self) -> Tensor:
        """(M,) bool, of all nodes: the one of each two siblings that is nearer to their parent, which is the one that
        weighs more; the first where both are as near, and single children."""
        means, parents = self.joined.means.cpu(), self.parents
        apart = (means - means[parents]).double().square().sum(1)
        order = torch.from_numpy(np.lexsort((apart.numpy(), parents.numpy())))
        first = torch.ones(len(parents), dtype=torch.bool)
        first[1:] = parents[order][1:] != parents[order][:-1]
        found = torch.zeros_like(first)
        found[order[first]] = True
        found[-1] = True  # the root
        return found

    @cached_property
    def turns(self) -> Tensor:
        """(M,) int64 of all nodes: which quarter turns of the parent bring its axes nearest to the node's, by its place
        in `AXIS_TURNS`."""
        quats = normalize(self.joined.quats.cpu().double(), dim=1)
        table = AXIS_TURNS if self.joined.scales.shape[1] == 3 else AXIS_TURNS[KEEPS_NORMAL]
        relative = _times(quats[self.parents] * quats.new_tensor([1, -1, -1, -1]), quats)
        best = (relative @ table.T).abs().argmax(1)
        return best if len(table) == len(AXIS_TURNS) else KEEPS_NORMAL[best]

    def cut(self, camera: Camera, pixels: float, near: float | None = None) -> Cut:
        """The nodes of at most so many pixels whose parents are larger; leaves have no limit (section 4.2).

        From the root down, so that it costs what is drawn. As all below a node is done when the node is, each leaf has
        exactly one such node above it, or is one.

        Args:
            camera: Who looks.
            pixels: Granularity tau.
            near: Leave out what lies below nodes that the camera does not see, with that as the nearest depth.
        """
        found: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []
        rows, above, parents = np.zeros(1, np.int64), np.full(1, np.inf), np.array([self.starts[-1] - 1])
        for level in range(len(self.levels) - 1, -1, -1):
            sizes = self.boxes[level].granularity(rows, camera)
            done = sizes <= pixels if level else np.ones(len(rows), dtype=bool)
            with np.errstate(invalid="ignore", divide="ignore"):  # inf - inf: the camera is within both boxes
                share = (above[done] - pixels) / (above[done] - sizes[done])
            share = np.where(np.isnan(share) | np.isinf(above[done]), 1.0, np.clip(share, 0, 1))
            found.append((rows[done] + self.starts[level], parents[done], share))
            left = ~done
            if near is not None:
                box = self.boxes[level]
                left[left] = ~outside(box.low[rows[left]], box.high[rows[left]], box.reach[rows[left]], camera, near)
            rows, above = rows[left], sizes[left]
            if level > 1:
                below, each = np.stack([2 * rows, 2 * rows + 1], 1).reshape(-1), np.full(len(rows), 2)
            elif level == 1:
                ends = leaf_ends(len(self.levels[0]))
                each = ends[rows + 1] - ends[rows]
                below = np.repeat(ends[rows + 1] - np.cumsum(each), each) + np.arange(each.sum())
            else:
                break
            parents, above, rows = np.repeat(rows + self.starts[level], each), np.repeat(above, each), below
        nodes, parents, share = (np.concatenate(each) for each in zip(*found, strict=True))
        return Cut(torch.from_numpy(nodes), torch.from_numpy(parents), torch.from_numpy(share.astype(np.float32)))

    def seen(self, camera: Camera, pixels: float) -> Splats:
        """The splats to draw for a camera: those of its cut, each on the way between its parent and itself."""
        cut = self.cut(camera, pixels, self.levels[0].near)
        device = self.joined.means.device
        whole, on_the_way = cut.take(cut.share == 1), cut.take(cut.share < 1)
        node, parent = (self.joined.take(rows.to(device)) for rows in (on_the_way.nodes, on_the_way.parents))
        return self.joined.take(whole.nodes.to(device)).and_then(self.between(on_the_way, node, parent))

    def between(self, cut: Cut, node: Splats, parent: Splats) -> Splats:
        """(K) splats on the way from the parents of a cut's nodes to these, differentiable (section 4.3).

        Positions, colours, scales and rotations are interpolated; before that, the axes of the parent are numbered as
        those of the node that lie nearest to them. Where both siblings have come to be their parent, one has its
        opacity and the other none, so that the picture is that of the parent, and does not jump when it takes over.

        Args:
            cut: With the share of each node.
            node: The nodes, activated.
            parent: Their parents, activated.
        """
        share, turns = cut.share.to(node.means), self.turns[cut.nodes]
        heir = self.heirs[cut.nodes].to(node.opacities)
        quats, scales = turned(parent, turns)
        own = normalize(node.quats, dim=1)
        quats = torch.where(((own * quats).sum(1) < 0)[:, None], -quats, quats)
        return node.with_named(
            {
                "means": torch.lerp(parent.means, node.means, share[:, None]),
                "quats": torch.lerp(quats, own, share[:, None]),
                "scales": torch.lerp(scales, node.scales, share[:, None]),
                "opacities": torch.lerp(parent.opacities * heir, node.opacities, share),
                "sh0": torch.lerp(parent.sh0, node.sh0, share[:, None, None]),
                "sh_rest": torch.lerp(parent.sh_rest, node.sh_rest, share[:, None, None]),
            }
        )


def turned(splats: Splats, turns: Tensor) -> tuple[Tensor, Tensor]:
    """The same ellipsoids with other axes called first, second and third.

    Args:
        splats: K of them.
        turns: (K,) int64 places in `AXIS_TURNS`.

    Returns:
        (K, 4) unit quaternions, and (K, 2 or 3) scales.
    """
    by = AXIS_TURNS.to(splats.quats)[turns]
    width = splats.scales.shape[1]
    return _times(normalize(splats.quats, dim=1), by), splats.scales.gather(
        1, TURNED_AXES[turns][:, :width].to(splats.means.device)
    )


def _times(one: Tensor, other: Tensor) -> Tensor:
    """(K, 4) products of quaternions wxyz: first the other turns, then the one."""
    a, b = one[:, :1], other[:, :1]
    u, v = one[:, 1:], other[:, 1:]
    real = a * b - (u * v).sum(1, keepdim=True)
    return torch.cat([real, a * v + b * u + torch.linalg.cross(u, v)], 1)


def _axis_turns() -> tuple[Tensor, Tensor]:
    """(24, 4) float64 quaternions of the rotations that bring axes to axes, the identity first; and (24, 3) int64,
    which of the old axes each new one is."""
    found = []
    for signed in product((0, 1, 2), (0, 1, 2), (0, 1, 2), (1.0, -1.0), (1.0, -1.0), (1.0, -1.0)):
        matrix = np.zeros((3, 3))
        matrix[signed[:3], (0, 1, 2)] = signed[3:]
        if np.linalg.det(matrix) > 0.5:
            found.append(matrix)
    turns = np.stack(found)
    return torch.from_numpy(numpy_quaternions(turns)), torch.from_numpy(np.abs(turns).argmax(1))


AXIS_TURNS, TURNED_AXES = _axis_turns()
KEEPS_NORMAL = (TURNED_AXES[:, 2] == 2).nonzero()[:, 0]
"""(8,) int64, the turns for discs, whose third axis is the normal."""
