"""From runs to a page: the sections in their order, and the HTML of all of it."""

from __future__ import annotations

import base64
import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from surfkit.apps.report.elements import ElementGroup, Section, TableCell, TableElement, pictures
from surfkit.apps.report.gallery import encode_all
from surfkit.apps.report.json_values import NO_VALUE
from surfkit.apps.report.run_files import RunFiles, read_sources
from surfkit.apps.report.sections.ablation_section import ABLATION_FILE, read_table, row_runs, table_section
from surfkit.apps.report.sections.blocks_section import blocks
from surfkit.apps.report.sections.compressed_section import compressed
from surfkit.apps.report.sections.configuration_section import configuration
from surfkit.apps.report.sections.curves_section import curves
from surfkit.apps.report.sections.notes_section import notes
from surfkit.apps.report.sections.provenance_section import provenance
from surfkit.apps.report.sections.resources_section import resources
from surfkit.apps.report.sections.results_section import results
from surfkit.apps.report.sections.surface_section import geometry, meshes
from surfkit.apps.report.sections.views_section import held_out
from surfkit.core.check import BadInput, printable
from surfkit.core.files import replacing

if TYPE_CHECKING:
    from jinja2 import Environment

PAGE_TEMPLATES = Path(__file__).parent / "templates"
DEFAULT_FILE = "report.html"
"""Name of the file in the folder of the first run, or of the table."""


@dataclass(frozen=True)
class ReportOptions:
    """What a report shows.

    Attributes:
        views: Held-out views with pictures.
        with_pictures: Whether there are pictures at all.
    """

    views: int = 3
    with_pictures: bool = True

    def __post_init__(self) -> None:
        if self.views < 0:
            raise BadInput(f"--views {self.views}: give 0 or more")


@dataclass(frozen=True)
class ReportPage:
    """All of a page.

    Attributes:
        title: Its heading.
        sections: In their order.
    """

    title: str
    sections: tuple[Section, ...]


def page_of(folders: Sequence[Path], options: ReportOptions) -> ReportPage:
    """The report of some run folders, or of the folder of an ablation table.

    Raises:
        BadInput: A folder is neither, a table is named with anything else, or a file is damaged.
    """
    for folder in folders:
        if not (folder / ABLATION_FILE).is_file() and not (folder / "recipe.json").is_file():
            raise BadInput(
                f"{folder}: neither a run folder (recipe.json, run.json) nor a table ({ABLATION_FILE}); name one "
                f"that surfkit "
                "train or surfkit ablate made"
            )
    tables = [folder for folder in folders if (folder / ABLATION_FILE).is_file()]
    if not tables:
        runs = read_sources(folders)
        return ReportPage(", ".join(run.name for run in runs), run_sections(runs, options))
    if len(folders) > 1:
        raise BadInput(f"{tables[0]}: a table is reported alone; name this folder only, or run folders only")
    report = read_table(tables[0])
    by_row = row_runs(tables[0], report)
    sections = run_sections(tuple(by_row.values()), options) if by_row else ()
    shown = tuple(section for section in sections if section.id != "results")
    return ReportPage(f"table:{report.get('table')}", (table_section(report, by_row), *shown))


def run_sections(runs: Sequence[RunFiles], options: ReportOptions) -> tuple[Section, ...]:
    """All sections that the runs have something for."""
    drawn = options.with_pictures
    found = (
        results(runs),
        notes(runs),
        held_out(runs, options.views if drawn else 0),
        meshes(runs, drawn),
        geometry(runs, drawn),
        curves(runs),
        resources(runs),
        blocks(runs, drawn),
        compressed(runs),
        configuration(runs),
        provenance(runs),
    )
    sections = tuple(section for section in found if section is not None)
    if len(runs) == 1:
        return sections
    index = Section("index", "Sections of each run", (index_of(runs, sections),))
    return (sections[0], index, *sections[1:])


def index_of(runs: Sequence[RunFiles], sections: Sequence[Section]) -> TableElement:
    """Links to what the sections say of each run."""
    groups = [element for section in sections for element in section.elements if isinstance(element, ElementGroup)]
    there = {group.id for group in groups}
    by_run = [section for section in sections if any(run.id(section.id) in there for run in runs)]
    rows = []
    for run in runs:
        links = [(section.title, run.id(section.id)) for section in by_run]
        cells = [
            TableCell(title, link=address) if address in there else TableCell(NO_VALUE) for title, address in links
        ]
        rows.append((TableCell(run.name), *cells))
    head = ("run", *(section.title for section in by_run))
    return TableElement("Where the page tells of each run", head, tuple(rows))


def html(page: ReportPage) -> str:
    """The page as one file that loads nothing; a policy in it forbids the network and all scripts but its own.

    Raises:
        BadInput: The pictures take too much room.
    """
    style, script = ((PAGE_TEMPLATES / name).read_text(encoding="utf-8").strip() for name in ("page.css", "page.js"))
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    shown = encode_all(picture for section in page.sections for picture in pictures(section.elements))
    template = environment().get_template("page.html.j2")
    return template.render(page=page, shown=shown, style=style, script=script, script_digest=digest)


def environment() -> Environment:
    """The templates; whatever they print is escaped."""
    from jinja2 import Environment, FileSystemLoader, StrictUndefined

    loader = FileSystemLoader(PAGE_TEMPLATES)
    return Environment(
        loader=loader,
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        finalize=_quoted,
    )


def _quoted(value: Any) -> Any:
    """What a template prints, without control characters; HTML that it includes stays as it is."""
    return printable(value, lines=True) if type(value) is str else value


def write_report(folders: Sequence[Path], out: Path, options: ReportOptions) -> int:
    """Write the report of some folders, whole or not at all, and return its size in bytes.

    Raises:
        BadInput: See `page_of` and `html`.
    """
    # Names of files that are not UTF-8 become question marks.
    content = html(page_of(folders, options)).encode("utf-8", "replace")
    with replacing(out) as file:
        file.write(content)
    return len(content)
