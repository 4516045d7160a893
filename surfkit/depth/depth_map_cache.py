"""Depth maps for runs whose data set has none: made once, kept in the user's cache, deleted when the cache is full."""

from __future__ import annotations

import os
import shlex
import shutil
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import replace
from pathlib import Path

from surfkit.core.check import BadInput, Fault, few
from surfkit.core.codec import dump
from surfkit.core.events import Progress, Warned, emit, say
from surfkit.core.files import DISK_FULL, refuse_unwritable, sweep
from surfkit.core.lock import IN_USE_FILE, is_used, lock_holder, locked, mark_used
from surfkit.depth.prepare_depth_maps import DepthPreparation, fault_of, files_of, without_damaged
from surfkit.io.datasets.depth_files import DEPTH_FOLDER, DEPTH_RECORD, is_whole, map_path, read_record, write_record
from surfkit.io.datasets.depth_map_index import DepthMapIndex, folder_of, read_made, write_made
from surfkit.io.datasets.fingerprint import Fingerprint, digest
from surfkit.scene.observations import Observations
from surfkit.scene.pixels import DEFAULT_PIXELS
from surfkit.scene.scene import Scene

PROCESS_POLL_S = 1.0
"""Between two looks whether another process is done."""
DROPPED = ".dropped-"
"""What names of folders begin with that are being deleted."""


def key_of(preparation: DepthPreparation, scene: Scene, prints: Fingerprint, tracks: Observations) -> str:
    """The name of the maps of the training views of a scene: another one when anything differs that they are made from.

    Args:
        preparation: How they are made. Maps of a GPU are as good as those of a CPU, and have other bits.
        scene: With the training views.
        prints: Of its photographs and cameras.
        tracks: Its observations.
    """
    estimator, device = preparation.estimator, preparation.device
    parts = [] if device.type == "cpu" else [device.type]
    parts += [] if preparation.known is None else [preparation.known.key]
    parts += [str(dump(estimator)), str(estimator.version), repr(float(scene.frame.scale))]
    parts += [digest(tracks.xyz), digest(tracks.error_px), *files_of(estimator, scene.train)]
    for view in scene.train:
        known, seen = prints.photographs[view.name], tracks.seen.get(view.name)
        parts += [view.name, known.camera, str(known.size), known.content, str(view.white)]
        parts += [] if view.pixels == DEFAULT_PIXELS else [str(view.pixels)]
        parts.append("" if seen is None else digest(seen))
    return digest("\0".join(parts))


@contextmanager
def maps(
    preparation: DepthPreparation, scene: Scene, tracks: Observations, key: str, budget_bytes: int
) -> Iterator[tuple[Path, DepthMapIndex]]:
    """Within, there are maps of the training views of a scene: their folder, and what is known of them.

    Those that are not there, or damaged, are made; nobody deletes them meanwhile. A cache that can only be read is used
    as it is if nothing is missing.

    Args:
        preparation: How; of its folder, nothing is used.
        scene: The scene.
        tracks: Its observations.
        key: Name of the maps.
        budget_bytes: Of all maps in the cache together; those longest unused are deleted when there are more.

    Raises:
        BadInput: The cache cannot be written to, or the estimator cannot work.
        Fault: The disk is full.
    """
    folder = folder_of(key)
    preparation, scene = replace(preparation, root=folder), replace(scene, held_out=())
    if folder.is_dir() and not os.access(folder, os.W_OK) and is_complete(preparation, scene):
        yield folder, read_made(folder)
        return
    make = (
        f"make them with `surfkit prepare depth {shlex.quote(str(preparation.data.path))}`, or do without: --no-prepare"
    )
    # Those that begin at what a model draws are made in no other way.
    otherwise = make if preparation.known is None else "or leave out what makes them of the model"
    with ExitStack() as use:
        with hold_folder(folder, otherwise):
            sweep(folder)
            forget_incomplete(folder, scene)
            use.enter_context(mark_used(folder))
            with full_cache_in_one_line(folder):
                fresh, made = make_missing(preparation, scene, tracks)
        if (left := make_room(folder, budget_bytes)) > budget_bytes and fresh:
            most = f"more than the {budget_bytes / 1e9:.2g} GB of --prepare-cache"
            emit(Warned(f"depth maps that are in use take {left / 1e9:.2g} GB, {most}, and are kept"))
        yield folder, made


@contextmanager
def full_cache_in_one_line(folder: Path) -> Iterator[None]:
    """Within, a disk that is full becomes a `Fault` that names the folder in the cache."""
    try:
        yield
    except OSError as error:
        if error.errno not in DISK_FULL:
            raise
        raise Fault(
            f"{error.filename or folder}: the disk is full ({error.strerror}); free some space, and the same command "
            "goes on after the depth maps that are done, or set SURFKIT_CACHE to a folder on another disk"
        ) from error


@contextmanager
def hold_folder(folder: Path, otherwise: str) -> Iterator[None]:
    """Within, no other process writes into a folder of the cache; waits for one that does. See `unwritable`."""
    with ExitStack() as inside:
        told = False
        while True:
            try:
                inside.enter_context(locked(folder))
                break
            except BadInput:
                if not told:
                    say(f"waiting for the depth maps that {lock_holder(folder) or 'another process'} makes in {folder}")
                told = True
            except FileNotFoundError:  # it was deleted just now, to make room
                pass
            except OSError as error:
                raise unwritable(folder, otherwise, error) from error
            time.sleep(PROCESS_POLL_S)
        yield


def refuse_unwritable_cache(what: str) -> None:
    """BadInput if the cache takes no maps: asked before what they are made from is computed; `what` makes them."""
    root = folder_of("any").parent
    try:
        refuse_unwritable(root)
    except OSError as error:
        raise unwritable(root, f"or leave {what} out", error) from error


def unwritable(folder: Path, otherwise: str, error: OSError) -> BadInput:
    """That a folder of the cache cannot be written to, and what to do, or `otherwise`."""
    return BadInput(
        f"{folder}: cannot be written ({error.strerror}); set SURFKIT_CACHE to a folder for depth maps, {otherwise}"
    )


def make_missing(preparation: DepthPreparation, scene: Scene, tracks: Observations) -> tuple[bool, DepthMapIndex]:
    """Make the maps that are not there, one after the other; whether there were any, and what is known of all."""
    folder, names = preparation.place, [view.name for view in scene.train]
    if broken := damaged_maps(preparation, scene):
        emit(
            Warned(f"{folder}: damaged depth maps, {len(broken)} of {len(names)}, {broken[0]} for one, are made again")
        )
        for name in broken:
            map_path(folder, name).unlink()
    if not (is_known := has_record(folder)):
        (folder / DEPTH_FOLDER / DEPTH_RECORD).unlink(missing_ok=True)
    made = read_made(folder)
    lacking = set(preparation.lacking(scene)) - set(made.without)
    count = len(names) - len(lacking) - len(made.without)
    if not lacking:
        if not is_known:
            write_record(folder, preparation.record(preparation.material(scene, tracks)))
        return False, replace(made, maps=count)
    given, damaged, unread = without_damaged(preparation.material(scene, tracks))
    preparation.open(preparation.record(given))
    wanted = [at for at, name in enumerate(names) if name in lacking and name not in damaged]
    without = (*made.without, *sorted(damaged & lacking))
    made = replace(made, maps=count, without=without, unread=tuple(sorted({*made.unread, *unread})))
    write_made(folder, made)
    begun, before, total = time.process_time(), made.cpu_seconds, count + len(wanted)
    emit(Progress("depth maps", count, total))
    for done, step in enumerate(preparation.run(scene, given, wanted), 1):
        none = (step.view.name,) if step.coverage is None else ()
        spent = before + time.process_time() - begun
        made = replace(made, maps=made.maps + 1 - len(none), cpu_seconds=spent, without=(*made.without, *none))
        write_made(folder, made)
        emit(Progress("depth maps", count + done, total))
    return True, made


def forget_incomplete(folder: Path, scene: Scene) -> None:
    """Delete maps, if unused, that were made without photographs which could not be read then, and can be now.

    Each depends on the photographs that it was compared with, and the name of the folder says that these were all.
    """
    unread = set(read_made(folder).unread)
    found = [view.name for view in scene.train if view.name in unread and fault_of(view) is None]
    if not found or is_used(folder):
        return
    emit(Warned(f"{few(found)} could not be read before, and can be now: all depth maps are made anew"))
    if (folder / DEPTH_FOLDER).exists():
        shutil.rmtree(folder / DEPTH_FOLDER)
    write_made(folder, DepthMapIndex())


def damaged_maps(preparation: DepthPreparation, scene: Scene) -> list[str]:
    """Names of the training views whose map is there, and cannot be used."""
    paths = {view.name: map_path(preparation.place, view.name) for view in scene.train}
    oriented = preparation.estimator.oriented
    return [name for name, path in paths.items() if path.exists() and not is_whole(path, oriented)]


def has_record(folder: Path) -> bool:
    """Whether it is written down in a folder what its maps are."""
    with suppress(BadInput):
        return bool(read_record(folder))
    return False


def is_complete(preparation: DepthPreparation, scene: Scene) -> bool:
    """Whether no map is missing or damaged."""
    lacking = set(preparation.lacking(scene)) - set(read_made(preparation.place).without)
    return not lacking and has_record(preparation.place) and not damaged_maps(preparation, scene)


def make_room(mine: Path, budget_bytes: int) -> int:
    """Delete the folders of maps that are longest unused, and not in use, until all take no more than a budget.

    Returns:
        Bytes of those that are left.
    """
    for left in mine.parent.glob(f"{DROPPED}*"):  # of a process that was killed
        shutil.rmtree(left, ignore_errors=True)
    folders = [path for path in mine.parent.iterdir() if path.is_dir() and not path.name.startswith(".")]
    sizes = {path: folder_bytes(path) for path in folders}
    total = sum(sizes.values())
    for path in sorted(folders, key=last_used):
        if total > budget_bytes and path != mine and drop_folder(path):
            total -= sizes[path]
    return total


def folder_bytes(folder: Path) -> int:
    """Bytes of the files in a folder."""
    found = 0
    for place, _, names in os.walk(folder):  # which passes over what another process has just deleted
        for name in names:
            with suppress(OSError):
                found += os.stat(os.path.join(place, name)).st_size
    return found


def last_used(folder: Path) -> float:
    """When a run last began to use the maps in a folder."""
    with suppress(OSError):
        return (folder / IN_USE_FILE).stat().st_mtime
    return 0.0


def drop_folder(folder: Path) -> bool:
    """Delete a folder of maps, unless somebody works with it; whether it is gone."""
    aside = folder.with_name(f"{DROPPED}{folder.name}-{os.getpid()}")
    try:
        with locked(folder):
            if is_used(folder):
                return False
            os.replace(folder, aside)
    except (BadInput, OSError):
        return False
    shutil.rmtree(aside, ignore_errors=True)
    return True
