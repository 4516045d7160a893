"""Components, and the plugins that offer them under names a user can type.

What is registered is what plugins return from their hooks: no decorators on classes, no import side effects. The
built-in folders enter by the same door as installed packages (entry points of the group "surfkit").
"""

from __future__ import annotations

import difflib
import importlib
import importlib.metadata
import inspect
import os
import re
from abc import ABC
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import MISSING, dataclass, fields, is_dataclass
from functools import cache
from typing import Annotated, Any, TypeVar, Union

import pluggy
import tyro

from surfkit.core.check import BadInput
from surfkit.core.hints import hints_of
from surfkit.core.hooks import HOOKS, Hooks, LazyCommand, hookimpl
from surfkit.core.memory import is_out_of_memory
from surfkit.core.version import own_version

_FOLDERS = """
io.splats io.datasets raster apps.sfm primitives losses depth start appearance densify mesh partition compress
runs.execute train train.refine compress.levels runs.methods study.recipes apps
"""
BUILTIN = tuple(f"surfkit.{name}" for name in _FOLDERS.split())


class Component(ABC):  # noqa: B024 (the methods are those of each kind)
    """A swappable part of a recipe: a frozen dataclass of plain settings, never tensors."""


C = TypeVar("C", bound=Component)


PLAIN = (bool, int, float, str, tuple, list, dict)
"""What settings are, beside parts."""
HOOK_VALUES = {
    "surfkit_recipes": "a surfkit.Recipe",
    "surfkit_tables": "a surfkit.Table",
    "surfkit_rows": "a tuple of surfkit.Row",
}
"""What the values of offering hooks are, beside parts."""


@dataclass(frozen=True)
class Plugin:
    """Where a plugin comes from and whether it is in use.

    Attributes:
        name: Of the entry point; the module for built-in plugins.
        distribution: The installed package.
        version: Of the distribution.
        hooks: Names of the hooks it implements.
        error: Why it is not in use, in one line; None if it is.
    """

    name: str
    distribution: str
    version: str
    hooks: tuple[str, ...] = ()
    error: str | None = None

    def __str__(self) -> str:
        return f"{self.name} ({self.distribution} {self.version})" if self.distribution else self.name


@cache
def _loaded() -> tuple[pluggy.PluginManager, dict[str, Plugin]]:
    """The manager, and what is known of each plugin, in use or failed."""
    manager = pluggy.PluginManager("surfkit")
    manager.add_hookspecs(Hooks)
    records: dict[str, Plugin] = {}
    for name in BUILTIN:
        _register(manager, importlib.import_module(name), name)
        records[name] = Plugin(name, "surfkit", own_version())
    for point in _installed():
        records[_unused(point.name, records)] = _load(manager, point)
    return manager, records


def plugins() -> pluggy.PluginManager:
    """Built-in and installed plugins, loaded once, on first use."""
    return _loaded()[0]


def records() -> tuple[Plugin, ...]:
    """What is known of every plugin: those in use, in the order of loading, then those that failed."""
    manager, known = _loaded()
    used = [
        Plugin(name, origin.distribution, origin.version, tuple(sorted(hook.name for hook in hooks)))
        for name, plugin in manager.list_name_plugin()
        for origin, hooks in [(known.get(name, Plugin(name, "", "")), manager.get_hookcallers(plugin) or ())]
    ]
    return (*used, *failures())


def failures() -> tuple[Plugin, ...]:
    """The installed plugins that could not be used, with the reason."""
    return tuple(plugin for plugin in _loaded()[1].values() if plugin.error)


def reload() -> None:
    """Forget every plugin; the next use loads them again. For tests."""
    _loaded.cache_clear()


class _OwnParts:
    """The parts of a script or a notebook."""

    def __init__(self) -> None:
        self.parts: dict[str, type[Component]] = {}

    @hookimpl
    def surfkit_components(self) -> Mapping[str, type[Component]]:
        """What `offer` was given."""
        return self.parts


OWN_PARTS = "this script"
"""The name of the plugin that has the parts of a script."""


def offer(name: str, cls: type[Component]) -> None:
    """Offer a part of a script or a notebook in this process, as a plugin offers its own; given again, it replaces the
    one before.

    Args:
        name: For recipes, such as "my-loss".
        cls: A frozen dataclass that extends the base class of its kind.

    Raises:
        BadInput: It is no such class, or another package offers one of its kind under this name.
    """
    _check_offer("surfkit_components", name, cls)
    for owner, known, other in offered("surfkit_components"):
        if known == name and owner != OWN_PARTS and issubclass(other, kind_of(cls)):
            raise BadInput(f"offer: {class_path(other)} ({owner}) is named {name!r} already; choose another name")
    own = plugins().get_plugin(OWN_PARTS)
    if own is None:
        own = _OwnParts()
        plugins().register(own, OWN_PARTS)
    own.parts[name] = cls


def components(base: type[C]) -> dict[str, type[C]]:
    """Every offered subclass of `base`, by name."""
    found: dict[str, tuple[str, type[C]]] = {}
    for owner, name, cls in offered("surfkit_components"):
        if not issubclass(cls, base):
            continue
        if name in found:
            other, first = found[name]
            two = f"{class_path(first)} ({other}) and {class_path(cls)} ({owner})"
            raise BadInput(
                f"two packages offer a {base.__name__} named {name!r}: {two}; uninstall one, or leave it out with "
                "SURFKIT_PLUGINS=none or SURFKIT_PLUGINS=NAME,NAME"
            )
        found[name] = (owner, cls)
    return {name: cls for name, (_, cls) in sorted(found.items())}


def offered(hook: str) -> Iterator[tuple[str, str, Any]]:
    """Plugin, name and value of everything that plugins return from one of the offering hooks."""
    manager, known = _loaded()
    for impl in list(getattr(manager.hook, hook).get_hookimpls()):
        try:
            offer = dict(impl.function())
            for name, value in offer.items():
                _check_offer(hook, name, value)
        except Exception as error:
            if impl.plugin_name in BUILTIN or is_out_of_memory(error):
                raise
            origin = known.get(impl.plugin_name, Plugin(impl.plugin_name, "", ""))
            known[impl.plugin_name] = Plugin(
                origin.name, origin.distribution, origin.version, error=f"{hook}: {_one_line(error)}"
            )
            manager.unregister(name=impl.plugin_name)
            continue
        yield from ((impl.plugin_name, name, value) for name, value in offer.items())


def offered_once(hook: str, what: str) -> dict[str, Any]:
    """Everything that plugins return from an offering hook, by name.

    Args:
        hook: Its name.
        what: Its values in words, such as "a recipe".

    Raises:
        BadInput: Two packages offer one under the same name.
    """
    found: dict[str, tuple[str, Any]] = {}
    for owner, name, value in offered(hook):
        if name in found:
            first = f"surfkit ({found[name][0]})" if found[name][0] in BUILTIN else found[name][0]
            raise BadInput(
                f"two packages offer {what} named {name!r}: {first} and {owner}; uninstall one, or leave it "
                "out with SURFKIT_PLUGINS=none or SURFKIT_PLUGINS=NAME,NAME"
            )
        found[name] = (owner, value)
    return {name: value for name, (_, value) in found.items()}


def find(base: type[C], name: str) -> type[C]:
    """The offered subclass of `base` with this name."""
    known = components(base)
    if name in known:
        return known[name]
    raise BadInput(f"{unknown(base.__name__, name, known)}; or install the plugin that offers it")


def unknown(kind: str, name: str, known: Iterable[str]) -> str:
    """The message for a name that nobody offers: the nearest known name, all of them, and the plugins that failed."""
    known = list(known)
    near = difflib.get_close_matches(name, known, n=1)
    hint = f"did you mean {near[0]!r}? " if near else ""
    lost = "".join(f"; plugin {plugin} is not in use: {plugin.error}" for plugin in failures())
    return f"no {kind} named {name!r}; {hint}known: {', '.join(known) or 'none'}{lost}"


def name_of(part: Component) -> str:
    """The name under which a component's class is offered."""
    for _, name, cls in offered("surfkit_components"):
        if type(part) is cls:
            return name
    raise BadInput(
        f"no plugin in use offers {class_path(type(part))}; return it from a surfkit_components hook, or in a script "
        f"call surfkit.offer(NAME, {type(part).__name__}); make the part anew if the class was defined again"
    )


def kind_of(cls: type[Component]) -> type[Component]:
    """The nearest abstract base, which says what kind of component a class is."""
    bases = [base for base in cls.__mro__[1:] if issubclass(base, Component)]
    return next((base for base in bases if inspect.isabstract(base)), bases[0])


def kebab(name: str) -> str:
    """A class name as users type it: `LossGradient` is loss-gradient."""
    return re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "-", name).lower()


def choice(base: type[Component], optional: bool = False, without: Sequence[str] = ()) -> Any:
    """Let `FIELD:NAME` on the command line pick any offered subclass of `base`, and `FIELD:none` if `optional`.

    For an annotation: `Annotated[Prune, choice(Prune)]`. The union is made when the command line is, so plugins
    that are loaded later still appear. A component that wraps another of its own kind names itself in `without`: the
    choices on the command line would otherwise have no end.
    """

    def union() -> Any:
        known = {name: cls for name, cls in components(base).items() if name not in without}
        named = [Annotated[cls, tyro.conf.subcommand(name)] for name, cls in derived_first(known)]
        members = tuple(named + [None] * optional)
        return Union[members] if members else Annotated[base, tyro.conf.Fixed]  # noqa: UP007 (made at run time)

    return tyro.conf.arg(constructor_factory=union)


def derived_first(known: Mapping[str, type]) -> list[tuple[str, type]]:
    """Names and classes in their order, but no class before one that is derived from it.

    tyro takes a default for the first class that it is an instance of: by the name of a base class, it would stay.
    """
    found: list[tuple[str, type]] = []
    for name, cls in known.items():
        before = next((at for at, (_, other) in enumerate(found) if issubclass(cls, other)), len(found))
        found.insert(before, (name, cls))
    return found


def _installed() -> list[importlib.metadata.EntryPoint]:
    """Installed entry points, narrowed by SURFKIT_PLUGINS."""
    points = sorted(importlib.metadata.entry_points(group="surfkit"), key=lambda point: point.name)
    wanted = os.environ.get("SURFKIT_PLUGINS", "").strip()
    if not wanted:
        return points
    if wanted == "none":
        return []
    names = [name.strip() for name in wanted.split(",") if name.strip()]
    known = [point.name for point in points]
    for name in names:
        if name not in known:
            raise BadInput(
                f"SURFKIT_PLUGINS: no plugin named {name!r} is installed; installed: {', '.join(known) or 'none'}"
            )
    return [point for point in points if point.name in names]


def _load(manager: pluggy.PluginManager, point: importlib.metadata.EntryPoint) -> Plugin:
    """Register an installed plugin; a failure of its own is written down instead of raised."""
    origin = Plugin(point.name, point.dist.name if point.dist else "", point.dist.version if point.dist else "")
    try:
        _register(manager, point.load(), point.name)
    except (Exception, SystemExit) as error:
        if is_out_of_memory(error):
            raise
        return Plugin(origin.name, origin.distribution, origin.version, error=_one_line(error))
    return origin


def _register(manager: pluggy.PluginManager, plugin: Any, name: str) -> None:
    """Register a plugin whose hooks are all known; pluggy itself would accept a misspelt hook and never call it."""
    if manager.has_plugin(name) or manager.is_registered(plugin):
        raise BadInput("another entry point has this name or this module; uninstall one of the two packages")
    hooks = _hooks_of(manager, plugin)
    for hook, options in hooks.items():
        if hook not in HOOKS:
            near = difflib.get_close_matches(hook, HOOKS, n=1)
            raise BadInput(
                f"unknown hook {hook!r}; " + (f"did you mean {near[0]!r}?" if near else f"hooks: {', '.join(HOOKS)}")
            )
        if options.get("wrapper") or options.get("hookwrapper"):
            raise BadInput(f"{hook} is a wrapper; surfkit calls plain hooks only")
    for hook in HOOKS:
        if callable(getattr(plugin, hook, None)) and hook not in hooks:
            raise BadInput(f"{hook} is not marked; put @surfkit.hookimpl above it")
    manager.register(plugin, name)


def _hooks_of(manager: pluggy.PluginManager, plugin: Any) -> dict[str, Mapping[str, Any]]:
    """Options of each function of a plugin that is marked as a hook, by the hook's name."""
    marked = {name: manager.parse_hookimpl_opts(plugin, name) for name in dir(plugin)}
    return {options.get("specname") or name: options for name, options in marked.items() if options is not None}


def _check_offer(hook: str, name: str, value: Any) -> None:
    """Refuse what could not be named, saved or shared."""
    if not re.fullmatch(r"[a-z0-9]+(-[a-z0-9]+)*", name):
        raise BadInput(f"{name!r} is not a name in kebab-case (lower-case letters, digits, single hyphens)")
    if hook in HOOK_VALUES:
        items = list(value) if hook == "surfkit_rows" and isinstance(value, (tuple, list)) else [value]
        wrong = [item for item in items if not is_dataclass(item) or isinstance(item, type)]
        if wrong or (hook == "surfkit_rows" and items == [value]):
            raise BadInput(f"{name!r} is {repr(value)[:80]}, and not {HOOK_VALUES[hook]}")
    if hook == "surfkit_commands" and not isinstance(value, LazyCommand):
        if not (isinstance(value, type) and is_dataclass(value) and callable(getattr(value, "run", None))):
            raise BadInput(
                f"{name!r} is {repr(value)[:80]}, and neither a dataclass with a method run() nor a surfkit.LazyCommand"
            )
        if not (value.__doc__ or "").strip() or (value.__doc__ or "").startswith(f"{value.__name__}("):
            raise BadInput(f"{class_path(value)} has no docstring; its first line is what `surfkit --help` shows")
    if hook != "surfkit_components":
        return
    if not (isinstance(value, type) and issubclass(value, Component)):
        raise BadInput(f"{name!r} is {value!r}, which is not a subclass of surfkit.Component")
    _check_class(name, value)


@cache  # all offers are checked again at each look-up, thousands of times in a table of runs
def _check_class(name: str, cls: type[Component]) -> None:
    if "__dataclass_params__" not in vars(cls) or not vars(cls)["__dataclass_params__"].frozen:
        raise BadInput(f"{class_path(cls)} must be a frozen dataclass to be offered as {name!r}")
    settings = fields(cls)  # type: ignore[arg-type]  # a dataclass, as was just looked at
    if any(field.name == "use" for field in settings):
        raise BadInput(
            f"{class_path(cls)} has a setting named 'use', which saved recipes keep for the component's name"
        )
    typed = {name for base in cls.__mro__ for name in vars(base).get("__annotations__", {})}
    for attribute, value in vars(cls).items():
        if not attribute.startswith("_") and isinstance(value, PLAIN) and attribute not in typed:
            raise BadInput(
                f"{class_path(cls)}: {attribute} = {value!r} has no type, so it is no setting and is not saved; write "
                f"{attribute}: {type(value).__name__} = {value!r}, or ClassVar[{type(value).__name__}] where it is none"
            )
    if missing := sorted(getattr(cls, "__abstractmethods__", ())):
        raise BadInput(f"{class_path(cls)} lacks {', '.join(missing)}, which every {kind_of(cls).__name__} must have")
    unset = [f.name for f in settings if f.init and f.default is MISSING and f.default_factory is MISSING]
    if unset:
        raise BadInput(
            f"{class_path(cls)}: setting {unset[0]!r} has no default; {name!r} alone must choose a usable part"
        )
    try:
        hints_of(cls)
    except Exception as error:  # a name that is not imported, or whatever else stands for a type
        raise BadInput(f"{class_path(cls)}: a type of its settings cannot be found: {_one_line(error)}") from error


def _unused(name: str, records: Mapping[str, Plugin]) -> str:
    """A key for a plugin's record: its name, unless another distribution came first with the same one."""
    return name if name not in records else _unused(f"{name} (again)", records)


def _one_line(error: BaseException) -> str:
    text = " ".join(str(error).split())
    return text if isinstance(error, BadInput) else f"{type(error).__name__}: {text}"


def class_path(cls: type) -> str:
    """A class as messages name it: its module and its name."""
    return f"{cls.__module__}.{cls.__qualname__}"
