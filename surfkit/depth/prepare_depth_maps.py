"""Depth priors for a whole data set: existing maps are kept, and an interrupted estimate resumes."""

from __future__ import annotations

import shutil
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from surfkit.core.check import BadInput, expect_kind, expect_tensor, few
from surfkit.core.codec import dump
from surfkit.core.events import Progress, Warned, emit
from surfkit.core.files import replacing
from surfkit.core.registry import class_path, name_of
from surfkit.core.version import own_version
from surfkit.depth.base import DepthEstimator, DepthInput, Estimate, KnownSurfaces
from surfkit.io.datasets.data import Data
from surfkit.io.datasets.depth_files import (
    DEPTH_FOLDER,
    DepthFile,
    confidence_path,
    map_path,
    normal_path,
    read_record,
    write_map,
    write_record,
)
from surfkit.io.datasets.depth_prior import MIN_TRUSTED_CONFIDENCE
from surfkit.io.datasets.fingerprint import content_of, digest
from surfkit.io.datasets.panoramas import points_remedy
from surfkit.io.datasets.read import observations
from surfkit.scene.camera import Camera
from surfkit.scene.observations import Observations
from surfkit.scene.photos import view_photo
from surfkit.scene.scene import Scene, View

WITHOUT_DEPTH = "show too few of the same sparse points, or were taken from one place"
"""What photographs do that are compared and give no depth."""
MADE_FROM_KEY, PHOTOGRAPHS_KEY = "made_from", "photographs"
"""In the record: from which cameras and sparse points, as a digest, which is also a file in the folder for work; and of
each photograph the content of its file."""
REMEDY = "; move the folder away to have others made"
"""For maps of a data set that are not those that a run would make."""


@dataclass(frozen=True)
class EstimatedPhoto:
    """A photograph whose depth was estimated.

    Attributes:
        view: The photograph.
        coverage: Share of its pixels with a confidence above one half; None where nothing could be estimated.
        seconds: It took.
    """

    view: View
    coverage: float | None
    seconds: float


@dataclass(frozen=True)
class DepthPreparation:
    """A data set and the estimator of its depth.

    Attributes:
        data: The data set; photographs that it keeps from training are not used by estimators that compare.
        estimator: How.
        device: Where to compute.
        root: The folder in which estimated_depths/ is written; the data set if None.
        known: What the estimator begins with, if it `continues`.
    """

    data: Data
    estimator: DepthEstimator
    device: torch.device
    root: Path | None = None
    known: KnownSurfaces | None = None

    @property
    def place(self) -> Path:
        """The folder in which estimated_depths/ is."""
        return self.root or self.data.path

    @property
    def work(self) -> Path:
        """What an interrupted estimate goes on from."""
        return self.place / DEPTH_FOLDER / ".work"

    def views(self, scene: Scene) -> tuple[View, ...]:
        """The photographs to estimate."""
        return scene.train if self.estimator.matched else (*scene.train, *scene.held_out)

    def material(self, scene: Scene, tracks: Observations | None = None) -> DepthInput:
        """What the estimator works from; `tracks` are read if None.

        Raises:
            BadInput: The sparse model does not show which photographs to compare, or the settings do not fit them.
        """
        tracks = tracks or observations(self.data, scene)
        self.refuse_unfit(scene, tracks)
        return DepthInput(self.views(scene), tracks, self.device, self.work, known=self.known)

    def refuse_unfit(self, scene: Scene, tracks: Observations) -> None:
        """BadInput if the settings do not fit the photographs, or the sparse model does not show which to compare."""
        self.estimator.refuse_unfit(self.views(scene))
        if self.estimator.matched and not any(len(seen.points) for seen in tracks.seen.values()):
            raise BadInput(
                f"{self.data.path}: no photograph of the sparse model observes any point, which says what to compare; "
                f"{points_remedy(self.data.path, (view.name for view in scene.train))}"
            )

    def begin(self, scene: Scene, given: DepthInput, again: bool, renew: bool = False) -> tuple[DepthInput, list[int]]:
        """What the estimator works from without damaged photographs, and the positions that are still to be estimated.

        Args:
            scene: Of the data set.
            given: What the estimator would work from if all photographs were whole.
            again: Whether to delete the maps that are there.
            renew: Whether to delete them if surfkit made them otherwise.

        Raises:
            BadInput: There are maps that something else made, or other settings, or from photographs that have changed
                since; or no photograph can be read.
        """
        root, views = self.place, given.views
        record, before = self.record(given), read_record(root)
        paths = [map_path(root, view.name) for view in views]
        alike, names = are_alike(before, record), [] if again else replaced(before, record, views)
        if names or not alike:
            again = again or (renew and bool(before)) or not self.is_begun()
        if not again and not alike:
            raise BadInput(
                f"{root / DEPTH_FOLDER} holds depth maps made {made_otherwise(before, record)}; --again replaces them"
            )
        if not again and names:
            raise BadInput(
                f"{root / DEPTH_FOLDER} holds depth maps made before {few(names)} "
                f"{'was' if len(names) == 1 else 'were'} "
                "changed, or replaced by other photographs of the same name; --again makes all maps anew"
            )
        known = {} if again else before.get(PHOTOGRAPHS_KEY) or {}
        damaged: set[str] = set()
        if again or self.lacking(scene) or not known.keys() >= {view.name for view in views}:
            given, damaged, _ = without_damaged(given)
        if again:
            for path in paths:
                path.unlink(missing_ok=True)
                confidence_path(path).unlink(missing_ok=True)
                normal_path(path).unlink(missing_ok=True)
            shutil.rmtree(self.work, ignore_errors=True)
        now = record[PHOTOGRAPHS_KEY].items()
        record[PHOTOGRAPHS_KEY] = {
            name: known.get(name, it) for name, it in now if name in known or name not in damaged
        }
        self.open(record)
        return given, [at for at, path in enumerate(paths) if views[at].name not in damaged and not path.exists()]

    def is_begun(self) -> bool:
        """Whether there is something to lose: maps, of these photographs or of others, or work on some."""
        return any((self.place / DEPTH_FOLDER).rglob("*.npy")) or any(
            path.is_file() and path.name != MADE_FROM_KEY for path in self.work.rglob("*")
        )

    def is_outdated(self, given: DepthInput) -> bool:
        """Whether there are maps that surfkit made otherwise: with other settings, or from something else."""
        before, now = read_record(self.place), self.record(given)
        return bool(before) and (not are_alike(before, now) or bool(replaced(before, now, given.views)))

    def open(self, record: Mapping[str, Any]) -> None:
        """Make the folders, and say what the maps are."""
        if read_record(self.place) != record:
            write_record(self.place, record)
        self.work.mkdir(parents=True, exist_ok=True)

    def lacking(self, scene: Scene) -> list[str]:
        """Names of the views that have no map."""
        return [view.name for view in self.views(scene) if not map_path(self.place, view.name).exists()]

    def record(self, given: DepthInput) -> dict[str, Any]:
        """What depth.json says of the maps."""
        views = given.views
        # Of maps in the cache, the name of the folder tells the content of photographs.
        content = {} if self.root else {PHOTOGRAPHS_KEY: {view.name: content_of(view) for view in views}}
        return content | {
            "estimator": dump(self.estimator),
            "surfkit": own_version(),
            "aligned": self.estimator.aligned,
            "longest": max((max(view.camera.width, view.camera.height) for view in views), default=0),
            "matched": [view.name for view in views] if self.estimator.matched else None,
            MADE_FROM_KEY: made_from(given, self.estimator),
        }

    def run(self, scene: Scene, given: DepthInput, wanted: Sequence[int]) -> Iterator[EstimatedPhoto]:
        """Estimate and save the views at the positions `wanted`, one after the other."""
        self.forget_other_work(given)
        begun = time.perf_counter()
        for estimate in self.estimator.estimate(given, wanted):
            _refuse_unsound(f"{class_path(type(self.estimator))}.estimate", self.estimator, estimate, wanted)
            view = given.views[estimate.at]
            coverage = self.save(view, estimate, scene)
            yield EstimatedPhoto(view, coverage, time.perf_counter() - begun)
            begun = time.perf_counter()
        shutil.rmtree(self.work, ignore_errors=True)

    def forget_other_work(self, given: DepthInput) -> None:
        """Delete what an interrupted estimate left, if it was made from other photographs, cameras or sparse points.

        Its files are named by the position of a photograph, and depend on those that it is compared with.
        """
        found, path = made_from(given, self.estimator), self.work / MADE_FROM_KEY
        if not path.exists() or path.read_text() != found:
            shutil.rmtree(self.work, ignore_errors=True)
            with replacing(path) as file:
                file.write(found.encode())

    def save(self, view: View, estimate: Estimate, scene: Scene) -> float | None:
        """Write a map, in the units of the input if it has any, and return its coverage."""
        if estimate.inverse is None or estimate.confidence is None:
            return None
        inverse: Tensor = estimate.inverse * (scene.frame.scale if self.estimator.aligned else 1.0)
        normal = None if estimate.normal is None else estimate.normal.numpy()
        write_map(self.place, view.name, inverse.numpy(), estimate.confidence.numpy(), normal)
        return float((estimate.confidence > MIN_TRUSTED_CONFIDENCE).float().mean())


def _refuse_unsound(where: str, estimator: DepthEstimator, estimate: Any, wanted: Sequence[int]) -> None:
    """BadInput unless an estimate is of a wanted view, with maps that belong together: a wrong position would give a
    photograph the depth of another, and maps of other shapes would be thrown away in each run, and made again."""
    expect_kind(where, estimate, Estimate)
    if estimate.at not in wanted:
        raise BadInput(f"{where}: at is {estimate.at}, no position of a view that was asked for")
    if estimate.inverse is None or estimate.confidence is None:
        return
    sizes = expect_tensor(f"{where}: inverse", estimate.inverse, ("float32",), ("h", "w"))
    expect_tensor(f"{where}: confidence", estimate.confidence, ("float32",), ("h", "w"), sizes)
    if estimate.normal is not None:
        expect_tensor(f"{where}: normal", estimate.normal, ("float32",), (3, "h", "w"), sizes)
    if estimator.aligned and bool((estimate.inverse < 0).any()):
        raise BadInput(f"{where}: inverse is below 0; give that of camera z, and 0 where there is none")


def made_from(given: DepthInput, estimator: DepthEstimator) -> str:
    """A digest of names and cameras of photographs, sparse points that they show, and files of the estimator."""
    tracks = given.observations
    parts = [digest(tracks.xyz), digest(tracks.error_px), *files_of(estimator, given.views)]
    for view in given.views:
        seen = tracks.seen.get(view.name)
        parts += [view.name, digest(view.camera), "" if seen is None else digest(seen)]
    return digest("\0".join(parts))


def files_of(estimator: DepthEstimator, views: Sequence[View]) -> list[str]:
    """What tells the files that an estimator reads beside photographs from others: path, size and time of change."""
    known = [(path, path.stat()) for path in estimator.files(views)]
    return [f"{path} {stat.st_size} {stat.st_mtime_ns}" for path, stat in known]


def are_alike(before: Mapping[str, Any], now: Mapping[str, Any]) -> bool:
    """Whether two records differ in nothing, or in the content of photographs alone."""
    return {**before, PHOTOGRAPHS_KEY: None} == {**now, PHOTOGRAPHS_KEY: None}


def replaced(before: Mapping[str, Any], now: Mapping[str, Any], views: Sequence[View]) -> list[str]:
    """Names of photographs that have another content than when maps were made, and can be read.

    Those that were damaged since are none of them: what was made from them is still right.
    """
    known = before.get(PHOTOGRAPHS_KEY) or {}
    other = [
        view
        for view in views
        if known.get(view.name, now[PHOTOGRAPHS_KEY][view.name]) != now[PHOTOGRAPHS_KEY][view.name]
    ]
    return [view.name for view, fault in faults_of(other) if fault is None]


def made_otherwise(before: Mapping[str, Any], now: Mapping[str, Any]) -> str:
    """How maps were made whose record is another one, in a few words; it is empty if surfkit did not make them."""
    if not before:
        return "by another program"
    if before.get("estimator") != now["estimator"]:
        return "with other settings"
    if before.get("surfkit") != now["surfkit"]:
        return f"by surfkit {before.get('surfkit', 'of another version')}"
    if MADE_FROM_KEY not in before and are_alike({**before, MADE_FROM_KEY: now[MADE_FROM_KEY]}, now):
        return "by an earlier surfkit, which did not note of which cameras"
    if are_alike({**before, MADE_FROM_KEY: None}, {**now, MADE_FROM_KEY: None}):
        return "from other cameras or sparse points"
    return "of other photographs, or of other sizes"


def others_warning(root: Path, maps: Iterable[DepthFile], own: DepthEstimator, longest: int) -> str | None:
    """What to say where surfkit made the maps of a data set otherwise than an estimator would.

    None where another program made them, or where only the photographs were larger, which gives maps that are as good.

    Args:
        root: The data set.
        maps: Its maps, or others in their place.
        own: The estimator.
        longest: Longest side of the photographs, pixels.
    """
    folder = root / DEPTH_FOLDER
    if not all(file.path.is_relative_to(folder) for file in maps):
        return None
    before = read_record(root)
    made, side = before.get("estimator"), before.get("longest")
    use, wanted = made.get("use") if isinstance(made, dict) else None, name_of(own)
    if not isinstance(use, str):
        return None
    parts = [f"with {use}, not with {wanted}"] if use != wanted else []
    parts += [f"with other settings of {wanted} than the recipe has"] if use == wanted and made != dump(own) else []
    if isinstance(side, int) and 0 < side and _longest_of_map(own, side) < _longest_of_map(own, longest):
        parts.append(f"from photographs of {side} px, where the run has such of {longest} px")
    return f"{folder} has depth maps, made {' and '.join(parts)}: the run uses these" if parts else None


def _longest_of_map(estimator: DepthEstimator, px: int) -> int:
    """Longest side of a depth map, from that of a photograph; estimators may make smaller maps of all photographs."""
    made = estimator.of_map(Camera(torch.eye(4, dtype=torch.float64), px, px, px / 2, px / 2, px, px))
    return max(made.width, made.height)


def fault_of(view: View) -> BadInput | None:
    """Why a photograph cannot be read, if it cannot."""
    try:
        view_photo(view)
    except BadInput as error:
        return error
    return None


def faults_of(views: Sequence[View]) -> Iterator[tuple[View, BadInput | None]]:
    """The same of many photographs, with progress."""
    with ThreadPoolExecutor(4) as pool:
        for at, (view, fault) in enumerate(zip(views, pool.map(fault_of, views), strict=True), 1):
            emit(Progress("looking at photographs", at, len(views)))
            yield view, fault


def without_damaged(given: DepthInput) -> tuple[DepthInput, set[str], set[str]]:
    """The same input, but that nothing is compared with damaged photographs; and their names.

    A note names each of them. All photographs keep their positions. Last are the names of those that the system could
    not read, as happens when too many files are open or a share is away, and that may be whole.

    Raises:
        BadInput: No photograph can be read.
    """
    views, damaged, unread = given.views, set(), set()
    for view, fault in faults_of(views):
        if fault is not None:
            passing = getattr(fault.__cause__, "errno", None) is not None
            emit(Warned(f"no depth map is made of a {'' if passing else 'damaged '}photograph: {fault}"))
            damaged.add(view.name)
            unread |= {view.name} if passing else set()
    if len(damaged) == len(views):
        raise BadInput(f"none of the {len(views)} photographs can be read, {views[0].path} for one")
    whole = {name: seen for name, seen in given.observations.seen.items() if name not in damaged}
    return replace(given, observations=replace(given.observations, seen=whole)), damaged, unread
