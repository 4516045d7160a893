"""From a folder of photographs to a data set with cameras, from top to bottom; each stage keeps its result."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from surfkit.apps.sfm.bundle_adjustment import adjust_once
from surfkit.apps.sfm.colmap_database import matched
from surfkit.apps.sfm.control_adjustment import adjust_to_points_once, clean_marks, said_of
from surfkit.apps.sfm.control_list import GroundControl, read_ground
from surfkit.apps.sfm.control_report import warnings_of, write_tables
from surfkit.apps.sfm.dataset_export import deliver
from surfkit.apps.sfm.engine import load_engine
from surfkit.apps.sfm.focal import (
    Weighed,
    exif_focals,
    height_above_ground,
    height_stretch,
    weighed,
    with_focals_held,
)
from surfkit.apps.sfm.georeference import NoSimilarity, Placement, centres_of
from surfkit.apps.sfm.gravity_alignment import points_of, turn_upright, up_of
from surfkit.apps.sfm.ground_control import ControlResiduals, doubts, place_by_points
from surfkit.apps.sfm.inspect_photos import PHOTOGRAPHS_FILE, Photo, known_photographs
from surfkit.apps.sfm.map_choice import PositionHypothesis, decide, heights_named, locate, readings
from surfkit.apps.sfm.mapping import MIN_MODEL_PHOTOS, map_photographs, read_model
from surfkit.apps.sfm.mask_export import deliver_masks
from surfkit.apps.sfm.match_photos import compare
from surfkit.apps.sfm.position_doubts import position_doubts
from surfkit.apps.sfm.positions import Positions, settle
from surfkit.apps.sfm.rolling_shutter import RollingShutter, correct_once, refuse_timeless, still
from surfkit.apps.sfm.row_motion import RowMotion
from surfkit.apps.sfm.settings import REPORT_FILE, WORK_FOLDER, Settings
from surfkit.apps.sfm.sfm_report import draw, model_facts, reasons
from surfkit.apps.sfm.sources import Sources, look_at_all
from surfkit.apps.sfm.survey_plausibility import upside_down
from surfkit.core.check import BadInput, few
from surfkit.core.codec import write_json
from surfkit.core.events import Warned, emit
from surfkit.core.stages import StageFolder, key_of
from surfkit.io.datasets.georeference_file import Georeference
from surfkit.io.datasets.topocentric import Similarity
from surfkit.scene.crs import EGM96

CAMERAS_PICTURE = "cameras.png"
SOURCE_FILE = "source.txt"
"""In the work folder: the folder that the photographs are from. They may change there, as when all are saved anew."""

PlacedModel = tuple[Any, Placement | ControlResiduals | None, Weighed, RollingShutter]
"""pycolmap.Reconstruction, where it lies, and what became of focal lengths, heights and shutters."""


@dataclass(frozen=True)
class SfmPreparation:
    """A folder of photographs on its way to a data set.

    Attributes:
        root: Folder of the photographs, or a video; nothing is written there.
        scene: The data set.
        settings: How cameras are found.
        refuse: Raises BadInput if the usable photographs do not fit what comes after the cameras.
        device: Where features are found and compared in torch.
    """

    root: Path
    scene: Path
    settings: Settings
    refuse: Callable[[Sequence[Photo]], None] = lambda _: None
    device: torch.device = torch.device("cpu")

    @property
    def work(self) -> Path:
        """Folder of what the stages keep."""
        return self.scene / WORK_FOLDER

    def run(self) -> dict[str, Any]:
        """Go through all stages that are not complete; the report.

        Raises:
            BadInput: There are too few photographs that can be used, or no cameras can be found for them.
        """
        load_engine()
        self.settings.refuse_missing()
        stages = StageFolder(self.work)
        sources, photos = stages.run("photographs", "", self._look)
        usable = [photo for photo in photos if photo.usable]
        self._refuse_few(photos, usable)
        self.refuse(usable)
        refuse_timeless(usable, self.settings)
        positions = settle(usable, sources.root, self.settings) if self.settings.gps else Positions(usable)
        usable, site = positions.photos, self._site(positions)
        found = compare(stages, usable, sources, self.work, self.settings, self.device)
        key = key_of(found.key, self.settings.mapper, self.settings.seed)
        models = stages.run("cameras", key, lambda: self._map(found.database, len(found.rich)), self._load_models)
        matches = matched(found.database)
        if not models:
            raise BadInput(self._no_model(photos, reasons(photos, found.counts, matches, [])))
        placed = stages.run("georeference", "", lambda: self._place(models, positions, site))
        by_name = {photo.name: photo for photo in usable}
        done = [(model, None if where is None else _placed(where, self.settings.crs)) for model, where, *_ in placed]
        motions = {name: motion for *_, rolling in reversed(placed) for name, motion in rolling.motions.items()}
        stages.run("undistortion", "", lambda: self._deliver(done, by_name, sources, motions))
        first, where, *_ = placed[0]
        points = where if isinstance(where, ControlResiduals) else None
        listed = site if isinstance(site, GroundControl) else None
        write_tables(self.scene, first, points, listed)
        names = [set(centres_of(model)) for model, *_ in placed]
        return self._report(stages, photos, placed, reasons(photos, found.counts, matches, names))

    def _look(self) -> tuple[Sources, list[Photo]]:
        path = self.work / PHOTOGRAPHS_FILE
        before = known_photographs(path)
        sources, photos = look_at_all(self.root, self.work, path, self.settings)
        root, source = os.fsencode(self.root.resolve()), self.work / SOURCE_FILE  # bytes: names need not be UTF-8
        if not (source.is_file() and source.read_bytes() == root):
            _refuse_others(self.scene, self.root, before, photos)
        elif before and not any(photo.shows_what(other) for photo, other in _alike(before, photos)):
            emit(
                Warned(
                    f"{self.root}: no photograph is as it was when {self.scene} was prepared; it is made anew, and "
                    "runs on it cannot be used any more"
                )
            )
        write_json(path, photos)
        source.write_bytes(root)
        return sources, photos

    def _deliver(
        self,
        models: Sequence[tuple[Any, Georeference | None]],
        photos: dict[str, Photo],
        sources: Sources,
        motions: dict[str, RowMotion],
    ) -> None:
        """Write photographs, masks and models of the data set."""
        deliver_masks([model for model, _ in models], photos, sources, self.scene, self.work, motions)
        deliver(models, photos, sources, self.scene, self.work, motions)

    def _refuse_few(self, photos: Sequence[Photo], usable: Sequence[Photo]) -> None:
        if len(usable) >= MIN_MODEL_PHOTOS:
            return
        wrong = [f"{photo.name} ({photo.problem})" for photo in photos if not photo.usable]
        why = f"; not usable: {few(wrong)}" if wrong else ""
        raise BadInput(
            f"{self.root}: {len(usable)} of {len(photos)} photographs can be used{why}; cameras are found for "
            f"{MIN_MODEL_PHOTOS} or more that show the same place from several sides"
        )

    def _map(self, database: Path, count: int) -> list[Path]:
        return (
            map_photographs(database, self.work / "models", count, self.settings) if count >= MIN_MODEL_PHOTOS else []
        )

    def _load_models(self) -> list[Path]:
        folder = self.work / "models"
        if not folder.is_dir():
            raise BadInput(f"{folder}: no such folder")
        return sorted((path for path in folder.iterdir() if path.name.isdigit()), key=lambda path: int(path.name))

    def _no_model(self, photos: Sequence[Photo], why: dict[str, str]) -> str:
        groups: dict[str, list[str]] = {}
        for name, reason in why.items():
            groups.setdefault(reason, []).append(name)
        largest = sorted(groups.items(), key=lambda item: -len(item[1]))[:3]
        said = "; ".join(f"{few(names, 2)}: {reason}" for reason, names in largest)
        return (
            f"{self.root}: no cameras could be found for {len(photos)} photographs ({said}); they must overlap, three "
            "views of each place, from positions that differ"
        )

    def _site(self, positions: Positions) -> GroundControl | list[PositionHypothesis]:
        """Ground control points on their map; else what the positions may mean, nothing where there are none."""
        given = self.settings
        if given.gcp is not None:
            sizes = {photo.name: photo.size for photo in positions.photos}
            return read_ground(given.gcp, given.crs, sizes, given.checkpoints, given.checkpoint_names)
        return readings(positions, self.settings.crs) if self.settings.gps else []

    def _place(
        self, models: Sequence[Path], positions: Positions, site: GroundControl | list[PositionHypothesis]
    ) -> list[PlacedModel]:
        """The models, each on the map or level, and what became of their focal lengths, heights and shutters."""
        photos = {photo.name: photo for photo in positions.photos}
        alone = [read_model(path) for path in models]
        loaded, shutters = [], []
        for number, model in enumerate(alone):
            folder = self.work / "rolling" / str(number)
            with_exif, photos = self._with_exif(number, model, photos)
            found = correct_once(with_exif, photos, self.settings, folder)
            loaded.append(found[0])
            shutters.append(found[1])
            for doubt in found[1].doubts():
                emit(Warned(f"sparse/{number}: {doubt}"))
        chosen: GroundControl | PositionHypothesis | NoSimilarity
        if isinstance(site, GroundControl):
            chosen = site
        elif site:
            chosen = decide(loaded[0], site, positions, self.settings.seed)
        else:
            chosen = NoSimilarity("no photograph has a position in EXIF or XMP" if self.settings.gps else "--no-gps")
        placed = []
        for number, (before, model, rolling) in enumerate(zip(alone, loaded, shutters, strict=True)):
            own = still(chosen, model, rolling) if isinstance(chosen, GroundControl) else chosen
            final, where, stretch = self._place_one(number, model, own, photos)
            metres = None if where is None else where.chart.metres
            placed.append((final, where, weighed(before, final, photos, stretch, metres), rolling))
        for doubt in placed[0][2].doubts():  # of the others, which have the same lenses mostly, the report says it
            emit(Warned(f"sparse/0: {doubt}"))
        return placed

    def _place_one(
        self, number: int, model: Any, site: GroundControl | PositionHypothesis | NoSimilarity, photos: dict[str, Photo]
    ) -> tuple[Any, Placement | ControlResiduals | None, tuple[float, float] | None]:
        """A model on the map or level, and how heights by GPS differ from those of its cameras (`height_stretch`)."""
        where: Placement | ControlResiduals | NoSimilarity
        if isinstance(site, GroundControl):
            site, wrong = clean_marks(model, site, self.settings)
            where = self._by_points(number, model, site, photos)
            if isinstance(where, ControlResiduals):
                model.transform(_sim3d(where.similarity))
                return self._adjusted_to_points(number, model, replace(where, wrong_marks=tuple(wrong)), site, photos)
            if number == 0:  # smaller ones may show none of the points
                raise BadInput(f"--gcp {self.settings.gcp}: {where.reason}{said_of(wrong)}")
        elif isinstance(site, PositionHypothesis):
            held = {name for name, photo in photos.items() if photo.exif.is_focal_held}
            photos = {photo.name: photo for photo in site.photos}
            photos |= with_focals_held({name: photo for name, photo in photos.items() if name in held})
            where = locate(model, site, self.settings.seed)
        else:
            where = site
        if isinstance(where, NoSimilarity):
            emit(Warned(f"sparse/{number} is level but not on the map and of no known scale: {where.reason}"))
            return _levelled(model, photos), None, None
        model.transform(_sim3d(where.similarity))
        for doubt in position_doubts(where, centres_of(model), photos):
            emit(Warned(doubt))
        if where.plan:
            emit(
                Warned(
                    f"sparse/{number} is placed in plan, by latitudes and longitudes: its heights are not absolute, 0 "
                    "is the middle of the ground, and up is as cameras are held"
                )
            )
            return model, where, None
        where, said = heights_named(where, list(photos.values()), self.settings.crs)
        if said:
            emit(Warned(f"sparse/{number}: {said}"))
        inside, ground = where.fit.inside, height_above_ground(model)
        cameras, onto = (where.onto - where.fit.residuals)[inside], where.onto[inside]
        stretch = height_stretch(cameras, onto, where.sigma[inside, 2], ground)
        adjusted = adjust_once(model, where, photos, self.settings, self.work / "adjusted" / str(number))
        if adjusted is None:
            emit(Warned(f"sparse/{number}: an adjustment to the positions did not fit the photographs and is left out"))
        return adjusted or model, where, stretch

    def _adjusted_to_points(
        self, number: int, model: Any, where: ControlResiduals, ground: GroundControl, photos: dict[str, Photo]
    ) -> tuple[Any, ControlResiduals, None]:
        """A model on the map, adjusted to the control points; says what is left out."""
        folder = self.work / "controlled" / str(number)
        found, where = adjust_to_points_once(model, where, ground, photos, self.settings, folder)
        if found is None:
            emit(
                Warned(
                    f"sparse/{number}: an adjustment to the control points did not fit the photographs and is left "
                    "out: they place the model, but do not straighten it; are --gcp-sigma and --mark-sigma what they "
                    "were surveyed and marked with?"
                )
            )
        for line in warnings_of(where):
            emit(Warned(f"sparse/{number}: {line}"))
        return found or model, where, None

    def _with_exif(self, number: int, alone: Any, photos: dict[str, Photo]) -> tuple[Any, dict[str, Photo]]:
        """A copy of the model, adjusted to the focal lengths of EXIF if there are some; the photographs, those of the
        model with focal lengths that are held if they cannot tell them, and contradict EXIF."""
        copy = load_engine().Reconstruction(alone)
        if not exif_focals(alone, photos):
            return copy, photos
        found = adjust_once(copy, None, photos, self.settings, self.work / "weighed" / str(number))
        if found is None:
            emit(Warned(f"sparse/{number}: the focal lengths of EXIF do not fit the photographs and are left out"))
        doubted = weighed(alone, found or copy, photos, None)
        if doubted.parallel and any(focal.contradicts for focal in doubted.focals):
            own = {image.name: photos[image.name] for image in map(alone.image, alone.reg_image_ids())}
            held = photos | with_focals_held(own)
            firm = adjust_once(copy, None, held, self.settings, self.work / "held" / str(number))
            if firm is not None:
                return firm, held
        return found or copy, photos

    def _by_points(
        self, number: int, model: Any, ground: GroundControl, photos: dict[str, Photo]
    ) -> ControlResiduals | NoSimilarity:
        """The model by control points, unless these put it where no survey can be; says what is doubtful."""
        given = self.settings
        where = place_by_points(model, ground, given.checkpoints, given.checkpoint_names, given.worst_gcp_sigma)
        if isinstance(where, NoSimilarity):
            return where
        if why := upside_down(model, where.similarity, up_of(model, photos), where.chart.metres, where.handed):
            return NoSimilarity(f"by the ground control points {why}; x must be east and y north, and heights count up")
        for doubt in doubts(where, centres_of(model), list(photos.values())):
            emit(Warned(f"sparse/{number}: {doubt}"))
        return where

    def _report(
        self,
        stages: StageFolder,
        photos: Sequence[Photo],
        placed: Sequence[PlacedModel],
        why: dict[str, str],
    ) -> dict[str, Any]:
        report = {
            "photographs": len(photos),
            "registered": placed[0][0].num_reg_images(),
            "not_registered": why,
            "models": [
                model_facts(model, where) | {"weighed": moved.facts(), "rolling_shutter": rolling.facts()}
                for model, where, moved, rolling in placed
            ],
            "seconds": stages.seconds(),
            "settings": self.settings,
        }
        write_json(self.scene / REPORT_FILE, report)
        draw(self.scene / CAMERAS_PICTURE, read_drawn(self.scene), placed[0][1])
        return report


def _refuse_others(scene: Path, root: Path, before: Sequence[Photo], photos: Sequence[Photo]) -> None:
    """BadInput where a scene was prepared from photographs of another folder, most of which are not there now, by their
    names and what they show: drones call those of each flight alike."""
    known = [photo for photo in before if photo.usable]
    named = _alike(known, photos)
    if not known or 2 * sum(photo.shows_what(other) for photo, other in named) > len(named):
        return
    why = f"most of those names in {root} show something else" if named else f"none of them is in {root}"
    raise BadInput(
        f"{scene} was prepared from other photographs, {few([photo.name for photo in known])}, and {why}; name another "
        f"folder with --out, or delete {scene}"
    )


def _alike(before: Sequence[Photo], photos: Sequence[Photo]) -> list[tuple[Photo, Photo]]:
    """Photographs of before, and those of the same names."""
    now = {photo.name: photo for photo in photos}
    return [(photo, now[photo.name]) for photo in before if photo.name in now]


def read_drawn(scene: Path) -> Any:
    """The first model as it was delivered, with colours."""
    return load_engine().Reconstruction(scene / "sparse" / "0")


def _sim3d(given: Similarity) -> Any:
    engine = load_engine()
    return engine.Sim3d(given.scale, engine.Rotation3d(given.turn), given.move)


def _placed(where: Placement | ControlResiduals, given: str) -> Georeference:
    """For the file beside a model; other programs know `crs` better without a vertical part that nobody has given."""
    crs, heights = where.chart.crs, None
    if given == "auto" and crs.endswith(EGM96):
        crs, heights = crs.removesuffix(EGM96), f"EPSG:{EGM96.removeprefix('+')}"
    return Georeference(crs, where.chart.offset, where.chart.metres, heights)


def _levelled(model: Any, photos: dict[str, Photo]) -> Any:
    """The model turned so that z is up, its points about 0."""
    engine = load_engine()
    turn = turn_upright(up_of(model, photos))
    middle = turn @ np.median(points_of(model), axis=0)
    model.transform(engine.Sim3d(1.0, engine.Rotation3d(turn), -middle))
    return model
