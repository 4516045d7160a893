"""What a page is made of: plain values, which templates/page.html.j2 turns into HTML and escapes."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar, Literal


@dataclass(frozen=True)
class EmbeddedPicture:
    """A picture, or a part of one, that lies in a file.

    Attributes:
        path: The file.
        alt: What it shows, for those who do not see it.
        box: Left, upper, right and lower edge of the part, pixels; None for the whole.
    """

    path: Path
    alt: str
    box: tuple[int, int, int, int] | None = None


@dataclass(frozen=True)
class TableCell:
    """One cell of a table.

    Attributes:
        text: What it says.
        value: What it is sorted by; the text if None.
        note: Small print below the text, such as a difference.
        link: Address within the page.
        share: Length of a bar behind the text, 0 to 1; None for no bar.
    """

    text: str
    value: float | None = None
    note: str = ""
    link: str = ""
    share: float | None = None


@dataclass(frozen=True)
class TableElement:
    """Rows below a head; columns that hold numbers are set to the right.

    Attributes:
        caption: What it shows.
        head: Names of the columns.
        rows: As many cells in each as in the head; the first names the row.
        is_sortable: Whether the reader can sort it by a column.
        dimmed: Positions of rows that are of less weight.
    """

    kind: ClassVar[str] = "table"
    caption: str
    head: tuple[str, ...]
    rows: tuple[tuple[TableCell, ...], ...]
    is_sortable: bool = False
    dimmed: tuple[int, ...] = ()


@dataclass(frozen=True)
class LegendEntry:
    """A line of a chart: its name, the number of its colour, its dashes as SVG has them, and what it begins and ends
    with."""

    name: str
    color: int
    dashes: str
    figures: str


@dataclass(frozen=True)
class LineChart:
    """A chart of lines.

    Attributes:
        title: What it shows.
        svg: The drawing: markup of our own without any text of a run.
        legend: Its lines.
        data: JSON that the cursor of the page reads.
        steps: Places that the cursor can be moved to.
    """

    kind: ClassVar[str] = "chart"
    title: str
    svg: str
    legend: tuple[LegendEntry, ...]
    data: str
    steps: int


@dataclass(frozen=True)
class Figure:
    """A picture with a caption."""

    kind: ClassVar[str] = "figure"
    picture: EmbeddedPicture
    caption: str


@dataclass(frozen=True)
class Compare:
    """Pictures of the same view over each other, two of them shown with a border between that the reader moves.

    Attributes:
        title: Of the view.
        layers: Two or more, each with its label.
        is_titled: Whether the title is shown, and not only told to those who do not see the pictures.
    """

    kind: ClassVar[str] = "compare"
    title: str
    layers: tuple[tuple[str, EmbeddedPicture], ...]
    is_titled: bool = True


@dataclass(frozen=True)
class ElementRow:
    """Charts or pictures side by side, as far as there is room: small ones also on a phone.

    Attributes:
        elements: From left to right.
        size: Of each.
    """

    kind: ClassVar[str] = "row"
    elements: tuple[Element, ...]
    size: Literal["wide", "normal", "small"] = "normal"


@dataclass(frozen=True)
class ElementGroup:
    """Elements below a heading, which may be empty, with an address within the page if `id` is not."""

    kind: ClassVar[str] = "group"
    title: str
    elements: tuple[Element, ...]
    id: str = ""


@dataclass(frozen=True)
class Details:
    """Elements that are hidden until they are asked for."""

    kind: ClassVar[str] = "details"
    title: str
    elements: tuple[Element, ...]


@dataclass(frozen=True)
class Prose:
    """A paragraph."""

    kind: ClassVar[str] = "prose"
    text: str


@dataclass(frozen=True)
class Listing:
    """A list of texts."""

    kind: ClassVar[str] = "listing"
    items: tuple[str, ...]


Element = TableElement | LineChart | Figure | Compare | ElementRow | ElementGroup | Details | Prose | Listing


@dataclass(frozen=True)
class Section:
    """A part of the page with a heading and an address."""

    id: str
    title: str
    elements: tuple[Element, ...]


def pictures(elements: tuple[Element, ...]) -> Iterator[EmbeddedPicture]:
    """All pictures, in the order of the page."""
    for element in elements:
        if isinstance(element, Figure):
            yield element.picture
        elif isinstance(element, Compare):
            yield from (picture for _, picture in element.layers)
        elif isinstance(element, (ElementRow, ElementGroup, Details)):
            yield from pictures(element.elements)
