"""Depth maps for a run that needs them and whose data set has none."""

from __future__ import annotations

import shlex
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path

from surfkit.core.check import BadInput
from surfkit.core.codec import read_json
from surfkit.core.events import Warned, emit
from surfkit.core.lock import mark_used
from surfkit.core.registry import name_of
from surfkit.depth.base import DepthEstimator, KnownSurfaces
from surfkit.depth.depth_map_cache import key_of, maps
from surfkit.depth.prepare_depth_maps import REMEDY, WITHOUT_DEPTH, DepthPreparation, others_warning
from surfkit.io.datasets.depth_files import DEPTH_FOLDER, DepthFile
from surfkit.io.datasets.depth_map_index import is_there, located
from surfkit.io.datasets.depth_prior import prior_files
from surfkit.io.datasets.fingerprint import Fingerprint, fingerprint
from surfkit.io.datasets.read import observations
from surfkit.mesh.base import Mesher
from surfkit.raster.select import Device, torch_device
from surfkit.runs.folder import Run, read_data
from surfkit.runs.make_mesh import has_mesh
from surfkit.scene.scene import Scene
from surfkit.train.data_cache import CacheSettings
from surfkit.train.streaming import open_last

OTHER_MAPS = "what depth maps are made from, or how, has changed: the steps to come look at other maps"
"""Of a run, or a stage of it, that goes on."""


@contextmanager
def with_maps(
    run: Run, scene: Scene, prints: Fingerprint, caches: CacheSettings, device: Device, begun: bool
) -> Iterator[Run]:
    """Within, the run has the depth maps that it wants, as far as they can be had; nobody deletes them meanwhile.

    Those of the data set come first. Where it has none, they are made as the recipe says, or taken from the user's
    cache; a run that began without any goes on without.

    Args:
        run: The run.
        scene: Its data.
        prints: Of the data.
        caches: How much room the cache has; whether maps may be made.
        device: Where to make them.
        begun: Whether there is a state to go on from.

    Raises:
        BadInput: The run began with maps that are gone and may not be made again, or they cannot be made.
    """
    before = read_data(run.out).priors if run.record.exists() else None
    if not run.wants_priors or (begun and before is None):
        yield run
    elif files := prior_files(run.data, scene):
        tell_of_others(run, scene, files, caches.maps is not None)
        yield run
    elif before is not None and is_finished(run):
        yield with_priors(run, before)
    elif before is not None and caches.maps is None and is_there(before):
        with mark_used(located(before)):
            yield with_priors(run, before)
    elif run.recipe.depth is None or caches.maps is None:
        if begun:
            raise BadInput(f"{run.out}: the depth maps of the run are gone; leave out --no-prepare to make them again")
        yield run
    else:
        with ExitStack() as use:
            folder = use.enter_context(made_maps(run, run.recipe.depth, scene, prints, caches, device))
            if begun and folder is not None and before is not None and folder.name != before.name:
                emit(Warned(OTHER_MAPS))
            yield run if folder is None else with_priors(run, folder)


@contextmanager
def with_maps_to_mesh(run: Run, mesher: Mesher, scene: Scene, caches: CacheSettings, device: Device) -> Iterator[Run]:
    """Within, a trained run has the depth maps that a mesher wants, as far as they can be had.

    Those that it was trained with come first, then those of the data set. Where neither are there, they are made as the
    recipe of the run says, or taken from the user's cache.

    Raises:
        BadInput: They may not be made, or cannot.
    """
    if not mesher.needs_prior_of(scene.train, scene.frame):
        yield run
    else:
        with with_maps_of(run, scene, caches, device, "the mesh") as found:
            yield found


@contextmanager
def with_maps_of(run: Run, scene: Scene, caches: CacheSettings, device: Device, what: str) -> Iterator[Run]:
    """Within, a trained run has depth maps, as far as they can be had; `what` needs them. See `with_maps_to_mesh`."""
    before, own = run.data.priors, replace(run, data=replace(run.data, priors=None))
    if before is not None and is_there(before):
        with mark_used(located(before)):
            yield run
    elif prior_files(own.data, scene) or run.recipe.depth is None:
        yield own
    elif caches.maps is None:
        raise BadInput(
            f"{run.out}: {what} needs depth maps, and there are none; leave out --no-prepare to make them, or give "
            f"`surfkit prepare depth {shlex.quote(str(run.data.path))}` first"
        )
    else:
        prints = fingerprint(scene, read_json(run.inputs, Fingerprint) if run.inputs.exists() else None)
        with made_maps(own, run.recipe.depth, scene, prints, caches, device) as folder:
            yield own if folder is None else with_priors(own, folder)


@contextmanager
def made_maps(
    run: Run,
    estimator: DepthEstimator,
    scene: Scene,
    prints: Fingerprint,
    caches: CacheSettings,
    device: Device,
    known: KnownSurfaces | None = None,
) -> Iterator[Path | None]:
    """Within, there are maps as the recipe makes them: their folder, or None where the data do not allow any.

    `known`: what the estimator begins with.
    """
    preparation = DepthPreparation(run.data, estimator, torch_device(device), known=known)
    tracks = observations(run.data, scene)
    try:
        preparation.refuse_unfit(scene, tracks)
    except BadInput as error:
        emit(Warned(f"depth maps cannot be made: {error}"))
        yield None
        return
    if notice := estimator.notice():
        emit(Warned(notice))
    if known is None and (folder := run.data.path / DEPTH_FOLDER).is_dir():
        emit(Warned(f"{folder} has no map of these photographs, so others are made"))
    key = key_of(preparation, scene, prints, tracks)
    with maps(preparation, scene, tracks, key, caches.maps_bytes()) as (folder, made):
        count = f"{made.maps} of {len(scene.train)}" if made.without else made.maps
        how = f"made with {name_of(estimator)} in {made.cpu_seconds:.0f} s of CPU time"
        emit(Warned(f"depth maps of {count} photographs, {how}, are in {folder}"))
        if made.without:
            emit(Warned(f"the others give no depth: they cannot be read, {WITHOUT_DEPTH}"))
        yield folder


def tell_of_others(run: Run, scene: Scene, files: Mapping[str, DepthFile], others: bool) -> None:
    """Say so where surfkit made the maps of the data set otherwise than the recipe would, as its settings are unused.

    Args:
        run: The run.
        scene: Its data.
        files: Its maps.
        others: Whether others may be made.
    """
    longest, own = max(max(view.camera.width, view.camera.height) for view in scene.train), run.recipe.depth
    if own is not None and (text := others_warning(run.data.path, files.values(), own, longest)):
        emit(Warned(f"{text}{REMEDY if others else ''}"))


def with_priors(run: Run, folder: Path) -> Run:
    """The run with depth maps of a folder of the cache."""
    return replace(run, data=replace(run.data, priors=folder))


def is_finished(run: Run) -> bool:
    """Whether nothing is left to do that needs depth maps."""
    if not run.metrics.exists() or (found := open_last(run.last.checkpoint)) is None:
        return False
    index = found[0].state.index
    needs_mesh = run.recipe.mesh is not None and run.recipe.mesh.needs_prior
    return index >= run.last.stage.steps and (not needs_mesh or has_mesh(run, index))
