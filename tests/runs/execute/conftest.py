"""The scene in two blocks, for the tests of this folder."""

from two_blocks import data, recipe, undisturbed

__all__ = ["data", "recipe", "undisturbed"]
