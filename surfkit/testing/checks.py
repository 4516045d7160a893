"""Checks for the tests of plugins: what any component, built in or third party, must keep to.

Each check returns nothing and raises AssertionError with a sentence that says what is wrong.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from surfkit.core.codec import dump, load
from surfkit.core.describe import settings, summary
from surfkit.core.registry import Component, kind_of

if TYPE_CHECKING:
    from torch import Generator, Tensor

    from surfkit.densify.base import Policy, Step
    from surfkit.losses.base import Loss, Target
    from surfkit.mesh.base import Mesher, MeshInput
    from surfkit.partition.base import CoarseModel, Partition
    from surfkit.primitives.base import Primitive
    from surfkit.primitives.points import Columns, Points
    from surfkit.raster.api import Maps
    from surfkit.refine.base import Refine
    from surfkit.scene.scene import View


def check_component(part: Component) -> None:
    """A component survives the way to JSON and back, and tells what it and each of its settings is for."""
    cls = type(part)
    assert summary(cls), f"{cls.__name__} needs a docstring: it is the line that `surfkit components` shows"
    for setting in settings(cls):
        assert setting.help, (
            f"{cls.__name__}.{setting.name} needs a docstring under it: it is the help text of the flag"
        )
    text = json.dumps(dump(part), allow_nan=False)
    again = load(kind_of(cls), json.loads(text))
    assert again == part, f"{cls.__name__} came back from JSON as {again!r} instead of {part!r}"


def check_policy(policy: Policy, points: Points, step: Step) -> None:
    """A policy asks for masks of the right shape, changes no parameter, keeps its statistics whole and repeats itself.

    Args:
        policy: With settings that make it act at `step`, or the check says little.
        points: N points.
        step: About those N points.
    """
    import torch

    name = type(policy).__name__
    before = {key: value.clone() for key, value in points.params.items()}
    policy.watch(points, step)
    stats = {key: value.clone() for key, value in points.stats.items()}
    first, second = policy.edit(points, step), policy.edit(points, step)
    for key, value in points.params.items():
        assert torch.equal(value, before[key]), f"{name} changed the parameter {key!r}; return an Edit instead"
    for key, value in points.stats.items():
        assert value.shape == (len(points),), f"{name}: the statistic {key!r} has shape {tuple(value.shape)}, not (N,)"
        assert key not in stats or torch.equal(value, stats[key]), f"{name}.edit changed {key!r}; only watch may"
    assert (first is None) == (second is None), f"{name}.edit is not repeatable"
    if first is None:
        return
    assert first.max_opacity == second.max_opacity, f"{name}.edit is not repeatable"
    assert first.max_opacity is None or 0 < first.max_opacity < 1, f"{name}: max_opacity must lie between 0 and 1"
    for key in ("drop", "clone", "split", "forget"):
        counts = key == "clone"
        _check_mask(f"{name}: {key}", getattr(first, key), getattr(second, key), len(points), counts)
    for key, shape in (("move", (len(points), 3)), ("opacities", (len(points),)), ("scale_by", (len(points),))):
        value, again = getattr(first, key), getattr(second, key)
        if value is None:
            assert again is None, f"{name}.edit is not repeatable"
            continue
        assert value.shape == shape, f"{name}: {key} has shape {tuple(value.shape)}, not {shape}"
        assert torch.equal(value.nan_to_num(-1), again.nan_to_num(-1)), f"{name}.edit is not repeatable: `step.seed`"
    if first.opacities is not None:
        wanted = first.opacities[~first.opacities.isnan()]
        assert bool(((wanted > 0) & (wanted < 1)).all()), f"{name}: opacities must lie between 0 and 1, or be NaN"
    assert first.scale_by is None or bool((first.scale_by > 0).all()), f"{name}: factors of scales must be above 0"


def check_loss(loss: Loss, size: tuple[int, int] = (24, 32)) -> None:
    """A loss is one finite number that repeats itself, with finite gradients, also where nothing was rendered, where no
    depth and no normals are known beforehand, and where there is no second view; it uses no map but those it says it
    reads, and its weight is 0 or more at any step.

    Args:
        loss: To check.
        size: (H, W) pixels of the pictures it is given.
    """
    import torch

    name = type(loss).__name__
    for index in (1, 500, 1_000):
        weight = loss.weight_at(index, 1_000)
        assert math.isfinite(weight) and weight >= 0, f"{name}: the weight at step {index} of 1000 is {weight}"
    draw = torch.Generator().manual_seed(0)
    target = _target(size, draw)
    cases = [("", torch.rand(size, generator=draw), target), (" of an empty render", torch.zeros(size), target)]
    without = {
        " without a depth prior": replace(target, prior=None),
        " without prior normals": replace(target, prior=replace(target.prior, normal=None)),
        " without a neighbour": replace(target, neighbour=None),
    }
    cases += [(what, torch.rand(size, generator=draw), less) for what, less in without.items()]
    for what, alpha, target in cases:
        maps = _maps(alpha, loss.reads, draw)
        leaves = {key: value.requires_grad_() for key, value in maps.present().items()}
        value, again = loss(maps, target), loss(maps, target)
        assert value.shape == (), f"{name} gives shape {tuple(value.shape)}, not one number"
        assert torch.isfinite(value), f"{name}{what} is {value.item()}"
        assert torch.equal(value, again), f"{name} is not repeatable"
        assert value.requires_grad, f"{name}{what} does not depend on {', '.join(loss.reads)}"
        grads = torch.autograd.grad(value, list(leaves.values()), allow_unused=True)
        for key, grad in zip(leaves, grads, strict=True):
            assert grad is None or torch.isfinite(grad).all(), f"{name}{what}: the gradient of {key!r} is not finite"


def _target(size: tuple[int, int], draw: Generator) -> Target:
    import torch

    from surfkit.losses.base import Neighbour, Target
    from surfkit.readers.depth_prior import DepthPrior
    from surfkit.scene.camera import Camera
    from surfkit.scene.scene import View

    height, width = size
    camera = Camera(torch.eye(4, dtype=torch.float64), 30.0, 30.0, width / 2, height / 2, width, height)
    view, photo = View("random.png", camera, Path("random.png")), torch.rand(3, *size, generator=draw)
    there = torch.rand(size, generator=draw) > 0.2
    inverse = torch.where(there, 0.5 + torch.rand(size, generator=draw), 0.0)
    normal = there * torch.nn.functional.normalize(torch.randn(3, *size, generator=draw), dim=0)
    prior = DepthPrior(inverse, torch.rand(size, generator=draw) * there, 0.8, normal)
    beside = camera.world_to_camera.clone()
    beside[0, 3] = 0.02  # less than a pixel of parallax, at any depth
    view_beside = View("beside.png", replace(camera, world_to_camera=beside), Path("beside.png"))
    maps = _maps(torch.ones(size), ("alpha", "depth", "median", "normal"), draw)
    return Target(view, photo, prior, neighbour=Neighbour(view_beside, torch.rand(3, *size, generator=draw), maps))


def _maps(alpha: Tensor, reads: Iterable[str], draw: Generator) -> Maps:
    """Random maps that fit together, of the names in `reads`; all 0 where `alpha` is."""
    import torch

    from surfkit.raster.api import Maps

    depth = 1 + torch.rand(alpha.shape, generator=draw)
    normal = torch.nn.functional.normalize(torch.randn(3, *alpha.shape, generator=draw), dim=0)
    everything = {
        "color": alpha * torch.rand(3, *alpha.shape, generator=draw),
        "alpha": alpha,
        "depth": alpha * depth,
        "median": torch.where(alpha > 0.5, depth, 0.0),
        "normal": alpha * normal,
        "distortion": alpha**2 * 0.01,
    }
    return Maps(**{name: everything[name].detach().clone() for name in reads})


def _check_mask(what: str, mask: Tensor | None, again: Tensor | None, count: int, counts: bool) -> None:
    import torch

    assert (mask is None) == (again is None), f"{what} is not repeatable"
    if mask is not None and again is not None:
        allowed = (torch.bool, torch.int64) if counts else (torch.bool,)
        assert mask.dtype in allowed, f"{what} is {mask.dtype}, not bool{' or int64' * counts}"
        assert mask.shape == (count,), f"{what} has shape {tuple(mask.shape)}, not ({count},)"
        assert torch.equal(mask, again), f"{what} is not repeatable"


def check_partition(partition: Partition, sight: CoarseModel) -> None:
    """Its cells own every place exactly once, far away and on their sides too, and come out the same again."""
    import torch

    cells = partition.cells(sight)
    assert cells == partition.cells(sight), "the same model gives other cells"
    assert sorted(set(cells.blocks)) == list(range(cells.count)), "blocks are not counted from 0 without gaps"
    assert len(cells.boxes) == len(cells.blocks), "each box belongs to one block"
    generator = torch.Generator().manual_seed(0)
    far = torch.randn(2_000, 3, generator=generator, dtype=torch.float64) * torch.logspace(-2, 4, 2_000)[:, None]
    places = torch.cat([far, sight.splats.means.double(), sight.centres])
    single = [replace(cells, boxes=(box,), blocks=(0,)).owner(places) == 0 for box in cells.boxes]
    owners = torch.stack(single).sum(0)
    assert int(owners.min()) == 1, "a place has no owner"
    assert int(owners.max()) == 1, "a place has two owners"


def check_refine(refine: Refine, primitive: Primitive, params: Columns, views: Sequence[View]) -> None:
    """It begins with points that its primitive can draw, changes none of those given, and sees the same views again.

    Args:
        refine: To check.
        primitive: What the points are before.
        params: N of them.
        views: Of the training photographs.
    """
    import torch

    from surfkit.primitives.columns import RATES
    from surfkit.scene.scene import Cloud

    name, before = type(refine).__name__, {key: value.clone() for key, value in params.items()}
    begun, after = refine.params(params), refine.primitive(primitive)
    assert all(torch.equal(value, before[key]) for key, value in params.items()), f"{name} changed what it was given"
    fresh = after.init(Cloud(torch.rand(4, 3), torch.zeros(4, 3, dtype=torch.uint8)), torch.Generator().manual_seed(0))
    shapes, wanted = ({key: value.shape[1:] for key, value in columns.items()} for columns in (begun, fresh))
    assert shapes == wanted, f"{name}: its points have the columns {shapes}, and what they are then has {wanted}"
    assert len({len(value) for value in begun.values()}) == 1, f"{name}: the columns differ in length"
    unknown = set(refine.stage.rates) - set(begun) - set(RATES)
    assert not unknown, f"{name}: stage.rates names {', '.join(sorted(unknown))}, which its points do not have"
    assert after.activate(begun, after.sh_degree).sh.shape[1] == (after.sh_degree + 1) ** 2
    seen, again = ([view.camera.centre.tolist() for view in refine.views(views, 0)] for _ in range(2))
    assert seen and seen == again, f"{name}: its views are not the same again"
    there = [view.camera.centre.tolist() for view in views]
    assert refine.taught or seen == there, f"{name} has photographs of the training views only"


def check_mesher(mesher: Mesher, subject: MeshInput) -> None:
    """Its mesh is whole, faces the cameras, and has the same area when it is made again."""
    import numpy as np
    import torch

    fresh = [replace(subject, generator=torch.Generator().manual_seed(1)) for _ in range(2)]
    mesh, again = (mesher.mesh(given) for given in fresh)
    assert len(mesh.faces), "there is no face"
    assert np.isfinite(mesh.vertices).all(), "a vertex is not finite"
    assert mesh.faces.min() >= 0 and mesh.faces.max() < len(mesh.vertices), "a face names a vertex that is not there"
    assert mesh.colors is None or mesh.colors.shape == mesh.vertices.shape, "colors are not one for each vertex"
    a, b, c = (mesh.vertices[mesh.faces[:, k]].astype(np.float64) for k in range(3))
    centres = torch.stack([view.camera.centre for view in subject.views]).numpy()
    nearest = centres[((a[:, None] - centres[None]) ** 2).sum(2).argmin(1)]
    towards = np.einsum("ni,ni->n", np.cross(b - a, c - a), nearest - a)
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    a, b, c = (again.vertices[again.faces[:, k]].astype(np.float64) for k in range(3))
    other = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    assert abs(area.sum() - other.sum()) <= 1e-3 * area.sum(), "the same splats give another surface"
    assert area[towards > 0].sum() > area[towards < 0].sum(), "most of the mesh faces away from the cameras"
