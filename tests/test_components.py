"""Every component and recipe that is offered, built in or installed, is tested from the day it arrives."""

import json
from pathlib import Path

import pytest

import surfkit
from surfkit import plugin
from surfkit.cli import main
from surfkit.cli.recipes import about, recipes
from surfkit.core import registry
from surfkit.core.codec import dump, load
from surfkit.core.registry import kind_of, offered
from surfkit.core.schedule import rescale
from surfkit.runs.recipe import Recipe
from surfkit.testing import check_component

OFFERED = sorted({(kind_of(cls).__name__, name): cls for _, name, cls in offered("surfkit_components")}.items())


@pytest.mark.parametrize("cls", [cls for _, cls in OFFERED], ids=[f"{kind}-{name}" for (kind, name), _ in OFFERED])
def test_components(cls):
    check_component(cls())


@pytest.mark.parametrize("name", recipes())
def test_recipes(name):
    recipe = recipes()[name]
    assert about(recipe), "say what the recipe is in `about`"
    assert load(Recipe, json.loads(json.dumps(dump(recipe), allow_nan=False))) == recipe
    for factor in (1 / 15, 1 / 1_000, 2):
        assert rescale(recipe, factor) != recipe


def test_public_names():
    for name in surfkit.__all__:
        assert getattr(surfkit, name) is not None
    assert len(plugin.__all__) > 100 and len(set(plugin.__all__)) == len(plugin.__all__)
    assert all(hasattr(plugin, name) for name in plugin.__all__)
    with pytest.raises(AttributeError, match="no attribute 'Prunes'"):
        surfkit.Prunes  # noqa: B018


def test_the_page_of_components_is_current(monkeypatch, capsys):
    monkeypatch.setenv("SURFKIT_PLUGINS", "none")
    registry.reload()
    try:
        assert main(["components", "--markdown"]) == 0
    finally:
        monkeypatch.undo()
        registry.reload()
    page = Path(__file__).parents[1] / "docs" / "components.md"
    # Written by `SURFKIT_PLUGINS=none surfkit components --markdown > docs/components.md`.
    assert capsys.readouterr().out == page.read_text()
