"""Checks of what looks at photographs: losses, regularizers, transients, appearance models, estimators of depth.

Each check returns nothing and raises AssertionError with a sentence that says what is wrong.
"""

from __future__ import annotations

import math
import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import torch
from torch import Tensor
from torch.nn.functional import interpolate

from surfkit.appearance.base import Appearance, PhotoLight, joined
from surfkit.depth.base import DepthEstimator, DepthInput, Estimate
from surfkit.depth.fill_base import Fill, FillInput
from surfkit.losses.base import Loss, Regularizer, RegularizerInput, Target
from surfkit.losses.transients import Transients
from surfkit.primitives.surfel2d import Surfel2D
from surfkit.raster.api import Splats
from surfkit.scene.camera import Camera
from surfkit.scene.response import OF_CAMERA, STOPS
from surfkit.testing.equality import assert_same, assert_tensor, twin, unchanged
from surfkit.testing.inputs import cloud, depth_input, maps, splats, target
from surfkit.testing.synthetic import Synthetic

DETERMINISM_HINT = "it may depend on its inputs and settings only"


def check_loss(loss: Loss, size: tuple[int, int] = (24, 32)) -> None:
    """A loss is one finite number that repeats itself, with finite gradients, also where nothing was rendered, where no
    depth and no normals are known beforehand, and where there is no second view; it uses no map but those it says it
    reads, changes none of its inputs, and its weight is 0 or more at any step.

    Args:
        loss: To check.
        size: (H, W) pixels of the pictures it is given.
    """
    name = type(loss).__name__
    _check_weights(loss)
    draw = torch.Generator().manual_seed(0)
    given = target(size, draw)
    cases = [("", torch.rand(size, generator=draw), given), (" of an empty render", torch.zeros(size), given)]
    assert given.prior is not None, "`target` has one"
    without = {
        " without a depth prior": replace(given, prior=None),
        " without prior normals": replace(given, prior=replace(given.prior, normal=None)),
        " without a neighbour": replace(given, neighbour=None),
    }
    cases += [(what, torch.rand(size, generator=draw), less) for what, less in without.items()]
    for what, alpha, about in cases:
        drawn = maps(alpha, loss.reads, draw)
        leaves = {key: value.requires_grad_() for key, value in drawn.present().items()}
        with unchanged(name, maps=drawn, target=about):
            value = loss(drawn, about)
        assert_tensor(name, value)
        assert value.shape == (), f"{name} gives shape {tuple(value.shape)}, not one number"
        assert torch.isfinite(value), f"{name}{what} is {value.item()}"
        assert torch.equal(value, loss(drawn, about)), f"{name} is not repeatable; draw from `target.seed`"
        _check_gradients(f"{name}{what}", value, leaves)


def check_regularizer(regularizer: Regularizer, given: Splats | None = None) -> None:
    """A regularizer is one finite number that repeats itself, with finite gradients by the splats' tensors, for surfels
    and ellipsoids, of the splats alone and in a step, also of a view that shows none of them; it uses no map but those
    it says it reads, keeps nothing but in its columns, which a resumed run has too, and its weight is 0 or more at any
    step.

    Args:
        regularizer: To check.
        given: What it looks at, for one that knows the splats of a certain primitive only; random surfels and
            ellipsoids if None.
    """
    name = type(regularizer).__name__
    _check_weights(regularizer)
    for each in [splats("surfel"), splats("gaussian")] if given is None else [given]:
        leaves = {key: value.detach().clone() for key, value in each.named().items()}
        leaves = {key: value.requires_grad_(value.is_floating_point()) for key, value in leaves.items()}
        given, kind = each.with_named(leaves), each.kind
        leaves = {key: value for key, value in leaves.items() if value.requires_grad}
        with unchanged(name, splats=given):
            value = regularizer(given)
        _check_number(f"{name} of {kind}s", value, leaves)
        assert torch.equal(value, regularizer(given)), f"{name} is not repeatable; {DETERMINISM_HINT}"
        if regularizer.only_seen:
            nothing = regularizer(given.first(0))
            assert torch.isfinite(nothing), f"{name} of no {kind} is {nothing.item()}; a view may show none"
        shown, empty = torch.ones(len(given), dtype=torch.bool), torch.zeros(len(given), dtype=torch.bool)
        for what, seen in {" in a step": shown, " of a view that shows none": empty}.items():
            _check_in_step(f"{name} of {kind}s{what}", regularizer, given, seen)


def _check_in_step(name: str, regularizer: Regularizer, given: Splats, seen: Tensor) -> None:
    """A term in some steps, and again with the columns that it has kept in between."""
    draw, size = torch.Generator().manual_seed(0), (24, 32)
    columns: dict[str, Tensor] = {}
    about, alpha = target(size, draw), torch.rand(size, generator=draw)
    drawn = maps(alpha if seen.any() else torch.zeros(size), {"color", "alpha", *regularizer.reads}, draw)
    step = RegularizerInput(1_000, 30_000, about, drawn, seen, _stats(columns, len(given)))
    for index in (1_000, 1_001):
        step, kept = replace(step, index=index), {key: value.clone() for key, value in columns.items()}
        _check_with_maps(f"{name}.with_maps", regularizer, given, replace(step, stat=_stats(kept, len(given))))
        with unchanged(f"{name}.in_step", splats=given, target=about, maps=drawn, seen=seen):
            value = regularizer.in_step(given, step)
        assert_tensor(name, value)
        assert value.shape == (), f"{name} gives shape {tuple(value.shape)}, not one number"
        assert torch.isfinite(value), f"{name} is {value.item()}"
        resumed = twin(regularizer).in_step(given, replace(step, stat=_stats(kept, len(given))))
        assert torch.equal(value, resumed), f"{name}: a resumed run differs; draw from `target.seed`, keep in `stat`"
        _check_gradients(name, value, {key: each for key, each in given.named().items() if each.requires_grad})


def _check_with_maps(name: str, regularizer: Regularizer, given: Splats, step: RegularizerInput) -> None:
    """The part that moves maps, if there is one, is a finite number with finite gradients by splats and maps."""
    leaves = {key: value.clone().requires_grad_() for key, value in step.maps.present().items()}
    step = replace(step, maps=replace(step.maps, **leaves))
    with unchanged(name, splats=given, target=step.target, maps=step.maps, seen=step.seen):
        value = regularizer.with_maps(given, step)
    if value is not None:
        assert value.shape == () and torch.isfinite(value), f"{name} gives {value}, not one finite number"
        own = {key: each for key, each in given.named().items() if each.requires_grad}
        _check_gradients(name, value, own | leaves)


def _stats(columns: dict[str, Tensor], count: int) -> Callable[..., Tensor]:
    def stat(name: str, *shape: int) -> Tensor:
        return columns.setdefault(name, torch.zeros(count, *shape))

    return stat


def _check_number(what: str, value: Tensor, leaves: Mapping[str, Tensor]) -> None:
    """A scalar that is finite, with finite gradients by some leaves."""
    name = what.split(" ")[0]
    assert value.shape == (), f"{name} gives shape {tuple(value.shape)}, not one number"
    assert torch.isfinite(value), f"{what} is {value.item()}"
    _check_gradients(what, value, leaves)


def check_transients(transients: Transients, size: tuple[int, int] = (24, 32)) -> None:
    """What finds transients says of each pixel whether it is kept, or nothing, at any step, also where nothing was
    rendered and where a mask covers some or all of the photograph; it says the same again, whatever it was asked in
    between, and changes none of its inputs.

    Args:
        transients: To check, with settings that leave something out of a photograph of something else.
        size: (H, W) pixels of the pictures it is given.
    """
    name, draw = type(transients).__name__, torch.Generator().manual_seed(0)
    given, render = target(size, draw), torch.rand(3, *size, generator=draw)
    cases: dict[str, tuple[Tensor, Target]] = {
        "": (render, given),
        " of an empty render": (torch.zeros(3, *size), given),
        " with a mask": (render, replace(given, mask=torch.rand(size, generator=draw) > 0.5)),
        " with a mask that covers all": (render, replace(given, mask=torch.zeros(size, dtype=torch.bool))),
    }
    steps = [(1, 1_000), (500, 1_000), (30_000, 30_000)]
    found = {}
    for what, (color, about) in cases.items():
        for at in steps:
            with unchanged(name, color=color, target=about):
                kept = transients.kept(color, about, *at)
            if kept is not None:
                assert kept.shape == size, f"{name}{what} gives shape {tuple(kept.shape)}, not {size}"
                assert kept.dtype == torch.bool, f"{name}{what} gives {kept.dtype}, not bool"
            found[what, at] = kept
    assert any(kept is not None for kept in found.values()), f"{name} says nothing at any step"
    for (what, at), kept in found.items():
        again = twin(transients).kept(*cases[what], *at)
        assert_same(f"{name}.kept{what}", kept, again, "a resumed run would differ; keep nothing from step to step")


def check_appearance(appearance: Appearance) -> None:
    """An appearance model begins with numbers that change nothing, gives finite colours that are differentiable in
    colours and, if it learns them, in numbers, learns at a rate of 0 or more, and folds its mean into points of the
    same columns. So it is with numbers that all photographs share, if there are any. A model that needs the light of
    photographs begins with it: no change of light is no change of colours. One that knows the way back learns nothing,
    and what it makes of the colours of a photograph leads to these again.

    Args:
        appearance: To check.
    """
    name, draw = type(appearance).__name__, torch.Generator().manual_seed(0)
    rates = [appearance.rate_at(*at) for at in ((1, 1_000), (500, 1_000), (1_000, 1_000), (30_000, 30_000))]
    _check_rates(name, rates)
    assert any(rates) or appearance.needs_light, f"{name}: the learning rate is 0 throughout, so nothing is learned"
    numbers, color = appearance.begin(5), torch.rand(3, 12, 16, generator=draw)
    camera = Camera(torch.eye(4, dtype=torch.float64), 15.0, 15.0, 8.0, 6.0, 16, 12)
    assert_tensor(f"{name}.begin", numbers)
    assert len(numbers) == 5, f"{name}.begin(5) has {len(numbers)} rows"
    assert torch.isfinite(numbers).all(), f"{name}.begin is not finite"
    assert_same(f"{name}.begin", numbers, appearance.begin(5), DETERMINISM_HINT)
    shared = appearance.begin_shared()
    assert shared.dim() == 1, f"{name}.begin_shared has shape {tuple(shared.shape)}, not (S,)"
    assert torch.isfinite(shared).all(), f"{name}.begin_shared is not finite"
    assert_same(f"{name}.begin_shared", shared, appearance.begin_shared(), DETERMINISM_HINT)
    if appearance.needs_light:
        none = PhotoLight(torch.zeros(5, STOPS), torch.zeros(5, OF_CAMERA))
        assert_same(f"{name}.begin_with, of light that did not change,", numbers, appearance.begin_with(none), "")
    for at, row in enumerate(numbers):
        shown = appearance(joined(row, shared), color, camera)
        assert_tensor(name, shown)
        assert shown.shape == color.shape, f"{name} gives shape {tuple(shown.shape)}, not {tuple(color.shape)}"
        same = torch.allclose(shown, color, atol=1e-5)
        assert same, f"{name}: the numbers that photograph {at} begins with change its colours"
    moved, common = (
        (value + 0.1 * torch.randn(value.shape, generator=draw)).requires_grad_() for value in (numbers[0], shared)
    )
    with unchanged(name, numbers=moved, shared=common, color=color):
        shown = appearance(joined(moved, common), color.requires_grad_(), camera)
    assert shown.shape == color.shape, f"{name} gives colours of shape {tuple(shown.shape)}, not {tuple(color.shape)}"
    assert torch.isfinite(shown).all(), f"{name} gives colours that are not finite"
    assert shown.requires_grad, f"{name} gives no gradient: what it returns has no graph"
    leaves = {"colours": color} | ({"numbers": moved} if any(rates) else {})
    leaves |= {"shared numbers": common} if len(shared) else {}
    for what, leaf in leaves.items():
        grad = torch.autograd.grad(shown.square().sum(), leaf, retain_graph=True, allow_unused=True)[0]
        assert grad is not None and grad.any(), f"{name} gives no gradient by the {what}"
        assert torch.isfinite(grad).all(), f"{name}: the gradient by the {what} is not finite"
    _check_way_back(name, appearance, joined(moved, common).detach(), shown.detach().clamp(0, 1), camera, any(rates))
    params = Surfel2D(sh_degree=1).init(cloud(), torch.Generator().manual_seed(0))
    with unchanged(f"{name}.folded", numbers=numbers, params=params):
        folded = appearance.folded(numbers, params)
    assert isinstance(folded, Mapping), f"{name}.folded gives {type(folded).__name__}, not columns by name"
    shapes = [{key: tuple(value.shape) for key, value in columns.items()} for columns in (params, folded)]
    assert shapes[0] == shapes[1], f"{name}.folded gives columns of shapes {shapes[1]}, not {shapes[0]}"
    for key, value in folded.items():
        close = torch.allclose(value, params[key], atol=1e-5)
        assert close, f"{name}.folded changes {key!r} for numbers that change no photograph"


def _check_way_back(
    name: str, appearance: Appearance, numbers: Tensor, photo: Tensor, camera: Camera, learns: bool
) -> None:
    """`of_scene`, if the model has one, of a photograph (3, H, W)."""
    found = appearance.of_scene(numbers, photo, camera)
    if found is None:
        return
    assert not learns, f"{name}.of_scene: its numbers are learned, and photographs in the light of the scene teach none"
    scene, least = found
    assert scene.shape == least.shape == photo.shape, f"{name}.of_scene gives shapes {[tuple(t.shape) for t in found]}"
    assert least.dtype == torch.bool, f"{name}.of_scene gives {least.dtype} where the scene may be brighter, not bool"
    clear = ~least & (scene < 1)
    off = (appearance(numbers, scene, camera) - photo)[clear].abs()
    assert len(off) and off.max() < 0.02, f"{name}.of_scene: the way back does not lead to the photograph"


def check_depth_estimator(estimator: DepthEstimator) -> None:
    """An estimator gives inverse depths, confidences and normals in their ranges for the photographs that were wanted,
    in the units of the scene if it is `aligned`; the same ones again, and after an interruption too.

    Args:
        estimator: With settings for nine photographs of 72 x 54 pixels.

    Raises:
        BadInput: The estimator cannot work on this machine, or its settings do not fit these photographs.
    """
    name, wanted = type(estimator).__name__, [7, 4]
    with tempfile.TemporaryDirectory() as place:
        given, truth = depth_input(Path(place))
        fresh = replace(given, work=Path(place) / "again")
        fresh.work.mkdir()
        estimator.refuse_unfit(given.views)
        with unchanged(f"{name}.estimate", given=given):
            found = list(estimator.estimate(given, wanted))
        got = [estimate.at for estimate in found]
        assert sorted(got) == sorted(wanted), f"{name} gives the photographs {got}; {wanted} were wanted"
        for estimate in found:
            _check_estimate(name, estimator, estimate, given.views[estimate.at].camera)
        if estimator.aligned:
            _check_units(name, given, truth, found)
        one = next(iter(estimator.estimate(fresh, wanted)))
        others = [at for at in wanted if at != one.at]
        resumed = {estimate.at: estimate for estimate in [one, *estimator.estimate(fresh, others)]}
    for estimate in found:
        again = resumed[estimate.at]
        assert_same(f"{name}.estimate of a photograph after an interruption", estimate, again, DETERMINISM_HINT)


def check_fill(fill: Fill) -> None:
    """A fill gives finite inverse depths of 0 or more for true maps with a hole in each, of about the true depth where
    it fills; none where nothing is trusted; the same ones again.

    Args:
        fill: With settings for photographs of 72 x 54 pixels.

    Raises:
        BadInput: The fill cannot work on this machine.
    """
    name, wanted = type(fill).__name__, [7, 4]
    fill.refuse_missing()
    with tempfile.TemporaryDirectory() as place:
        given, truth = depth_input(Path(place))
        maps = [_with_hole(given, truth, at) for at in wanted]
        answers = []
        for _ in range(2):
            work = fill.opened(given, wanted)
            with unchanged(f"{name}.opened", maps=maps):
                answers.append([work(each) for each in maps])
        blind = fill.opened(given, wanted)
        none = [blind(replace(each, inverse=torch.zeros_like(each.inverse), trust=each.trust * 0)) for each in maps]
    for each, values, again, nothing in zip(maps, *answers, none, strict=True):
        shape = tuple(each.inverse.shape)
        right = values.dtype == torch.float32 and tuple(values.shape) == shape
        assert right, f"{name} gives {values.dtype} of shape {tuple(values.shape)}, not float32 of {shape}"
        assert torch.isfinite(values).all() and (values >= 0).all(), f"{name}: an inverse depth is not 0 or more"
        assert_same(f"{name}.opened", values, again, DETERMINISM_HINT)
        assert not (nothing > 0).any(), f"{name} fills pixels where no depth is trusted that it could be fitted to"
        depth = truth.exact[given.views[each.at].name].depth.float()
        filled = each.holes & (values > 0) & (depth > 0)
        if filled.any():
            middle = float((values * depth)[filled].median())
            assert 0.9 < middle < 1.1, f"{name}: what it fills has {middle:.3g} times the inverse depth of the scene"


def _with_hole(given: DepthInput, truth: Synthetic, at: int) -> FillInput:
    """The true map of a view with a hole in the middle, beside those of all other views."""
    maps = []
    for view in given.views:
        depth = truth.exact[view.name].depth
        maps.append((view.camera, torch.where(depth > 0, 1 / depth, 0).float()))
    photo = truth.exact[given.views[at].name].color.float()
    camera, inverse = maps.pop(at)
    inverse = inverse.clone()
    inverse[22:32, 30:42] = 0
    return FillInput(at, photo, camera, inverse, (inverse > 0).float(), maps)


def _check_estimate(name: str, estimator: DepthEstimator, estimate: Estimate, camera: Camera) -> None:
    inverse, confidence, normal = estimate.inverse, estimate.confidence, estimate.normal
    assert (inverse is None) == (confidence is None), f"{name}: inverse and confidence must be given both, or neither"
    if inverse is None or confidence is None:
        return
    for what, value in {"inverse": inverse, "confidence": confidence}.items():
        assert value.dtype == torch.float32, f"{name}: {what} is {value.dtype}, not float32"
        assert value.dim() == 2, f"{name}: {what} has shape {tuple(value.shape)}, not (h, w)"
        assert torch.isfinite(value).all(), f"{name}: {what} is not finite; write 0 where there is none"
    assert inverse.shape == confidence.shape, f"{name}: inverse and confidence have different shapes"
    told = estimator.of_map(camera)
    size = f"{inverse.shape[1]} x {inverse.shape[0]} px, and {name}.of_map tells {told.width} x {told.height}"
    assert inverse.shape == (told.height, told.width), f"{name}: a map has {size}: the time of maps is foretold by it"
    assert (inverse >= 0).all(), f"{name}: an inverse depth is below 0"
    assert ((confidence >= 0) & (confidence <= 1)).all(), f"{name}: confidence must lie in [0, 1]"
    assert (normal is not None) == estimator.oriented, f"{name}: normals are given if and only if it is `oriented`"
    if normal is not None:
        assert normal.shape == (3, *inverse.shape), f"{name}: normal has shape {tuple(normal.shape)}, not (3, h, w)"
        length = normal.norm(dim=0)
        unit = ((length - 1).abs() < 1e-3) | (length == 0)
        assert unit.all(), f"{name}: a normal is neither of length 1 nor 0"
        rays = torch.nn.functional.normalize(camera.resized(inverse.shape[1], inverse.shape[0]).rays(), dim=0)
        away = (normal * rays).sum(0) > 0.2
        assert not away.any(), f"{name}: a normal points away from the camera; its axes are x right, y down, z forward"


def _check_units(name: str, given: DepthInput, truth: Synthetic, found: Sequence[Estimate]) -> None:
    """Where an aligned estimator is confident, its depths are about the true ones."""
    ratios = []
    for estimate in found:
        if estimate.inverse is None or estimate.confidence is None:
            continue
        depth = truth.exact[given.views[estimate.at].name].depth.float()
        depth = interpolate(depth[None, None], size=estimate.inverse.shape)[0, 0]
        sure = (estimate.confidence > 0.5) & (depth > 0) & (estimate.inverse > 0)
        ratios.append((estimate.inverse * depth)[sure])
    sure = torch.cat(ratios) if ratios else torch.zeros(0)
    assert len(sure), f"{name} is confident nowhere; give it settings for photographs of 72 x 54 pixels"
    middle = float(sure.median())
    assert 0.8 < middle < 1.25, f"{name} is `aligned`, but its inverse depths are {middle:.3g} times those of the scene"


def _check_weights(term: Loss | Regularizer) -> None:
    for index in (1, 500, 1_000):
        weight = term.weight_at(index, 1_000)
        valid = math.isfinite(weight) and weight >= 0
        assert valid, f"{type(term).__name__}: the weight at step {index} of 1000 is {weight}"


def _check_rates(name: str, rates: Sequence[float]) -> None:
    for rate in rates:
        assert math.isfinite(rate) and rate >= 0, f"{name}: the learning rate {rate} is not a number of 0 or more"


def _check_gradients(what: str, value: Tensor, leaves: Mapping[str, Tensor]) -> None:
    """A scalar depends on some of the leaves, and its gradients by all of them are finite."""
    assert value.requires_grad, f"{what} does not depend on {', '.join(leaves)}"
    grads = torch.autograd.grad(value, list(leaves.values()), allow_unused=True)
    assert any(grad is not None for grad in grads), f"{what} does not depend on {', '.join(leaves)}"
    for key, grad in zip(leaves, grads, strict=True):
        assert grad is None or torch.isfinite(grad).all(), f"{what}: the gradient of {key!r} is not finite"
