"""The mesh of each run, and how close it is to a truth."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from surfkit.apps.report.elements import (
    Compare,
    Details,
    Element,
    ElementGroup,
    ElementRow,
    EmbeddedPicture,
    Figure,
    Prose,
    Section,
    TableCell,
    TableElement,
)
from surfkit.apps.report.gallery import image_size
from surfkit.apps.report.json_values import flat, in_words, mapping, number, numeric, plain, value_at
from surfkit.apps.report.run_files import RunFiles, heading
from surfkit.apps.report.svg_charts import ChartSeries, chart

ERROR_COLORS_NOTE = "Blue is within the distance threshold, orange to red is further away."
BY_VALUE = {"above-views.png": "views", "above-error.png": "error"}
"""Pictures of the mesh by values of its vertices, and what these are called."""
VIEW_PICTURES = ("view-1", "view-2", "view-3", "view-4")
SURFACE_SCORES = ("precision", "recall", "f1")
ERRORS = (("plan", "from above"), ("view0", "view 1"), ("view1", "view 2"), ("view2", "view 3"))
"""Pictures of both clouds coloured by their error, and how they are called."""


def meshes(runs: Sequence[RunFiles], with_pictures: bool) -> Section | None:
    """The meshes of runs of the same data over each other, then that of each run."""
    made = [run for run in runs if run.mesh]
    are_alike = len(made) > 1 and all(_data(run) == _data(made[0]) for run in made)
    groups = []
    if with_pictures and are_alike and (views := _views(made)):
        groups.append(ElementGroup("All meshes", (ElementRow(tuple(views), size="wide"),)))
    for run in made:
        elements = [*(_views([run]) if not are_alike else []), *_above(run)] if with_pictures else []
        elements = [ElementRow(tuple(elements), size="wide")] if elements else []
        tables = (_mesh_table(run), *_quality(run))
        groups.append(ElementGroup(heading(run, runs), (*elements, *tables), run.id("mesh")))
    return Section("mesh", "Mesh", tuple(groups)) if groups else None


def _data(run: RunFiles) -> dict[str, Any]:
    """What decides which training views are drawn: the data set without its depth maps."""
    return {name: value for name, value in mapping(run.record, "data").items() if name != "priors"}


def _views(runs: Sequence[RunFiles]) -> list[Element]:
    """Training views: the render of the first run, and the mesh of each."""
    found: list[Element] = []
    for name in VIEW_PICTURES:
        layers: dict[str, EmbeddedPicture] = {}
        for run in runs:
            path = run.out / "mesh_pictures" / f"{name}.png"
            if path.is_file():
                render, mesh = halves(path, ("render", "mesh"), run)
                of = "" if len(runs) == 1 else f" of {run.name}"
                layers |= {f"render{of}": render} if not layers else {}
                layers[f"mesh{of}"] = mesh
        if layers:
            found.append(Compare(f"Training view {name[-1]}", tuple(layers.items())))
    return found


def _above(run: RunFiles) -> list[Element]:
    path = run.out / "mesh_pictures" / "above.png"
    picture = EmbeddedPicture(path, f"mesh of {run.name} from above")
    found: list[Element] = [Figure(picture, "from above; blue is seen from behind")] if path.is_file() else []
    for name, words in mapping(run.mesh, "pictures").items():
        path = run.out / "mesh_pictures" / name
        if name in BY_VALUE and isinstance(words, str) and path.is_file():
            found.append(
                Figure(EmbeddedPicture(path, f"mesh of {run.name} from above, by its {BY_VALUE[name]}"), words)
            )
    return found


def halves(path: Path, names: tuple[str, str], run: RunFiles) -> tuple[EmbeddedPicture, EmbeddedPicture]:
    """The left and the right half of a picture."""
    width, height = image_size(path)
    middle = width // 2
    boxes = ((0, 0, middle, height), (middle, 0, width, height))
    first, second = (EmbeddedPicture(path, f"{n} of {run.name}", box) for n, box in zip(names, boxes, strict=True))
    return first, second


def _mesh_table(run: RunFiles) -> TableElement:
    cleaning = mapping(run.mesh, "cleaning")
    facts = mapping(run.mesh, "facts") or mapping(run.mesh, "lengths")
    mesher = mapping(run.mesh, "mesher")
    rows = [plain("mesher", mesher.get("use"))]
    for name in ("triangles", "vertices", "clusters_kept", "clusters", "boundaries", "holes_closed"):
        if (value := number(run.mesh, name) or number(cleaning, name)) is not None:
            rows.append(plain(name.replace("_", " "), f"{value:,.0f}"))
    if (share := number(cleaning, "boundary_share")) is not None:
        rows.append(plain("share of edges that are boundaries", f"{share:.1%}"))
    for name, value in flat(facts).items() if facts else ():
        shown = f"{value:,.4g}" if isinstance(value, float) else in_words(value)
        rows.append(plain(re.sub(" m$", ", m", name.replace("_", " ")), shown))
    return TableElement("The mesh", ("quantity", "value"), tuple(rows))


def _quality(run: RunFiles) -> list[Element]:
    """What `surfkit evaluate` has measured of the mesh by itself."""
    found = mapping(run.metrics, "mesh")
    unit = "m" if found.get("unit") == "m" else "units"
    forms = (
        (("triangles",), "triangles", ",.0f"),
        (("triangles_per_area",), f"triangles per square {'metre' if unit == 'm' else 'unit'}", ",.4g"),
        (("boundary_share",), "share of edges with one triangle", ".2%"),
        (("components",), "connected parts", ",.0f"),
        (("non_manifold_edges",), "edges with more than two triangles", ",.0f"),
        (("crossing", "share"), "share of triangles that cross others", ".3%"),
        (("crossing", "measured"), "triangles that this was measured on", ",.0f"),
        (("roughness", "on_planes"), f"roughness on planes of the mesh, {unit}", ".3g"),
        (("roughness", "planes"), "share of the area that is planes", ".0%"),
        (("roughness", "radius"), f"radius that roughness is measured in, {unit}", ".3g"),
    )
    rows = [
        plain(label, f"{value:{form}}") for path, label, form in forms if (value := number(found, *path)) is not None
    ]
    return [TableElement("The mesh by itself", ("quantity", "value"), tuple(rows))] if rows else []


def geometry(runs: Sequence[RunFiles], with_pictures: bool) -> Section | None:
    """Precision and recall of each run whose mesh was compared with a truth, and where the errors are."""
    groups = []
    for run in runs:
        if found := mapping(run.metrics, "geometry"):
            elements = [_scores(found), *_curve(found), *_classes(found)]
            elements += _error_pictures(run) if with_pictures else []
            groups.append(ElementGroup(heading(run, runs), tuple(elements), run.id("geometry")))
    return Section("geometry", "Geometry against the truth", tuple(groups)) if groups else None


def _scores(found: dict[str, Any]) -> TableElement:
    rows = [
        plain("F1" if name == "f1" else name, f"{value:.3f}")
        for name in SURFACE_SCORES
        if (value := number(found, name)) is not None
    ]
    if (tau := number(found, "tau")) is not None:
        rows.append(plain("distance threshold", f"{tau:g}"))
    for name in ("accuracy", "completeness", "overall"):
        if (value := number(found, "chamfer", name)) is not None:
            rows.append(plain(f"chamfer distance, {name}", f"{value:.3f}"))
    for path, label, form in (
        (("normals", "median"), "angle between normals, median, degrees", ".1f"),
        (("normals", "p90"), "angle between normals, 90 % quantile, degrees", ".1f"),
        (("roughness", "on_truth_planes"), "roughness where the truth is plane", ".3g"),
    ):
        if (value := number(found, *path)) is not None:
            rows.append(plain(label, f"{value:{form}}"))
    for name in ("align", "truth", "reconstruction"):
        if isinstance(value := found.get(name), str):
            rows.append(plain("alignment" if name == "align" else name, value))
    return TableElement("Mesh against the truth", ("quantity", "value"), tuple(rows))


def _curve(found: dict[str, Any]) -> list[Element]:
    """Precision, recall and F1 over the distance threshold."""
    columns = [value_at(found, "curve", name) for name in ("tau", "precision", "recall")]
    try:
        table = np.array(columns, dtype=np.float64)
    except (TypeError, ValueError):  # not numbers, or not equally many
        return []
    if table.ndim != 2 or table.shape[1] < 2 or not np.isfinite(table).all() or abs(table).max() > 1e300:
        return []
    taus, precision, recall = table
    total = precision + recall
    f1 = np.divide(2 * precision * recall, total, out=np.zeros_like(total), where=total > 0)
    named = (("F1", f1), ("precision", precision), ("recall", recall))
    lines = [ChartSeries(name, np.stack([taus, values])) for name, values in named]
    return [chart("Precision, recall and F1 over the distance threshold", lines, "distance threshold", top=1.0)]


def _classes(found: dict[str, Any]) -> list[Element]:
    """Scores by class of places."""
    rows = []
    for group, classes in mapping(found, "classes").items():
        for name, one in classes.items() if isinstance(classes, dict) else ():
            values = [number(one, score) for score in SURFACE_SCORES]
            if any(value is not None for value in values):
                cells = [numeric(value, "" if value is None else f"{value:.3f}") for value in values]
                rows.append((TableCell(f"{group}: {name}"), *cells))
    head = ("class", "precision", "recall", "F1")
    return [TableElement("By class of places", head, tuple(rows), is_sortable=True)] if rows else []


def _error_pictures(run: RunFiles) -> list[Element]:
    folder, found = run.out / "geometry", []
    for name, words in ERRORS:
        path = folder / f"{name}.png"
        if path.is_file():
            both = halves(path, (f"errors of the mesh, {words},", f"errors of the truth, {words},"), run)
            captions = (f"mesh, {words}: red is wrong", f"truth, {words}: red is missing")
            figures = tuple(Figure(picture, caption) for picture, caption in zip(both, captions, strict=True))
            found.append(ElementRow(figures, size="small"))
    more = [Details("Errors as training views see them", tuple(found[1:]))] if found[1:] else []
    return [*([Prose(ERROR_COLORS_NOTE)] if found else []), *found[:1], *more]
