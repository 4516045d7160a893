"""Pictures of the maps, the overlap of photographs, and the surface."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.ndimage import binary_fill_holes

from surfkit.apps.maps.hillshade import hillshade
from surfkit.apps.quality.document import Element, Figure, Paragraph, Section, Table, facts
from surfkit.apps.quality.figures import as_map, bounds_about, drawing, finished, styled
from surfkit.apps.quality.photo_overlap import Ground, read_raster
from surfkit.apps.quality.sections.words import area, fixed, share
from surfkit.apps.quality.survey import Survey
from surfkit.apps.report.json_values import mapping, number, value_at

PICTURE_PX = 900
"""Longer side of maps as they are read for pictures."""
HEIGHT_PX = 1500
"""Longer side of the surface model as statistics are made of it."""
OVERLAP_COLOURS = ("#d7191c", "#fdae61", "#ffffbf", "#a6d96a", "#1a9641")
"""Of 1, 2, 3, 4, and 5 or more photographs."""
NEEDS_MAPS = "surfkit maps RUN draws them, with the packages of pip install 'surfkit[maps]'."
MAX_SPARSE_DRAWN = 30_000
"""Sparse points in a picture."""


def picture(survey: Survey, name: str, title: str, part: float) -> Figure | None:
    """One of the maps as a figure of a part of the page; None if there is no such map."""
    path = survey.map_file(name)
    if path is None:
        return None
    bands, bounds = read_raster(path, PICTURE_PX)
    if len(bands) >= 3:
        known = bands[3] > 0 if len(bands) > 3 else np.isfinite(bands[0])
        shown = np.where(known[..., None], np.nan_to_num(bands[:3], nan=255).transpose(1, 2, 0), 255).astype(np.uint8)
    else:
        shown = np.nan_to_num(np.where(bands[0] > 0, bands[0], 255), nan=255).astype(np.uint8)
    return drawn_map(survey, shown, bounds, title, part)


def drawn_map(
    survey: Survey,
    shown: np.ndarray,
    bounds: tuple[float, float, float, float],
    title: str,
    part: float,
    values: tuple[str, str, float, float] | None = None,
    note: str = "",
) -> Figure:
    """A picture with the frame of a map.

    Args:
        survey: For its unit and coordinate reference system.
        shown: (H, W) or (H, W, 3) uint8, or (H, W) float64 with `values`.
        bounds: West, south, east, north.
        title: Above it.
        part: Of the width of the page.
        values: Colour map, label with unit, lowest and highest of the colour bar.
        note: Below it.
    """
    west, south, east, north = bounds
    with styled():
        canvas, axes = drawing(part, min(1.3, max(0.5, (north - south) / (east - west) + 0.12)))
        looks: dict[str, Any] = {"cmap": "gray", "vmin": 0, "vmax": 255}
        if values is not None:
            looks = dict(zip(("cmap", "vmin", "vmax"), (values[0], *values[2:]), strict=True))
        image = axes.imshow(shown, extent=(west, east, south, north), interpolation="antialiased", **looks)
        if values is not None:
            canvas.colorbar(image, ax=axes, label=values[1], shrink=0.7)
        as_map(axes, bounds, survey.unit, survey.scene.frame.crs is not None)
        return finished(canvas, title, part, note, photographic=True)


def sparse_picture(survey: Survey, part: float) -> Figure | None:
    """The sparse points from above in their colours; None without any."""
    placed = survey.sparse_points
    if not len(placed):
        return None
    low, high = np.percentile(placed[:, :2], [1, 99], axis=0)
    near = np.flatnonzero(((placed[:, :2] >= low) & (placed[:, :2] <= high)).all(1))
    near = near[:: max(1, len(near) // MAX_SPARSE_DRAWN)]
    near = near[np.argsort(placed[near, 2], kind="stable")]
    with styled():
        canvas, axes = drawing(part, 0.9)
        colours = survey.scene.cloud.rgb.numpy()[near] / 255
        axes.scatter(placed[near, 0], placed[near, 1], c=colours, s=2, linewidths=0)
        as_map(axes, bounds_about(np.stack([low, high])), survey.unit, survey.scene.frame.crs is not None)
        return finished(canvas, "Tie points from above", part, photographic=True)


def overlap_section(survey: Survey, ground: Ground | None, counts: np.ndarray | None) -> Section:
    """How many photographs see each place."""
    title = "Overlap"
    if ground is None or counts is None:
        text = (
            "There is neither a surface model nor a sparse point, so the ground is not known, nor who sees it. "
            + NEEDS_MAPS.replace("them", "the surface model")
        )
        return Section(title, (Paragraph(text, "missing"),))
    from matplotlib.colors import ListedColormap
    from matplotlib.patches import Patch

    with styled():
        west, south, east, north = ground.bounds
        canvas, axes = drawing(0.9, min(1.2, max(0.5, (north - south) / (east - west) + 0.1)))
        colours = ListedColormap(["#4d4d4d", *OVERLAP_COLOURS])
        shown = np.minimum(counts, 5)
        axes.imshow(
            shown, cmap=colours, vmin=-0.5, vmax=5.5, extent=(west, east, south, north), interpolation="nearest"
        )
        axes.plot(*survey.centres[:, :2].T, "^", color="black", markersize=2.5)
        bounds = bounds_about(np.concatenate([survey.centres[:, :2], [[west, south], [east, north]]]), 0.02)
        as_map(axes, bounds, survey.unit, survey.scene.frame.crs is not None)
        handles = [Patch(color=colour, label=name) for colour, name in zip(OVERLAP_COLOURS, "1234", strict=False)]
        handles.append(Patch(color=OVERLAP_COLOURS[-1], label="5+"))
        if (counts == 0).any():
            handles.insert(0, Patch(color="#4d4d4d", label="0"))
        axes.legend(handles=handles, title="photographs", loc="upper left", bbox_to_anchor=(1.0, 1.0))
        note = (
            f"Photographs whose frame holds the place, by heights of {ground.source}, in cells of "
            f"{(east - west) / counts.shape[1]:.3g} {survey.unit}; what stands between is not looked at. "
            "Triangles: cameras."
        )
        figure = finished(canvas, "Number of overlapping photographs", 0.9, note)
    known = counts[np.isfinite(counts)]
    rows = [("0", share(float((known == 0).sum()), len(known)))] if (known == 0).any() else []
    rows += [(str(at), share(float((known == at).sum()), len(known))) for at in (1, 2, 3, 4)]
    rows.append(("5 or more", share(float((known >= 5).sum()), len(known))))
    table = Table("Share of the area", ("photographs", "of the area"), tuple(rows))
    spread = f"median {np.median(known):.0f}, least {known.min():.0f}, most {known.max():.0f} photographs"
    return Section(title, (figure, table, Paragraph(f"Over the area: {spread}.")))


def surface(survey: Survey) -> Section:
    """Heights, holes, precision and volumes of the surface."""
    elements: list[Element] = []
    path = survey.map_file("dsm.tif")
    if path is None:
        elements.append(Paragraph(f"There are no maps of this run. {NEEDS_MAPS}", "missing"))
    else:
        bands, bounds = read_raster(path, HEIGHT_PX)
        elements += _surface_figures(survey, bands[0], bounds)
    if (triangles := number(survey.mesh, "faces")) is not None:
        elements.append(facts("Mesh", [("triangles", f"{triangles:,.0f}")]))
    precision = survey.map_file("precision.tif")
    if precision is not None:
        elements += _precision(survey, *read_raster(precision, PICTURE_PX))
    elif path is not None:
        text = "The maps have no precision map (precision.tif), the standard deviation of each height."
        elements.append(Paragraph(text, "missing"))
    elements += _volumes(survey)
    return Section("Surface", tuple(elements))


def _surface_figures(survey: Survey, heights: np.ndarray, bounds: tuple[float, float, float, float]) -> list[Element]:
    known = np.isfinite(heights)
    whole = binary_fill_holes(known)
    unit, told = survey.unit, mapping(survey.maps)
    lowest, highest = (float(value) for value in told.get("heights", (np.nanmin(heights), np.nanmax(heights))))
    low, high = np.nanpercentile(heights, [1, 99])
    rows = [
        ("heights", f"{lowest:,.2f} to {highest:,.2f} {unit}; 98 % are from {low:,.2f} to {high:,.2f} {unit}"),
        ("holes", f"{share(float((whole & ~known).sum()), float(whole.sum()))} of the area within the outline"),
        ("cell of the maps", f"{number(told, 'gsd'):.4g} {unit}" if number(told, "gsd") is not None else ""),
    ]
    values = ("terrain", f"height, {unit}", float(low), float(high))
    # Heights are shaded here at the size of the picture: those of hillshade.tif, reduced, would be noise.
    gsd = (bounds[2] - bounds[0]) / heights.shape[1]
    shades = hillshade(np.pad(heights, 1, mode="edge"), gsd)
    from matplotlib import colormaps

    light = np.where(shades > 0, shades / 255, 1.0)
    tint = colormaps["terrain"](np.clip((np.nan_to_num(heights, nan=low) - low) / max(high - low, 1e-9), 0, 1))[..., :3]
    shaded = np.where(known[..., None], tint * (0.35 + 0.65 * light[..., None] / max(np.median(light), 0.5)), 1.0)
    note = "Colours by height, shaded by light from the north-west."
    coloured = drawn_map(survey, shaded.clip(0, 1), bounds, "Surface model", 0.9, values, note)
    return [facts("Heights", [row for row in rows if row[1]]), coloured]


def _precision(survey: Survey, bands: np.ndarray, bounds: tuple[float, float, float, float]) -> list[Element]:
    known = bands[0][np.isfinite(bands[0])]
    if not len(known):
        return [Paragraph("The precision map has no values.", "warning")]
    told = mapping(survey.maps, "precision")  # of all cells; the picture has fewer, which are means
    middle, ninety = (
        float(np.percentile(known, rank)) if (value := number(told, name)) is None else value
        for name, rank in (("median", 50), ("percentile_90", 90))
    )
    values = ("viridis", f"standard deviation of heights, {survey.unit}", 0.0, float(np.percentile(known, 98)))
    text = f"Precision of heights: median {fixed(middle, 3)}, 90 % below {fixed(ninety, 3)} {survey.unit}."
    return [drawn_map(survey, bands[0], bounds, "Precision of the surface model", 0.9, values), Paragraph(text)]


def _volumes(survey: Survey) -> list[Element]:
    polygons = value_at(survey.maps, "volumes", "polygons")
    if not isinstance(polygons, list) or not polygons:
        text = "No volumes were measured: surfkit maps RUN --volume POLYGONS measures them."
        return [Paragraph(text, "missing")]
    unit, rows = survey.unit, []
    for polygon in polygons:
        sizes = (fixed(number(polygon, name), 2) for name in ("area", "fill", "cut", "net"))
        rows.append((str(value_at(polygon, "name")), str(value_at(polygon, "base")), *sizes))
    head = ("polygon", "base", f"area, {unit}²", *(f"{name}, {unit}³" for name in ("fill", "cut", "net")))
    return [Table("Volumes", head, tuple(rows))]


def covered(survey: Survey, ground: Ground | None) -> str | None:
    """The area that the maps cover, else that around the sparse points; None where neither is there."""
    cell, size, part = (survey.maps.get(name) for name in ("gsd", "size", "covered"))
    metres = survey.scene.frame.metres
    if isinstance(cell, float) and isinstance(size, list) and isinstance(part, float):
        return area(part * size[0] * size[1] * cell**2, metres)
    if ground is None:
        return None
    west, south, east, north = ground.bounds
    return f"about {area(np.isfinite(ground.heights).mean() * (east - west) * (north - south), metres)}, by tie points"
