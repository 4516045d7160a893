"""A data set examined: what is there, what will be done with it, and everything that is wrong, before any training."""

from __future__ import annotations

import os
import time
from collections import Counter
from collections.abc import Callable, Iterable, Sequence, Set
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from surfkit.apps.doctor.estimate import ResourceEstimate
from surfkit.apps.doctor.examine_photos import Photograph, PhotoToExamine, look_at
from surfkit.apps.doctor.finding import FINDING_LEVELS, Finding, of_each
from surfkit.apps.doctor.gather import Gathered, gather
from surfkit.apps.doctor.geometry import Geometry, points_in_common, points_in_view, seen_by, survey
from surfkit.apps.doctor.light import uneven_light
from surfkit.apps.doctor.priors import priors
from surfkit.core.check import BadInput, few
from surfkit.core.memory import peak_memory_bytes, size
from surfkit.core.registry import name_of
from surfkit.io.datasets.data import Data
from surfkit.io.datasets.masks import empty_masks
from surfkit.io.datasets.panoramas import CUBE_FACES, points_remedy, size_to_read, view_names, view_sizes
from surfkit.io.datasets.panoramas import PANORAMAS_FOLDER as PANORAMAS
from surfkit.io.datasets.raw_dataset import RawImage
from surfkit.io.datasets.read import check_size
from surfkit.io.datasets.sparse_points import RANDOM_POINTS
from surfkit.io.datasets.undistort import cache_folder, is_panorama, is_pinhole
from surfkit.runs.photo_light import sampled
from surfkit.runs.recipe import Recipe
from surfkit.runs.warn import plain_blocks
from surfkit.scene.connected_photos import groups_warning, untied_warning
from surfkit.scene.decoded_photos import place
from surfkit.scene.photos import refuse_large

Told = Callable[[str, int, int], None]
"""Called with what is being done, how much of it is done, and how much there is."""
MAX_INVERTED_SHARE = 0.2
"""A mask that keeps less is probably inverted, if most masks are so."""


@dataclass(frozen=True)
class Diagnosis:
    """What is known of a data set.

    Attributes:
        data: Its folder.
        found: What there is, in words, by topic.
        will: What a run will do with it, in words.
        findings: What is wrong or to be known, the worst first.
        estimate: What a run takes; None if it was not measured.
    """

    data: Path
    found: dict[str, str] = field(default_factory=dict)
    will: tuple[str, ...] = ()
    findings: tuple[Finding, ...] = ()
    estimate: ResourceEstimate | None = None

    @property
    def sound(self) -> bool:
        """Whether nothing stops training."""
        return not any(finding.level == "error" for finding in self.findings)


@dataclass(frozen=True)
class ExaminedData:
    """A diagnosis, and what an estimate goes on from.

    Attributes:
        diagnosis: Without an estimate.
        gathered: The data set.
        photographs: By name; those that are there.
        read_seconds: To read the data set, photographs aside.
        read_peak_bytes: Most memory held until it was read.
    """

    diagnosis: Diagnosis
    gathered: Gathered
    photographs: dict[str, Photograph]
    read_seconds: float
    read_peak_bytes: int


def examine(data: Data, recipe: Recipe, quick: bool = False, told: Told | None = None) -> ExaminedData:
    """Examine a data set; nothing is written.

    Args:
        data: Which, and how it is to be used.
        recipe: What it is to be used for.
        quick: Whether to look at the headers of photographs only.
        told: Hears of the progress.
    """
    start = time.perf_counter()
    gathered = gather(data, quick)
    seconds, peak = time.perf_counter() - start, peak_memory_bytes()
    geometry = survey(gathered.capture.shots, gathered.train, gathered.capture.xyz, recipe.pretrain.near)
    sound = [shot for shot in gathered.train if shot.name in geometry.sound]
    lit = () if quick else sampled(sound, *points_in_view(gathered.capture.xyz))
    compared = points_in_common(lit, gathered.capture.xyz)
    looks = _look(gathered, {shot.name for shot in lit}, compared, quick, told)
    known = {shot.name: looks[shot.path] for shot in gathered.capture.shots if shot.path in looks}
    findings = [
        *gathered.findings,
        *geometry.findings,
        *_photographs(data, gathered, looks),
        *_sizes(data, gathered, known),
        *_masks(gathered, known),
        *_split(data, gathered),
        *_groups(gathered),
        *_untied(gathered),
        *uneven_light(gathered, known, compared, recipe),
        *priors(data, gathered, recipe, quick),
        *([Finding("warning", "blocks", text)] if (text := plain_blocks(recipe)) else []),
    ]
    findings.sort(key=lambda finding: FINDING_LEVELS.index(finding.level))
    found = _found(data, gathered, geometry, looks)
    diagnosis = Diagnosis(data.path, found, _will(data, gathered, known, recipe), tuple(findings))
    return ExaminedData(diagnosis, gathered, known, seconds, peak)


def _look(
    gathered: Gathered, lit: Set[str], compared: np.ndarray, quick: bool, told: Told | None
) -> dict[Path, Photograph]:
    """A look at every photograph that is there, at those called as in `lit` with their colours at the points that are
    compared; at those without a pose only where nothing has one."""
    wanted = [
        PhotoToExamine(
            shot.path,
            gathered.masks.get(shot.name),
            seen_by(shot, compared) if len(compared) and shot.name in lit else None,
            gathered.pixels[shot.name],
        )
        for shot in gathered.capture.shots
        if shot.path.is_file()
    ]
    wanted = wanted or [PhotoToExamine(path) for path in gathered.loose]
    looks = {}
    for one, found in zip(wanted, look_at(wanted, quick), strict=True):
        looks[one.path] = found
        if told is not None:
            told("photographs", len(looks), len(wanted))
    return looks


def _photographs(data: Data, gathered: Gathered, looks: dict[Path, Photograph]) -> list[Finding]:
    """Damaged, blank and unused photographs."""
    folder = data.path / (data.images or "images")
    folder = folder if folder.is_dir() else data.path
    names = {path: os.path.relpath(path, folder) for path in gathered.loose}  # drones number each folder from 1
    names |= {shot.path: shot.name for shot in gathered.capture.shots}
    faults = {names[path]: bare(path, look.fault) for path, look in looks.items() if look.fault}
    away = "delete them from the model" if gathered.capture.shots else "leave them out"
    cure = f"copy them again, or {away}"
    found = of_each("damaged-photographs", faults, cure)
    flat = [names[path] for path, look in looks.items() if look.flat]
    if flat:
        text = f"{len(flat)} photographs are of one colour throughout, {few(flat)}: {away}"
        found.append(Finding("warning", "blank-photographs", text, tuple(flat)))
    loose, used = gathered.loose, len(gathered.capture.shots)
    if loose and used:
        others = tuple(os.path.relpath(path, data.path) for path in loose)
        text = (
            f"{len(loose)} of {len(loose) + used} pictures in the folder of the photographs have no pose and are not "
            f"used, {few(others)}; align them too, if they belong to the scene"
        )
        found.append(Finding("warning" if len(loose) > used / 4 else "note", "unused-pictures", text, others))
    turned = [names[path] for path, look in looks.items() if look.turned]
    if turned:
        text = (
            f"EXIF of {len(turned)} photographs asks for a turn, {few(turned)}, which is not made: they are used as "
            "stored, as COLMAP uses them"
        )
        found.append(Finding("note", "exif-turns", text, tuple(turned)))
    return found


def bare(path: Path, text: str) -> str:
    """A message without the file that it begins with."""
    return text.removeprefix(f"{path}: ")


def _sizes(data: Data, gathered: Gathered, known: dict[str, Photograph]) -> list[Finding]:
    """Photographs that are not what their cameras took, or too large."""
    faults = {}
    for shot in gathered.capture.shots:
        look = known.get(shot.name)
        if look is not None and look.size is not None:
            try:
                check_size(shot, look.size)
                refuse_large(shot.path, look.size, size_to_read(data, shot, look.size))
            except BadInput as error:
                faults[shot.name] = bare(shot.path, str(error))
            except ZeroDivisionError:
                pass  # a camera without a size, which is told already
    return of_each("sizes", faults)


def _masks(gathered: Gathered, known: dict[str, Photograph]) -> list[Finding]:
    """Masks that are damaged, of another shape, or inverted."""
    faults = {name: bare(gathered.masks[name].path, look.mask_fault) for name, look in known.items() if look.mask_fault}
    found = of_each("masks", {f"mask of {name}": text for name, text in faults.items()})
    kept = [look.kept for look in known.values() if look.kept is not None]
    empty = [name for name, look in known.items() if look.kept == 0]
    if kept and np.median(kept) < MAX_INVERTED_SHARE:
        text = (
            f"the masks keep {np.median(kept):.0%} of the pixels: black is ignored, so they are probably inverted; "
            "invert them, or name their folder with --masks"
        )
        found.append(Finding("warning", "inverted-masks", text))
    elif empty:
        found.append(Finding("warning", "empty-masks", empty_masks(empty), tuple(empty)))
    return found


def _split(data: Data, gathered: Gathered) -> list[Finding]:
    """What the split leaves."""
    shots, train = len(gathered.capture.shots), len(gathered.train)
    found = []
    if shots and train < 3:
        text = f"{train} photographs to train on: a surface needs at least 3, and should have dozens"
        remedy = "align more, or use --test-every 0" if train < shots else "align more"
        found.append(Finding("warning", "few-photographs", f"{text}; {remedy}"))
    if shots and train == shots:
        text = "no photograph is kept from training, so the quality cannot be measured; see --test-every"
        found.append(Finding("note", "no-held-out", text))
    wrong = any(finding.level == "error" for finding in gathered.findings)
    if shots and not len(gathered.capture.xyz) and not wrong:
        text = f"there are no sparse points: training would start from {RANDOM_POINTS:,} random ones"
        remedy = points_remedy(data.path, view_names(gathered.capture.shots))
        found.append(Finding("warning", "no-points", f"{text}; {remedy}"))
    return found


def _groups(gathered: Gathered) -> list[Finding]:
    """Photographs that no sparse points connect."""
    largest, *others = gathered.capture.groups or [()]
    text = groups_warning(gathered.capture.groups)
    return [Finding("warning", "unconnected", text, tuple(name for names in others for name in names))] if text else []


def _untied(gathered: Gathered) -> list[Finding]:
    """Photographs that show no sparse point."""
    found = gathered.capture.untied(gathered.held_out)
    text = untied_warning(found)
    return [Finding("warning", "untied", text, tuple(found))] if text else []


def _found(data: Data, gathered: Gathered, geometry: Geometry, looks: dict[Path, Photograph]) -> dict[str, str]:
    """What there is, in words, by topic."""
    shots, xyz = gathered.capture.shots, gathered.capture.xyz
    found = {"layout": gathered.layout or "none"}
    found["photographs"] = f"{len(shots)} with a pose" if shots else f"{len(looks)}, none with a pose"
    if looks:
        found["photographs"] += f", {size(sum(look.bytes for look in looks.values()))}"
        found["kinds"] = counted(look.kind for look in looks.values() if look.kind)
        found["sizes"] = counted(f"{look.size[0]} x {look.size[1]} px" for look in looks.values() if look.size)
    if shots:
        lenses = {id(shot.camera): shot.camera for shot in shots}
        found["cameras"] = counted(
            f"{lens.model.name} {lens.width} x {lens.height}" + focal(lens) for lens in lenses.values()
        )
        found["masks"] = str(len(gathered.masks)) if gathered.masks else "none"
        seen = f", each in view of {geometry.views.mean():.0f} photographs on average" if len(xyz) else ""
        found["sparse points"] = f"{len(xyz):,}{seen}"
    if geometry.extent is not None:
        depth = "" if geometry.depth is None else f"; what is in view is {geometry.depth:,.4g} away (median)"
        found["extent"] = f"{geometry.extent:,.4g} units{depth}"
    return found


def focal(lens: Any) -> str:
    """The focal length of a camera in words, if it has any."""
    lengths = [lens.params[at] for at in lens.focal_length_idxs()]
    return f", focal length {sum(lengths) / len(lengths):.0f} px" if lengths else ""


def counted(values: Iterable[str], most: int = 4) -> str:
    """The most frequent of some texts, with how often each occurs."""
    counts = Counter(values)
    shown = [f"{text} ({count})" if len(counts) > 1 else text for text, count in counts.most_common(most)]
    return "; ".join(shown) + (f"; and {len(counts) - most} other kinds" if len(counts) > most else "")


def _will(data: Data, gathered: Gathered, known: dict[str, Photograph], recipe: Recipe) -> tuple[str, ...]:
    """What a run will do, in words."""
    shots: Sequence[RawImage] = gathered.capture.shots
    if not shots:
        return ()
    train, held = len(gathered.train), len(shots) - len(gathered.train)
    whose = "its own split" if gathered.capture.held_out is not None else f"one of every {data.test_every}"
    whose = "as listed" if data.test_list is not None else whose
    whose = name_of(data.split) if data.split is not None else whose
    told = [f"train on {train} photographs, and measure on {held}" + (f" ({whose})" if held else "")]
    sized = [(shot, size) for shot in shots if shot.name in known and (size := known[shot.name].size) is not None]
    changes = {(size, size_to_read(data, shot, size)) for shot, size in sized}
    if smaller := sorted((a, b) for a, b in changes if a != b):
        (was, now), more = smaller[-1], f" (and {len(smaller) - 1} other sizes)" if len(smaller) > 1 else ""
        told.append(f"reduce photographs of {was[0]} x {was[1]} px to {now[0]} x {now[1]}{more}")
    whole = sum(is_panorama(shot.camera) for shot in shots)
    bent = sum(not is_pinhole(shot.camera) for shot in shots) - whole
    if whole:
        folder = place(data.path, PANORAMAS)
        told.append(f"cut {whole} panoramas into {len(CUBE_FACES)} views each, once, into {folder}")
    if bent:
        told.append(f"undistort {bent} photographs, once, into {cache_folder(data.path)}")
    kinds = [(mask.alpha, mask.path == shot.path) for shot in shots if (mask := gathered.masks.get(shot.name))]
    if count := kinds.count((False, False)):
        told.append(f"ignore what is black in the masks of {count} photographs")
    if count := kinds.count((True, False)):
        told.append(f"ignore what is transparent in the masks of {count} photographs")
    own = kinds.count((True, True))
    if own:
        told.append(f"ignore what is transparent in {own} photographs")
    if not recipe.has_stages:
        return (*told, f"reconstruct with method:{name_of(recipe.method)}")
    if recipe.start.needs_prior:
        return (*told, f"start from points of depth maps (start:{name_of(recipe.start)})")
    sparse = len(gathered.capture.xyz)
    pixels = sum(width * height for shot, size in sized for width, height in view_sizes(data, shot, size))
    count = recipe.start.expected(sparse or RANDOM_POINTS, pixels)
    drawn = "" if sparse else f"; {RANDOM_POINTS:,} random points stand in for sparse ones"
    return (*told, f"start from about {count:,} points (start:{name_of(recipe.start)}{drawn})")
