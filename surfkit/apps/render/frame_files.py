"""The pictures of a path in a folder, one for each frame; those that are there already are not drawn again."""

from __future__ import annotations

import hashlib
from collections import deque
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Literal

import torch
from torch import Tensor

from surfkit.core.check import BadInput
from surfkit.core.codec import read_json, write_json
from surfkit.core.events import Progress, Warned, emit
from surfkit.core.lock import LOCK_FILE as LOCK
from surfkit.evaluate.images.comparison_pictures import colour_depth, colour_normal, write_picture
from surfkit.raster.api import Maps
from surfkit.scene.camera import Camera
from surfkit.scene.scene import View

Show = Literal["color", "depth", "normal"]
FRAMES_RECORD = "frames.json"
"""What the pictures of a folder show: what was drawn, and from which cameras."""
WRITTEN_AHEAD = 4
"""Pictures that are compressed while the next ones are drawn."""

Tell = Callable[[str, int, int], None]
"""Told what is done, how much of it, and of how much; what it raises ends the work."""


def tell_all(what: str, done: int, total: int) -> None:
    """Tell whoever listens to events."""
    emit(Progress(what, done, total))


def draw_frames(
    folder: Path,
    cameras: Sequence[Camera],
    draw: Callable[[View], Maps],
    show: Show,
    of: str,
    replace: bool = False,
    tell: Tell = tell_all,
) -> list[Path]:
    """Draw every frame into a folder, and return their paths in order.

    Pictures of the same that the folder has already are kept. The caller has locked it.

    Args:
        folder: For the pictures.
        cameras: One for each frame, local frame.
        draw: Maps of a view.
        show: Which of them; depths have the colours of the middle frame in all frames.
        of: What is drawn: a different text means different pictures.
        replace: Delete frames of anything else that the folder has; else they are an error.
        tell: Who is told after each frame.

    Raises:
        BadInput: The folder has other files.
    """
    paths = [folder / f"{at:06d}.png" for at in range(len(cameras))]
    claim(folder, digest(cameras, show, of), replace)
    left = [at for at, path in enumerate(paths) if not path.exists()]
    bounds = None
    if show == "depth" and left:
        bounds = spread(draw(view_of(cameras[len(cameras) // 2])))
    waiting: deque[Future[None]] = deque()
    with ThreadPoolExecutor(2) as writers:
        for done, at in enumerate(left, len(paths) - len(left) + 1):
            picture = shown(draw(view_of(cameras[at])), show, bounds)
            waiting.append(writers.submit(write_picture, paths[at], picture))
            while len(waiting) >= WRITTEN_AHEAD:
                waiting.popleft().result()
            tell("drawing frames", done, len(paths))
        for each in waiting:
            each.result()
    return paths


def claim(folder: Path, shows: str, replace: bool) -> None:
    """Take a folder for these pictures; BadInput if it has anything else in it."""
    record = folder / FRAMES_RECORD
    if record.exists():
        if read_json(record, dict[str, str]).get("shows") == shows:
            return
        if not replace:
            raise BadInput(
                f"{folder}: it has frames of another model, path or size; delete the folder, or give another --out"
            )
        emit(Warned(f"{folder}: frames of another model, path or size, which are there, are replaced"))
        record.unlink()
        for frame in folder.glob("[0-9]" * 6 + ".png"):
            frame.unlink()
    elif any(path.name != LOCK for path in folder.iterdir()):
        raise BadInput(
            f"{folder}: it has files but no {FRAMES_RECORD}, so frames are not written into it; give another --out"
        )
    write_json(record, {"shows": shows})


def identity(path: Path, compressed: bool = False) -> str:
    """A text that differs between models: of the files that describe a run, and of what they hold; or of one file."""
    model = "compressed/model.surfkit" if compressed else "point_cloud.ply"
    found = hashlib.sha256()
    for name in ("recipe.json", "run.json", "result/result.json", model) if path.is_dir() else ("",):
        file = path / name
        if file.exists():
            facts = file.stat()
            found.update(f"{name} {facts.st_size} {facts.st_mtime_ns}\n".encode())
    return found.hexdigest()


def digest(cameras: Sequence[Camera], show: Show, of: str) -> str:
    """A name for the pictures of a path."""
    found = hashlib.sha256(f"{of}\n{show}\n{len(cameras)}".encode())
    for camera in cameras:
        lens = camera.fx, camera.fy, camera.cx, camera.cy, camera.width, camera.height
        found.update(repr(lens).encode() + camera.world_to_camera.contiguous().numpy().tobytes())
    return found.hexdigest()


def view_of(camera: Camera) -> View:
    """What is drawn from a camera that took no photograph."""
    return View("", camera, Path())


def spread(maps: Maps) -> tuple[float, float] | None:
    """Depths of percentiles 2 and 98 of a picture; None where it shows nothing."""
    depth = depth_of(maps)
    valid = depth[torch.isfinite(depth) & (depth > 0)].double()
    if not len(valid):
        return None
    low, high = torch.quantile(valid[:: max(1, len(valid) // 1_000_000)], valid.new_tensor([0.02, 0.98])).tolist()
    return low, high


def shown(maps: Maps, show: Show, bounds: tuple[float, float] | None) -> Tensor:
    """(3, H, W) in [0, 1]."""
    if show == "color":
        return maps.need("color").detach().cpu()
    if show == "depth":
        return colour_depth(depth_of(maps), bounds)
    if maps.normal is None:
        raise BadInput("--show normal: what this run has made draws no normals; give color or depth")
    return colour_normal(maps.normal)


def depth_of(maps: Maps) -> Tensor:
    """(H, W) depth on the CPU, the median one if it is there; BadInput where none is drawn."""
    if maps.median is not None:
        return maps.median.detach().cpu()
    if maps.depth is None or maps.alpha is None:
        raise BadInput("--show depth: what this run has made draws no depth; give color")
    return maps.expected_depth().detach().cpu()
