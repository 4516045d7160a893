"""Frames to a video file: VP9, in MP4 or WebM, by OpenCV."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
from PIL import Image

from surfkit.apps.render.frame_files import Show, Tell, draw_frames, tell_all
from surfkit.core.check import BadInput, Fault
from surfkit.core.files import sync_folder
from surfkit.core.lock import locked
from surfkit.core.optional import needed
from surfkit.raster.api import Maps
from surfkit.scene.camera import Camera
from surfkit.scene.scene import View
from surfkit.train.faults import full_disk_in_one_line

CODECS = {".mp4": "vp09", ".webm": "VP90"}
"""Names of VP9 by container. OpenCV's packages have no encoder of H.264."""


def is_video(path: Path) -> bool:
    """Whether a path names a video file, and not a folder of pictures."""
    return path.suffix.lower() in CODECS


def require_video() -> ModuleType:
    """OpenCV; BadInput where it does not load."""
    with needed("cv2", "a video"):
        import cv2

    return cv2


def frames_of(path: Path) -> Path:
    """The folder of pictures that a video is made from."""
    return path.with_name(f"{path.name}.frames")


@dataclass(frozen=True)
class Film:
    """What a video shows.

    Attributes:
        cameras: One for each frame, local frame.
        draw: Maps of a view.
        show: Which of them.
        of: What is drawn: a different text means different pictures.
        fps: Frames per second.
    """

    cameras: Sequence[Camera]
    draw: Callable[[View], Maps]
    show: Show
    of: str
    fps: float


def make_video(path: Path, film: Film, keep_frames: bool = False, tell: Tell = tell_all) -> None:
    """Draw the frames of a video into the folder beside it, and make it; an interrupted call goes on from its frames.

    Args:
        path: Of the video.
        film: What it shows; frames of anything else that are in the folder are replaced.
        keep_frames: Do not delete the folder at the end.
        tell: Who is told after each frame.

    Raises:
        BadInput: OpenCV is not installed or has no encoder, or another process makes the same video.
        Fault: The disk is full.
    """
    require_video()  # before hours are spent
    folder = frames_of(path)
    with locked(folder), full_disk_in_one_line(folder):
        frames = draw_frames(folder, film.cameras, film.draw, film.show, film.of, replace=True, tell=tell)
        write_video(path, frames, film.fps, tell)
        if not keep_frames:
            shutil.rmtree(folder)


def write_video(path: Path, frames: Sequence[Path], fps: float, tell: Tell = tell_all) -> None:
    """Make a video of pictures of one size; the file is whole or not there.

    Raises:
        BadInput: OpenCV is not installed, or has no encoder.
        Fault: The disk is full.
    """
    cv2 = require_video()
    unfinished = path.with_name(f".{path.stem}.{os.getpid()}.part{path.suffix.lower()}")  # the ending is the container
    with Image.open(frames[0]) as first:
        size = first.size
    try:
        writer = cv2.VideoWriter(
            str(unfinished), cv2.CAP_FFMPEG, cv2.VideoWriter_fourcc(*CODECS[path.suffix.lower()]), fps, size
        )
        if not writer.isOpened():
            raise BadInput(
                f"{path}: OpenCV {cv2.__version__} cannot encode VP9; install opencv-python-headless, or give a "
                "folder as --out and encode its pictures with another program"
            )
        _write(writer, frames, tell)
        refuse_cut_off(cv2, unfinished, path, frames, tell)
        os.replace(unfinished, path)
        sync_folder(path.parent)
    finally:
        unfinished.unlink(missing_ok=True)


def refuse_cut_off(cv2: ModuleType, video: Path, path: Path, frames: Sequence[Path], tell: Tell) -> None:
    """Fault if a video, to be called `path`, lacks frames: OpenCV does not say when a file could not be written."""
    reader, count = cv2.VideoCapture(str(video)), 0  # what its head says of its length is right even then
    try:
        while reader.grab():
            count += 1
            tell("checking the video", count, len(frames))
    finally:
        reader.release()
    if count < len(frames):
        raise Fault(
            f"{path}: the video could not be written to its end; free some space on the disk, then give the same "
            f"command again: the pictures in {frames[0].parent} are kept"
        )


def _write(writer: Any, frames: Sequence[Path], tell: Tell) -> None:
    try:
        for at, frame in enumerate(frames):
            with Image.open(frame) as picture:
                writer.write(np.ascontiguousarray(np.asarray(picture.convert("RGB"))[..., ::-1]))
            tell("encoding the video", at + 1, len(frames))
    finally:
        writer.release()
