"""A document as plain values: sections of paragraphs, tables and figures. Writers of HTML and PDF render it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime
from typing import Literal

PRINT_WIDTH_MM = 174.0
"""Between the margins of A4."""


@dataclass(frozen=True)
class Paragraph:
    """A text.

    Attributes:
        text: Plain text; writers escape it.
        kind: "missing" says what there is not, and how to get it.
    """

    text: str
    kind: Literal["plain", "warning", "missing"] = "plain"


@dataclass(frozen=True)
class Table:
    """Rows of text.

    Attributes:
        title: Above it.
        head: Names of the columns; empty for a table of names and values.
        rows: Cells as they are shown; columns after the first are aligned to the right where there is a head.
        note: Below it.
    """

    title: str
    head: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    note: str = ""

    def __post_init__(self) -> None:
        widths = {len(row) for row in self.rows} | ({len(self.head)} if self.head else set())
        assert len(widths) <= 1, f"{self.title}: rows of different lengths"


@dataclass(frozen=True)
class Figure:
    """A picture.

    Attributes:
        title: Above it.
        picture: A PNG or JPEG file.
        size: Width and height in pixels.
        share: Of the width of the page.
        note: Below it.
    """

    title: str
    picture: bytes
    size: tuple[int, int]
    share: float = 1.0
    note: str = ""

    @property
    def media_type(self) -> str:
        """As HTML names it."""
        return "image/png" if self.picture.startswith(b"\x89PNG") else "image/jpeg"


@dataclass(frozen=True)
class Row:
    """Figures beside each other."""

    figures: tuple[Figure, ...]


Element = Paragraph | Table | Figure | Row


@dataclass(frozen=True)
class Section:
    """A part of a document, with a heading.

    Attributes:
        title: Its heading.
        elements: In their order.
    """

    title: str
    elements: tuple[Element, ...]

    @property
    def address(self) -> str:
        """Of links to it."""
        return "-".join("".join(sign if sign.isalnum() else " " for sign in self.title.lower()).split())


@dataclass(frozen=True)
class Document:
    """All of a report.

    Attributes:
        title: On the first page.
        subtitle: Below it, and at the top of all other pages.
        footer: At the foot of each page.
        sections: The first one is on the first page.
        moment: When what it tells of was made, UTC.
    """

    title: str
    subtitle: str
    footer: str
    sections: tuple[Section, ...]
    moment: datetime


def facts(title: str, pairs: Sequence[tuple[str, str]], note: str = "") -> Table:
    """A table of names and values."""
    return Table(title, (), tuple(pairs), note)
