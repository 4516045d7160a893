"""Clocks of receivers and cameras that disagree show where a flight turns."""

import numpy as np
import pytest

from surfkit.apps.sfm.exif import Exif
from surfkit.apps.sfm.georeference import chart_of, place
from surfkit.apps.sfm.inspect_photos import Photo
from surfkit.apps.sfm.position_doubts import delay_of, position_doubts
from surfkit.scene.earth import from_utm

EAST, NORTH = 372_000.0, 5_810_000.0
SPEEDS = (7.0, -14.0)
"""With the wind and against it, m/s."""


def flight(delay, noise=0.3, gap=4, strips=4, each=8):
    """Cameras and photographs of a fixed wing in strips to and fro, whose positions are `delay` seconds old."""
    draw, clock, rows = np.random.default_rng(0), 0, []
    for strip in range(strips):
        speed = SPEEDS[strip % 2]
        start = 0.0 if speed > 0 else SPEEDS[0] * gap * each
        for at in range(each):
            rows.append((clock, start + speed * gap * at, 40.0 * strip, 90.0 + draw.uniform(-5, 5), speed))
            clock += gap
        clock += 60  # a turn
    times, east, north, up, speed = np.array(rows).T
    xyz = np.column_stack([east, north, up])
    seen = xyz - np.column_stack([delay * speed, 0 * speed, 0 * speed]) + draw.normal(0, noise, xyz.shape)
    latitude, longitude = from_utm(seen[:, 0] + EAST, seen[:, 1] + NORTH, 33, False)
    photos, centres = {}, {}
    for at, second in enumerate(times.astype(int)):
        name, taken = f"{at:03}.jpg", f"2024:05:01 12:{second // 60:02}:{second % 60:02}"
        position = (latitude[at], longitude[at], seen[at, 2])
        photos[name], centres[name] = Photo(name, (0, 0), exif=Exif(taken=taken, position=position)), xyz[at]
    return centres, photos


def doubts(delay, **how):
    centres, photos = flight(delay, **how)
    chart = chart_of(np.array([photo.exif.position for photo in photos.values()]), "auto")
    where = place(centres, list(photos.values()), chart)
    moved = dict(zip(centres, where.similarity.points(np.stack(list(centres.values()))), strict=True))
    return position_doubts(where, moved, photos)


@pytest.mark.parametrize(("delay", "when"), [(0.3, "0.3 s before"), (-0.3, "0.3 s after")])
def test_positions_that_are_older_or_newer_than_the_photographs_are_told(delay, when):
    said = doubts(delay)[-1]
    number, rest = said.partition("those of ")[2].split(" s ", 1)
    assert float(number) == pytest.approx(0.3, abs=0.05) and rest.startswith(f"{when.split()[-1]} each photograph")
    assert float(said.partition("each other by ")[2].split()[0]) == pytest.approx(0.3 * 21, abs=1)
    assert "--gcp" in said


def test_noise_is_no_delay():
    assert doubts(0.0) == [] and doubts(0.0, noise=2.0) == []


def test_velocities_that_are_all_alike_tell_nothing():
    draw = np.random.default_rng(0)
    residuals, alike = draw.normal(0, 0.2, (20, 2)) - (3.0, 0.0), np.tile([10.0, 0.0], (20, 1))
    assert delay_of(residuals, alike) is None and delay_of(residuals[:5], draw.normal(0, 9, (5, 2))) is None
    nearly = alike + draw.normal(0, 0.3, (20, 2))
    assert not delay_of(residuals, nearly).is_sure


def test_a_few_wrong_positions_do_not_hide_a_delay():
    draw = np.random.default_rng(1)
    velocities = np.outer(np.resize([9.0, -9.0], 30), [0.6, 0.8])
    residuals = (2.0, -1.0) - 0.25 * velocities + draw.normal(0, 0.3, (30, 2))
    residuals[[3, 8, 20]] += draw.normal(0, 2, (3, 2))
    found = delay_of(residuals, velocities)
    assert found.seconds == pytest.approx(0.25, abs=0.03) and found.is_sure
    assert found.reach == pytest.approx(0.25 * 18, rel=0.1)
