"""The first page: what a client reads."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from surfkit.apps.quality.document import Element, Paragraph, Row, Section, Table, facts
from surfkit.apps.quality.photo_overlap import Ground
from surfkit.apps.quality.sections.maps_section import NEEDS_MAPS, covered, picture, sparse_picture
from surfkit.apps.quality.sections.residuals import accuracy_rows
from surfkit.apps.quality.sections.words import days, fixed, length, share
from surfkit.apps.quality.survey import Survey
from surfkit.apps.report.json_values import mapping, number, texts
from surfkit.apps.sfm.focal import MAX_START_RATIO
from surfkit.scene.photos import open_header

MAX_ERROR_PX = 1.0
"""Mean reprojection error above which something is wrong: Pix4D's manual and others state one pixel."""
MAX_UNUSED_SHARE = 0.05
"""Of the photographs without a camera, above which a warning is given."""
MAX_THIN_SHARE = 0.2
"""Of the area that fewer than three photographs see, above which a warning is given."""
MAX_CHECK_GSD = 3.0
"""Ground sampling distances that check points may be off in one axis (RMS): 1 to 3 is what surveyors expect."""
ASPRS_CHECK_POINTS = 30
"""ASPRS Positional Accuracy Standards for Digital Geospatial Data, edition 2 (2023)."""
MAX_HEIGHT_SAMPLES = 20_000
"""Sparse points that tell how far away the ground is."""


@dataclass(frozen=True)
class Findings:
    """What several parts of a report need.

    Attributes:
        survey: The survey.
        ground: Heights; None where there are none.
        counts: (H, W) photographs that see each of its cells.
    """

    survey: Survey
    ground: Ground | None
    counts: np.ndarray | None


def summary(found: Findings, processed: str) -> Section:
    """The first page.

    Args:
        found: The survey.
        processed: Day of the processing.
    """
    survey = found.survey
    rows = [
        ("photographs taken", days(survey.taken) if survey.taken else "not stated in EXIF"),
        ("processed", processed),
        ("photographs used", _used(survey)),
        ("area covered", covered(survey, found.ground) or "not known: there is neither a surface model nor tie points"),
    ]
    if (distance := ground_sampling_distance(survey)) is not None:
        rows.append(
            ("ground sampling distance", f"{length(distance, survey.unit)} per pixel of the photographs (median)")
        )
    if (cell := number(survey.maps, "gsd")) is not None:
        rows.append(("cell of the maps", length(cell, survey.unit)))
    rows.append(("mean reprojection error", _error(survey)))
    rows.append(("coordinate reference system", survey.scene.frame.crs or "none: coordinates are local"))
    rows.append(("held-out photographs", _held_out(survey)))
    elements: list[Element] = []
    orthophoto = picture(survey, "orthophoto.tif", "Orthophoto", 0.5) or sparse_picture(survey, 0.5)
    relief = picture(survey, "hillshade.tif", "Hillshade", 0.5)
    if shown := tuple(figure for figure in (orthophoto, relief) if figure is not None):
        elements.append(Row(shown) if len(shown) > 1 else shown[0])
    if not survey.maps:
        elements.append(Paragraph(f"There are no maps. {NEEDS_MAPS}", "missing"))
    elements.append(facts("Survey", rows))
    accuracy = accuracy_rows(survey)
    if accuracy:
        head = ("root mean square of residuals, m", "number", "x (east)", "y (north)", "z (up)")
        elements.append(Table("Accuracy", head, tuple(accuracy)))
    else:
        text = "No accuracy is stated: the data set tells of no control points and no positions of its photographs."
        elements.append(Paragraph(text, "missing"))
    elements.append(Paragraph(meaning(survey, distance)))
    elements += [Paragraph(text, "warning") for text in warnings(found, distance)]
    return Section("Summary", tuple(elements))


def _used(survey: Survey) -> str:
    total, used = number(survey.prepared, "photographs"), number(survey.model_facts, "photographs")
    if total is None or used is None:
        return f"{len(survey.views)} with cameras; how many were taken, the data set does not say"
    return f"{used:.0f} of {total:.0f} ({share(used, total)})"


def _error(survey: Survey) -> str:
    if survey.tie_points is None:
        return "not known: the data set keeps no observations of tie points"
    return f"{mean_error(survey):.2f} px"


def mean_error(survey: Survey) -> float | None:
    """Of all observations, pixels of the photographs; None without tie points."""
    return None if survey.tie_points is None else float(survey.tie_points.errors.mean())


def _held_out(survey: Survey) -> str:
    psnr = number(survey.metrics, "images", "psnr")
    if psnr is None:
        return "none: with --test-every 8, every eighth photograph is kept from the optimisation to measure with"
    return f"PSNR {psnr:.2f} dB of {len(mapping(survey.metrics, 'images', 'per_image'))} photographs"


def ground_sampling_distance(survey: Survey) -> float | None:
    """What a pixel of the photographs, at the size of their files, covers at the median depth of the sparse points that
    they see; the median of all photographs, units of the map. None without sparse points."""
    cloud = survey.scene.cloud
    if cloud.drawn or not len(cloud.xyz):
        return None
    points, sizes = cloud.xyz.double()[:: max(1, len(cloud.xyz) // MAX_HEIGHT_SAMPLES)], []
    for view in survey.views:
        camera = view.camera
        x, y, depth = camera.project(points).unbind(1)
        seen = depth[(depth > 0) & (x >= 0) & (x < camera.width) & (y >= 0) & (y < camera.height)]
        if len(seen):
            stored = open_header(view.path, lambda image: max(image.size))
            sizes.append(float(seen.median()) / camera.fx * max(camera.width, camera.height) / stored)
    return float(np.median(sizes)) / survey.scene.frame.scale if sizes else None


def meaning(survey: Survey, distance: float | None) -> str:
    """In plain words, what the figures say of the maps."""
    said = []
    if (error := mean_error(survey)) is not None:
        fits = "less than a pixel, as it should be" if error <= MAX_ERROR_PX else "more than a pixel"
        said.append(f"The cameras agree with one another to {error:.2f} px, {fits}.")
    checks = mapping(survey.ground_control, "checkpoints_rms_m")
    if checks:
        plan = float(np.hypot(number(checks, "e") or 0, number(checks, "n") or 0))
        said.append(
            f"Check points, which took no part in the adjustment, are off by {length(plan, 'm')} in plan and "
            f"{length(number(checks, 'u'), 'm')} in height (RMS): so exact are coordinates taken from the maps. "
            f"That is by {len(texts(survey.ground_control, 'checkpoints'))} of them; the ASPRS standard asks for "
            f"{ASPRS_CHECK_POINTS} or more."
        )
    elif survey.ground_control:
        said.append(
            "The residuals of control points tell how well the block fits them; without check points nothing tells "
            "independently how exact coordinates taken from the maps are."
        )
    elif survey.georeference:
        said.append(
            "The map lies where the positions of the photographs put it. Their residuals tell how exact each position "
            "is; an error that all share moves the whole map, and only ground control points reveal it. Lengths and "
            "shapes on the map are more exact than its position."
        )
    elif survey.scene.frame.metres is None:
        said.append(
            "Without positions or control points the scale is unknown: no lengths can be taken from the result."
        )
    if distance is not None:
        cell = number(survey.maps, "gsd") or 0.0  # photographs may have been read smaller than they are
        what = "two cells of the maps" if cell > distance else "two pixels"
        least = length(2 * max(distance, cell), survey.unit)
        said.append(f"Details smaller than about {least} ({what}) are not resolved.")
    return " ".join(said) or "Nothing is known of how exact the result is."


def warnings(found: Findings, distance: float | None) -> list[str]:
    """What a client should not overlook."""
    survey, said = found.survey, []
    total, used = number(survey.prepared, "photographs"), number(survey.model_facts, "photographs")
    if total and used is not None and total - used > MAX_UNUSED_SHARE * total:
        said.append(f"{total - used:.0f} of {total:.0f} photographs are not used; the section on tie points says why.")
    error = mean_error(survey)
    if error is not None and error > MAX_ERROR_PX:
        said.append(f"The mean reprojection error is {error:.2f} px; up to {MAX_ERROR_PX:g} px is usual.")
    checks = mapping(survey.ground_control, "checkpoints_rms_m")
    metres = survey.scene.frame.metres
    if checks and distance is not None and metres is not None:
        worst = max(number(checks, axis) or 0.0 for axis in "enu")
        if worst > MAX_CHECK_GSD * distance * metres:
            times = worst / (distance * metres)
            said.append(f"Check points are off by {times:.1f} ground sampling distances; {MAX_CHECK_GSD:g} are usual.")
    if left := texts(survey.ground_control, "left_out"):
        said.append(f"Control points contradict the others and were left out: {', '.join(left)}.")
    if off := mapping(survey.georeference, "left_out"):
        by = _distances([number(off, name) for name in off])
        what = f"1 position of a photograph contradicts the others{by} and was" if len(off) == 1 else (
            f"{len(off)} positions of photographs contradict the others{by} and were"
        )  # fmt: skip
        said.append(f"{what} left out.")
    said += focal_warnings(survey)
    if found.counts is not None:
        known = found.counts[np.isfinite(found.counts)]
        thin = float((known < 3).mean()) if len(known) else 0.0
        if thin > MAX_THIN_SHARE:
            said.append(f"{100 * thin:.0f} % of the area is in fewer than three photographs; heights are weak there.")
    if (steps := number(survey.metrics, "steps")) is None and survey.run is not None:
        said.append("The run is not finished.")
    elif survey.delivery.get("quality") == "draft":
        said.append(f"This is a draft ({fixed(steps, 0)} steps): the surface is a first look.")
    return said


def _distances(metres: Sequence[float | None]) -> str:
    """How far positions are off: " by 3.1 m", " by 3.1 to 250.0 m", or "" where that is not known."""
    known = [value for value in metres if value is not None]
    if not known:
        return ""
    least, most = fixed(min(known), 1), fixed(max(known), 1)
    return f" by {most} m" if least == most else f" by {least} to {most} m"


def focal_warnings(survey: Survey) -> list[str]:
    """What is known of the focal length from one source only: heights depend on it."""
    weighed, said = mapping(survey.model_facts, "weighed"), []
    remedy = "The residuals of check points tell." if survey.ground_control else "Check heights with control points."
    for lens in weighed.get("focal_lengths_px") or ():
        if isinstance(lens, dict) and lens.get("held") is True:
            exif, alone = number(lens, "exif") or 0.0, number(lens, "photographs_alone") or 0.0
            said.append(
                "All photographs look the same way, so heights are as exact as the focal length in EXIF "
                f"({exif:.0f} px), which the photographs alone contradict ({alone:.0f} px). {remedy}"
            )
    ground, start = number(weighed, "cameras_above_ground_m"), number(weighed, "cameras_above_start_m")
    if ground and start and (said or abs(ground / start - 1) > MAX_START_RATIO):
        said.append(f"The cameras are {ground:.1f} m above the ground, and by XMP {start:.1f} m above their start.")
    return said
