"""A small world of components and recipes for the tests of core and cli: no built-in folder, no plugin, no torch."""

import gc
import importlib
import os
import signal
import sys
import types
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

import pytest
from listening import listening

from surfkit.cli.recipes import chosen_recipe
from surfkit.core import registry
from surfkit.core.events import Warned
from surfkit.core.hooks import hookimpl
from surfkit.core.registry import Component, choice
from surfkit.core.schedule import Interval, StepCount, Steps

# As in the command, and before torch is loaded: threads that wait for others do not spin.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
os.environ.setdefault("OPENBLAS_THREAD_TIMEOUT", "4")
if workers := int(os.environ.get("PYTEST_XDIST_WORKER_COUNT", 0)):  # they share the cores
    os.environ.setdefault("OMP_NUM_THREADS", str(max(1, (os.cpu_count() or 1) // workers)))


@pytest.fixture(scope="module", autouse=True)
def little_garbage():
    """What is loaded stays: it is not searched for garbage again and again, which took a third of the time."""
    gc.freeze()
    yield
    gc.collect()


@pytest.fixture(autouse=True)
def same_numbers():
    """What is drawn at random does not depend on the tests before."""
    if torch := sys.modules.get("torch"):
        torch.manual_seed(0)


@pytest.fixture
def warned():
    """What warnings said."""
    with listening(Warned, lambda event: event.text) as texts:
        yield texts


class Loss(Component):
    """What is minimised."""


class Grow(Component):
    """How points multiply."""


class Empty(Component):
    """A kind that nobody offers."""


@dataclass(frozen=True)
class L1(Loss):
    """Mean absolute error."""

    weight: float = 0.8
    """Share of the total."""


@dataclass(frozen=True)
class Depth(Loss):
    """Depth against a prior."""

    start: Steps = 7_000
    """First step that counts."""
    until: Steps | None = None
    """Last step that counts."""

    def __post_init__(self):
        if self.start < 0:
            raise ValueError(f"start is {self.start}; it must be 0 or more")


@dataclass(frozen=True)
class Adaptive(Grow):
    """Clone and split.

    Not in the first paragraph.
    """

    every: Interval = 100
    """Steps between edits,
    at least one."""
    reset: Annotated[int, StepCount(floor=25)] = 3_000
    """Steps between resets."""
    empty: tuple[Annotated[Empty, choice(Empty)], ...] = ()
    """Conditions."""


@dataclass(frozen=True)
class Relocate(Grow):
    """Move dead points | to live ones."""

    cap: int = 1_000
    """Most points."""


@dataclass(frozen=True)
class Stage:
    """One optimisation run."""

    steps: Steps = 30_000
    losses: dict[str, Annotated[Loss, choice(Loss)]] = field(default_factory=lambda: {"l1": L1(), "depth": Depth()})
    grow: Annotated[Grow | None, choice(Grow, optional=True)] = Adaptive()
    prune: tuple[Annotated[Grow, choice(Grow)], ...] = ()
    marks: tuple[Steps, ...] = (7_000, 30_000)

    def __post_init__(self):
        if self.steps < 1:
            raise ValueError(f"steps is {self.steps}; it must be 1 or more")


@dataclass(frozen=True)
class Recipe:
    """Everything that decides a result."""

    about: str = ""
    mode: Literal["fast", "fine"] = "fine"
    pretrain: Stage = Stage()
    tune: Stage | None = None


@dataclass(frozen=True)
class Train:
    """Reconstruct a surface."""

    recipe: Annotated[Recipe, chosen_recipe]
    data: Path
    """Folder of photographs."""
    device: Literal["auto", "cpu"] = "auto"
    """Where to compute."""

    def run(self):
        print(self)


class Plugin:
    """The plugin that offers the stand-ins."""

    @hookimpl
    def surfkit_components(self):
        return {"l1": L1, "depth": Depth, "adaptive": Adaptive, "relocate": Relocate}

    @hookimpl
    def surfkit_recipes(self):
        return {"discs": Recipe("Flat\n  discs."), "balls": Recipe("Round balls.", pretrain=Stage(prune=(Relocate(),)))}


@pytest.fixture(scope="session", autouse=True)
def compiled():
    """Without the native module, tests that draw with what `select` chooses are skipped: it would take minutes."""
    from needs import NO_NATIVE, native

    class Slow:
        def warn(self, *args, **more):
            pytest.skip(f"this draws with the native rasterizer: {NO_NATIVE}")

    with pytest.MonkeyPatch.context() as patch:
        if native.module() is None:
            patch.setattr("surfkit.raster.select.warnings", Slow())
        yield


@pytest.fixture(scope="session", autouse=True)
def unsynced():
    """No file is flushed to the disk: that is for a loss of power, and no test has one."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(os, "fsync", lambda file: None)
        yield


@pytest.fixture
def bare(monkeypatch):
    """The registry with nothing in it; as it was again afterwards."""
    monkeypatch.setattr(registry, "BUILTIN", ())
    monkeypatch.setenv("SURFKIT_PLUGINS", "none")
    registry.reload()
    yield registry
    registry.reload()


@pytest.fixture
def world(bare, monkeypatch):
    """The classes of this module, offered by a plugin named stand-in, with `surfkit train` and its recipes."""
    importlib.import_module("surfkit.cli.parse")  # which would import the modules that are replaced below
    bare.plugins().register(Plugin(), "stand-in")
    functions = ("complete", "with_steps", "refuse_unused", "unused", "without_unused")
    for name, values in {
        "surfkit.apps.train": {"COMMAND": Train},
        "surfkit.runs.recipe": {"Recipe": Recipe} | dict.fromkeys(functions, lambda recipe, *_: recipe),
    }.items():
        module = types.ModuleType(name)
        vars(module).update(values)
        monkeypatch.setitem(sys.modules, name, module)
    return types.SimpleNamespace(**globals())


@pytest.fixture(autouse=True, scope="session")
def user_cache(tmp_path_factory):
    """The user's own cache is left alone, also by what modules of tests share."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("SURFKIT_CACHE", str(tmp_path_factory.mktemp("cache")))
        yield


@pytest.fixture(autouse=True)
def own_cache(tmp_path_factory, monkeypatch):
    """The user's cache of one test, empty."""
    folder = tmp_path_factory.mktemp("cache")
    monkeypatch.setenv("SURFKIT_CACHE", str(folder))
    return folder


@pytest.fixture
def hangs_up():
    """A closed terminal ends this process by default, also where the tests run under nohup."""
    before = signal.signal(signal.SIGHUP, signal.SIG_DFL)
    yield
    signal.signal(signal.SIGHUP, before)


@pytest.fixture
def forked_probe(monkeypatch):
    """The process of a probe is forked from one that has loaded torch."""
    import multiprocessing

    from forks import Probing

    monkeypatch.setattr(multiprocessing, "get_context", lambda method: Probing)


@pytest.fixture
def forked_jobs():
    """The processes of `Pool` are forked from one that has loaded torch."""
    from forks import Forked

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("surfkit.runs.execute.base.subprocess", types.SimpleNamespace(Popen=Forked, DEVNULL=None))
        yield


@pytest.fixture
def crowd():
    """200 random points and a step about them, at which policies with default settings act."""
    from surfkit.testing import inputs

    return inputs.crowd()


@pytest.fixture(scope="module")
def quick_alignment():
    """ICP, which is most of a comparison and no matter to some tests, ends after two fits."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("surfkit.evaluate.geometry.registration.ITERATIONS", 2)
        yield


@pytest.fixture(scope="module")
def quick_comparison(quick_alignment):
    """What is drawn of errors, most of the rest of a comparison, is a quarter as wide too."""
    with pytest.MonkeyPatch.context() as patch:
        for module in ("errors", "measure_geometry", "class_pictures"):
            patch.setattr(f"surfkit.evaluate.geometry.{module}.PICTURE_LONGEST_PX", 180)
        yield
