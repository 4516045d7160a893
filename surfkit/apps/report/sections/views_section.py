"""Held-out photographs beside their renders, with depth and normals.

The pictures are cut from those that the evaluation has written, so no model is loaded and nothing is rendered again.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

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
from surfkit.apps.report.json_values import mapping, number, numeric
from surfkit.apps.report.run_files import RunFiles
from surfkit.evaluate.images.comparison_pictures import picture_path

PICTURE_PARTS = ("photograph", "render", "depth", "normals")
"""What a picture of the evaluation has side by side, as far as the method draws it."""
MAX_OPEN_RUNS = 2
"""Runs whose depth and normals are shown without being asked for."""
COLORS_NOTE = "Depth: near is pale, far is dark. Normals: red to the right, green up, blue towards the camera."


def held_out(runs: Sequence[RunFiles], views: int) -> Section | None:
    """Some views from the worst to the best, and the figures of all; None if nothing was measured.

    Args:
        runs: Of which those with pictures are shown.
        views: How many are shown; 0 for the figures alone.
    """
    names = view_names(runs)
    if not names:
        apart = Prose("The runs have no held-out photograph in common; report each by itself.")
        return Section("views", "Held-out views", (apart,)) if any(map(psnrs, runs)) else None
    elements: list[Element] = []
    for name, word in chosen(runs, names, views):
        elements.append(shown(runs, name, word))
    if elements:
        elements.append(Prose(COLORS_NOTE))
    elements.append(Details(f"Figures of all {len(names)} held-out views", (_table(runs, names),)))
    return Section("views", "Held-out views", tuple(elements))


def view_names(runs: Sequence[RunFiles]) -> list[str]:
    """Photographs that were measured in every run that has measured any, from the lowest mean PSNR to the highest."""
    measured = [one for run in runs if (one := psnrs(run))]
    common = [name for name in measured[0] if all(name in one for one in measured)] if measured else []
    return sorted(common, key=lambda name: (sum(one[name] for one in measured), name))


def psnrs(run: RunFiles) -> dict[str, float]:
    """PSNR by photograph."""
    per_image = mapping(run.metrics, "images", "per_image")
    found = {name: number(per_image, name, "psnr") for name in per_image}
    return {name: value for name, value in found.items() if value is not None}


def chosen(runs: Sequence[RunFiles], names: Sequence[str], views: int) -> list[tuple[str, str]]:
    """So many of the names that have pictures, each with its rank in words: evenly from the worst to the best."""
    there = [name for name in names if any(panel_path(run, name) for run in runs)]
    count = min(views, len(there))
    ranks = [len(there) // 2] if count == 1 else [round(at * (len(there) - 1) / (count - 1)) for at in range(count)]
    words = {0: "lowest PSNR", len(there) - 1: "highest PSNR", len(there) // 2: "median PSNR"}
    return [(there[rank], words.get(rank, f"PSNR number {rank + 1} of {len(there)}")) for rank in ranks]


def panel_path(run: RunFiles, name: str) -> Path | None:
    """The picture that the evaluation has written of a view, if it is there."""
    path = picture_path(run.out / "pictures", name)
    return path if path.is_file() else None


def shown(runs: Sequence[RunFiles], name: str, word: str) -> ElementGroup:
    """A view: photograph and renders over each other, then depth and normals of each run."""
    layers: dict[str, EmbeddedPicture] = {}
    maps: list[Element] = []
    for run in runs:
        value, has_one = psnrs(run).get(name), len(runs) == 1
        told = "" if value is None else f", {value:.2f} dB"
        for part, picture in panel(run, name).items():
            if part == "photograph":
                layers.setdefault(part, picture)
            elif part == "render":
                layers[f"{part if has_one else run.name}{told}"] = picture
            else:
                maps.append(Figure(picture, part if has_one else f"{part} of {run.name}"))
    elements: list[Element] = []
    if len(layers) > 1:
        elements.append(Compare(name, tuple(layers.items()), is_titled=False))
    if maps:
        row = ElementRow(tuple(maps), size="small")
        elements.append(row if len(runs) <= MAX_OPEN_RUNS else Details(f"Depth and normals of {name}", (row,)))
    return ElementGroup(f"{name} ({word})", tuple(elements))


def panel(run: RunFiles, name: str) -> dict[str, EmbeddedPicture]:
    """The parts of the picture of a view; in one piece, as "pictures", where nobody knows how wide a part is."""
    path = panel_path(run, name)
    if path is None:
        return {}
    width, height = image_size(path)
    size = run.photo_sizes.get(name)
    count = width // size[0] if size and size[0] else 0
    if not (size and 1 < count <= len(PICTURE_PARTS) and (width, height) == (count * size[0], size[1])):
        return {"pictures": EmbeddedPicture(path, f"photograph, render and maps of {name}")}
    boxes = [(at * size[0], 0, (at + 1) * size[0], height) for at in range(count)]
    return {
        part: EmbeddedPicture(path, f"{part} of {name}" + (f", {run.name}" if part != "photograph" else ""), box)
        for part, box in zip(PICTURE_PARTS, boxes, strict=False)
    }


def _table(runs: Sequence[RunFiles], names: Sequence[str]) -> TableElement:
    """PSNR and SSIM of every view that all runs have measured."""
    rows = []
    for name in names:
        cells = []
        for run in runs:
            for key, digits in (("psnr", 2), ("ssim", 3)):
                value = number(mapping(run.metrics, "images", "per_image"), name, key)
                cells.append(numeric(value, "" if value is None else f"{value:.{digits}f}"))
        rows.append((TableCell(name), *cells))
    of = [""] if len(runs) == 1 else [f" of {run.name}" for run in runs]
    head = ("photograph", *(f"{what}{one}" for one in of for what in ("PSNR, dB", "SSIM")))
    return TableElement("Held-out views, from the lowest PSNR to the highest", head, tuple(rows), is_sortable=True)
