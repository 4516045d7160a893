"""The check that a method keeps its contract: sound results, the same again, also after an interruption."""

from __future__ import annotations

import json
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

from surfkit.core.codec import dump
from surfkit.core.events import Progress, StepDone
from surfkit.core.hooks import hookimpl
from surfkit.core.registry import plugins
from surfkit.core.schedule import rescale
from surfkit.testing.component_checks import check_component

if TYPE_CHECKING:
    from surfkit.io.datasets.data import Data
    from surfkit.runs.methods.base import Method, Reconstruction
    from surfkit.scene.scene import View


def check_method(method: Method, data: Data | None = None, folder: Path | None = None) -> None:
    """A method returns a sound mesh, sound splats or maps of the right shapes; the same from the same seed, also when
    it is interrupted after its second step or piece of progress and called again; and, called again when it has
    finished, at once. Its `uses` are fields of recipes, and its `length` follows a change of scale.

    Args:
        method: To check.
        data: A small data set; a synthetic one if None.
        folder: Empty; gets what the method writes. A temporary one if None.
    """
    if data is None or folder is None:
        with tempfile.TemporaryDirectory() as temporary:
            check_method(method, data or _small_data(Path(temporary, "data")), folder or Path(temporary, "runs"))
        return
    from surfkit.runs.recipe import Recipe

    name, known = type(method).__name__, [field.name for field in fields(Recipe)]
    check_component(method)
    assert set(method.uses) <= set(known), (
        f"{name}.uses names {sorted(set(method.uses) - set(known))}, no recipe fields"
    )
    if (length := method.length()) is not None:
        double = rescale(method, 2.0).length()
        assert double == 2 * length, (
            f"{name}: twice the steps are {double}, not {2 * length}; mark the setting as Steps"
        )
    first = _made(method, data, folder / "first")
    _check_sound(name, first, data)
    with _interrupting(at=2) as seen, suppress(KeyboardInterrupt):
        _made(method, data, folder / "second")
    after = " after an interruption" * (seen.count >= 2)
    _check_same(f"{name} gives another result{after}", first, _made(method, data, folder / "second"), data)
    with _interrupting(at=None) as seen:
        again = _made(method, data, folder / "second")
    assert not seen.steps, f"{name} made {seen.steps} steps when it was called again after it had finished"
    _check_same(f"{name} gives another result when it is called again after it has finished", first, again, data)


def _small_data(folder: Path) -> Data:
    from surfkit.io.datasets.data import Data
    from surfkit.testing.synthetic import Flight, photograph, write_colmap

    folder.mkdir(parents=True)
    write_colmap(folder, photograph(Flight(views=8, width=40, height=30, points=150)))
    return Data(folder)


class _Interrupter:
    """Counts steps and progress, and interrupts at the `at`-th of them."""

    def __init__(self, at: int | None) -> None:
        self.at, self.count, self.steps = at, 0, 0

    @hookimpl
    def surfkit_event(self, event: Any) -> None:
        """See one event."""
        self.steps += isinstance(event, StepDone)
        if isinstance(event, (StepDone, Progress)):
            self.count += 1
            if self.count == self.at:
                raise KeyboardInterrupt


@contextmanager
def _interrupting(at: int | None) -> Iterator[_Interrupter]:
    listener = _Interrupter(at)
    plugins().register(listener)
    try:
        yield listener
    finally:
        plugins().unregister(listener)


def _made(method: Method, data: Data, folder: Path) -> Reconstruction:
    """What the method makes, going on from what is in the folder."""
    from surfkit.io.datasets.read import read
    from surfkit.raster.select import select
    from surfkit.runs.context import RunContext
    from surfkit.runs.folder import Run
    from surfkit.runs.recipe import Recipe
    from surfkit.runs.run_method import method_input, with_drawing
    from surfkit.runs.run_stage import Intervals
    from surfkit.train.data_cache import CacheSettings

    run = Run(folder, Recipe(method=method), data)
    ctx = RunContext(run, read(data), select("cpu")[0], Intervals(checkpoint=1), CacheSettings())
    with method_input(ctx, "cpu") as given:
        given.folder.mkdir(parents=True, exist_ok=True)
        method.refuse_unfit(given)
        return with_drawing(method.reconstruct(given), ctx.rasterizer)


def _first_view(data: Data) -> View:
    from surfkit.io.datasets.read import read

    return read(data).train[0]


def _check_sound(name: str, made: Reconstruction, data: Data) -> None:
    import torch

    from surfkit.runs.run_method import refuse_unsound

    assert made.mesh or made.splats or made.draw, f"{name} returned no mesh, no splats and nothing that draws"
    json.dumps(dump(dict(made.facts)), allow_nan=False)
    assert made.steps >= 0, f"{name} says that it has made {made.steps} steps"
    if made.mesh is not None:
        refuse_unsound(made.mesh, name)
    if made.draw is not None:
        view = _first_view(data)
        height, width = view.camera.height, view.camera.width
        for key, value in made.draw(view).present().items():
            assert value.shape[-2:] == (height, width), f"{name} draws {key} of shape {tuple(value.shape)}"
            assert torch.isfinite(value).all(), f"{name} draws {key} with NaN or Inf"
        assert made.draw(view).color is not None, f"{name} draws no color"


def _check_same(what: str, first: Reconstruction, other: Reconstruction, data: Data) -> None:
    import numpy as np
    import torch

    assert (first.mesh is None) == (other.mesh is None), what
    if first.mesh is not None and other.mesh is not None:
        assert np.array_equal(first.mesh.faces, other.mesh.faces), what
        assert np.allclose(first.mesh.vertices, other.mesh.vertices, atol=1e-5), what
    assert (first.draw is None) == (other.draw is None), what
    if first.draw is not None and other.draw is not None:
        view = _first_view(data)
        one, two = (draw(view).need("color") for draw in (first.draw, other.draw))
        assert torch.allclose(one, two, atol=1e-4), what
    assert first.steps == other.steps, f"{what}: {other.steps} steps, not {first.steps}"
