"""What is wrong with an input, said so that its sender can put it right."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Any

CONTROLS = re.compile("[\x00-\x1f\x7f-\x9f\u200e\u200f\u2028-\u202e\u2066-\u2069]")
"""Characters that are not shown but obeyed: of C0 and C1, ends of lines and paragraphs, directions of writing."""
BETWEEN_LINES = re.compile(f"(?![\n\t]){CONTROLS.pattern}")


class BadInput(ValueError):
    """Input that its sender can put right. The command line prints it as one line and exits 2.

    The message says where, what came, what is allowed and what to do.
    """


class Fault(RuntimeError):
    """A sound run that cannot go on: memory, disk or numbers gave out. The command line prints one line and exits 1.

    The message says where, what happened, what is still there and what to do.
    """

    status = 1
    """Exit status of the command line."""
    kind = "fault"
    """What gave out, in a word."""


_COLLECTED_ERRORS: ContextVar[list[BadInput] | None] = ContextVar("kept", default=None)


@contextmanager
def collecting() -> Iterator[list[BadInput]]:
    """Within, in this thread, what is rejected is only kept, in the list, and the reader goes on to find more."""
    kept: list[BadInput] = []
    token = _COLLECTED_ERRORS.set(kept)
    try:
        yield kept
    finally:
        _COLLECTED_ERRORS.reset(token)


def reject(error: BadInput) -> None:
    """Raise an error that a reader could go on after; where faults are being collected, keep it and go on."""
    kept = _COLLECTED_ERRORS.get()
    if kept is None:
        raise error
    kept.append(error)


@contextmanager
def leaving_out() -> Iterator[None]:
    """BadInput within concerns one item of many: it is rejected, and what follows within is left out."""
    try:
        yield
    except BadInput as error:
        reject(error)


def require_within(ranges: Mapping[str, tuple[float, float]], settings: object) -> None:
    """BadInput for the first setting outside the range from its least to its greatest value, or no number at all.

    Args:
        ranges: By the name of the field.
        settings: What has these fields.
    """
    for name, (least, most) in ranges.items():
        value = getattr(settings, name)
        if not least <= value <= most:
            shown = f"{value:g}" if isinstance(value, float) else value  # as a float, a whole number may be too large
            raise BadInput(f"{name} is {shown}; it must lie between {least:g} and {most:g}")


def few(names: Sequence[str], most: int = 3) -> str:
    """The first of some names, and how many there are beyond them: `'a', 'b', 'c' and 39 more`."""
    shown = ", ".join(repr(name) for name in names[:most])
    return f"{shown} and {len(names) - most} more" if len(names) > most else shown


def printable(text: str, lines: bool = False) -> str:
    """A text as it may go to a terminal or a page: control characters in it are written out, a newline as ``\\n``.

    All that is printed goes through this, as names of photographs and folders may hold anything: a line of their own,
    or what tells a terminal to change its colours, its title or the direction of writing.

    Args:
        text: To be printed.
        lines: Whether newlines and tabs are the writer's own, and stay.
    """
    return (BETWEEN_LINES if lines else CONTROLS).sub(lambda found: found[0].encode("unicode_escape").decode(), text)


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


def expect_tensor(
    name: str, value: Any, kinds: Sequence[str], shape: tuple[int | str, ...], sizes: dict[str, int] | None = None
) -> dict[str, int]:
    """As `expect`, of a tensor of torch that has one of some types.

    Args:
        name: What the message calls it.
        value: Anything.
        kinds: Names of the types, such as "float32".
        shape: See `expect`.
        sizes: See `expect`.
    """
    library, _, kind = str(getattr(value, "dtype", "")).partition(".")
    if library != "torch" or kind not in kinds:
        came = f"a tensor of {kind}" if library == "torch" else type(value).__name__
        raise BadInput(f"{name}: expected a tensor of {' or '.join(kinds)} of shape {_written(shape)}, got {came}")
    return expect(name, value, shape, sizes)


def expect_kind(name: str, value: Any, kind: type) -> None:
    """BadInput unless a value is of a class."""
    if not isinstance(value, kind):
        raise BadInput(f"{name}: expected {kind.__name__}, got {type(value).__name__}")


@contextmanager
def read_only(name: str, tensors: Mapping[str, Any], error: type[Exception] = BadInput) -> Iterator[None]:
    """Within, something is given tensors that it shall not change: an error if it does.

    torch counts changes in place, so nothing is copied or compared, and no GPU is waited for. What goes around torch,
    through `.data` or an array of numpy, is not found.

    Args:
        name: Of what is given them.
        tensors: By the names that messages call them.
        error: `Fault` where somebody would go on after BadInput, with what has been changed.
    """

    def counts() -> dict[str, int]:
        return {key: value._version for key, value in tensors.items() if not value.is_inference()}

    before = counts()
    yield
    if changed := [key for key, count in counts().items() if count != before[key]]:
        raise error(f"{name} changes {changed[0]} in place, which others read too; change a copy, as of clone()")


def _written(shape: tuple[int | str, ...]) -> str:
    return f"({', '.join(map(str, shape))}{',' * (len(shape) == 1)})"
