"""Coordinate reference systems as well-known text (WKT 1), as far as readers need it without pyproj."""

from __future__ import annotations

import re
from dataclasses import dataclass

from surfkit.core.check import BadInput

TOKEN = re.compile(r'\s*(?:"((?:[^"]|"")*)"|([A-Za-z_][A-Za-z0-9_]*)|([-+.0-9][-+.0-9eE]*)|([\[\](),]))')
NESTED = 50
"""Nodes within one another that are read."""


@dataclass(frozen=True)
class Node:
    """A node such as UNIT["metre", 1].

    Attributes:
        keyword: In capitals.
        values: Texts and numbers, as text.
        children: Nodes inside it.
    """

    keyword: str
    values: tuple[str, ...]
    children: tuple[Node, ...]

    def child(self, *keywords: str) -> Node | None:
        """The first node directly inside it of one of some keywords; None without."""
        return next((node for node in self.children if node.keyword in keywords), None)

    @property
    def name(self) -> str:
        """What it is called."""
        return self.values[0] if self.values else ""

    @property
    def code(self) -> str | None:
        """Such as "EPSG:32632"; None where the text names none."""
        found = self.child("AUTHORITY", "ID")
        return ":".join(found.values[:2]).upper() if found is not None and len(found.values) > 1 else None

    def number(self, at: int) -> float | None:
        """The value at a position, if it is a number."""
        try:
            return float(self.values[at])
        except (IndexError, ValueError):
            return None


def parse_wkt(where: str, text: str) -> Node:
    """The outermost node of a well-known text.

    Raises:
        BadInput: It is none; names `where` it comes from.
    """
    tokens, at, text = [], 0, text.rstrip()
    while at < len(text):
        found = TOKEN.match(text, at)
        if found is None:
            raise _damaged(where, f"{text[at : at + 40]!r} in its text")
        tokens.append(found)
        at = found.end()
    node, used = _node(where, tokens, 0, 0)
    if used != len(tokens):
        raise _damaged(where, "something follows its last bracket")
    return node


def _node(where: str, tokens: list[re.Match[str]], at: int, depth: int) -> tuple[Node, int]:
    """The node that begins at a token, and the token after it."""
    opens = [token[4] for token in tokens[at + 1 : at + 2]]
    if at >= len(tokens) or tokens[at][2] is None or opens not in (["["], ["("]) or depth > NESTED:
        raise _damaged(where, "no well-known text")
    values: list[str] = []
    children: list[Node] = []
    here = at + 2
    while here < len(tokens):
        token = tokens[here]
        if token[4] in ("]", ")"):
            return Node(tokens[at][2].upper(), tuple(values), tuple(children)), here + 1
        if token[4] == ",":
            here += 1
        elif token[2] is not None and here + 1 < len(tokens) and tokens[here + 1][4] in ("[", "("):
            child, here = _node(where, tokens, here, depth + 1)
            children.append(child)
        else:
            values.append(next(part for part in token.groups() if part is not None))
            here += 1
    raise _damaged(where, "its text is cut off")


def _damaged(where: str, why: str) -> BadInput:
    return BadInput(f"{where}: no coordinate reference system: {why}; export it again")
