"""What is said about a data set before anyone trains on it."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

from surfkit.core.check import BadInput, few

Level = Literal["error", "warning", "note"]
"""An error stops training or loses photographs; a warning costs quality or hours; a note is to be known."""
FINDING_LEVELS: tuple[Level, ...] = ("error", "warning", "note")
_VARYING = re.compile(r"'[^']*'|\"[^\"]*\"|[^\s:]*/[^\s:]*|[^\s:]*\d[^\s:]*")
"""What differs between messages about one kind of fault: names, paths and numbers."""
LISTED_NAMES = 3
"""Names of a group that are told in its line."""


@dataclass(frozen=True)
class Finding:
    """One thing to know.

    Attributes:
        level: How bad it is.
        what: Its kind in a word or two, such as "damaged-photographs"; the same in every version, for programs.
        text: One line: where, what, and what to do.
        names: The photographs, or other items, that it is about; all of them.
    """

    level: Level
    what: str
    text: str
    names: tuple[str, ...] = ()


def from_errors(what: str, errors: Iterable[BadInput], level: Level = "error") -> list[Finding]:
    """One finding for each kind of message; the first stands for those that differ in names and numbers only."""
    groups: dict[str, list[str]] = {}
    for error in errors:
        text = " ".join(str(error).split())
        groups.setdefault(_VARYING.sub("*", text), []).append(text)
    return [_told(level, what, list(dict.fromkeys(texts))) for texts in groups.values()]


def of_each(what: str, faults: Mapping[str, str], cure: str = "", level: Level = "error") -> list[Finding]:
    """One finding for each kind of fault of named things.

    Args:
        what: Kind of the findings.
        faults: Messages by name; those that differ in numbers only are of one kind.
        cure: What to do, where the messages do not say it.
        level: Of the findings.
    """
    groups: dict[str, list[str]] = {}
    for name, text in faults.items():
        groups.setdefault(_VARYING.sub("*", text), []).append(name)
    return [
        Finding(level, what, f"{few(names)}: {' '.join(faults[names[0]].split())}{cure and f'; {cure}'}", tuple(names))
        for names in groups.values()
    ]


def _told(level: Level, what: str, texts: Sequence[str]) -> Finding:
    names = tuple(dict.fromkeys(_own_part(text, texts) for text in texts)) if len(texts) > 1 else ()
    if len(texts) == 1:
        return Finding(level, what, texts[0])
    others = ", ".join(names[1 : 1 + LISTED_NAMES]) + (", ..." if len(names) > 1 + LISTED_NAMES else "")
    return Finding(level, what, f"{texts[0]} (and {len(texts) - 1} more like it: {others})", names)


def _own_part(text: str, texts: Sequence[str]) -> str:
    """The first part of a message that the others do not share."""
    parts = [_VARYING.findall(other) for other in texts[:50]]
    for at, mine in enumerate(_VARYING.findall(text)):
        if len({found[at] for found in parts if at < len(found)}) > 1:
            return mine.strip("'\"")
    return text
