"""The check of what makes levels of detail.

It returns nothing and raises AssertionError with a sentence that says what is wrong.
"""

from __future__ import annotations

import tempfile
from dataclasses import replace
from pathlib import Path

from surfkit.compress.levels.base import LevelsOfDetail, LodInput
from surfkit.compress.levels.lod_tree import LodTree
from surfkit.compress.levels.validate_levels import fault
from surfkit.testing.equality import assert_same, unchanged
from surfkit.testing.inputs import lod_input


def check_levels_of_detail(lod: LevelsOfDetail, given: LodInput | None = None) -> None:
    """The first level is the full model, point for point, none has more points than the one before, the blocks are a
    tree that holds each point once, and the same model gives the same levels; nothing that was given changes.

    Args:
        lod: To check; settings for few points and steps are faster.
        given: What levels are made of; 400 surfels over a survey of nine views if None. Its folder is not used.

    Raises:
        BadInput: It cannot make levels of that model.
    """
    name, given = type(lod).__name__, given or lod_input()
    lod.refuse_unfit(given.model.primitive)
    with unchanged(f"{name}.build", params=given.model.params, views=tuple(given.views)):
        tree = _built(lod, given)
    assert isinstance(tree, LodTree), f"{name}.build gives a {type(tree).__name__}, not a LodTree"
    wrong = fault(tree, given.model)
    assert wrong is None, f"{name}.build: {wrong}"
    assert_same(f"{name}.build", tree, _built(lod, given), "draw from a generator made of the seed")


def _built(lod: LevelsOfDetail, given: LodInput) -> LodTree:
    with tempfile.TemporaryDirectory() as folder:
        return lod.build(replace(given, folder=Path(folder)))
