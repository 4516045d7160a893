"""Components that lack a docstring, or change on their way through JSON, are named; `check` does all in one line."""

from dataclasses import dataclass

import pytest

from surfkit import Component, Edit, Prune, hookimpl
from surfkit.core.registry import plugins
from surfkit.testing import check, check_component


@dataclass(frozen=True)
class Sound(Prune):
    """Drops nothing, whenever it is asked."""

    def edit(self, points, step):
        return Edit(drop=step.splats.opacities < 0)


@dataclass(frozen=True)
class Odd(Sound):
    """Drops no points, but adds all again."""

    def edit(self, points, step):
        return Edit(clone=step.splats.opacities > 0)


@dataclass(frozen=True)
class Nameless(Prune):
    def edit(self, points, step):
        return None


@dataclass(frozen=True)
class Mute(Prune):
    """Says nothing of its setting."""

    share: float = 0.5

    def edit(self, points, step):
        return None


@dataclass(frozen=True)
class Forgets(Prune):
    """Rounds on construction, so that saving changes it."""

    share: float = 0.26
    """Share."""

    def __post_init__(self):
        object.__setattr__(self, "share", round(self.share / 2, 2))

    def edit(self, points, step):
        return None


class Kind(Component):
    """Of another package."""


@dataclass(frozen=True)
class Own(Kind):
    """A part of it."""


def test_components_that_do_not_conform():
    class Offer:
        @hookimpl
        def surfkit_components(self):
            return {"mute": Mute, "forgets": Forgets, "sound": Sound, "nameless": Nameless, "odd": Odd, "own": Own}

    name = plugins().register(Offer())
    try:
        check(Sound())
        with pytest.raises(AssertionError, match="Odd adds points .*Densify"):
            check(Odd())
        with pytest.raises(TypeError, match="no check of a Kind"):
            check(Own())
        with pytest.raises(AssertionError, match="Mute.share .*docstring"):
            check_component(Mute())
        with pytest.raises(AssertionError, match="Nameless needs a docstring"):
            check_component(Nameless())
        with pytest.raises(AssertionError, match="Forgets came back from JSON as"):
            check_component(Forgets())
    finally:
        plugins().unregister(name=name)
