"""What a component says of itself: the text of its settings, read from the docstrings under the fields."""

from __future__ import annotations

import ast
import inspect
import textwrap
import types
from dataclasses import MISSING, dataclass, fields, is_dataclass
from typing import Annotated, Any, Literal, Union, get_args, get_origin

from surfkit.core.hints import hints_of
from surfkit.core.registry import Component, components, kebab, kind_of, name_of, offered

Kinds = dict[str, dict[str, type[Component]]]
"""Components by kind and name."""


@dataclass(frozen=True)
class Setting:
    """One setting of a component, in words.

    Attributes:
        name: Of the field.
        type: As a person would write it.
        default: Likewise; "required" if there is none.
        help: The docstring under the field in one line; "" if there is none.
    """

    name: str
    type: str
    default: str
    help: str


def summary(cls: type) -> str:
    """The first paragraph of a class's own docstring, in one line; "" if it has none."""
    text = vars(cls).get("__doc__") or ""
    if text.startswith(f"{cls.__name__}("):  # what `dataclass` makes up
        return ""
    return " ".join(inspect.cleandoc(text).split("\n\n")[0].split())


def settings(cls: type) -> list[Setting]:
    """The settings of a dataclass, in the order of its fields."""
    hints = hints_of(cls)
    texts: dict[str, str] = {}
    for base in reversed(cls.__mro__):
        texts |= _field_docs(base)
    return [
        Setting(field.name, _type(hints[field.name]), _default(field), texts.get(field.name, ""))
        for field in fields(cls)
        if field.init
    ]


def _field_docs(cls: type) -> dict[str, str]:
    """Docstrings under the annotated names of one class body, each in one line."""
    if not is_dataclass(cls):
        return {}
    try:
        body = ast.parse(textwrap.dedent(inspect.getsource(cls))).body[0]
    except (OSError, TypeError, SyntaxError):  # a class without source, as in a frozen program
        return {}
    found = {}
    if not isinstance(body, ast.ClassDef):
        return {}
    for field, text in zip(body.body, body.body[1:], strict=False):
        if not (isinstance(field, ast.AnnAssign) and isinstance(field.target, ast.Name)):
            continue
        if isinstance(text, ast.Expr) and isinstance(text.value, ast.Constant):
            found[field.target.id] = " ".join(str(text.value.value).split())
    return found


def _type(hint: Any) -> str:
    kind, args = get_origin(hint), get_args(hint)
    if kind is Annotated:
        return _type(args[0])
    if kind in (Union, types.UnionType):
        return " or ".join(_type(arg) for arg in args)
    if kind is Literal:
        return " or ".join(map(repr, args))
    if kind is tuple:
        return f"list of {_type(args[0])}" if args[1:] == (...,) else f"({', '.join(map(_type, args))})"
    if kind is dict:
        return f"named {_type(args[1])}"
    if hint is type(None):
        return "none"
    return getattr(hint, "__name__", str(hint))


def _default(field: Any) -> str:
    if field.default is not MISSING:
        return _shown(field.default)
    return "required" if field.default_factory is MISSING else _shown(field.default_factory())


def _shown(value: Any) -> str:
    if isinstance(value, Component):
        return name_of(value)
    if isinstance(value, tuple):
        return f"({', '.join(map(_shown, value))})"
    if isinstance(value, dict):
        return ", ".join(f"{key}: {_shown(item)}" for key, item in value.items()) or "none"
    return "none" if value is None else str(value)


def by_kind() -> Kinds:
    """Every offered component, by kind and name."""
    bases = {kind_of(cls) for _, _, cls in offered("surfkit_components")}
    return {kebab(base.__name__): _of_kind(base) for base in sorted(bases, key=lambda base: base.__name__)}


def _of_kind(base: type[Component]) -> dict[str, type[Component]]:
    return {name: cls for name, cls in components(base).items() if kind_of(cls) is base}
