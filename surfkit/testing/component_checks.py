"""What every component must keep to, whatever its kind, and the check of its kind."""

from __future__ import annotations

import json
from typing import Any

from surfkit.core.codec import dump, load
from surfkit.core.describe import settings, summary
from surfkit.core.registry import Component, kebab, kind_of


def check(part: Component, *given: Any, **more: Any) -> None:
    """A component passes `check_component` and the check of its kind.

    Args:
        part: To check.
        given, more: What the check of its kind takes beside the part.
    """
    import surfkit.testing

    check_component(part)
    kind = kind_of(type(part)).__name__
    name = f"check_{kebab(kind).replace('-', '_')}"
    if name not in surfkit.testing.__all__:
        raise TypeError(f"surfkit.testing has no check of a {kind}")
    getattr(surfkit.testing, name)(part, *given, **more)


def check_component(part: Component) -> None:
    """A component survives the way to JSON and back, and tells what it and each of its settings is for."""
    cls = type(part)
    assert summary(cls), f"{cls.__name__} needs a docstring: it is the line that `surfkit components` shows"
    for setting in settings(cls):
        assert setting.help, (
            f"{cls.__name__}.{setting.name} needs a docstring under it: it is the help text of the flag"
        )
    text = json.dumps(dump(part), allow_nan=False)
    again = load(kind_of(cls), json.loads(text))
    assert again == part, f"{cls.__name__} came back from JSON as {again!r} instead of {part!r}"
