"""Pages of documentation, taken apart: prose, code, links, anchors."""

import re
from dataclasses import dataclass
from functools import cache
from pathlib import Path

ROOT = Path(__file__).parents[1]
PAGES = sorted(
    [
        ROOT / "README.md",
        ROOT / "CONTRIBUTING.md",
        ROOT / "SECURITY.md",
        ROOT / ".github" / "PULL_REQUEST_TEMPLATE.md",
        *(ROOT / "docs").glob("*.md"),
        *(ROOT / "plugins").glob("*/README.md"),
        *(ROOT / "examples").glob("*/README.md"),
    ]
)
NOTES = sorted((ROOT / "bench" / "log").glob("*.md"))
"""Notes of one time: their links lead somewhere, their commands may be those of then."""
FENCE = re.compile(r"^```(\w*)(?: title=\"([^\"]*)\")?\n(.*?)^```$", re.M | re.S)
INDENTED = re.compile(r"(?:(?<=\n\n)|\A)(?: {4}.*\n|\n(?= {4}))+", re.M)


@dataclass(frozen=True)
class Code:
    """A block of code.

    Attributes:
        language: After the fence; "" for none, and for indented blocks.
        title: Of a fence that has one.
        text: What is in it.
        start: Where it begins in the page.
    """

    language: str
    title: str
    text: str
    start: int


def title(page: Path) -> str:
    """A page's path from the root."""
    return page.relative_to(ROOT).as_posix()


@cache
def code(page: Path) -> tuple[Code, ...]:
    """The blocks of code of a page, in their order."""
    text = page.read_text(encoding="utf-8")
    fenced = [Code(found[1], found[2] or "", found[3], found.start()) for found in FENCE.finditer(text)]
    rest = FENCE.sub(lambda found: "." * len(found[0]), text)
    for found in INDENTED.finditer(rest):
        lines = "\n".join(line[4:] for line in found[0].strip("\n").splitlines())
        fenced.append(Code("", "", lines, found.start()))
    return tuple(sorted(fenced, key=lambda block: block.start))


@cache
def prose(page: Path) -> str:
    """A page without its blocks of code."""
    return INDENTED.sub("\n", FENCE.sub("\n", page.read_text(encoding="utf-8")))


@cache
def spans(page: Path) -> tuple[str, ...]:
    """What stands between backticks."""
    return tuple(" ".join(text.replace("\\|", "|").split()) for text in re.findall(r"`([^`]+)`", prose(page)))


def named(page: Path) -> set[str]:
    """Paths of this repository that stand between backticks."""
    found = {span for span in spans(page) if re.fullmatch(r"(?:surfkit|tests|bench|docs|plugins)/[\w./-]+", span)}
    return found | {span for span in spans(page) if span.startswith("examples/") and " " not in span}


@cache
def anchors(page: Path) -> frozenset[str]:
    """The anchors of a page's headings, as GitHub and the built site make them."""
    found = re.findall(r"^#+ (.*)$", FENCE.sub("\n", page.read_text(encoding="utf-8")), re.M)
    plain = (re.sub(r"[`*]", "", heading).strip().lower() for heading in found)
    return frozenset(re.sub(r"\s", "-", re.sub(r"[^\w\s-]", "", heading)) for heading in plain)
