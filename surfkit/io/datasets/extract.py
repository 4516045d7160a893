"""What some views of a scene need, in a file of its own: who has it need not read the data set, which may be large."""

from __future__ import annotations

import json
from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch

from surfkit.core.check import BadInput
from surfkit.core.codec import dump, from_json
from surfkit.core.codec import load as load_value
from surfkit.core.files import replacing
from surfkit.io.datasets.depth_prior import DepthAlignment
from surfkit.scene.camera import Camera
from surfkit.scene.pixels import DEFAULT_PIXELS, Pixels
from surfkit.scene.scene import Frame, Lens, Mask, Scene, SparsePoints, View


@dataclass(frozen=True)
class Extract:
    """Some views of a scene.

    Attributes:
        scene: With these for training, none held out, and no cloud.
        priors: How their depth maps are aligned, where that was asked for.
    """

    scene: Scene
    priors: DepthAlignment | None


@dataclass(frozen=True)
class ExtractedView:
    """A view but for its pose, as in the file."""

    name: str
    path: Path
    mask: Mask | None
    white: bool
    lens: tuple[float, float, float, float]
    size: tuple[int, int]
    bent: Lens | None = None
    pixels: Pixels = DEFAULT_PIXELS
    taken_by: str = ""


@dataclass(frozen=True)
class ExtractHeader:
    """What is not in arrays."""

    name: str
    shots: tuple[ExtractedView, ...]
    scale: float
    metres: float | None
    crs: str | None
    shift: tuple[float, float, float]
    priors: DepthAlignment | None


def of(scene: Scene, names: Iterable[str], priors: DepthAlignment | None) -> Extract:
    """The training views of these names alone; `priors` are those of the whole scene."""
    wanted = set(names)
    part = _scene(scene.name, tuple(view for view in scene.train if view.name in wanted), scene.frame)
    fits = {} if priors is None else {name: fit for name, fit in priors.fits.items() if name in wanted}
    return Extract(part, None if priors is None else replace(priors, fits=fits))


def _scene(name: str, views: tuple[View, ...], frame: Frame) -> Scene:
    return Scene(name, views, (), SparsePoints(torch.zeros(0, 3), torch.zeros(0, 3, dtype=torch.uint8)), frame)


def save(path: Path, made: Extract) -> None:
    """Write an extract."""
    scene, frame = made.scene, made.scene.frame
    shots = tuple(
        ExtractedView(
            v.name,
            v.path,
            v.mask,
            v.white,
            (c.fx, c.fy, c.cx, c.cy),
            (c.width, c.height),
            v.lens,
            v.pixels,
            v.taken_by,
        )
        for v in scene.train
        for c in [v.camera]
    )
    facts = ExtractHeader(scene.name, shots, frame.scale, frame.metres, frame.crs, frame.shift, made.priors)
    poses = np.stack([view.camera.world_to_camera.numpy() for view in scene.train])
    with replacing(path) as file:
        np.savez(file, facts=np.array(json.dumps(dump(facts))), poses=poses, origin=frame.origin)


def is_whole(path: Path) -> bool:
    """Whether there is an extract in a file."""
    try:
        load(path)
    except BadInput:
        return False
    return True


def load(path: Path) -> Extract:
    """The extract in a file.

    Raises:
        BadInput: It is not there or damaged.
    """
    try:
        with np.load(path) as file:
            arrays = {name: file[name] for name in file.files}
        return _extract(arrays)
    except Exception as error:  # of a damaged file, zipfile and numpy raise whatever comes
        told = "is not there" if isinstance(error, FileNotFoundError) else f"cannot be used ({error})"
        raise BadInput(f"{path} {told}; give the surfkit train command again, which writes it again") from error


def _extract(arrays: dict[str, np.ndarray]) -> Extract:
    facts = load_value(ExtractHeader, from_json(str(arrays["facts"])))
    views = tuple(
        View(
            s.name,
            Camera(torch.from_numpy(pose), *s.lens, *s.size),
            s.path,
            s.mask,
            s.white,
            s.bent,
            s.pixels,
            s.taken_by,
        )
        for s, pose in zip(facts.shots, arrays["poses"], strict=True)
    )
    frame = Frame(arrays["origin"], facts.scale, facts.metres, facts.crs, facts.shift)
    return Extract(_scene(facts.name, views, frame), facts.priors)
