"""`surfkit maps`."""

from __future__ import annotations

from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import tyro

from surfkit.apps.maps.make_maps import MAPS_RECORD, make_maps
from surfkit.apps.maps.map_grid import same_crs
from surfkit.apps.maps.map_settings import MapSettings
from surfkit.apps.maps.precision import StereoDepths
from surfkit.apps.maps.volume_table import show_volumes
from surfkit.apps.texture.texture_cache import seen
from surfkit.apps.texture.texture_mesh import MeshWithPhotos
from surfkit.cli.console_table import print_table
from surfkit.core.check import BadInput
from surfkit.core.events import Warned, emit
from surfkit.core.stages import key_of
from surfkit.evaluate.geometry.file_transform import same_plan
from surfkit.evaluate.geometry.height_systems import HeightSystem
from surfkit.evaluate.geometry.surface_file import SurfaceFile, read_mesh, read_surface, system_of
from surfkit.evaluate.geometry.top_surface import highest
from surfkit.io.datasets.depth_prior import prior_files, read_priors
from surfkit.runs.command import refuse_no_mesh
from surfkit.runs.ensure_depth_maps import with_maps_of
from surfkit.runs.folder import Run
from surfkit.runs.pipeline import opened
from surfkit.runs.resume import read_unchanged
from surfkit.runs.run_notes import collect_notes
from surfkit.runs.warn import note_held_out
from surfkit.scene.available_memory import cache_bytes
from surfkit.scene.scene import Frame, Scene
from surfkit.train.data_cache import CacheSettings
from surfkit.train.progress_bars import bars


@dataclass(frozen=True)
class MapsCommand:
    """Draw maps of the mesh of a finished run: surface model, orthophoto, hillshade, contour lines, point cloud,
    expected errors of heights, and terrain without buildings and trees.

    Rasters are Cloud Optimized GeoTIFFs in the coordinates of the data set, with its coordinate reference system. With
    --against, the heights of another mesh are subtracted; with --volume, volumes within polygons are measured; with
    --area, only what lies within polygons is drawn. Needs `pip install 'surfkit[maps]'`. Examples: `surfkit maps RUN
    --gsd 0.1`, `surfkit maps RUN --volume HEAPS.geojson`, `surfkit maps RUN --against LAST_YEAR --products orthophoto`.
    When it is interrupted, the same command goes on where it stopped.
    """

    run_folder: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUN")]
    """Folder that `surfkit train` made."""

    out: Path | None = None
    """Folder for the maps; by default RUN/maps."""

    settings: Annotated[MapSettings, tyro.conf.arg(name="")] = MapSettings()
    """What is drawn."""

    against: Path | None = None
    """A run, or a file in the same coordinates, with a mesh, a raster of heights (GeoTIFF) or a cloud (LAS, LAZ, PLY):
    also write the heights of RUN minus those of this one, as GeoTIFF and as a picture, with the volumes by which RUN
    lies above (fill) and below (cut)."""

    metres_per_unit: float | None = None
    """Metres per unit of the data set's coordinates, if the data set does not state it."""

    def __post_init__(self) -> None:
        if self.metres_per_unit is not None and not 0 < self.metres_per_unit < float("inf"):
            raise BadInput(f"--metres-per-unit {self.metres_per_unit:g}: it must be more than 0")

    def run(self) -> None:
        """Draw the maps, and print what they are."""
        self.settings.refuse_missing()
        if self.settings.least_difference and self.against is None:
            raise BadInput("--least-difference: it is of two dates; name the other one too, --against OTHER")
        run = opened(self.run_folder)
        refuse_no_mesh(run)
        out = self.out or run.out / "maps"
        with collect_notes(), bars(), ExitStack() as use:
            scene, surface = read_unchanged(run), read_mesh(run.mesh)
            frame = scene.frame
            if self.metres_per_unit is not None:
                frame = replace(frame, metres=self.metres_per_unit)
            other = None if self.against is None else self._other(self.against, frame)
            depths = None
            if "precision" in self.settings.products:
                own = use.enter_context(with_maps_of(run, scene, CacheSettings(), "auto", "--products precision"))
                depths = stereo_depths(own, scene, self.settings)
            record = make_maps(MeshWithPhotos(surface, frame, scene.train), self.settings, out, other, depths)
            note_held_out(run, scene)
        show(out, record)

    def _other(self, against: Path, frame: Frame) -> SurfaceFile:
        """The mesh to subtract; BadInput if it is known to lie in other coordinates."""
        if not against.exists():
            raise BadInput(f"--against {against}: no such file or run")
        if not against.is_dir():
            system = system_of(against)
            if system is not None and frame.crs is not None and not same_plan(system, frame.crs):
                raise BadInput(
                    f"--against {against}: its coordinates are in {system}, and those of {self.run_folder} in "
                    f"{frame.crs}; heights can be subtracted in one system only"
                )
            _refuse_other_heights(against, system, frame)
            return heights_of(against)
        run = opened(against)
        refuse_no_mesh(run)
        theirs = read_unchanged(run).frame
        if not same_crs(theirs.crs, frame.crs):
            raise BadInput(
                f"--against {against}: its coordinate reference system is {theirs.crs or 'not known'}, and that of "
                f"{self.run_folder} {frame.crs or 'not known'}; heights can be subtracted in one system only"
            )
        if frame.crs is None:
            emit(Warned("neither run is georeferenced; their coordinates are taken to be the same"))
        return read_mesh(run.mesh)


def _refuse_other_heights(against: Path, system: str | None, frame: Frame) -> None:
    """BadInput for heights that are above something else, or in another unit; a line where one side does not say what
    they are above.

    Args:
        against: A file of heights.
        system: Coordinate reference system that it names.
        frame: Of the run.
    """
    ours, theirs = HeightSystem.of(frame.crs), HeightSystem.of(system, against)
    if frame.crs is None:
        ours = replace(ours, metres=frame.metres)
    if why := ours.contradicts(theirs):
        raise BadInput(f"--against {against}: {why}; convert it, for example with gdalwarp or pdal, or leave it out")
    if frame.crs is not None and (open_ := ours.leaves_open(theirs)):
        emit(Warned(f"--against {against}: {open_}; they are subtracted as they are"))


def stereo_depths(run: Run, scene: Scene, settings: MapSettings) -> StereoDepths | None:
    """The depth maps that a run was trained with; None where there are none."""
    priors = read_priors(run.data, scene, cache_bytes(settings.memory, "--memory"))
    if priors is None:
        return None
    if run.data.priors is None:
        emit(
            Warned(
                "--products precision: the depth maps are those of the data set; errors are foretold for maps of "
                "`surfkit prepare depth` with estimator:patch-match, and may be wrong for others"
            )
        )
    states = [(name, file.path.stat()) for name, file in sorted(prior_files(run.data, scene).items())]
    files = [[name, state.st_size, state.st_mtime_ns] for name, state in states]
    return StereoDepths(priors, key_of(files, seen(scene.train)))


def heights_of(path: Path) -> SurfaceFile:
    """The surface in a file whose heights can be subtracted: a mesh, a raster of heights, or the highest points of a
    cloud."""
    found = read_surface(path)
    if "f_dc_0" in (found.rows.dtype.names or ()):
        raise BadInput(f"{path}: splats, which are no surface; name a mesh, a raster of heights or a cloud")
    return highest(found) if found.faces is None else found


def show(out: Path, record: dict[str, Any]) -> None:
    """Print what the maps are, and the paths of what was written."""
    unit = record["unit"]
    rows = [
        ("coordinates", record["coordinates"]),
        ("up", record["up"]),
        ("ground sampling distance", f"{record['gsd']:g} {unit}"),
        ("size", "{} x {} cells".format(*record["size"])),
        *([("area", f"{found['area']:,.6g} {unit}², from {found['file']}")] if (found := record.get("area")) else []),
        ("covered", f"{record['covered']:.1%}"),
        ("heights", "{:.2f} to {:.2f} {}".format(*record["heights"], unit)),
    ]
    if found := record.get("orthophoto"):
        rows.append(("orthophoto", f"{found['from_photographs']:.1%} of it from photographs, the rest from the mesh"))
    for key, name in (("contours", "contour lines"), ("terrain_contours", "contour lines of the terrain")):
        if found := record.get(key):
            short = f"; {found['too_short']:,} shorter than {found['shortest']:g} {unit} left out"
            left = short if found["too_short"] else ""
            rows.append((name, f"{found['lines']:,}, every {found['interval']:g} {unit}{left}"))
    if found := record.get("points"):
        rows.append(("points", f"{found['points']:,}, one for {found['spacing']:g} x {found['spacing']:g} {unit}"))
    if found := record.get("terrain"):
        rows.append(("ground that is seen", f"{found['ground_seen']:.1%} of the surface"))
        told = f"{found['without_terrain']:.1%} of it: no ground within {found['reach']:g} {unit}"
        rows.append(("without terrain", told))
        rows.append(("surface below the terrain", f"{found['below_terrain']:.1%} of it"))
    if found := record.get("precision"):
        told = (
            f"median {found['median']:.3g}, 90 % under {found['percentile_90']:.3g} {unit}" if found["known"] else "-"
        )
        rows += [
            ("expected error of a height", told),
            ("not confirmed by two photographs", f"{1 - found['known']:.1%} of the surface; no error is known there"),
        ]
    if found := record.get("difference"):
        rows += [
            ("above (fill)", f"{found['fill']:,.6g} {unit}³ on {found['area']:,.6g} {unit}² compared"),
            ("below (cut)", f"{found['cut']:,.6g} {unit}³"),
            ("difference of heights", f"median {found['median']:.4g} {unit}"),
            (
                "its absolute value",
                f"median {found['median_absolute']:.4g}, 90 % under {found['percentile_90']:.4g} {unit}",
            ),
            ("no surface", f"{found['only_other']:,} cells here, {found['only_here']:,} cells there"),
        ]
        if least := found["least_difference"]:
            told = f"{found['unchanged']:,.6g} {unit}², which differ by less than {least:g} {unit}"
            rows.append(("taken as unchanged", told))
    print_table(("map", "value"), rows)
    if found := record.get("volumes"):
        print()
        show_volumes(found["polygons"], unit)
    print()
    print_table(("written",), [(str(out / name),) for name in (*record["files"], MAPS_RECORD)])


COMMAND = MapsCommand
