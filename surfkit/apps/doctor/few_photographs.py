"""What a few photographs that show the same places tell of a run: the time of its depth maps, how many points it starts
from, and what its mesh takes."""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy.spatial import cKDTree

from surfkit.apps.doctor.estimate import MeshCosts
from surfkit.apps.doctor.examine import ExaminedData
from surfkit.apps.doctor.gather import depth_maps, heard
from surfkit.core.check import BadInput
from surfkit.core.events import Progress
from surfkit.core.hooks import hookimpl
from surfkit.core.memory import peak_memory_bytes, reset_peak_memory, resident_bytes
from surfkit.core.registry import plugins
from surfkit.depth.base import DepthEstimator
from surfkit.depth.depth_map_cache import make_missing
from surfkit.depth.prepare_depth_maps import DepthPreparation
from surfkit.io.datasets.data import Data
from surfkit.io.datasets.depth_prior import alignment, read_priors, typical_inverse_depth
from surfkit.io.datasets.masks import view_mask
from surfkit.io.datasets.read import build_scene, observations
from surfkit.mesh.base import Mesher
from surfkit.mesh.clean import clean
from surfkit.mesh.grid_tiles import different
from surfkit.mesh.mesh_export import write_mesh
from surfkit.primitives.model import SplatModel
from surfkit.raster.select import Device, select, torch_device
from surfkit.runs.folder import Run
from surfkit.runs.make_mesh import mesh_input
from surfkit.runs.mesh_output import MeshOutput
from surfkit.runs.methods.base import Reconstruction
from surfkit.runs.recipe import Recipe
from surfkit.runs.run_method import with_drawing
from surfkit.scene.available_memory import cache_bytes
from surfkit.scene.observations import Observations
from surfkit.scene.photos import view_photo
from surfkit.scene.scene import Scene, SparsePoints, View
from surfkit.start.base import StartInput

LOOKED_AT_PHOTOS = 12
"""Photographs that are looked at: one in the middle, and those that show most of what it shows."""
LONGEST_PX = 320
"""Longest side at which they are used: the time is that of the pixels."""
VISIBLE_OPACITY = 0.9
"""Of the sparse points that stand for a surface where there are no depth maps."""

CELL_GAPS, GAPS_SHARE, SAMPLED_GAPS = 3.0, 0.9, 10_000
"""Side of the cells by which surface is counted, in distances from a sparse point to the next: that which this share of
so many points has at most, so that cells have points where there is little texture too."""


@dataclass(frozen=True)
class Foretold:
    """What a few photographs tell.

    Attributes:
        depth_seconds: Of the depth maps of all photographs; 0 where none are made, or it cannot be told.
        points: At the start; None where it cannot be told, or needs no depth maps.
        mesh: None where none is made, or it cannot be told.
        refine_depth_seconds: Of the depth maps that refinements make, as if they began at no known depth.
    """

    depth_seconds: float = 0.0
    points: int | None = None
    mesh: MeshCosts | None = None
    refine_depth_seconds: float = 0.0


@dataclass(frozen=True)
class Few:
    """The few photographs, and how much more all of them show.

    Attributes:
        scene: With their views, at the size that they are looked at, and the sparse points that they show.
        tracks: Of all training photographs.
        typical: Typical inverse depth of all of them, 1/local units.
        views: All training photographs, at the size that they are used at.
        finer: Pixels of such a photograph, for each that is looked at.
        surface: By how much more surface all photographs show than these.
    """

    scene: Scene
    tracks: Observations
    typical: float
    views: tuple[View, ...]
    finer: float
    surface: float


def foretell(data: Data, examined: ExaminedData, recipe: Recipe, device: Device, folder: Path) -> Foretold:
    """Make depth maps of a few photographs, the points that a run would start from, and their mesh.

    Args:
        data: A data set without errors.
        examined: What is known of it.
        recipe: What to do with it.
        device: Where to compute.
        folder: Not there yet, for what is to be deleted.
    """
    folder.mkdir()
    found = Foretold()
    with heard(), suppress(BadInput):  # what is wrong is told by what looks at depth maps, points and meshers
        few = few_of(data, examined, folder)
        if few is None:
            return found
        run = Run(folder, recipe, data)
        if recipe.depth is not None and run.wants_priors and not depth_maps(data, examined.gathered):
            run = replace(run, data=replace(data, priors=folder))
            found = replace(found, depth_seconds=_depth_seconds(data, recipe.depth, few, device, folder))
        if recipe.start.needs_prior or recipe.mesh is not None:
            model = _start(run, few)
            count = round(len(model) * few.surface * few.finer)
            if recipe.start.needs_prior:
                found = replace(found, points=min(count, recipe.start.most_points or count))
            if recipe.mesh is not None:
                found = replace(found, mesh=mesh_costs(run, model, few, recipe.mesh, device))
        again: dict[DepthEstimator, float] = {}  # by estimator: several refinements make maps the same way
        for estimator in (refine.estimator for refine in recipe.refine):
            if estimator is None:
                continue
            if estimator not in again:
                again[estimator] = _depth_seconds(data, estimator, few, device, folder / f"again{len(again)}")
            seconds = found.refine_depth_seconds + again[estimator]
            found = replace(found, refine_depth_seconds=seconds)
    return found


def few_of(data: Data, examined: ExaminedData, folder: Path) -> Few | None:
    """The photographs to look at; None where it is not known which of them show the same places.

    Args:
        data: As for `foretell`.
        examined: Likewise.
        folder: For photographs without distortion.
    """
    capture = examined.gathered.capture
    whole = build_scene(data, capture, folder, pixels=False)
    tracks, views = observations(data, whole), whole.train
    shown = [tracks.seen[view.name].points if view.name in tracks.seen else np.zeros(0, int) for view in views]
    in_middle = np.zeros(len(tracks.xyz), bool)
    in_middle[shown[len(views) // 2]] = True
    shared = np.array([in_middle[points].sum() for points in shown])
    chosen = sorted(np.argsort(-shared, kind="stable")[:LOOKED_AT_PHOTOS].tolist())
    own = np.unique(np.concatenate([shown[at] for at in chosen]))
    if not len(own):
        return None
    scene = build_scene(data, capture, folder, {views[at].name for at in chosen})
    cloud = SparsePoints(
        torch.from_numpy(tracks.xyz[own]).float(),
        torch.full((len(own), 3), 128, dtype=torch.uint8),
        opacity=torch.full((len(own),), VISIBLE_OPACITY),
    )
    small = replace(fitted(scene, LONGEST_PX), held_out=(), cloud=cloud)
    typical = typical_inverse_depth(views, tracks, whole)
    finer = pixels(scene.train) / pixels(small.train)
    return Few(small, tracks, typical, views, finer, times_the_surface(tracks.xyz, np.concatenate(shown), own))


def times_the_surface(xyz: np.ndarray, all_of_them: np.ndarray, some: np.ndarray) -> float:
    """By how much larger a surface is on which points lie than that with some of them: each counts a cell that has
    points, however many, as more texture gives more of them.

    Args:
        xyz: (P, 3) float64 points.
        all_of_them: (K,) rows of those that tell where the surface is.
        some: (S,) rows of some of these.
    """
    rows = np.unique(all_of_them)
    there = xyz[rows]
    gaps, _ = cKDTree(there).query(there[:: max(1, len(there) // SAMPLED_GAPS)], 2)
    side = CELL_GAPS * max(float(np.quantile(gaps[:, 1], GAPS_SHARE)), 1e-12)
    low = there.min(0)
    whole, part = (len(different(np.floor((xyz[at] - low) / side).astype(np.int64))) for at in (rows, some))
    return whole / part


def fitted(scene: Scene, longest: int) -> Scene:
    """The scene with training photographs of at most so many pixels."""
    return replace(scene, train=tuple(replace(view, camera=view.camera.fitted(longest)) for view in scene.train))


def pixels(views: Iterable[View]) -> int:
    """Of all photographs."""
    return sum(view.camera.width * view.camera.height for view in views)


def _depth_seconds(data: Data, estimator: DepthEstimator, few: Few, device: Device, root: Path) -> float:
    """Seconds of the depth maps of all photographs, after those of the few were made in a folder."""
    preparation, begun = DepthPreparation(data, estimator, torch_device(device), root), time.perf_counter()
    make_missing(preparation, few.scene, few.tracks)
    seconds = time.perf_counter() - begun
    here, all_of_them = (
        pixels(replace(view, camera=estimator.of_map(view.camera)) for view in views)
        for views in (few.scene.train, few.views)
    )
    return seconds * all_of_them / here


def _start(run: Run, few: Few) -> SplatModel:
    """What the run would start from, if there were no other photographs."""
    recipe, scene, priors = run.recipe, few.scene, None
    if recipe.start.needs_prior:
        known = replace(alignment(run.data, scene, True), typical=few.typical)
        priors = read_priors(run.data, scene, known=known, normals=True)
    photos, masks = [view_photo(view) for view in scene.train], [view_mask(view) for view in scene.train]
    own, its = (torch.Generator().manual_seed(recipe.seed) for _ in range(2))
    made = recipe.start.model(recipe.primitive, StartInput(scene, photos, masks, priors, own), its)
    return SplatModel(recipe.primitive, made.params, made.sh_degree, recipe.pretrain.near)


@dataclass(frozen=True)
class MeshSample:
    """What the mesh of some photographs took.

    Attributes:
        pixels: Of these photographs.
        by_view: Seconds of what is done view by view.
        other: Seconds of everything else.
        memory: Bytes beside what was held before.
        triangles: Before cleaning.
    """

    pixels: int
    by_view: float
    other: float
    memory: int
    triangles: int


def mesh_costs(run: Run, model: SplatModel, few: Few, mesher: Mesher, device: Device) -> MeshCosts:
    """What the mesh of all photographs takes, from that of the few at two sizes: what does not grow with them, such as
    a look at some views, counts once.

    Args:
        run: Whose folder is for what is to be deleted.
        model: What is meshed.
        few: The photographs.
        mesher: How.
        device: Where to compute.

    Raises:
        BadInput: These few show no surface, or the mesher lacks something.
    """
    mesher.ready()
    rasterizer, budget = select(device)[0], cache_bytes("auto")
    made = with_drawing(Reconstruction(splats=model), rasterizer)

    def sample(longest: int) -> MeshSample:
        scene, held, output = fitted(few.scene, longest), resident_bytes(), MeshOutput()
        reset_peak_memory()
        begun = time.perf_counter()
        with phases() as clock:
            raw = mesher.mesh(mesh_input(run, made, scene, rasterizer, budget, mesher))
            mesh, _ = clean(raw, output.clusters, output.least_triangles, gap=output.cluster_gap)
            write_mesh(run.out / "mesh.ply", mesh, scene.frame)
        by_view = clock.seconds_by_view(len(scene.train))
        memory = max(0, peak_memory_bytes() - held)
        return MeshSample(pixels(scene.train), by_view, time.perf_counter() - begun - by_view, memory, len(raw.faces))

    longest = max(max(view.camera.width, view.camera.height) for view in few.scene.train)
    small, large = sample(max(1, longest // 2)), sample(longest)
    surface, share = few.surface * few.finer, max(0.5, 1 - small.pixels / large.pixels)  # about three quarters
    if (most := mesher.most_triangles) is not None:
        surface = min(surface, most / large.triangles)

    def grown(less: float, more: float, times: float) -> float:
        return more + max(0.0, more - less) / share * (times - 1)

    views = len(few.views) / len(few.scene.train) * grown(small.by_view, large.by_view, few.finer)
    memory = min(round(grown(small.memory, large.memory, surface)), budget)  # which meshers stay within
    return MeshCosts(views + grown(small.other, large.other, surface), memory)


class PhaseClock:
    """The time of each piece of work whose progress is told."""

    def __init__(self) -> None:
        self.before = time.perf_counter()
        self.taken: dict[tuple[str, int], list[float]] = {}

    @hookimpl
    def surfkit_event(self, event: Any) -> None:
        """See one event."""
        now = time.perf_counter()
        if isinstance(event, Progress):
            self.taken.setdefault((event.what, event.total), []).append(now - self.before)
            self.before = now

    def seconds_by_view(self, views: int) -> float:
        """Of the work that is done view by view. What came before the first view was other work: the first counts as
        the others do in the mean."""
        done = [times for (_, total), times in self.taken.items() if total == views and len(times) > 1]
        return sum(len(times) / (len(times) - 1) * sum(times[1:]) for times in done)


@contextmanager
def phases() -> Iterator[PhaseClock]:
    """Within, the clock sees how work goes on."""
    clock = PhaseClock()
    plugins().register(clock)
    try:
        yield clock
    finally:
        plugins().unregister(clock)
