"""What `--help` shows of settings: each docstring as one paragraph, and no "None" of Python."""

from __future__ import annotations

import inspect
import shutil
import textwrap
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from types import NoneType, UnionType
from typing import Annotated, Any, Union, get_args, get_origin

import tyro
from tyro.constructors import (
    ConstructorRegistry,
    PrimitiveConstructorSpec,
    PrimitiveTypeInfo,
    StructConstructorSpec,
    StructFieldSpec,
    StructTypeInfo,
    UnsupportedTypeAnnotationError,
)

from surfkit.cli.standard_streams import recorded

NONE_OF_TYRO = "None"
"""The word on a command line that tyro takes for no value."""
NONE_WORD = "none"
"""The word that surfkit takes and shows, as in `pretrain.densify:none`."""


def rules_of_help() -> ConstructorRegistry:
    """Rules for `tyro.cli`: texts fill the lines, and no value is written `none`.

    tyro keeps the line breaks of docstrings whose lines are indented, as those of settings are, and then fills the
    lines once more to the width of the terminal, which leaves them ragged.
    """
    registry = ConstructorRegistry()
    asking: list[Any] = []
    """What the rules of tyro are being asked: they ask all rules, these too."""

    @registry.struct_rule
    def one_paragraph_each(info: StructTypeInfo) -> StructConstructorSpec | None:
        if asking:
            return None
        asking.append(info)
        try:
            spec = ConstructorRegistry.get_struct_spec(info)
        finally:
            asking.pop()
        if not isinstance(spec, StructConstructorSpec):
            return spec  # type: ignore[return-value]  # as tyro's own rules do
        return replace(spec, fields=tuple(_shown(field) for field in spec.fields))

    @registry.primitive_rule
    def none_in_lower_case(info: PrimitiveTypeInfo) -> PrimitiveConstructorSpec | UnsupportedTypeAnnotationError | None:
        if asking or not is_optional(info.type):
            return None
        asking.append(info)
        try:
            spec = ConstructorRegistry.get_primitive_spec(info)
        finally:
            asking.pop()
        return _with_lower_case(spec) if isinstance(spec, PrimitiveConstructorSpec) else spec

    return registry


@contextmanager
def described(command: type) -> Iterator[None]:
    """Within, help that tyro prints has the docstring of a command after its first lines, those of the usage.

    tyro would print each paragraph of it as one line, which a terminal breaks within words.
    """
    with recorded() as text:
        try:
            yield
        finally:  # tyro ends with SystemExit
            usage, gap, settings = text.getvalue().partition("\n\n")
            about = f"\n\n{filled(inspect.getdoc(command) or '')}" if gap else ""
            text.screen.write(f"{usage}{about}{gap}{settings}")


def filled(text: str) -> str:
    """The paragraphs of a text, each filled to the width of the terminal."""
    width = max(40, shutil.get_terminal_size().columns)
    paragraphs = (" ".join(part.split()) for part in text.split("\n\n"))
    return "\n\n".join(textwrap.fill(part, width, break_on_hyphens=False) for part in paragraphs)


def is_optional(hint: Any) -> bool:
    """Whether a type is a union with None."""
    hint = get_args(hint)[0] if get_origin(hint) is Annotated else hint
    return get_origin(hint) in (Union, UnionType) and NoneType in get_args(hint)


def _with_lower_case(spec: PrimitiveConstructorSpec) -> PrimitiveConstructorSpec:
    """The same rule, which takes "none", also as Python writes it, and does not name it among the types."""
    choices = spec.choices and tuple(NONE_WORD if choice == NONE_OF_TYRO else choice for choice in spec.choices)
    types = spec.metavar.replace("{None}|", "").replace("{None,", "{")
    if types.startswith("{[") and types.endswith("]}"):  # of any number of values
        types = types[1:-1]

    def made(words: list[str]) -> Any:
        return spec.instance_from_str([NONE_OF_TYRO if word == NONE_WORD else word for word in words])

    def written(value: Any) -> list[str]:
        return [NONE_WORD if word == NONE_OF_TYRO else word for word in spec.str_from_instance(value)]

    return replace(spec, choices=choices, metavar=types, instance_from_str=made, str_from_instance=written)


def _shown(field: StructFieldSpec) -> StructFieldSpec:
    text = field.helptext
    if text is not None:
        field = replace(field, helptext=lambda: _joined(text))
    if is_optional(field.type):
        hint: Any = Annotated[field.type, tyro.conf.arg(help_behavior_hint=_default)]
        field = replace(field, type=hint)
    return field


def _default(label: str) -> str:
    """What follows the text of a setting that may have no value."""
    return "" if label in (NONE_WORD, NONE_OF_TYRO) else f"(default: {label}; none for no value)"


def _joined(text: str | Callable[[], str | None]) -> str | None:
    found = text() if callable(text) else text
    return None if found is None else " ".join(found.split())
