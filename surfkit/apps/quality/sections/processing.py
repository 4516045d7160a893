"""What was held out, and how the result was made: times, machine, versions, settings, notes."""

from __future__ import annotations

from typing import Any

from surfkit.apps.quality.document import Element, Paragraph, Section, Table, facts
from surfkit.apps.quality.sections.words import fixed
from surfkit.apps.quality.survey import Survey
from surfkit.apps.report.json_values import as_bytes, as_duration, flat, in_words, mapping, number, texts

HIDDEN = {"path", "priors"}
"""Settings that are places on this machine, no business of a client's."""
MAX_ROWS = 200
"""Of a table of held-out photographs."""


def held_out(survey: Survey) -> Section:
    """Photographs that were kept to measure with."""
    found = mapping(survey.metrics, "images", "per_image")
    title = "Held-out photographs"
    if not found:
        text = (
            "No photograph was held out, so how well the model shows places it was not trained on is not measured. "
            "surfkit make and train --test-every 8 hold out every eighth."
        )
        return Section(title, (Paragraph(text, "missing"),))
    names = [name for name in ("psnr", "ssim", "lpips") if any(number(row, name) is not None for row in found.values())]
    heads = {"psnr": "PSNR, dB", "ssim": "SSIM", "lpips": "LPIPS"}
    digits = {"psnr": 2}
    rows = [("mean", *(fixed(number(survey.metrics, "images", name), digits.get(name, 3)) for name in names))]
    for photo, row in list(found.items())[:MAX_ROWS]:
        rows.append((photo, *(fixed(number(row, name), digits.get(name, 3)) for name in names)))
    note = "Renders of the model against photographs that it was not trained on."
    note += f" The first {MAX_ROWS} of {len(found)}." if len(found) > MAX_ROWS else ""
    return Section(title, (Table("Held out", ("photograph", *(heads[name] for name in names)), tuple(rows), note),))


def processing(survey: Survey) -> Section:
    """Times, machine, versions, settings and notes."""
    elements: list[Element] = []
    if steps := _times(survey):
        elements.append(Table("Times", ("step", "time"), tuple(steps)))
    machine = [
        ("device", in_words(survey.record.get("device")) if survey.record else ""),
        ("threads", in_words(survey.record.get("threads")) if survey.record else ""),
        ("peak memory", _bytes(survey, "peak_memory_bytes")),
        ("peak GPU memory", _bytes(survey, "peak_gpu_bytes")),
    ]
    versions = mapping(survey.record, "versions") or mapping(survey.delivery, "versions")
    rows = [*machine, *((name, in_words(version)) for name, version in versions.items())]
    if rows := [row for row in rows if row[1] and row[1] != "none"]:
        elements.append(facts("Machine and versions", rows))
    else:
        elements.append(Paragraph("Machine and versions are known of runs: surfkit train or surfkit make.", "missing"))
    decisions = mapping(survey.delivery, "decisions")
    if decisions:
        told = [
            ("quality", in_words(survey.delivery.get("quality"))),
            ("source", in_words(survey.delivery.get("input"))),
        ]
        told += [(name, in_words(decisions[name])) for name in ("recipe", "why", "steps") if name in decisions]
        elements.append(facts("Decisions of surfkit make", told))
    for title, settings in (
        ("Settings of structure from motion", mapping(survey.prepared, "settings")),
        ("Reading of the data set", mapping(survey.record, "data")),
    ):
        if settings:
            rows = [
                (name, in_words(value))
                for name, value in flat(settings).items()
                if value is not None and name not in HIDDEN
            ]
            elements.append(facts(title, rows, "Those that are given, or have a default."))
    made = mapping(survey.delivery, "steps")  # notes of the surface are those of the run
    of_steps = (f"{name}: {note}" for name in made if name != "surface" for note in texts(mapping(made, name), "notes"))
    notes = [
        *texts(survey.record, "notes"),
        *of_steps,
        *(f"left out: {name}: {why}" for name, why in _left_out(survey).items()),
    ]
    elements += [Paragraph(f"Note: {note}") for note in notes]
    return Section("Processing", tuple(elements))


def _left_out(survey: Survey) -> dict[str, Any]:
    return mapping(survey.delivery, "left_out")


def _times(survey: Survey) -> list[tuple[str, str]]:
    rows = [
        (name, as_duration(value))
        for name, step in mapping(survey.delivery, "steps").items()
        if (value := number(step, "seconds")) is not None
    ]
    if not rows and (value := number(survey.metrics, "seconds")) is not None:
        rows.append(("optimisation", as_duration(value)))
    inner = mapping(survey.prepared, "seconds")
    return rows + [(f"cameras: {name}", as_duration(number(inner, name) or 0.0)) for name in inner]


def _bytes(survey: Survey, name: str) -> str:
    value = number(survey.metrics, name)
    return "" if value is None else as_bytes(value)
