"""What doctor says of depth priors: whether there are any, and what training will find wrong with them."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace

from surfkit.apps.doctor.finding import Finding, from_errors
from surfkit.apps.doctor.gather import Gathered, depth_maps, heard
from surfkit.core.check import BadInput, few
from surfkit.core.events import reading_again
from surfkit.core.registry import name_of
from surfkit.depth.base import DepthEstimator
from surfkit.depth.prepare_depth_maps import REMEDY, others_warning
from surfkit.io.datasets.data import Data
from surfkit.io.datasets.depth_prior import SWITCHED_OFF, alignment, normals_warning, prepare_command
from surfkit.io.datasets.panoramas import has_panoramas, points_remedy, view_names, view_sizes
from surfkit.io.datasets.read import build_scene, reader_of
from surfkit.runs.recipe import Recipe
from surfkit.train.data_cache import needs_normals, needs_priors


def priors(data: Data, gathered: Gathered, recipe: Recipe, quick: bool) -> list[Finding]:
    """Depth priors, where the recipe uses them; with `quick`, their numbers are not looked at."""
    train, losses = gathered.train, recipe.pretrain.losses
    names = view_names(train)
    stereo = recipe.start.needs_prior or recipe.method.needs_prior
    if not train or not (stereo or needs_priors(losses)):
        return []
    normals = needs_normals(losses)
    try:
        maps = depth_maps(data, gathered)
        matched = has_panoramas(names) if recipe.depth is None else recipe.depth.matched
        tracks = bool(maps) or not matched or _has_tracks(data, gathered)
    except BadInput as error:
        return from_errors("depth-priors", [error])
    make = prepare_command(data) if tracks else points_remedy(data.path, names)
    if not tracks and recipe.depth is not None:
        text = "there are no depth priors, and none can be made, as no photograph observes any sparse point"
        text = f"the run begins at depth maps: {text}" if stereo else f"{text}, so {SWITCHED_OFF}"
        lacking = Finding("error" if stereo else "warning", "depth-priors", f"{text}; {make}")
        return [lacking, *(_normals_to_come(recipe.depth) if normals else [])]
    if not maps and recipe.depth is not None:
        text = f"there are no depth priors, so the run makes them, {len(names)} maps with {name_of(recipe.depth)}"
        return [Finding("note", "depth-priors", text), *(_normals_to_come(recipe.depth) if normals else [])]
    if not maps and stereo:
        begins = f"method:{name_of(recipe.method)} needs" if recipe.method.needs_prior else "the run begins at"
        return [Finding("error", "depth-priors", f"{begins} depth maps, and there are none; {make}")]
    if not maps:
        text = f"the recipe uses depth priors, and there are no depth priors, so {SWITCHED_OFF}; {make}"
        return [Finding("warning", "depth-priors", text)]
    found = []
    if missing := [name for name in names if name not in maps]:
        text = f"{len(missing)} of {len(names)} photographs have no depth prior, {few(missing)}; {make}"
        found.append(Finding("warning", "depth-priors", text, tuple(missing)))
    sizes = [view_sizes(data, shot, (shot.camera.width, shot.camera.height)) for shot in train]
    longest = max(side for views in sizes for size in views for side in size)
    if recipe.depth is not None and (others := others_warning(data.path, maps.values(), recipe.depth, longest)):
        found.append(Finding("warning", "depth-priors", f"{others}{REMEDY}"))
    if normals and (bare := normals_warning(data, list(maps.values()))):
        found.append(Finding("warning", "prior-normals", bare))
    return found if quick else [*found, *_numbers(data, gathered, maps)]


def _has_tracks(data: Data, gathered: Gathered) -> bool:
    """Whether any photograph is known to observe a sparse point, without which none can be compared."""
    if gathered.capture.groups:
        return True
    try:
        with reading_again():
            tracks = reader_of(data).tracks(data)
    except BadInput:
        return True  # what cannot be read is told already, and may observe some
    return tracks is not None and any(len(rows) for rows, _ in tracks.seen.values())


def _numbers(data: Data, gathered: Gathered, maps: Collection[str]) -> list[Finding]:
    """What training will say of the numbers in the maps."""
    shots = [shot for shot in gathered.capture.shots if shot.path.is_file()]
    capture = replace(gathered.capture, shots=shots)
    with heard():  # of these, doctor tells in its own words
        try:
            scene = build_scene(data, capture, only=set(maps), pixels=False)
        except BadInput:
            return []
    with heard() as said:
        try:
            alignment(data, scene)
        except BadInput as error:
            return from_errors("depth-maps", [error])
    return [Finding("warning", "depth-maps", text) for text in said]


def _normals_to_come(estimator: DepthEstimator) -> list[Finding]:
    """Maps that the run makes have no normals if its estimator gives none."""
    if estimator.oriented:
        return []
    text = (
        f"the loss normal-prior learns nothing from depth priors without normals, and {name_of(estimator)} gives none; "
        "depth:patch-match does"
    )
    return [Finding("warning", "prior-normals", text)]
