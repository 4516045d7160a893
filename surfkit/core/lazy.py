"""Fields of dataclasses that are computed when they are first read."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Generic, TypeVar

Value = TypeVar("Value")


class Lazy(Generic[Value]):
    """A field that takes a value, or a function without arguments that is called for it at most once.

    As the default of a field of a dataclass: `splats: Lazy[Splats] = Lazy()`. Without another default, the field must
    be given.
    """

    def __init__(self, *default: Value) -> None:
        self.default = default

    def __set_name__(self, owner: type, name: str) -> None:
        self.name = name

    def __get__(self, instance: Any, owner: type) -> Value:
        if instance is None:  # a dataclass asks so for the default
            if not self.default:
                raise AttributeError(self.name)
            return self.default[0]
        held = instance.__dict__
        if callable(held[self.name]):
            held[self.name] = held[self.name]()
        return held[self.name]

    def __set__(self, instance: Any, value: Value | Callable[[], Value]) -> None:
        instance.__dict__[self.name] = value
