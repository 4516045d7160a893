"""A document as PDF of A4 pages, with header, footer, page numbers, contents and bookmarks, by reportlab."""

from __future__ import annotations

import io
from functools import partial
from typing import TYPE_CHECKING, Any
from xml.sax.saxutils import escape

from surfkit.apps.quality.document import PRINT_WIDTH_MM, Document, Element, Figure, Paragraph, Section, Table
from surfkit.core.check import printable
from surfkit.core.optional import needed

if TYPE_CHECKING:
    from reportlab.lib.styles import ParagraphStyle

INK, FAINT, ACCENT, RULE, PALE = "#1b1f24", "#57606a", "#0b57a4", "#c3cad1", "#f3f5f7"
KIND_COLOURS = {"warning": "#b85a00", "missing": "#9aa5b1"}
MAX_FIGURE_MM = 205.0
"""Height of a figure, so that it fits on a page with its title."""
FACTS_SHARE = 0.36
"""Of the width: names of a table of names and values."""
FONTS = {"Text": "DejaVuSans.ttf", "Text-Bold": "DejaVuSans-Bold.ttf"}
"""Of matplotlib: they have the letters of file names that the built-in fonts of PDF lack."""


def require_reportlab() -> None:
    """BadInput where reportlab is not installed."""
    with needed("reportlab", "a quality report as PDF"):
        __import__("reportlab")


def pdf(document: Document) -> bytes:
    """The whole file; the same document gives the same bytes."""
    from reportlab.lib.pagesizes import A4
    from reportlab.lib.units import mm
    from reportlab.platypus import BaseDocTemplate, Frame, PageBreak, PageTemplate

    _register_fonts()
    width, height = A4
    margin = (width - PRINT_WIDTH_MM * mm) / 2
    frame = Frame(margin, 18 * mm, PRINT_WIDTH_MM * mm, height - 38 * mm, 0, 0, 0, 0)

    class Template(BaseDocTemplate):
        def beforeDocument(self) -> None:
            # Invariant documents are of the year 2000 to reportlab; the date is that of the results, so it is no clock.
            self.canv.setDateFormatter(lambda *_: f"{document.moment:D:%Y%m%d%H%M%S}+00'00'")

        def afterFlowable(self, flowable: Any) -> None:
            if (section := getattr(flowable, "section", None)) is not None:
                self.canv.bookmarkPage(section.address)
                self.canv.addOutlineEntry(section.title, section.address)
                self.notify("TOCEntry", (0, section.title, self.page, section.address))

    target = io.BytesIO()
    template = Template(
        target, pagesize=A4, invariant=1, title=f"{document.title}: {document.subtitle}", author="surfkit"
    )
    first = PageTemplate("first", [frame], onPage=partial(_margins, document=document, is_first=True))
    later = PageTemplate("later", [frame], onPage=partial(_margins, document=document, is_first=False))
    first.autoNextPageTemplate = "later"
    template.addPageTemplates([first, later])
    story: list[Any] = [*_title(document), *_section(document.sections[0])]
    story += [PageBreak(), *_contents()]
    for section in document.sections[1:]:
        story += _section(section)
    template.multiBuild(story)
    return target.getvalue()


def _register_fonts() -> None:
    from matplotlib import get_data_path
    from reportlab.pdfbase.pdfmetrics import registerFont, registerFontFamily
    from reportlab.pdfbase.ttfonts import TTFont

    for name, file in FONTS.items():
        registerFont(TTFont(name, f"{get_data_path()}/fonts/ttf/{file}"))
    registerFontFamily("Text", normal="Text", bold="Text-Bold", italic="Text", boldItalic="Text-Bold")


def _style(size: float = 8.5, colour: str = INK, bold: bool = False, **settings: Any) -> ParagraphStyle:
    from reportlab.lib.styles import ParagraphStyle

    font = "Text-Bold" if bold else "Text"
    usual = {"leading": 1.35 * size, "splitLongWords": 1}
    return ParagraphStyle(f"{font}-{size}-{colour}", fontName=font, fontSize=size, textColor=colour, **usual | settings)


def _text(text: str, style: ParagraphStyle) -> Any:
    from reportlab.platypus import Paragraph as PdfParagraph

    return PdfParagraph(escape(printable(text, lines=True)), style)


def _margins(canvas: Any, template: Any, document: Document, is_first: bool) -> None:
    """Draw header and footer of a page."""
    from reportlab.lib.units import mm

    width, height = template.pagesize
    margin = (width - PRINT_WIDTH_MM * mm) / 2
    canvas.saveState()
    canvas.setFont("Text", 7)
    canvas.setFillColor(FAINT)
    canvas.setStrokeColor(RULE)
    if not is_first:
        canvas.drawString(margin, height - 13 * mm, printable(document.title)[:60])
        canvas.drawRightString(width - margin, height - 13 * mm, printable(document.subtitle)[:90])
        canvas.line(margin, height - 15 * mm, width - margin, height - 15 * mm)
    canvas.line(margin, 14 * mm, width - margin, 14 * mm)
    canvas.drawString(margin, 10 * mm, printable(document.footer)[:110])
    canvas.drawRightString(width - margin, 10 * mm, f"page {template.page}")
    canvas.restoreState()


def _title(document: Document) -> list[Any]:
    return [
        _text(document.title, _style(17, bold=True)),
        _text(document.subtitle, _style(9, FAINT, spaceBefore=1, spaceAfter=3)),
    ]


def _contents() -> list[Any]:
    from reportlab.platypus.tableofcontents import TableOfContents

    contents = TableOfContents(levelStyles=[_style(9, spaceBefore=2)], dotsMinLevel=0)
    return [_text("Contents", _style(13, ACCENT, bold=True, spaceAfter=4)), contents]


def _section(section: Section) -> list[Any]:
    heading = _text(section.title, _style(13, ACCENT, bold=True, spaceBefore=10, spaceAfter=3, keepWithNext=1))
    heading.section = section
    return [heading, *(flowable for element in section.elements for flowable in _element(element))]


def _element(element: Element) -> list[Any]:
    if isinstance(element, Paragraph):
        return [_paragraph(element)]
    if isinstance(element, Table):
        return _table(element)
    return [_row((element,), element.share) if isinstance(element, Figure) else _row(element.figures, 1.0)]


def _paragraph(paragraph: Paragraph) -> Any:
    if paragraph.kind == "plain":
        return _text(paragraph.text, _style(spaceBefore=2, spaceAfter=3))
    from reportlab.lib.units import mm
    from reportlab.platypus import Table as PdfTable

    box = PdfTable([[_text(paragraph.text, _style())]], colWidths=[PRINT_WIDTH_MM * mm], spaceBefore=3, spaceAfter=3)
    box.setStyle([
        ("LINEBEFORE", (0, 0), (0, -1), 2.5, KIND_COLOURS[paragraph.kind]),
        ("BACKGROUND", (0, 0), (-1, -1), PALE),
    ])  # fmt: skip
    return box


def _table(table: Table) -> list[Any]:
    from reportlab.lib.units import mm
    from reportlab.platypus import Table as PdfTable

    left, right = _style(7.5), _style(7.5, alignment=0 if not table.head else 2)
    rows = [[_text(cell, left if at == 0 else right) for at, cell in enumerate(row)] for row in table.rows]
    head = [[_text(name, _style(7.5, bold=True, alignment=2 if at else 0)) for at, name in enumerate(table.head)]]
    shown = PdfTable(
        (head if table.head else []) + rows,
        colWidths=[share * PRINT_WIDTH_MM * mm for share in _widths(table)],
        repeatRows=int(bool(table.head)),
        hAlign="LEFT",
    )
    lines = [("LINEBELOW", (0, 0), (-1, -1), 0.4, "#dde2e7")]
    if table.head:
        lines.append(("LINEBELOW", (0, 0), (-1, 0), 0.8, FAINT))
    shown.setStyle([*lines, *_padding(right=5, top=1.2, bottom=1.6)])
    title = _text(table.title, _style(9, bold=True, spaceBefore=6, spaceAfter=2, keepWithNext=1))
    note = [_text(table.note, _style(7, FAINT, spaceBefore=2, spaceAfter=3))] if table.note else []
    return [title, shown, *note]


def _widths(table: Table) -> list[float]:
    """Of the columns, as shares of the page: by the longest cells; those of few short columns do not fill the page."""
    if not table.head:
        return [FACTS_SHARE, 1 - FACTS_SHARE]
    rows = (table.head, *table.rows)
    longest = [min(40, max(5, *(len(row[at]) for row in rows))) for at in range(len(table.head))]
    return [length / max(sum(longest), 70) for length in longest]


def _row(figures: tuple[Figure, ...], share: float) -> Any:
    """Figures beside each other, with their titles and notes, kept together on one page."""
    from reportlab.lib.units import mm
    from reportlab.platypus import Image
    from reportlab.platypus import Table as PdfTable

    width = share * PRINT_WIDTH_MM * mm / len(figures)
    gap = 4 * mm if len(figures) > 1 else 0
    cells = []
    for figure in figures:
        across = width - gap
        down = across * figure.size[1] / figure.size[0]
        fit = min(1.0, MAX_FIGURE_MM * mm / down)
        picture = Image(io.BytesIO(figure.picture), across * fit, down * fit)
        picture.hAlign = "LEFT"
        note = [_text(figure.note, _style(7, FAINT, spaceBefore=1))] if figure.note else []
        cells.append([_text(figure.title, _style(9, bold=True, spaceAfter=2)), picture, *note])
    shown = PdfTable([cells], colWidths=[width] * len(figures), hAlign="LEFT", spaceBefore=4, spaceAfter=4)
    shown.setStyle(_padding(right=gap))
    return shown


def _padding(right: float = 0, top: float = 0, bottom: float = 0) -> list[Any]:
    """Of all cells of a table, points; they have none to the left, and begin at the top."""
    sides = {"LEFT": 0, "RIGHT": right, "TOP": top, "BOTTOM": bottom}
    whole = ((0, 0), (-1, -1))
    return [("VALIGN", *whole, "TOP"), *((f"{side}PADDING", *whole, value) for side, value in sides.items())]
