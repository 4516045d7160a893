"""Names of others as text on the page, read by another parser of CommonMark."""

import re
from types import SimpleNamespace

import pytest
from markdown_it import MarkdownIt

from surfkit.apps.view import photo_comparison as photographs
from surfkit.apps.view.escape_text import as_code, as_text
from surfkit.core.check import BadInput

NAMES = [
    "<b>bold</b>.jpg",
    "**bold** _and_ ~~gone~~.jpg",
    "![a picture](b.png)",
    "[a link](b.html) and <http://a.example/b>",
    "www.example.com and http://a.example/b.jpg, a@b.example",
    "- no list",
    "+ no list",
    "12. no list",
    "=== no title",
    "# no title",
    "> no quotation",
    "a `code` b",
    "two\nlines, a\ttab and \x1b[1m",
    "back\\slash &amp; |table|",
    "plain_name-01.jpg",
]


def shown(markdown):
    """The text that a reader sees, and the kinds of everything else in it."""
    pieces, kinds = "", set()
    for block in MarkdownIt("commonmark").enable(["table", "strikethrough"]).parse(markdown):
        kinds.add(block.type)
        for piece in block.children or ():
            kinds.add(piece.type)
            pieces += piece.content
    return pieces, kinds - {"paragraph_open", "paragraph_close", "inline", "text", "text_special"}


@pytest.mark.parametrize("name", NAMES)
def test_a_name_is_shown_as_it_is(name):
    text, kinds = shown(as_text(name))
    assert not kinds
    assert text.replace("\u2060", "") == name.replace("\n", "\\n").replace("\t", "\\t").replace("\x1b", "\\x1b")
    assert not re.search(r"(?i)https?://|www\.|\w@\w", text), "GitHub's Markdown makes links of these"


@pytest.mark.parametrize("name", NAMES)
def test_code_is_shown_as_it_is(name):
    text, kinds = shown(as_code(name))
    assert kinds == {"code_inline"}
    assert text == name.replace("\n", "\\n").replace("\t", "\\t").replace("\x1b", "\\x1b")


def test_the_panel_of_photographs_shows_names_and_errors_as_text(monkeypatch):
    def refused(*_args):
        raise BadInput("<i>x</i>.jpg: damaged")

    monkeypatch.setattr(photographs, "picture", refused)
    panel = photographs.PhotoComparisonTool.__new__(photographs.PhotoComparisonTool)
    panel.shelf = SimpleNamespace(subject=SimpleNamespace(scene=SimpleNamespace(train=[1]), draw=None, frame=None))
    panel.client = SimpleNamespace(scene=SimpleNamespace(remove_by_name=lambda _: None))
    panel.chosen, panel.views = 0, [SimpleNamespace(name="<b>bold</b>.jpg")]
    panel.kind, panel.told, panel.panel = SimpleNamespace(value="photograph"), SimpleNamespace(), SimpleNamespace()
    with pytest.raises(BadInput):
        panel.show()
    text, kinds = shown(panel.told.content)
    assert kinds == {"strong_open", "strong_close"}  # around the name
    assert text == "<b>bold</b>.jpg: <i>x</i>.jpg: damaged"
