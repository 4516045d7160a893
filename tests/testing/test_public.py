"""What a part needs is in `surfkit.plugin`."""

import inspect
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import is_dataclass
from typing import Any, get_args, get_type_hints

import surfkit
from surfkit import plugin
from surfkit.core.registry import Component, kind_of, offered

KINDS = {kind_of(cls) for _, _, cls in offered("surfkit_components")}


def classes(hint: Any) -> Iterator[type]:
    """Our own classes in a type hint."""
    if isinstance(hint, (list, tuple)):
        for one in hint:
            yield from classes(one)
    elif isinstance(hint, type) and not get_args(hint):
        if hint.__module__.startswith("surfkit."):
            yield hint
    else:
        yield from classes(get_args(hint))


def mentioned(cls: type) -> set[type]:
    """Our own classes in the fields of a value, or in the hints of the fields and methods of what has behaviour."""
    hints = list(get_type_hints(cls).values()) if is_dataclass(cls) or issubclass(cls, Component) else []
    if is_dataclass(cls) and not issubclass(cls, Component):
        return {found for hint in hints for found in classes(hint)}
    for name, member in vars(cls).items():
        function = member.fget if isinstance(member, property) else getattr(member, "__func__", member)
        if inspect.isfunction(function) and (not name.startswith("_") or name == "__call__"):
            hints += get_type_hints(function).values()
    return {found for hint in hints for found in classes(hint)}


def needed() -> set[type]:
    """Kinds, what their methods take and give, and what is in that."""
    found = {base for kind in KINDS for base in kind.__mro__ if issubclass(base, Component)}
    new = found
    while new:
        new = {inner for cls in new for inner in mentioned(cls)} - found
        found = found | new
    return found


def test_every_kind_and_every_value_of_its_contract_is_public():
    lacking = {cls.__name__: cls.__module__ for cls in needed() if cls.__name__ not in plugin.__all__}
    assert not lacking, "add these to surfkit/plugin.py"
    for cls in needed():
        assert getattr(plugin, cls.__name__) is cls is getattr(surfkit, cls.__name__)


def test_the_hints_are_followed():
    """Two steps: a mesher is given a MeshInput, which has a Frame; a loss a Target with the maps of its Neighbour."""
    assert {plugin.Mesher, plugin.MeshInput, plugin.Frame, plugin.Neighbour, plugin.Contribution} <= needed()


def test_surfkit_loads_no_torch():
    code = "import sys, surfkit; raise SystemExit('torch' in sys.modules or 'numpy' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code]).returncode == 0
