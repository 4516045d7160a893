"""Depth maps for a run that wants some and whose data set has none."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path

from surfkit.core.check import BadInput
from surfkit.core.codec import read_json
from surfkit.core.events import Warned, emit
from surfkit.core.lock import used
from surfkit.core.registry import name_of
from surfkit.depth.keep import key_of, maps
from surfkit.depth.prepare import WITHOUT_DEPTH, Preparation, torch_device
from surfkit.mesh.base import Mesher
from surfkit.raster.select import Device
from surfkit.readers.depth_files import FOLDER
from surfkit.readers.depth_prior import prior_files
from surfkit.readers.fingerprint import Fingerprint, fingerprint
from surfkit.readers.made_maps import is_there, located
from surfkit.readers.read import observations
from surfkit.run.folder import Run, read_data
from surfkit.run.mesh import meshed
from surfkit.scene.scene import Scene
from surfkit.train.material import Store
from surfkit.train.streaming import open_last


@contextmanager
def with_maps(this: Run, scene: Scene, prints: Fingerprint, store: Store, device: Device, begun: bool) -> Iterator[Run]:
    """Within, the run has the depth maps that it wants, as far as they can be had; nobody deletes them meanwhile.

    Those of the data set come first. Where it has none, they are made as the recipe says, or taken from the user's
    cache; a run that began without any goes on without.

    Args:
        this: The run.
        scene: Its data.
        prints: Of the data.
        store: How much room the cache has; whether maps may be made.
        device: Where to make them.
        begun: Whether there is a state to go on from.

    Raises:
        BadInput: The run began with maps that are gone and may not be made again, or they cannot be made.
    """
    before = read_data(this.out).priors if this.record.exists() else None
    if not this.wants_priors or prior_files(this.data, scene) or (begun and before is None):
        yield this
    elif before is not None and is_finished(this):
        yield given(this, before)
    elif before is not None and store.maps is None and is_there(before):
        with used(located(before)):
            yield given(this, before)
    elif this.recipe.depth is None or store.maps is None:
        if begun:
            raise BadInput(f"{this.out}: the depth maps of the run are gone; leave out --no-prepare to make them again")
        yield this
    else:
        with ExitStack() as use:
            folder = use.enter_context(made_for(this, scene, prints, store, device))
            if begun and folder is not None and folder.name != before.name:
                emit(Warned("what depth maps are made from, or how, has changed: the steps to come look at other maps"))
            yield this if folder is None else given(this, folder)


@contextmanager
def with_maps_to_mesh(this: Run, mesher: Mesher, scene: Scene, store: Store, device: Device) -> Iterator[Run]:
    """Within, a trained run has the depth maps that a mesher wants, as far as they can be had.

    Those that it was trained with come first, then those of the data set. Where neither are there, they are made as the
    recipe of the run says, or taken from the user's cache.

    Raises:
        BadInput: They may not be made, or cannot.
    """
    before, own = this.data.priors, replace(this, data=replace(this.data, priors=None))
    if not mesher.needs_prior:
        yield this
    elif before is not None and is_there(before):
        with used(located(before)):
            yield this
    elif prior_files(own.data, scene) or this.recipe.depth is None:
        yield own
    elif store.maps is None:
        raise BadInput(
            f"{this.out}: the mesh needs depth maps, and there are none; leave out --no-prepare to make them, or give "
            f"`surfkit prepare depth {this.data.path}` first"
        )
    else:
        prints = fingerprint(scene, read_json(this.inputs, Fingerprint) if this.inputs.exists() else None)
        with made_for(own, scene, prints, store, device) as folder:
            yield own if folder is None else given(own, folder)


@contextmanager
def made_for(this: Run, scene: Scene, prints: Fingerprint, store: Store, device: Device) -> Iterator[Path | None]:
    """Within, there are maps as the recipe makes them: their folder, or None where the data do not allow any."""
    preparation = Preparation(this.data, this.recipe.depth, torch_device(device))
    tracks = observations(this.data, scene)
    try:
        preparation.refuse_unfit(scene, tracks)
    except BadInput as error:
        emit(Warned(f"depth maps cannot be made: {error}"))
        yield None
        return
    if notice := this.recipe.depth.notice():
        emit(Warned(notice))
    if (folder := this.data.path / FOLDER).is_dir():
        emit(Warned(f"{folder} has no map of these photographs, so others are made"))
    key = key_of(this.recipe.depth, scene, prints, tracks)
    with maps(preparation, scene, tracks, key, store.maps_bytes()) as (folder, made):
        count = f"{made.maps} of {len(scene.train)}" if made.without else made.maps
        what, cost = f"depth maps of {count} photographs", f"{made.cpu_seconds:.0f} s of CPU time"
        emit(Warned(f"{what} made with {name_of(this.recipe.depth)} in {cost}, in {folder}"))
        if made.without:
            emit(Warned(f"the others give no depth: they are damaged, {WITHOUT_DEPTH}"))
        yield folder


def given(this: Run, folder: Path) -> Run:
    """The run with depth maps of a folder of the cache."""
    return replace(this, data=replace(this.data, priors=folder))


def is_finished(this: Run) -> bool:
    """Whether nothing is left to do that looks at depth maps."""
    final = replace(this, part=this.parts[-1])
    if not this.metrics.exists() or (found := open_last(final.checkpoint)) is None:
        return False
    index = found[0].state.index
    needs_mesh = this.recipe.mesh is not None and this.recipe.mesh.needs_prior
    return index >= final.stage.steps and (not needs_mesh or meshed(this, index))
