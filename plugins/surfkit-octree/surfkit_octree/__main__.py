"""How many anchors views use, by their distance: `python -m surfkit_octree RUN`."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from surfkit.plugin import BadInput, Camera, Columns
from surfkit.runs.pipeline import load_run
from surfkit_octree.anchors import Anchors
from surfkit_octree.levels import TABLE, Census, LevelTable, census

FACTORS = (1, 2, 4, 8, 16)
"""Times as far as the photographs."""


def moved_back(camera: Camera, by: float) -> Camera:
    """The camera moved along its viewing direction, away from what it shows, by local units."""
    pose = camera.world_to_camera.clone()
    pose[2, 3] += by
    return replace(camera, world_to_camera=pose)


def counts(params: Columns, cameras: Sequence[Camera], factor: float) -> list[Census]:
    """What each camera uses from `factor` times as far."""
    found = []
    for camera in cameras:
        distance = census(params, camera).distance
        found.append(census(params, moved_back(camera, (factor - 1) * distance)))
    return found


def report(params: Columns, cameras: Sequence[Camera], factors: Sequence[float] = FACTORS) -> str:
    """A table of means over cameras: distance, anchors in view and drawn, and drawn of each level."""
    levels = LevelTable.of(params[TABLE]).count
    lines = ["| distance | local units | in view | drawn | " + " | ".join(f"level {at}" for at in range(levels)) + " |"]
    lines.append("|---" * (4 + levels) + "|")
    for factor in factors:
        found = counts(params, cameras, factor)
        mean = [
            sum(values) / len(found) for values in zip(*([c.in_view, c.used, *c.by_level] for c in found), strict=True)
        ]
        distance = sum(each.distance for each in found) / len(found)
        lines.append(f"| {factor:g} x | {distance:.3g} | " + " | ".join(f"{value:,.0f}" for value in mean) + " |")
    return "\n".join(lines)


def main(words: Sequence[str] | None = None) -> int:
    """Print the table of a finished run; 2 if it is none of anchors."""
    parser = argparse.ArgumentParser(prog="python -m surfkit_octree", description=__doc__)
    parser.add_argument("run", type=Path, help="Folder of a finished run with primitive:anchors.")
    try:
        out = parser.parse_args(words).run
        run, state, scene = load_run(out)
        if not isinstance(run.last.primitive, Anchors):
            raise BadInput(f"{out} has no anchors, and so no levels of them; train it with recipe:octree")
        print(report(state.points.all_params(), [view.camera for view in (*scene.train, *scene.held_out)]))
    except BadInput as error:
        print(f"python -m surfkit_octree: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
