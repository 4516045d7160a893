"""The docstrings of settings as `--help` shows them: each as one paragraph."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from tyro.constructors import ConstructorRegistry, StructConstructorSpec, StructFieldSpec, StructTypeInfo


def one_paragraph_each() -> ConstructorRegistry:
    """Rules for `tyro.cli` that change nothing but the help.

    tyro keeps the line breaks of docstrings whose lines are indented, as those of settings are, and then fills the
    lines once more to the width of the terminal, which leaves them ragged.
    """
    registry, asking = ConstructorRegistry(), []

    @registry.struct_rule
    def as_by_default(info: StructTypeInfo) -> StructConstructorSpec | None:
        if asking:
            return None  # so that the rules of tyro are asked
        asking.append(info)
        try:
            spec = ConstructorRegistry.get_struct_spec(info)
        finally:
            asking.pop()
        if not isinstance(spec, StructConstructorSpec):
            return spec
        return replace(spec, fields=tuple(_filled(field) for field in spec.fields))

    return registry


def _filled(field: StructFieldSpec) -> StructFieldSpec:
    text = field.helptext
    return field if text is None else replace(field, helptext=lambda: _joined(text))


def _joined(text: str | Callable[[], str | None]) -> str | None:
    found = text() if callable(text) else text
    return None if found is None else " ".join(found.split())
