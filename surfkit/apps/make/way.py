"""The steps of `surfkit make`, one after the other: each calls what the command of its name calls."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from surfkit.apps.doctor.estimate import duration
from surfkit.apps.make.extras import Wanted
from surfkit.apps.make.plan import decide, recipe_of, rows
from surfkit.apps.make.quality import QualityName
from surfkit.apps.make.record import MAKE_RECORD, Delivery
from surfkit.apps.maps.command import MapsCommand
from surfkit.apps.maps.map_settings import MapSettings
from surfkit.apps.maps.owned_files import MAPS_RECORD
from surfkit.apps.prepare_photos import PreparePhotosCommand
from surfkit.apps.quality.report import DEFAULT_HTML, DEFAULT_PDF, write_quality
from surfkit.apps.report.report_page import DEFAULT_FILE, ReportOptions, write_report
from surfkit.apps.run_summary import show
from surfkit.apps.texture.command import TextureCommand
from surfkit.apps.texture.texture_mesh import TEXTURE_RECORD
from surfkit.cli.console_table import print_table, tell
from surfkit.core.check import BadInput
from surfkit.core.codec import read_json
from surfkit.core.events import say
from surfkit.core.stages import key_of
from surfkit.io.datasets.data import Data, ReadSettings
from surfkit.io.datasets.depth_prior import prior_files
from surfkit.io.datasets.read import read
from surfkit.raster.select import Device
from surfkit.runs.blocks.train_blocks import Compute
from surfkit.runs.command import refuse_no_mesh
from surfkit.runs.folder import Run
from surfkit.runs.pipeline import opened, run
from surfkit.train.progress_bars import bars

SCENE, RUN, TEXTURE, MAPS = "scene", "run", "texture", "maps"
"""Folders in a delivery."""
OPENED = {
    "quality report": DEFAULT_HTML,
    "quality report (PDF)": DEFAULT_PDF,
    "report": DEFAULT_FILE,
    "textured mesh (GLB)": f"{TEXTURE}/textured.glb",
    "textured mesh (OBJ)": f"{TEXTURE}/textured.obj",
    "textured mesh (3D Tiles)": f"{TEXTURE}/tiles3d/tileset.json",
    "mesh": f"{RUN}/mesh.ply",
    "surface model": f"{MAPS}/dsm.tif",
    "orthophoto": f"{MAPS}/orthophoto.tif",
    "hillshade": f"{MAPS}/hillshade.tif",
    "expected errors of heights": f"{MAPS}/precision.tif",
    "contour lines": f"{MAPS}/contours.gpkg",
    "point cloud": f"{MAPS}/points.copc.laz",
    "splats": f"{RUN}/point_cloud.ply",
    "cameras": f"{SCENE}/sparse/0",
}
"""What a client opens, the first first."""


@dataclass(frozen=True)
class Way:
    """All that a delivery is made from.

    Attributes:
        delivery: Its folder, which is locked.
        photos: What cameras are to be found of; None where `source` has them.
        source: What the user has named.
        reading: How the data set is read.
        quality: The preset.
        steps: That the user wants; None for those of the preset.
        device: Where to compute.
        wanted: What can be made with what is installed.
    """

    delivery: Delivery
    photos: Path | None
    source: Path
    reading: ReadSettings
    quality: QualityName
    steps: int | None
    device: Device
    wanted: Wanted

    @property
    def out(self) -> Path:
        """The folder of the delivery."""
        return self.delivery.out

    def go(self) -> None:
        """Do what is not done yet, and print the way and its end."""
        record = self.delivery.record
        record.left_out = dict(self.wanted.left_out)
        told = self._tell_left_out({})
        data = self.reading.of(self.out / SCENE if self.photos is not None else self.source, 0)
        if self.photos is not None:
            say("time: it is told when the cameras are known")
            self._step("cameras", self.out / SCENE, key_of("cameras"), self._cameras)
        wanted = self._plan(data)
        record.left_out = dict(wanted.left_out)
        self._tell_left_out(told)
        self.delivery.write()
        self._step("surface", self.out / RUN, key_of(recipe_of(self._decisions)), lambda: self._surface(data))
        mesh = self._mesh_key()
        if wanted.texture is not None:
            texture = TextureCommand(self.out / RUN, self.out / TEXTURE, wanted.texture)
            work = self._files_of(texture.run, self.out / TEXTURE, TEXTURE_RECORD)
            self._once("texture", self.out / TEXTURE, key_of(mesh, wanted.texture), work)
        if wanted.maps is not None:
            drawn = self._without_unknown_precision(wanted.maps, data)
            maps = MapsCommand(self.out / RUN, self.out / MAPS, drawn)
            work = self._files_of(maps.run, self.out / MAPS, MAPS_RECORD)
            self._once("maps", self.out / MAPS, key_of(mesh, drawn), work)
        self._once("report", self.out, key_of(mesh, self._text("metrics.json")), self._report)
        key = key_of(mesh, self._text("metrics.json"), self._maps_text(), wanted.pdf)
        self._once("quality", self.out, key, lambda: write_quality(self.out, self.out / DEFAULT_HTML, wanted.pdf))
        self._finish()

    def _without_unknown_precision(self, maps: MapSettings, data: Data) -> MapSettings:
        """The maps that can be drawn of the run: without depth maps no errors are known, and a line says so."""
        if "precision" not in maps.products or opened(self.out / RUN).data.priors is not None:
            return maps
        with bars():
            if prior_files(data, read(data)):
                return maps
        told = dict(self.delivery.record.left_out)
        self.delivery.record.left_out["precision"] = "no depth maps could be made of the photographs"
        self._tell_left_out(told)
        return replace(maps, products=tuple(name for name in maps.products if name != "precision"))

    @property
    def _decisions(self) -> Any:
        decisions = self.delivery.record.decisions
        assert decisions is not None, "what follows needs a plan"
        return decisions

    @property
    def _names(self) -> list[str]:
        """The steps of this delivery."""
        without = {*self.delivery.record.left_out, *(["cameras"] if self.photos is None else [])}
        return [name for name in ("cameras", "surface", "texture", "maps", "report", "quality") if name not in without]

    def _tell_left_out(self, told: dict[str, str]) -> dict[str, str]:
        """Say what is left out and has not been told; all that is told then."""
        for what, why in self.delivery.record.left_out.items():
            if told.get(what) != why:
                say(f"left out: {what}: {why}")
        return dict(self.delivery.record.left_out)

    def _step(self, name: str, folder: Path, key: str, work: Callable[[], Sequence[Path]]) -> None:
        at = self._names.index(name) + 1
        say(f"step {at} of {len(self._names)}: {name}, in {folder}")
        self.delivery.run(name, folder, key, work)

    def _once(self, name: str, folder: Path, key: str, work: Callable[[], Sequence[Path]]) -> None:
        """Do a step whose command does all again when it is given again, unless it is finished."""
        if self.delivery.is_done(name, key):
            at = self._names.index(name) + 1
            say(f"step {at} of {len(self._names)}: {name}: finished, in {folder}")
        else:
            self._step(name, folder, key, work)

    def _cameras(self) -> list[Path]:
        assert self.photos is not None, "a data set has cameras"
        self.delivery.write()  # so that the folder is known to be ours when this goes on
        PreparePhotosCommand(self.photos, self.out / SCENE).prepare()
        return [self.out / SCENE / "sparse"]

    def _plan(self, data: Data) -> Wanted:
        """Decide what is not decided yet, and print it; what can be made of the scene."""
        record = self.delivery.record
        if record.decisions is None:
            record.decisions = decide(data, self.quality, self.steps, self.device, self.out / RUN)
        with bars():
            frame = read(data).frame
        surface = record.steps.get("surface")
        if surface is None or not surface.complete:
            print_table(("plan", f"--quality {self.quality}"), rows(record.decisions))
            print(flush=True)
        if frame.crs is None:
            say("the data set is not georeferenced: mesh, maps and points have its local coordinates")
        return self.wanted.on(frame)

    def _surface(self, data: Data) -> list[Path]:
        recipe, out = recipe_of(self._decisions), self.out / RUN
        metrics = run(recipe, data, out, Compute(self.device))
        made = Run(out, recipe, data)
        show(made, metrics)
        print()
        refuse_no_mesh(made)
        return [made.mesh, made.metrics]

    def _files_of(self, command: Callable[[], None], out: Path, record: str) -> Callable[[], list[Path]]:
        """A command as a step: the files that its record names."""

        def work() -> list[Path]:
            command()
            print()
            return [out / record, *(out / name for name in read_json(out / record, dict[str, Any])["files"])]

        return work

    def _report(self) -> list[Path]:
        path = self.out / DEFAULT_FILE
        write_report((self.out / RUN,), path, ReportOptions())
        return [path]

    def _mesh_key(self) -> str:
        """A digest of which mesh the run has now: it may be made again with other settings."""
        facts = (self.out / RUN / "mesh.ply").stat()
        return key_of(self._text("mesh.json"), facts.st_size, facts.st_mtime_ns)

    def _maps_text(self) -> str:
        """The facts of the maps, which the quality report shows; empty where there are none."""
        path = self.out / MAPS / MAPS_RECORD
        return path.read_text(encoding="utf-8") if path.is_file() else ""

    def _text(self, name: str) -> str:
        try:
            return (opened(self.out / RUN).out / name).read_text(encoding="utf-8")
        except OSError as error:
            raise BadInput(f"{self.out / RUN / name}: cannot be read: {error.strerror}") from error

    def _finish(self) -> None:
        """Save and print what there is to open, and how long it took."""
        record = self.delivery.record
        known = {name: self.out / path for name, path in OPENED.items()}
        record.files = {name: OPENED[name] for name, path in known.items() if path.exists()}
        self.delivery.write()
        paths = [(name, str(self.out / path)) for name, path in record.files.items()]
        print_table(("delivered", "path"), [*paths, ("decisions, times, versions", str(self.out / MAKE_RECORD))])
        print()
        seconds = {name: step.seconds for name, step in record.steps.items() if name in self._names}
        parts = ", ".join(f"{name} {duration(value)}" for name, value in seconds.items())
        tell(f"it took {duration(sum(seconds.values()))}: {parts}")
        for what, why in record.left_out.items():
            tell(f"left out: {what}: {why}")
