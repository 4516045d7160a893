"""How cameras changed the light of a run's photographs: found once, for all stages and blocks."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, TypeVar

import numpy as np
import torch

from surfkit.appearance.base import PhotoLight
from surfkit.core.check import BadInput, few
from surfkit.core.codec import read_json, write_json
from surfkit.core.events import FileWritten, Warned, emit, say
from surfkit.core.registry import name_of
from surfkit.io.datasets.panoramas import points_remedy
from surfkit.io.datasets.read import observations
from surfkit.raster.api import Maps
from surfkit.runs.folder import Run, RunStage
from surfkit.scene.light_spread import LightSpread
from surfkit.scene.observations import Observations
from surfkit.scene.response import CENTRE, CURVE, FALLOFF, mean_falloff
from surfkit.scene.scene import Scene, View
from surfkit.scene.track_colors import axes_of, rows_of, track_colors
from surfkit.scene.track_light import MIN_SEEN, TrackLight, fit_light

Shot = TypeVar("Shot")
"""A photograph."""
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
    """A camera in light.json, see `surfkit.scene.response`.

    Attributes:
        falloff: Stops at r^2, r^4 and r^6.
        centre: Where r is 0, from the principal point, in halves of the diagonal.
        curve: Terms of the response curve.
        mean: Stops that vignetting takes from a picture on average. Colours of the scene are those of the mean
            photograph, averaged over the picture; where it is 0, as in light.json of earlier versions, those where r
            is 0.
    """

    falloff: tuple[float, float, float]
    centre: tuple[float, float]
    curve: tuple[float, float, float]
    mean: float = 0.0


@dataclass(frozen=True)
class LightRecord:
    """Content of light.json.

    Attributes:
        photographs: Training photographs by name.
        cameras: By what tells them apart.
        deviation: Standard deviation of colours of the same place that is left, in [0, 1].
        spread: How far photographs differ, of all or of `sampled` ones; None where nothing tells.
        is_used: Whether colours are changed by it. They are not where an appearance wants to only if light is uneven,
            and it is not, or nothing tells; there are no numbers then.
    """

    photographs: dict[str, PhotoNumbers]
    cameras: dict[str, CameraNumbers]
    deviation: float
    spread: LightSpread | None = None
    is_used: bool = True


def needed_light(run: Run, scene: Scene) -> LightRecord | None:
    """What light.json will say; None if no stage needs it, or it is there.

    Raises:
        BadInput: Nothing tells which photographs show which points.
    """
    found = [stage.stage.appearance for stage in run.stages]
    models = [each for each in found if each is not None and each.needs_light]
    if not models or run.light.exists():
        return None
    tracks, is_wanted = observations(run.data, scene), not all(model.only_if_uneven for model in models)
    if tracks.is_empty and is_wanted:
        raise BadInput(
            f"{run.data.path}: appearance {name_of(models[0])} needs the sparse points that each photograph shows, and "
            f"the data set has none; {points_remedy(run.data.path, (view.name for view in scene.train))}, or choose "
            "appearance:exposure, which learns from the photographs alone"
        )
    if tracks.is_empty:
        say("light of the photographs: not known, as nothing tells which show which points; colours stay as they are")
        return LightRecord({}, {}, 0.0, None, is_used=False)
    some = scene.train if is_wanted else sampled_by_tracks(scene.train, tracks)
    for views in [scene.train] if len(some) == len(scene.train) else [some, scene.train]:  # a few may only seem uneven
        light = light_by_tracks(views, tracks)
        if not is_wanted and not (spread := LightSpread.of(light)).is_uneven:
            say(f"light of the photographs: {spread}; that is little, so colours stay as they are")
            return LightRecord({}, {}, 0.0, spread, is_used=False)
    say(f"light of the photographs: {LightSpread.of(light)}; all are compared in one light")
    if unknown := [view.name for view, seen in zip(scene.train, light.seen, strict=True) if seen < MIN_SEEN]:
        emit(
            Warned(
                f"{len(unknown)} photographs share fewer than {MIN_SEEN} sparse points with others, so their exposure "
                f"is hardly known: {few(unknown)}"
            )
        )
    return recorded(light, scene.train)


def warn_of_light(run: Run, scene: Scene) -> None:
    """Say how far light differs between photographs, where it is uneven and a stage takes all colours as they are."""
    settings = run.recipe.without_appearance
    if not settings or (tracks := observations(run.data, scene)).is_empty:
        return
    if (spread := LightSpread.of(light_by_tracks(sampled_by_tracks(scene.train, tracks), tracks))).is_uneven:
        emit(Warned(spread.remedy(True, settings)))


def sampled(shots: Sequence[Shot], points: int, shown_by: Callable[[Shot], np.ndarray]) -> Sequence[Shot]:
    """Photographs that tell how far light differs: of many, some and for each those that share most points with it.

    Neighbours by their names would be of one flight; places that several flights show are where flights differ.

    Args:
        shots: Photographs.
        points: How many points there are.
        shown_by: (K,) int64 which of them a photograph shows.
    """
    if len(shots) <= GROUPS * GROUP:
        return shots
    chosen, shown = set[int](), [shown_by(shot) for shot in shots]
    for first in np.linspace(0, len(shots) - 1, GROUPS).astype(int):
        is_shown = np.zeros(points, bool)
        is_shown[shown[first]] = True
        shared = np.array([np.count_nonzero(is_shown[rows]) for rows in shown])
        shared[list(chosen)] = -1
        chosen |= {*np.argsort(-shared, kind="stable")[:GROUP].tolist()}
    return tuple(shots[at] for at in sorted(chosen))


def sampled_by_tracks(views: Sequence[View], tracks: Observations) -> Sequence[View]:
    """See `sampled`, by the sparse points that they are known to show."""
    none = np.zeros(0, np.int64)
    return sampled(
        views, len(tracks.xyz), lambda view: tracks.seen[view.name].points if view.name in tracks.seen else none
    )


def light_by_tracks(views: Sequence[View], tracks: Observations) -> TrackLight:
    """The light of some photographs, from the sparse points that they show."""
    return fit_light(track_colors(views, tracks), rows_of(views), axes_of(views))


def recorded(light: TrackLight, views: Sequence[View]) -> LightRecord:
    """A fit to some views, by name."""
    lenses = {view.taken_by: view.camera for view in reversed(views)}  # of the first view of each
    names = list(dict.fromkeys(view.taken_by for view in views))
    photographs = {
        view.name: PhotoNumbers(tuple(stops.tolist()), view.taken_by, int(seen))
        for view, stops, seen in zip(views, light.stops, light.seen, strict=True)
    }
    cameras = {
        name: CameraNumbers(
            falloff=tuple(numbers[FALLOFF].tolist()),
            centre=tuple(numbers[CENTRE].tolist()),
            curve=tuple(numbers[CURVE].tolist()),
            mean=mean_falloff(numbers, lenses[name]),
        )
        for name, numbers in zip(names, light.cameras, strict=True)
    }
    return LightRecord(photographs, cameras, light.deviation, LightSpread.of(light))


def write_light(run: Run, record: LightRecord | None) -> None:
    """Write light.json, if there is something to write."""
    if record is not None:
        write_json(run.light, record)
        emit(FileWritten(run.light, "exposures and vignetting"))


def light_in_short(run: Run, found: LightRecord | None) -> dict[str, Any] | None:
    """What run.json says: how far light differs, and whether colours are changed by it; None where nothing needs it.

    Args:
        run: Its light.json counts where nothing was `found` just now.
        found: What light.json will say.
    """
    record = found or (read_json(run.light, LightRecord) if run.light.exists() else None)
    if record is None:
        return None
    return {"is_used": record.is_used, **({} if record.spread is None else asdict(record.spread))}


def light_of(run: Run, views: Sequence[View]) -> PhotoLight | None:
    """What light.json says of some views; None where it changes no colour.

    Raises:
        BadInput: It is not there, damaged, or does not know one of them.
    """
    record = read_json(run.light, LightRecord)
    if not record.is_used:
        return None
    known = [(record.photographs.get(view.name), view.name) for view in views]
    if lost := [name for one, name in known if one is None or one.camera not in record.cameras]:
        raise BadInput(f"{run.light}: it lacks {few(lost)}; delete it and train again, which writes it again")
    photographs = [one for one, _ in known if one is not None]
    return _photo_light([one.stops for one in photographs], [record.cameras[one.camera] for one in photographs])


def held_out_response(run: Run, stage: RunStage) -> Callable[[View, Maps], Maps] | None:
    """What turns maps of held-out views into what the cameras of light.json take: with vignetting and response curve.

    Their exposure is that of the mean photograph: only they could tell theirs, and they are measured against. Views of
    a camera that took no photograph that is trained on stay as they are.

    Args:
        run: Whose light.json it is.
        stage: Whose model is drawn. One that learns from renders has the light of the stage before.

    Returns:
        None where nothing is known of any camera.
    """
    stages = run.stages[: 1 + [each.name for each in run.stages].index(stage.name)]
    seeing = (each for each in reversed(stages) if each.refine is None or not each.refine.taught)
    model = next(seeing).stage.appearance
    if model is None or not model.needs_light or not run.light.exists():
        return None
    record = read_json(run.light, LightRecord)
    cameras, folders = record.cameras, dict[str, str]()
    for name, photograph in record.photographs.items():
        folders.setdefault(_folder(name), photograph.camera)

    def respond(view: View, maps: Maps) -> Maps:
        # Earlier versions called cameras otherwise: then it is that of the other photographs of the folder.
        camera = cameras.get(view.taken_by) or cameras.get(folders.get(_folder(view.name), ""))
        if camera is None:
            return maps
        numbers, color = model.begin_with(_photo_light([(0.0, 0.0, 0.0)], [camera]))[0], maps.need("color")
        with torch.no_grad():
            return replace(maps, color=model(numbers.to(color), color, view.camera))

    return respond if cameras else None


def _folder(name: str) -> str:
    """Of a photograph."""
    return name.replace("\\", "/").rpartition("/")[0]


def _photo_light(stops: Sequence[tuple[float, float, float]], cameras: Sequence[CameraNumbers]) -> PhotoLight:
    numbers = np.array([[*camera.falloff, *camera.centre, *camera.curve] for camera in cameras], np.float32)
    mean = torch.tensor([[camera.mean] for camera in cameras])
    return PhotoLight(torch.tensor(stops, dtype=torch.float32) + mean, torch.from_numpy(numbers))
