"""Frames of a video that serve as photographs: sharp ones, each moved on from the one before by a share of the width.

How far the picture has moved is the upper quartile of the displacements of corners that are followed from frame to
frame (pyramidal Lucas and Kanade, 1981; good features to track, Shi and Tomasi, 1994), since the last frame in which
they were chosen anew. So a camera that stands still gets nowhere, however long.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from surfkit.core.check import BadInput
from surfkit.core.codec import read_json, write_json
from surfkit.core.events import Progress, Warned, emit
from surfkit.core.files import replacing_folder
from surfkit.core.optional import needed

VIDEO_RECORD = "frames.json"
"""What was taken of a video, beside the frames."""
FRAME_PATTERN = re.compile(r"\d{6,}\.jpg")
"""Of a frame: its number in the video, from 0."""
CACHE_VERSION = "1"
"""Changes when other frames would be taken of the same video."""
JPEG_QUALITY = 95
"""Of JPEG files."""
FOLLOWED_PX, SHARP_PX = 320, 960
"""Longer side of frames in which corners are followed, and sharpness is measured."""
MAX_CORNERS, MIN_CORNERS = 200, 20
"""Corners that are followed; fewer do not tell the movement."""
MAX_CORNER_MOVE_WIDTHS = 0.05
"""Widths that corners have moved by when they are chosen anew."""
MOTION_PERCENTILE = 75
"""Percentile of the displacements that counts: in a circle about something its middle hardly moves."""
MAX_RETURN_PX = 1.0
"""A corner is lost that comes back to another place when it is followed backwards."""
MAX_LOST_FRAMES = 10
"""Frames in a row in which no corner is found again, after which the picture is another one."""
MAX_STEP_OFFSET = 0.35
"""Of a step: a frame is the sharpest of those that are nearer than this to where it should be."""
SHARPNESS_WINDOW_FRAMES = 15
"""Frames before and after, with which the sharpness of one is compared."""
MIN_SHARPNESS_RATIO = 0.6
"""A frame is blurred below this share of the upper quartile of the sharpness around it."""
MAX_STEP_WIDTHS = 0.3
"""Share of the width that the picture moves by between two frames, beyond which few places are in four of them."""
CONVERT = "convert it to MP4 with H.264, or take frames with ffmpeg"
MIN_FRAME_SHARE = 0.95
"""A video with less than this share of the frames that its head names is cut off."""


@dataclass(frozen=True)
class ExtractedFrames:
    """Frames that were taken of a video.

    Attributes:
        key: Of the file and the settings.
        frames: How many the video has.
        step: Share of the width that the picture moves by from one to the next.
        names: Of the files, in their order.
    """

    key: str
    frames: int
    step: float
    names: tuple[str, ...]


@dataclass(frozen=True)
class Track:
    """What is known of each frame of a video.

    Attributes:
        way: (F,) how far the picture has moved up to it, widths.
        sharpness: (F,) standard deviation of the Laplacian over the contrast.
    """

    way: np.ndarray
    sharpness: np.ndarray


def require_opencv(video: Path) -> Any:
    """The module cv2; BadInput without it."""
    with needed("cv2", f"{video}: taking frames of a video"):
        import cv2
    return cv2


def take_frames(video: Path, folder: Path, step: float, most: int) -> ExtractedFrames:
    """Take frames of a video into a folder, unless an earlier call has with the same settings.

    Args:
        video: A file.
        folder: For the frames of this video; what is in it is replaced when all went well.
        step: Share of the width that the picture moves by from one to the next.
        most: Frames at most; if there were more, `step` becomes larger.

    Raises:
        BadInput: OpenCV is missing or cannot read it.
    """
    stat = video.stat()
    key = f"{CACHE_VERSION} {JPEG_QUALITY} {stat.st_size} {stat.st_mtime_ns} {step} {most}"
    try:
        before = read_json(folder / VIDEO_RECORD, ExtractedFrames)
    except BadInput:
        before = None
    if before is not None and before.key == key and all(_is_there(folder, name) for name in before.names):
        _tell(video, before)
        return before
    cv2 = require_opencv(video)
    track = follow(cv2, video)
    chosen, step = choose(track, step, most)
    digits = max(6, len(str(len(track.way))))
    names = tuple(f"{at:0{digits}}.jpg" for at in chosen)
    with replacing_folder(folder) as made:
        for done, (name, frame) in enumerate(zip(names, _frames(cv2, video, chosen), strict=True), 1):
            Image.fromarray(frame[..., ::-1]).save(made / name, "JPEG", quality=JPEG_QUALITY, subsampling=0)
            emit(Progress(f"taking frames of {video.name}", done, len(names)))
        taken = ExtractedFrames(key, len(track.way), step, names)
        write_json(made / VIDEO_RECORD, taken)
    _tell(video, taken)
    return taken


def follow(cv2: Any, video: Path) -> Track:
    """How far the picture moves in a video, and how sharp each frame is."""
    way, sharpness = [0.0], []
    before, anchors, places = None, np.empty((0, 2), np.float32), np.empty((0, 2), np.float32)
    start, lost = 0.0, 0
    total = int(_opened(cv2, video).get(cv2.CAP_PROP_FRAME_COUNT))  # 0 or less where the file does not say
    for at, frame in enumerate(_frames(cv2, video)):
        grey = cv2.cvtColor(frame, cv2.COLOR_BGR2GRAY)
        sharpness.append(_sharpness(cv2, _reduced(cv2, grey, SHARP_PX)))
        small = _reduced(cv2, grey, FOLLOWED_PX)
        if before is None:
            before, anchors = small, _corners(cv2, small)
            places = anchors
        else:
            found, kept = _followed(cv2, before, small, places)
            if kept.sum() >= min(MIN_CORNERS, max(len(places), 1)):
                before, anchors, places, lost = small, anchors[kept], found[kept], 0
                moved = (
                    float(np.percentile(np.linalg.norm(places - anchors, axis=1), MOTION_PERCENTILE)) / small.shape[1]
                )
                way.append(start + moved)
                if moved > MAX_CORNER_MOVE_WIDTHS or len(places) < MAX_CORNERS // 4:
                    start, anchors = way[-1], _corners(cv2, small)
                    places = anchors
            else:  # a blurred frame, or another scene
                lost += 1
                way.append(way[-1])
                if lost > MAX_LOST_FRAMES or not len(places):
                    start, lost, before, anchors = way[-1] + MAX_CORNER_MOVE_WIDTHS, 0, small, _corners(cv2, small)
                    way[-1], places = start, anchors
        if at % 25 == 0 and total > 0:
            emit(Progress(f"looking at {video.name}", min(at + 1, total), total))
    if not sharpness:
        raise BadInput(f"{video}: OpenCV finds no frame in it; {CONVERT}")
    if len(sharpness) < MIN_FRAME_SHARE * total:
        emit(Warned(f"{video}: ends after {len(sharpness)} of {total} frames: it is cut off or damaged there"))
    emit(Progress(f"looking at {video.name}", len(sharpness), len(sharpness)))
    return Track(np.array(way), np.array(sharpness))


def choose(track: Track, step: float, most: int) -> tuple[list[int], float]:
    """Positions of the frames to take, in order: the sharpest near each step of the way, none that is blurred; and the
    step, which becomes larger where these would be more than `most`."""
    count = len(track.way)
    usual = np.array(
        [
            np.percentile(track.sharpness[max(0, at - SHARPNESS_WINDOW_FRAMES) : at + SHARPNESS_WINDOW_FRAMES + 1], 75)
            for at in range(count)
        ]
    )
    good = np.flatnonzero(track.sharpness >= MIN_SHARPNESS_RATIO * usual)
    way, sharpness = track.way[good], track.sharpness[good]
    while True:
        chosen, target = [], way[0]
        while True:
            near = np.flatnonzero(np.abs(way - target) <= MAX_STEP_OFFSET * step)
            beyond = np.flatnonzero(way > target + MAX_STEP_OFFSET * step)
            if len(near):
                at = near[sharpness[near].argmax()]
            elif len(beyond):
                at = beyond[0]
            else:
                break
            chosen.append(int(good[at]))
            target = way[at] + step
        if len(chosen) <= most:
            return chosen, step
        step *= len(chosen) / most


def _is_there(folder: Path, name: str) -> bool:
    """Whether a frame lies in a folder, and not elsewhere."""
    return FRAME_PATTERN.fullmatch(name) is not None and (folder / name).is_file()


def _tell(video: Path, taken: ExtractedFrames) -> None:
    """Say how many frames were taken, and whether they overlap."""
    said = f"{video}: {len(taken.names)} of {taken.frames} frames are taken, one each time that the picture moves by"
    wide = ", so that they hardly overlap; give more --frames" if taken.step > MAX_STEP_WIDTHS else ""
    emit(Warned(f"{said} {taken.step:.0%} of its width{wide}"))


def _opened(cv2: Any, video: Path) -> Any:
    reader = cv2.VideoCapture(str(video))
    if not reader.isOpened():
        raise BadInput(f"{video}: OpenCV cannot read it; {CONVERT}")
    reader.set(cv2.CAP_PROP_ORIENTATION_AUTO, 1)  # the rotation in the metadata, as players apply it
    return reader


def _frames(cv2: Any, video: Path, wanted: Sequence[int] | None = None) -> Iterator[np.ndarray]:
    """(h, w, 3) uint8 BGR of each frame, or of those at some positions."""
    reader, at, left = _opened(cv2, video), 0, None if wanted is None else set(wanted)
    try:
        while reader.grab() and left != set():
            if left is None or at in left:
                whole, frame = reader.retrieve()
                if not whole:
                    return
                yield frame
            if left is not None:
                left.discard(at)
            at += 1
    finally:
        reader.release()


def _reduced(cv2: Any, grey: np.ndarray, longest: int) -> np.ndarray:
    by = longest / max(grey.shape)
    if by >= 1:
        return grey
    size = max(1, round(grey.shape[1] * by)), max(1, round(grey.shape[0] * by))
    return cv2.resize(grey, size, interpolation=cv2.INTER_AREA)


def _sharpness(cv2: Any, grey: np.ndarray) -> float:
    return float(cv2.Laplacian(grey, cv2.CV_32F).std()) / max(float(grey.std()), 1.0)


def _corners(cv2: Any, grey: np.ndarray) -> np.ndarray:
    """(C, 2) float32 of corners, spread over the picture."""
    found = cv2.goodFeaturesToTrack(grey, MAX_CORNERS, 0.01, max(grey.shape) / 50)
    return np.empty((0, 2), np.float32) if found is None else found.reshape(-1, 2)


def _followed(cv2: Any, before: np.ndarray, now: np.ndarray, places: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Where corners are in the next frame, (C, 2), and (C,) which of them are found there."""
    if not len(places):
        return places, np.zeros(0, bool)
    there, seen, _ = cv2.calcOpticalFlowPyrLK(before, now, places.reshape(-1, 1, 2), None)
    back, again, _ = cv2.calcOpticalFlowPyrLK(now, before, there, None)
    off = np.linalg.norm(back.reshape(-1, 2) - places, axis=1)
    return there.reshape(-1, 2), (seen.ravel() == 1) & (again.ravel() == 1) & (off < MAX_RETURN_PX)
