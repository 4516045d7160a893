"""A document as one HTML file that loads nothing, for screens and for print."""

from __future__ import annotations

import base64
from pathlib import Path

from surfkit.apps.quality.document import Document, Figure, Paragraph, Row, Table
from surfkit.core.check import printable

TEMPLATES = Path(__file__).parent / "templates"


def html(document: Document) -> str:
    """The whole file; a policy in it forbids scripts and the network."""
    from jinja2 import Environment, FileSystemLoader, StrictUndefined

    environment = Environment(
        loader=FileSystemLoader(TEMPLATES),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        finalize=lambda value: printable(value, lines=True) if type(value) is str else value,
    )
    environment.tests |= {
        name: lambda element, kind=kind: isinstance(element, kind)
        for name, kind in (("paragraph", Paragraph), ("table", Table), ("figure", Figure), ("row", Row))
    }
    environment.filters["uri"] = _uri
    style = (TEMPLATES / "quality.css").read_text(encoding="utf-8").strip()
    return environment.get_template("quality.html.j2").render(document=document, style=style)


def _uri(figure: Figure) -> str:
    return f"data:{figure.media_type};base64,{base64.b64encode(figure.picture).decode()}"
