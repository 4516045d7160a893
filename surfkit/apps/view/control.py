"""Between a page and a training: pictures that are drawn between two steps, and a pause."""

from __future__ import annotations

import threading
import time
from collections import defaultdict
from concurrent.futures import Future
from dataclasses import dataclass, field
from pathlib import Path

from surfkit.core.check import BadInput
from surfkit.core.events import say
from surfkit.raster.api import Maps
from surfkit.scene.scene import View
from surfkit.train.progress import PSNR_EVERY
from surfkit.train.watch import Watched

LOOK_S = 0.1
"""Between two looks, while the training is paused, whether it was asked to stop."""


@dataclass(frozen=True)
class RenderedStep:
    """What was drawn between two steps.

    Attributes:
        maps: On the CPU.
        index: The step before.
    """

    maps: Maps
    index: int


@dataclass(frozen=True)
class RenderRequest:
    """A picture that a page waits for: of what, with the geometry or only colours."""

    view: View
    geometry: bool
    made: Future[RenderedStep] = field(default_factory=Future)


class TrainingControl:
    """Draws in the thread of the training what a page orders from another thread; one picture between two steps.

    While nobody orders anything, it costs a step some comparisons.

    Attributes:
        stage: The one whose steps are made in this process; None at other times.
        index: Its last step.
        paused: Whether it waits until it is asked to go on.
        spent: Seconds for which it has waited for pictures so far.
        psnrs: By folder of a journal, steps and PSNR of the training views about then, dB.
    """

    def __init__(self) -> None:
        """Nothing runs yet."""
        self.changed = threading.Condition()
        self.stage: Watched | None = None
        self.index, self.paused, self.spent = 0, False, 0.0
        self.order: RenderRequest | None = None
        self.psnrs: dict[Path, list[tuple[int, float]]] = defaultdict(list)

    def begin(self, stage: Watched) -> None:
        """See `Watcher.begin`."""
        with self.changed:
            self.stage = stage

    def look(self, index: int, psnr: float | None) -> None:
        """See `Watcher.look`."""
        self.index = index
        stage = self.stage
        assert stage is not None, "a stage begins before its steps"
        if psnr is not None and index % PSNR_EVERY == 0:
            self._note(stage, index, psnr)
        if self.order is not None:
            self._draw(stage)
        if self.paused:
            self._wait(stage)

    def end(self) -> None:
        """See `Watcher.end`."""
        with self.changed:
            order, self.order, self.stage = self.order, None, None
        if order is not None:
            order.made.set_exception(BadInput("no step is being made now, so that nothing is drawn"))

    def pause(self, paused: bool) -> None:
        """Hold the training after its step, or have it go on. For pages."""
        with self.changed:
            self.paused = paused
            self.changed.notify_all()

    def draw(self, view: View, geometry: bool) -> RenderedStep:
        """Have a view drawn after the step that is being made, and wait for it. For the one thread that orders.

        Raises:
            BadInput: No stage runs in this process, or it ends before.
            Exception: What stopped the rasterizer, such as a lack of memory; the training goes on.
        """
        order = RenderRequest(view, geometry)
        with self.changed:
            if self.stage is None:
                raise BadInput("no step is being made now, so that nothing is drawn")
            self.order = order
            self.changed.notify_all()
        return order.made.result()

    def _note(self, stage: Watched, index: int, psnr: float) -> None:
        rows = self.psnrs[stage.folder]
        while rows and rows[-1][0] >= index:  # steps that are made again
            rows.pop()
        rows.append((index, psnr))

    def _draw(self, stage: Watched) -> None:
        with self.changed:
            order, self.order = self.order, None
        assert order is not None, "orders are taken by the thread of the training alone"
        began = time.perf_counter()
        try:
            drawn = stage.draw(order.view, order.geometry)
            maps = Maps(**{name: value.detach().cpu() for name, value in drawn.present().items()})
        except Exception as error:  # also that memory ran out: a picture less, and the training goes on
            failed = error.with_traceback(None)  # whose frames hold memory
            self.spent += time.perf_counter() - began
            order.made.set_exception(failed)
            return
        except BaseException:  # a second Ctrl-C
            order.made.set_exception(BadInput("the run was stopped"))
            raise
        self.spent += time.perf_counter() - began
        order.made.set_result(RenderedStep(maps, self.index))

    def _wait(self, stage: Watched) -> None:
        title = stage.title
        say(f"{title}: paused on the page after step {self.index}; it goes on from there, and Ctrl-C saves and stops")
        while self.paused and not stage.stopping():
            with self.changed:
                if self.order is None and self.paused:
                    self.changed.wait(LOOK_S)
            if self.order is not None:
                self._draw(stage)
        if not self.paused:
            say(f"{title}: goes on after step {self.index}")
