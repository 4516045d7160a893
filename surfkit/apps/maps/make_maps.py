"""All maps of a mesh, from the settings of a user to a folder of files."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from surfkit.apps.maps.cloud import Classify, write_cloud
from surfkit.apps.maps.contours import even_interval, write_contours
from surfkit.apps.maps.difference import Difference, draw_difference, write_difference
from surfkit.apps.maps.geotiff import GeoTiffSettings, workshop
from surfkit.apps.maps.hillshade import draw_hillshade
from surfkit.apps.maps.map_grid import MapGrid, map_crs, shown
from surfkit.apps.maps.map_settings import (
    COMPARISON_FILES,
    SEVERAL_FILES,
    SHORTEST_CELLS,
    TERRAIN_CONTOURS,
    VOLUME_FILES,
    VOLUME_OPTION,
    MapSettings,
)
from surfkit.apps.maps.orthophoto import mosaic
from surfkit.apps.maps.owned_files import MAPS_RECORD, PRODUCT_FILES, claim, own_files
from surfkit.apps.maps.precision import Rays, StereoDepths, write_precision
from surfkit.apps.maps.rasters import Raster
from surfkit.apps.maps.surface_model import SurfaceModelStats, draw_surface, has_colors, needs_double
from surfkit.apps.maps.terrain import find_ground, write_terrain
from surfkit.apps.maps.volumes import VolumeSettings, measure_volumes, tell_cut_off, volumes_record, write_volumes
from surfkit.apps.texture.resolution import ground_sampling_distance
from surfkit.apps.texture.texture_cache import identity, seen
from surfkit.apps.texture.texture_mesh import MeshWithPhotos
from surfkit.core.check import BadInput
from surfkit.core.codec import write_json
from surfkit.core.events import FileWritten, Warned, emit
from surfkit.core.stages import key_of
from surfkit.core.version import own_version
from surfkit.evaluate.geometry.surface_file import SurfaceFile
from surfkit.io.area import bounds_of, read_area
from surfkit.io.polygon_file import AreaPolygon, Site, read_polygons
from surfkit.scene.available_memory import cache_bytes
from surfkit.scene.lengths import unit_of
from surfkit.scene.scene import Frame
from surfkit.scene.up_direction import map_axes, up_direction


def make_maps(
    subject: MeshWithPhotos,
    settings: MapSettings,
    out: Path,
    other: SurfaceFile | None = None,
    depths: StereoDepths | None = None,
) -> dict[str, Any]:
    """Write the maps of a mesh into a folder, and return what maps.json says: lengths are in units of the input.

    Args:
        subject: What to draw.
        settings: How.
        out: The folder; maps of surfkit in it are replaced, all other files stay. What an interrupted call has finished
            for the same maps is in it, and is not done again.
        other: A mesh in the same coordinates, to subtract.
        depths: What the photographs know of depth, for the precision.

    Raises:
        BadInput: A package is missing, there is nothing to draw, or the map would be too large.
        OSError: There are files of the names of the maps that surfkit did not write.
    """
    settings.refuse_missing()
    frame, surface = subject.frame, subject.surface
    if "terrain" in settings.products and frame.metres is None:
        raise BadInput(
            "--products terrain: it needs lengths in metres, and the data set does not say how long its unit is; give "
            "--metres-per-unit (1 if its coordinates are metres)"
        )
    if "precision" in settings.products and depths is None:
        raise BadInput(
            "--products precision: the run has no depth maps of its photographs, which it is told from; train with a "
            "recipe that uses them, such as recipe:surface, or leave it out"
        )
    crs, told = map_crs(frame)
    up = up_direction(settings.up, subject.views, frame, np.eye(4))
    grid = grid_of(subject, settings, map_axes(up.direction))
    if settings.bounds is not None:
        refuse_apart(surface, grid)
    if other is not None:
        refuse_apart(other, grid)
    polygons = []
    if settings.volume is not None:
        polygons = read_polygons(settings.volume, VOLUME_OPTION, Site("the map", frame.crs, grid.bounds))
        if grid.area is not None:
            tell_cut_off(polygons, grid.area, unit_of(frame))
    done, unit = drawable(surface, settings), unit_of(frame)
    from_photographs = "orthophoto" in done and settings.colors == "photographs"
    files = [PRODUCT_FILES[name] for name in (*done, *["sources"] * from_photographs,
             *(COMPARISON_FILES if other is not None else ()), *(VOLUME_FILES if polygons else ()))]  # fmt: skip
    key = key_of(
        replace(settings, memory="auto"), files, frame.crs, frame.metres, told, own_version(), grid.turn.tolist(),
        grid.gsd, grid.bounds, identity(surface), other and identity(other),
        seen(subject.views) if settings.colors == "photographs" else "",
        depths.key if depths is not None and "precision" in settings.products else "",
        [(each.name, each.shape.wkb.hex()) for each in polygons], grid.area and grid.area.shape.wkb.hex(),
    )  # fmt: skip
    with workshop(out, (*files, MAPS_RECORD), key) as folder:
        replaced = (MAPS_RECORD, *sorted(own_files(out) - {*files, MAPS_RECORD}))
        sheet = GeoTiffSettings(grid, crs, folder, out, needs_double(surface, grid), replaced)
        drawn, photographs = draw(subject, settings, sheet, "orthophoto" in done)
        record = {
            "mesh": str(surface.path),
            "crs": frame.crs,
            "coordinates": told,
            "up": up.source,
            "axes": grid.turn.tolist(),
            "metres_per_unit": frame.metres,
            "unit": unit,
            "gsd": grid.gsd,
            "bounds": list(grid.bounds),
            "size": [grid.width, grid.height],
            "covered": round(min(1.0, drawn.covered / grid.cells), 6),
            "heights": [drawn.lowest, drawn.highest],
        }
        if grid.area is not None:
            record["area"] = grid.area.record()
        if photographs:
            record["orthophoto"] = photographs
        record |= draw_products(subject, settings, sheet, drawn, done)
        if "precision" in done and depths is not None:
            record["precision"] = estimate_precision(subject, depths, sheet, settings.tile)
        if other is not None:
            record["difference"] = subtract(sheet, other, settings, unit, least_of(settings, frame))
        if polygons:
            record["volumes"] = measure(sheet, polygons, settings, other is not None, least_of(settings, frame))
        record["files"] = files
        write_json(out / MAPS_RECORD, record)
        emit(FileWritten(out / MAPS_RECORD, "facts of the maps"))
    return record


def draw(
    subject: MeshWithPhotos, settings: MapSettings, sheet: GeoTiffSettings, colored: bool
) -> tuple[SurfaceModelStats, dict[str, Any]]:
    """Draw the surface model, and the orthophoto if it is wanted; what maps.json says of photographs in it."""
    heights, colors, sources = (PRODUCT_FILES[name] for name in ("dsm", "orthophoto", "sources"))
    by_photographs, target = colored and settings.colors == "photographs", None
    under = Raster(sheet.folder / "mesh-colors", sheet.grid, sheet.crs, "colors", sheet.double)
    if by_photographs:
        under.folder.mkdir(exist_ok=True)
        target = nullcontext(under)

    def model() -> dict[str, Any]:
        into = sheet.raster(colors, "colors") if colored and not by_photographs else target
        return asdict(draw_surface(subject.surface, sheet, settings.tile, heights, into))

    drawn = SurfaceModelStats(**sheet.once([heights, *[colors] * (colored and not by_photographs)], model))
    if not by_photographs:
        return drawn, {}
    budget = cache_bytes(settings.memory, "--memory")
    found = sheet.once(
        [colors, sources], lambda: mosaic(subject, sheet, heights, under.whole(), (colors, sources), budget)
    )
    share = round(sum(each["cells"] for each in found["photographs"].values()) / drawn.covered, 6)
    return drawn, {"from_photographs": share, **found}


def grid_of(subject: MeshWithPhotos, settings: MapSettings, turn: np.ndarray) -> MapGrid:
    """The cells of the maps; `turn` is (3, 3), from the frame of the input to east, north and up."""
    frame, surface = subject.frame, subject.surface
    if settings.gsd == "auto":
        gsd = ground_sampling_distance(surface, subject.views, frame)
    else:
        gsd = settings.gsd / (frame.metres or 1.0)
    bounds = settings.bounds or bounds_of(surface.blocks(), turn)
    if settings.area is None:
        return MapGrid.around(turn, gsd, bounds)
    area = read_area(settings.area, Site("the map", frame.crs, bounds), turn)
    west, south, east, north = area.bounds
    bounds = max(west, bounds[0]), max(south, bounds[1]), min(east, bounds[2]), min(north, bounds[3])
    return replace(MapGrid.around(turn, gsd, bounds), area=area)


def refuse_apart(surface: SurfaceFile, grid: MapGrid) -> None:
    """BadInput for a mesh that lies beside the cells, before maps that are there are replaced."""
    west, south, east, north = found = bounds_of(surface.blocks(), grid.turn)
    borders = grid.bounds
    if west > borders[2] or east < borders[0] or south > borders[3] or north < borders[1]:
        raise BadInput(
            f"{surface.path}: it lies within {shown(found)} (west south east north), and the maps within "
            f"{shown(borders)}: not in the same place"
        )


def drawable(surface: SurfaceFile, settings: MapSettings) -> tuple[str, ...]:
    """Names of the products, but for an orthophoto that would have no colours, which a warning tells."""
    if "orthophoto" not in settings.names or settings.colors == "photographs" or has_colors(surface):
        return settings.names
    emit(Warned(f"{surface.path}: its vertices have no colours, so there is no orthophoto"))
    return tuple(name for name in settings.names if name != "orthophoto")


def draw_products(
    subject: MeshWithPhotos,
    settings: MapSettings,
    sheet: GeoTiffSettings,
    drawn: SurfaceModelStats,
    done: Sequence[str],
) -> dict[str, Any]:
    """Draw what follows from the surface model, and return what maps.json says of it."""
    record: dict[str, Any] = {}
    units = subject.frame.metres or 1.0
    if "hillshade" in done:
        sheet.once([PRODUCT_FILES["hillshade"]], lambda: shade(sheet, settings.tile))
    given = settings.interval
    interval = even_interval(drawn.lowest, drawn.highest) if given == "auto" else given / units
    least = SHORTEST_CELLS * sheet.grid.gsd if settings.shortest == "auto" else settings.shortest / units
    lines = partial(trace, sheet, interval, least, settings.tile)
    if "contours" in done:
        record["contours"] = sheet.once([PRODUCT_FILES["contours"]], partial(lines, "dsm", "contours"))
    classify = None
    if "terrain" in done:
        names = [PRODUCT_FILES[name] for name in SEVERAL_FILES["terrain"]]
        ground = find_ground(subject.surface, sheet, PRODUCT_FILES["dsm"], settings.terrain, 1 / units)
        record["terrain"] = sheet.once(
            names, lambda: write_terrain(sheet, ground, PRODUCT_FILES["dsm"], names, settings.tile)
        )
        classify = partial(ground.classes_of, grid=sheet.grid)
    if TERRAIN_CONTOURS in done:
        files = [PRODUCT_FILES[TERRAIN_CONTOURS]]
        record["terrain_contours"] = sheet.once(files, partial(lines, "terrain", TERRAIN_CONTOURS))
    if "points" in done:
        spacing = sheet.grid.gsd if settings.spacing == "auto" else settings.spacing / units
        record["points"] = sheet.once(
            [PRODUCT_FILES["points"]], lambda: scatter(subject.surface, sheet, spacing, classify)
        )
    return record


def estimate_precision(
    subject: MeshWithPhotos, depths: StereoDepths, sheet: GeoTiffSettings, side: int
) -> dict[str, Any]:
    """Write the expected errors of the surface model, and return what maps.json says of them."""
    names = [PRODUCT_FILES[name] for name in SEVERAL_FILES["precision"]]
    pixel = ground_sampling_distance(subject.surface, subject.views, subject.frame)
    rays = Rays(subject.views, depths.priors, subject.frame, sheet.grid, pixel)
    return sheet.once(names, lambda: write_precision(sheet, rays, PRODUCT_FILES["dsm"], names, side))


def shade(sheet: GeoTiffSettings, side: int) -> dict[str, Any]:
    """Draw the hillshade; there is nothing to tell of it."""
    draw_hillshade(sheet, PRODUCT_FILES["dsm"], PRODUCT_FILES["hillshade"], side)
    return {}


def trace(
    sheet: GeoTiffSettings, interval: float, least: float, side: int, heights: str, contours: str
) -> dict[str, Any]:
    """Write the contour lines of a product, and return what maps.json says of them."""
    lines, short = write_contours(sheet, PRODUCT_FILES[heights], PRODUCT_FILES[contours], interval, least, side)
    return {"interval": interval, "lines": lines, "shortest": least, "too_short": short}


def scatter(surface: SurfaceFile, sheet: GeoTiffSettings, spacing: float, classify: Classify | None) -> dict[str, Any]:
    """Write the point cloud, and return what maps.json says of it."""
    counts = write_cloud(surface, sheet, PRODUCT_FILES["points"], spacing, classify)
    return {"spacing": spacing, "points": sum(counts.values())} | ({} if classify is None else {"classes": counts})


def least_of(settings: MapSettings, frame: Frame) -> float:
    """The least detectable difference, units of the input."""
    return settings.least_difference / (frame.metres or 1.0)


def measure(
    sheet: GeoTiffSettings, polygons: list[AreaPolygon], settings: MapSettings, two_dates: bool, least: float
) -> dict[str, Any]:
    """Measure volumes, write them, and return what maps.json says of them."""
    other = sheet.out / PRODUCT_FILES["other"] if two_dates else None
    errors = sheet.out / PRODUCT_FILES["precision"] if "precision" in settings.products else None

    def made() -> dict[str, Any]:
        found = measure_volumes(
            sheet, sheet.out / PRODUCT_FILES["dsm"], other, errors, polygons, VolumeSettings(settings.base, least)
        )
        write_volumes(sheet, polygons, found, *(PRODUCT_FILES[name] for name in VOLUME_FILES))
        return volumes_record(found)

    facts = sheet.once([PRODUCT_FILES[name] for name in VOLUME_FILES], made)
    return {"polygons_file": str(settings.volume), **facts}


def subtract(
    sheet: GeoTiffSettings, other: SurfaceFile, settings: MapSettings, unit: str, least: float
) -> dict[str, Any]:
    """Draw another mesh on the same grid, subtract it, and return what maps.json says of the difference."""
    side = settings.tile
    sheet.once([PRODUCT_FILES["other"]], lambda: asdict(draw_surface(other, sheet, side, PRODUCT_FILES["other"])))
    heights = sheet.out / PRODUCT_FILES["dsm"], sheet.out / PRODUCT_FILES["other"]
    name = PRODUCT_FILES["difference"]
    found = Difference(**sheet.once([name], lambda: asdict(write_difference(sheet, heights, name, side, least))))
    claim(sheet.out, PRODUCT_FILES["picture"])
    draw_difference(sheet.out / PRODUCT_FILES["picture"], sheet.out / name, found, unit)
    return {"other": str(other.path), **asdict(found)}
