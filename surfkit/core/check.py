"""What is wrong with an input, said so that its sender can put it right."""

from __future__ import annotations

from typing import Any


class BadInput(ValueError):
    """Input that its sender can put right. The command line prints it as one line and exits 2.

    The message says where, what came, what is allowed and what to do.
    """


class Fault(RuntimeError):
    """A sound run that cannot go on: memory, disk or numbers gave out. The command line prints one line and exits 1.

    The message says where, what happened, what is still there and what to do.
    """


def expect(name: str, array: Any, shape: tuple[int | str, ...], sizes: dict[str, int] | None = None) -> dict[str, int]:
    """The size behind each letter of `shape`, or BadInput if the array has another shape.

    Args:
        name: What the message calls the array.
        array: Anything with a `.shape`.
        shape: Sizes; the same letter stands for the same size everywhere, as in `("N", 3)`.
        sizes: Letters already bound by another array: the answer of an earlier call.
    """
    bound = dict(sizes or {})
    got = getattr(array, "shape", None)
    if got is None:
        raise BadInput(f"{name}: expected shape {_written(shape)}, got {type(array).__name__}, which has no shape")
    got = tuple(got)
    fits = len(got) == len(shape)
    for wanted, size in zip(shape, got, strict=False):
        if isinstance(wanted, str):
            wanted = bound.setdefault(wanted, int(size))
        fits &= wanted == size
    if fits:
        return bound
    known = ", ".join(f"{letter} = {size}" for letter, size in (sizes or {}).items() if letter in shape)
    raise BadInput(f"{name}: expected shape {_written(shape)}{known and f' with {known}'}, got {_written(got)}")


def _written(shape: tuple[int | str, ...]) -> str:
    return f"({', '.join(map(str, shape))}{',' * (len(shape) == 1)})"
