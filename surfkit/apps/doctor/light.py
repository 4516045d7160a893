"""How differently photographs show the same places: exposure, white balance, dark corners."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from surfkit.apps.doctor.examine_photos import Photograph
from surfkit.apps.doctor.finding import Finding
from surfkit.apps.doctor.gather import Gathered
from surfkit.apps.doctor.geometry import seen_by
from surfkit.io.datasets.photo_cameras import cameras_of
from surfkit.io.datasets.undistort import is_panorama
from surfkit.runs.recipe import Recipe
from surfkit.scene.light_spread import LightSpread
from surfkit.scene.track_colors import TrackColors, sensor_axes
from surfkit.scene.track_light import MIN_SEEN, fit_light

MIN_PHOTOGRAPHS = 3
"""Photographs that are compared, at least."""


def uneven_light(gathered: Gathered, known: Mapping[str, Photograph], xyz: np.ndarray, recipe: Recipe) -> list[Finding]:
    """A warning where light differs between photographs and the recipe learns nothing of it; a note where it will.

    Sparse points are looked for in all photographs whose cameras have them in view. Those that something hides there
    are told by their colours, which fit no others.

    Args:
        gathered: The data set.
        known: A look at its photographs, of those to compare with the colours at the points, by name.
        xyz: (S, 3) the points, input frame.
        recipe: To train by.
    """
    colors = {name: look.colors for name, look in known.items() if look.colors is not None and not look.flat}
    shots = [shot for shot in gathered.capture.shots if shot.name in colors]
    without, looking = recipe.without_appearance, recipe.looks_for_uneven_light
    if len(shots) < MIN_PHOTOGRAPHS or not (without or looking):
        return []
    parts, axes = [], np.zeros((len(shots), 3, 2))
    for at, shot in enumerate(shots):
        camera, share = shot.camera, seen_by(shot, xyz)()
        rows = np.flatnonzero(np.isfinite(share).all(1))
        size = np.array([camera.width, camera.height])
        middle = np.array([camera.principal_point_x, camera.principal_point_y])
        scale = 2 / float(np.hypot(*size))
        place = (share[rows] * size - middle) * scale
        if not is_panorama(camera):  # which looks all around itself
            axes[at] = sensor_axes(shot.pose[:3, :3], (camera.focal_length_x, camera.focal_length_y), scale)
        parts.append((np.full(len(rows), at), rows, place, colors[shot.name][rows]))
    names = cameras_of(shots)
    cameras = {name: row for row, name in enumerate(dict.fromkeys(names))}
    tracks = TrackColors(*(np.concatenate(each) for each in zip(*parts, strict=True)))
    light = fit_light(tracks, np.array([cameras[name] for name in names]), axes)
    spread = LightSpread.of(light)
    if not spread.is_uneven:
        return []
    exposure = np.where(light.seen >= MIN_SEEN, light.stops.mean(1), 0)
    darkest, brightest = shots[int(exposure.argmin())].name, shots[int(exposure.argmax())].name
    some = f" of {len(shots)} that were compared" if len(shots) < len(gathered.train) else ""
    text, has_tracks = (
        f"{darkest!r} is the darkest photograph and {brightest!r} the brightest{some}",
        gathered.capture.groups,
    )
    if has_tracks and not without:
        return [Finding("note", "exposure", f"{text}: {spread}; {looking[0]} makes up for it")]
    settings = without + [each.partition(":")[0] for each in looking]
    return [Finding("warning", "exposure", f"{text}, and {spread.remedy(bool(has_tracks), settings)}")]
