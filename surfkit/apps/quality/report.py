"""From a folder to a quality report: the sections in their order, written as HTML and PDF."""

from __future__ import annotations

from datetime import datetime, timezone
from pathlib import Path

from surfkit.apps.quality.document import Document, Section
from surfkit.apps.quality.html_writer import html
from surfkit.apps.quality.pdf_writer import pdf
from surfkit.apps.quality.photo_overlap import ground_of, overlap
from surfkit.apps.quality.sections.calibration import calibration
from surfkit.apps.quality.sections.maps_section import overlap_section, surface
from surfkit.apps.quality.sections.processing import held_out, processing
from surfkit.apps.quality.sections.residuals import control, positions
from surfkit.apps.quality.sections.summary import Findings, summary
from surfkit.apps.quality.sections.tie_point_section import appendix, tie_points
from surfkit.apps.quality.survey import Survey, open_survey
from surfkit.apps.sfm.settings import REPORT_FILE
from surfkit.core.files import replacing
from surfkit.core.version import own_version

DEFAULT_HTML, DEFAULT_PDF = "quality_report.html", "quality_report.pdf"
"""Names of the files in the folder."""


def document_of(survey: Survey) -> Document:
    """The whole report."""
    ground = ground_of(survey)
    counts = None if ground is None else overlap(survey, ground)
    moment = last_written(survey)
    day = "not known" if moment is None else f"{moment:%Y-%m-%d}"
    found: tuple[Section | None, ...] = (
        summary(Findings(survey, ground, counts), day),
        overlap_section(survey, ground, counts),
        positions(survey),
        control(survey),
        calibration(survey),
        tie_points(survey),
        surface(survey),
        held_out(survey),
        processing(survey),
        appendix(survey),
    )
    sections = tuple(section for section in found if section is not None)
    moment = moment or datetime.now(timezone.utc)
    return Document("Quality report", survey.name, f"surfkit {own_version()}", sections, moment)


def last_written(survey: Survey) -> datetime | None:
    """When the last of its results was written, UTC; what a report adds does not count. None where there are none."""
    paths = [survey.data.path / REPORT_FILE]
    if survey.run is not None:
        paths = [survey.run.metrics, survey.run.mesh, survey.run.out / "run.json"]
    times = [path.stat().st_mtime for path in paths if path.is_file()]
    return datetime.fromtimestamp(max(times), timezone.utc) if times else None


def write_quality(target: Path, out: Path, with_pdf: bool) -> list[Path]:
    """Write the report of a folder as HTML and, beside it, as PDF; the paths.

    Args:
        target: A delivery, a run or a prepared scene.
        out: The HTML file.
        with_pdf: Whether to write the PDF too.

    Raises:
        BadInput: See `open_survey`; nothing is written then.
    """
    document = document_of(open_survey(target))
    files = {out: html(document).encode("utf-8", "replace")}
    if with_pdf:
        files[out.with_suffix(".pdf")] = pdf(document)
    for path, content in files.items():
        with replacing(path) as file:
            file.write(content)
    return list(files)
