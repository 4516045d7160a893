"""`surfkit render`."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from surfkit.apps.render.drawn_levels import DrawnLevels
from surfkit.apps.render.frame_files import Show, draw_frames, identity
from surfkit.apps.render.path import MAX_FRAMES, MAX_SIDE_PX, CameraPath, flyover, from_file, lens_of, orbit
from surfkit.apps.render.video import Film, is_video, make_video, require_video
from surfkit.cli.console_table import print_table
from surfkit.core.check import BadInput
from surfkit.core.lock import locked
from surfkit.primitives.drawing import drawn_by
from surfkit.raster.select import Device
from surfkit.runs.context import RunContext
from surfkit.runs.make_levels import load_levels
from surfkit.runs.methods.base import Reconstruction
from surfkit.runs.pipeline import loaded
from surfkit.runs.run_method import splats_of
from surfkit.runs.run_notes import collect_notes
from surfkit.scene.camera import Camera
from surfkit.scene.scene import Scene
from surfkit.train.faults import full_disk_in_one_line
from surfkit.train.progress_bars import bars

SIZE_PATTERN = re.compile(r"(\d{1,5})x(\d{1,5})")
FPS = 30.0
MADE_PATHS: dict[str, Callable[[Scene, Camera, int], CameraPath]] = {"orbit": orbit, "flyover": flyover}


@dataclass(frozen=True)
class RenderCommand:
    """Draw a finished run along a path of the camera, as a video or as pictures.

    Example: `surfkit render RUN --path orbit --out orbit.mp4 --seconds 20 --size 1920x1080`. When it is interrupted,
    the same command goes on where it stopped.
    """

    run_folder: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUN")]
    """Folder that `surfkit train` made."""

    path: Annotated[str, tyro.conf.arg(metavar="orbit|flyover|FILE")] = "orbit"
    """orbit: around the middle of the scene. flyover: straight over it, along its longest side. FILE: JSON with cameras
    to fly through, as RUN/cameras.json, or a camera path of nerfstudio in the frame of the data set."""

    out: Path | None = None
    """Video file, .mp4 or .webm (needs OpenCV: `pip install 'surfkit[video]'`), or a folder for pictures. Default: a
    video in the run folder, named after the path."""

    seconds: float = 10.0
    """Length of the video. A camera path of nerfstudio has its own number of frames."""

    fps: float | None = None
    """Frames per second. Default: what the file of cameras says, otherwise 30."""

    size: Annotated[str | None, tyro.conf.arg(metavar="WIDTHxHEIGHT")] = None
    """Size of the pictures, pixels, such as 1920x1080. Default: that of the training photographs."""

    show: Show = "color"
    """What is drawn."""

    compressed: bool = False
    """Draw the compressed model of the run (`surfkit compress`)."""

    lod: bool = False
    """Draw the levels of detail of the run (`surfkit lod`), as each frame needs them; prints how many splats that are,
    and the time."""

    lod_pixels: float | None = None
    """With --lod: largest error of the blocks that are drawn, pixels; for lod:hierarchy largest size of a splat's
    box. 1 if it is not given."""

    keep_frames: bool = False
    """Keep the folder of pictures beside the video, OUT.frames."""

    device: Device = "auto"
    """Device for rendering: auto, cpu, cuda, cuda:1, or a rasterizer by its name (`surfkit components rasterizer`)."""

    def __post_init__(self) -> None:
        for name, value in (("seconds", self.seconds), ("fps", self.fps)):
            if value is not None and not 0 < value <= 1e6:
                raise BadInput(f"--{name} {value:g}: give more than 0, up to a million")
        if self.lod_pixels is not None and not 0 <= self.lod_pixels < float("inf"):
            raise BadInput(f"--lod-pixels {self.lod_pixels:g}: give 0 or more")
        if self.lod_pixels is not None and not self.lod:
            raise BadInput(f"--lod-pixels {self.lod_pixels:g} is for levels of detail; add --lod")
        if self.lod and self.compressed:
            raise BadInput("--lod and --compressed are two models of the run: leave out one of them")
        if self.frames > MAX_FRAMES:
            raise BadInput(f"--seconds {self.seconds:g}: that is {self.frames} frames; at most {MAX_FRAMES} are drawn")
        self.sides()
        if self.path not in MADE_PATHS and not Path(self.path).is_file():
            raise BadInput(
                f"--path {self.path}: no such file; give {', '.join(MADE_PATHS)} or a JSON file with cameras"
            )
        if self.out is not None and self.out.suffix and not is_video(self.out):
            raise BadInput(f"--out {self.out}: give a video, .mp4 or .webm, or a folder for pictures")

    @property
    def frames(self) -> int:
        """How many there are, if the path does not say."""
        return max(1, round(self.seconds * (self.fps or FPS)))

    def sides(self) -> tuple[int, int] | None:
        """Width and height in pixels; BadInput if `size` is none."""
        if self.size is None:
            return None
        found = SIZE_PATTERN.fullmatch(self.size)
        sides = tuple(map(int, found.groups())) if found else (0, 0)
        if not all(16 <= side <= MAX_SIDE_PX for side in sides):
            raise BadInput(
                f"--size {self.size}: give width and height such as 1920x1080, of 16 to {MAX_SIDE_PX} pixels"
            )
        return sides[0], sides[1]

    def run(self) -> None:
        """Draw the frames, make the video, and print what was written."""
        name = self.path if self.path in MADE_PATHS else Path(self.path).stem
        out = self.out or self.run_folder / f"{name}.mp4"
        film = is_video(out)
        if film:
            require_video()  # before anything is read
        with collect_notes(), bars(), loaded(self.run_folder, self.device, self.compressed) as (ctx, made):
            draw = (made.draw_color if self.show == "color" else None) or made.draw
            if draw is None:
                raise BadInput(f"{ctx.run.out}: what its method has made draws no pictures")
            levels = self.levels_of(ctx, made) if self.lod else None
            draw = levels or draw
            flight = self.flight(ctx.scene)
            fps = self.fps or flight.fps or FPS
            model = identity(self.run_folder, self.compressed)
            if levels is not None:
                model += f" {levels.pixels!r} {identity(ctx.run.lod_record)}"
            if film:
                make_video(out, Film(flight.cameras, draw, self.show, model, fps), self.keep_frames)
            else:
                with locked(out), full_disk_in_one_line(out):
                    draw_frames(out, flight.cameras, draw, self.show, model)
        lens, count = flight.cameras[0], len(flight.cameras)
        print_table(
            ("render", "value"),
            [
                ("path", self.path),
                ("frames", f"{count}, {count / fps:.1f} s at {fps:g} per second"),
                ("size", f"{lens.width} x {lens.height}"),
                ("video" if film else "pictures", str(out)),
                *(levels.rows() if levels is not None else ()),
            ],
        )

    def levels_of(self, ctx: RunContext, made: Reconstruction) -> DrawnLevels:
        """What draws the levels of detail of the run."""
        model = splats_of(ctx.run, made)
        tree, pixels = load_levels(ctx.run, model), 1.0 if self.lod_pixels is None else self.lod_pixels
        return DrawnLevels(tree, drawn_by(model.primitive, ctx.rasterizer), pixels, self.show != "color")

    def flight(self, scene: Scene) -> CameraPath:
        """The cameras of all frames."""
        lens = lens_of(scene, self.sides())
        if self.path in MADE_PATHS:
            return MADE_PATHS[self.path](scene, lens, self.frames)
        return from_file(Path(self.path), scene.frame, lens, self.frames)


COMMAND = RenderCommand
