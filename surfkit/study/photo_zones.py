"""Held-out photographs of a run, measured by parts: what enough training views see, and what lies at block borders."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor

from surfkit.core.check import BadInput
from surfkit.evaluate.geometry.surface_file import SurfaceFile
from surfkit.evaluate.geometry.transform import apply
from surfkit.evaluate.images.measure_images import Draw
from surfkit.evaluate.images.region_metrics import by_seams, by_views, measure_parts
from surfkit.evaluate.images.seams import Seams
from surfkit.evaluate.images.view_counts import DepthSource, ViewCounts, count_views
from surfkit.io.datasets.masks import view_mask
from surfkit.mesh.depths import mesh_depth
from surfkit.mesh.fusion_image import depth_of
from surfkit.partition.borders import border_places
from surfkit.runs.blocks.block import plan_file, read_plan
from surfkit.runs.folder import Run
from surfkit.scene.photos import view_photo
from surfkit.scene.scene import Frame, Scene, View

AUTO_SEAM_SHARE = 0.02
"""Automatic distance from a border, as a share of the width of the scene: twice its extent."""
PLACES_PER_REACH = 40
"""Places along a border, for each distance from it that counts as near: far more than a circle of it needs."""
MIN_BORDER_DISTANCE = 1e-3
"""Distance from a border that can be told, in extents."""
BORDER_REACH_EXTENTS = 8.0
"""Extents around the middle of the scene in which borders are looked at: surfaces lie within."""
RENDERED_DEPTH_TOLERANCE = 0.01
"""Share of the depth within which rendered depths agree."""

Distance = float | Literal["auto"]


@dataclass(frozen=True)
class Zones:
    """Parts of held-out photographs that are told apart.

    Attributes:
        seen: Numbers of training views.
        seams: Distance from the borders of blocks, metres or automatic; None to leave them out.
    """

    seen: tuple[int, ...] = ()
    seams: Distance | None = None

    def __post_init__(self) -> None:
        if wrong := [number for number in self.seen if number < 1]:
            raise BadInput(f"--seen {wrong[0]}: it is a number of training views, so give 1 or more")
        if self.seams is not None and self.seams != "auto" and not 0 < self.seams < float("inf"):
            raise BadInput(f"--seams {self.seams:g}: it is a length, so it must be above 0, or auto")

    def refuse_too_many(self, scene: Scene) -> None:
        """BadInput if no photograph can be measured so."""
        if not self.seen:
            return
        if not scene.held_out:
            raise BadInput("--seen: no photograph is kept from training, so there is nothing to measure; --test-every")
        if (most := max(self.seen)) > len(scene.train):
            raise BadInput(f"--seen {most}: there are {len(scene.train)} training views, so give that many or fewer")


def seams_of(run: Run, frame: Frame, distance: Distance) -> Seams:
    """The borders of the blocks of a run.

    Raises:
        BadInput: It has none, or the distance is in metres and nobody knows how long a unit is.
    """
    path = plan_file(run)
    if not path.exists():
        raise BadInput(f"--seams: no {path}: the run is not one in blocks, or they are deleted; leave --seams out")
    cells = read_plan(run).plan.cells
    if cells.count < 2:
        raise BadInput(f"--seams: {path} has one block, and so no borders; leave --seams out")
    if distance == "auto":
        reach = 2 * AUTO_SEAM_SHARE
    elif frame.local_metres is None:
        raise BadInput(
            f"--seams {distance:g}: metres cannot be used, as the data set does not say how long its unit is; give "
            "--seams auto"
        )
    else:
        reach = distance / frame.local_metres
    if reach < MIN_BORDER_DISTANCE:
        raise BadInput(
            f"--seams {distance:g}: less than {MIN_BORDER_DISTANCE:g} of the extent of the scene; give more, or auto"
        )
    middle = np.zeros(2)  # of the training cameras
    borders = border_places(
        cells, middle - BORDER_REACH_EXTENTS, middle + BORDER_REACH_EXTENTS, reach / PLACES_PER_REACH
    )
    metres = frame.local_metres
    told = f"{reach / frame.scale:.3g} units" if metres is None else f"{reach * metres:.3g} m"
    return Seams(borders, np.array([cells.ground.x, cells.ground.y]), reach, told)


def rendered_depths(draw: Draw) -> DepthSource:
    """Depth that the model itself has: the median depth where the primitive has one, else the expected depth."""

    def of(view: View) -> Tensor:
        maps = draw(view)
        if maps.median is None and maps.depth is None:
            raise BadInput(
                "the method of the run draws no depth: leave out --seen and --seams, or name a mesh with --gt"
            )
        return depth_of(maps, "expected" if maps.median is None else "median").cpu()

    return DepthSource(of, "rendered depth", RENDERED_DEPTH_TOLERANCE, through=False)


def true_depths(truth: SurfaceFile, frame: Frame, matrix: Sequence[Sequence[float]]) -> DepthSource:
    """Depth of the true mesh.

    Args:
        truth: A mesh.
        frame: Of the views.
        matrix: (4, 4) from the input frame of the views to that of the truth.
    """
    vertices = frame.to_local(apply(np.linalg.inv(np.asarray(matrix)), truth.vertices()))
    finite = np.isfinite(vertices).all(1)
    vertices[~finite] = 0.0  # no face is at these
    faces = np.asarray(truth.faces)
    return DepthSource(
        lambda view: torch.from_numpy(mesh_depth(vertices, faces, view.camera)), "truth", 0.0, through=True
    )


def measure_zones(scene: Scene, draw: Draw, zones: Zones, depths: DepthSource, seams: Seams | None) -> dict[str, Any]:
    """Figures for metrics.json, to stand among those of the images: "seen" and "seams", as far as they are asked for.

    Args:
        scene: With photographs that are held out.
        draw: Makes the renders that are measured.
        zones: Which parts.
        depths: Where depth comes from: it says which place a pixel shows, and which training views see that.
        seams: Borders of blocks, if they are asked for.
    """
    zones.refuse_too_many(scene)
    wanted = tuple(sorted(set(zones.seen)))

    def parts(sight: ViewCounts) -> dict[str, Tensor]:
        return by_views(wanted)(sight) | ({} if seams is None else by_seams(partial(_near, seams))(sight))

    found = measure_parts(
        count_views(scene.held_out, scene.train if wanted else (), depths),
        parts,
        draw,
        lambda sight: view_photo(sight.view),
        lambda sight: view_mask(sight.view),
    )
    result: dict[str, Any] = {}
    if wanted:
        pairs = {f"{n}": found[f"{n}"] | {"psnr_rest": found[f"<{n}"]["psnr"]} for n in wanted if f"{n}" in found}
        result["seen"] = {"depth": depths.source, "by_views": pairs}
    if seams is not None:
        named = {name: found[name] for name in ("near", "elsewhere") if name in found}
        result["seams"] = {"depth": depths.source, "distance": seams.distance, **named}
    return result


def _near(seams: Seams, sight: ViewCounts) -> Tensor:
    """(H, W) bool: pixels whose places are near a border; those without a place are not."""
    flat = sight.places.reshape(-1, 3)
    known = torch.isfinite(flat[:, 0])
    found = torch.zeros(len(flat), dtype=torch.bool)
    found[known] = torch.from_numpy(seams.near(flat[known].numpy()))
    return found.reshape(sight.counts.shape)
