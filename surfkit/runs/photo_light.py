"""How cameras changed the light of a run's photographs: found once, for all stages and blocks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from surfkit.appearance.base import PhotoLight
from surfkit.appearance.response import CENTRE, CURVE, FALLOFF
from surfkit.appearance.track_light import MIN_SEEN, LightSpread, TrackLight, fit_light, rows_of, track_colors
from surfkit.core.check import BadInput, few
from surfkit.core.codec import read_json, write_json
from surfkit.core.events import FileWritten, Warned, emit, say
from surfkit.core.registry import name_of
from surfkit.io.datasets.panoramas import points_remedy
from surfkit.io.datasets.read import observations
from surfkit.runs.folder import Run
from surfkit.scene.scene import Scene, View

GROUPS, GROUP = 5, 20
"""Of photographs, and how many each has, that are looked at for a warning."""


@dataclass(frozen=True)
class PhotoNumbers:
    """A photograph in light.json.

    Attributes:
        stops: How much brighter than the mean photograph it is: of red, green and blue.
        camera: Which of the cameras took it.
        points: Sparse points that it shares with others.
    """

    stops: tuple[float, float, float]
    camera: str
    points: int


@dataclass(frozen=True)
class CameraNumbers:
    """A camera in light.json, see `surfkit.appearance.response`.

    Attributes:
        falloff: Stops at r^2, r^4 and r^6.
        centre: Where r is 0, from the principal point, in halves of the diagonal.
        curve: Terms of the response curve.
    """

    falloff: tuple[float, float, float]
    centre: tuple[float, float]
    curve: tuple[float, float, float]


@dataclass(frozen=True)
class LightRecord:
    """Content of light.json.

    Attributes:
        photographs: Training photographs by name.
        cameras: By what tells them apart.
        deviation: Standard deviation of colours of the same place that is left, in [0, 1].
    """

    photographs: dict[str, PhotoNumbers]
    cameras: dict[str, CameraNumbers]
    deviation: float


def needed_light(run: Run, scene: Scene) -> LightRecord | None:
    """What light.json will say; None if no stage needs it, or it is there.

    Raises:
        BadInput: Nothing tells which photographs show which points.
    """
    found = [stage.stage.appearance for stage in run.stages]
    model = next((each for each in found if each is not None and each.needs_light), None)
    if model is None or run.light.exists():
        return None
    tracks = observations(run.data, scene)
    if tracks.is_empty:
        raise BadInput(
            f"{run.data.path}: appearance {name_of(model)} needs the sparse points that each photograph shows, and the "
            f"data set has none; {points_remedy(run.data.path, (view.name for view in scene.train))}, or choose "
            "appearance:exposure, which learns from the photographs alone"
        )
    light = fit_light(track_colors(scene.train, tracks), rows_of(scene.train))
    say(f"light of the photographs: {LightSpread.of(light)}")
    if unknown := [view.name for view, seen in zip(scene.train, light.seen, strict=True) if seen < MIN_SEEN]:
        emit(
            Warned(
                f"{len(unknown)} photographs share fewer than {MIN_SEEN} sparse points with others, so their exposure "
                f"is hardly known: {few(unknown)}"
            )
        )
    return recorded(light, scene.train)


def warn_of_light(run: Run, scene: Scene) -> None:
    """Say how far light differs between photographs, where it is uneven and a stage takes all colours as they are.

    Of many photographs, some are looked at: groups that follow one another in the order of their names.
    """
    settings = run.recipe.without_appearance
    if not settings or (tracks := observations(run.data, scene)).is_empty:
        return
    views = scene.train
    if len(views) > GROUPS * GROUP:
        starts = np.linspace(0, len(views) - GROUP, GROUPS).astype(int)
        views = tuple(view for start in starts for view in views[start : start + GROUP])
    spread = LightSpread.of(fit_light(track_colors(views, tracks), rows_of(views)))
    if spread.is_uneven:
        emit(Warned(spread.remedy(True, settings)))


def recorded(light: TrackLight, views: Sequence[View]) -> LightRecord:
    """A fit to some views, by name."""
    names = list(dict.fromkeys(view.taken_by for view in views))
    photographs = {
        view.name: PhotoNumbers(tuple(stops.tolist()), view.taken_by, int(seen))
        for view, stops, seen in zip(views, light.stops, light.seen, strict=True)
    }
    cameras = {
        name: CameraNumbers(*(tuple(numbers[part].tolist()) for part in (FALLOFF, CENTRE, CURVE)))
        for name, numbers in zip(names, light.cameras, strict=True)
    }
    return LightRecord(photographs, cameras, light.deviation)


def write_light(run: Run, record: LightRecord | None) -> None:
    """Write light.json, if there is something to write."""
    if record is not None:
        write_json(run.light, record)
        emit(FileWritten(run.light, "exposures and vignetting"))


def light_of(run: Run, views: Sequence[View]) -> PhotoLight:
    """What light.json says of some views.

    Raises:
        BadInput: It is not there, damaged, or does not know one of them.
    """
    record = read_json(run.light, LightRecord)
    known = [(record.photographs.get(view.name), view.name) for view in views]
    if lost := [name for one, name in known if one is None or one.camera not in record.cameras]:
        raise BadInput(f"{run.light}: it lacks {few(lost)}; delete it and train again, which writes it again")
    photographs = [one for one, _ in known if one is not None]
    cameras = [record.cameras[one.camera] for one in photographs]
    numbers = np.array([[*camera.falloff, *camera.centre, *camera.curve] for camera in cameras], np.float32)
    stops = np.array([one.stops for one in photographs], np.float32)
    return PhotoLight(torch.from_numpy(stops), torch.from_numpy(numbers))
