"""Text of others on the page: names of photographs, files and errors, shown as they are."""

from __future__ import annotations

import re

from surfkit.core.check import printable

MARKUP_PATTERN = re.compile(r"([\\`*_\[\]<>#|~&])")
"""What Markdown and HTML begin with within a line; CommonMark takes each for itself behind a backslash."""
LIST_PATTERN = re.compile(r"(?=[-+=\d])")
"""What may begin a list, or underline a title, at the beginning of a line."""
LINKS = re.compile(r"(www(?=\.)|:(?=//)|@)", re.IGNORECASE)
"""What GitHub's Markdown, which the page speaks, makes links of after the backslashes are gone."""
JOINER = "\u2060"
"""A letter without width (WORD JOINER), which is no part of a link."""


def as_text(text: object) -> str:
    """Markdown that shows a text as it is: no mark in it makes a tag, a link, a picture or bold letters."""
    shown = LINKS.sub(rf"\1{JOINER}", printable(str(text)))
    return MARKUP_PATTERN.sub(r"\\\1", JOINER + shown if LIST_PATTERN.match(shown) else shown)


def as_code(text: object) -> str:
    """Markdown that shows a text as code, to be copied: it ends where the text does, whatever marks this has."""
    shown = printable(str(text))
    fence = "`" * (1 + max((len(run) for run in re.findall("`+", shown)), default=0))
    return f"{fence} {shown} {fence}" if "`" in shown else f"`{shown}`"
