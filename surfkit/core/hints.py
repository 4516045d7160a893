"""The type hints of settings."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from types import MappingProxyType
from typing import Any, get_type_hints


@cache  # each text among the annotations is compiled to find them, and a recipe is read and written many times in a run
def hints_of(cls: type) -> Mapping[str, Any]:
    """The type hint of each field of a class, with the marks of `Annotated`."""
    return MappingProxyType(get_type_hints(cls, include_extras=True))
