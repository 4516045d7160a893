"""What happens while something works: steps and warnings."""

from __future__ import annotations

import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from surfkit.core.events import StepDone, Warned
from surfkit.core.hooks import hookimpl
from surfkit.core.registry import plugins
from surfkit.runs.run_notes import collect_notes

OnStep = Callable[[StepDone], None]
"""Called after each optimisation step. It may raise KeyboardInterrupt: the run saves its state and stops."""


class Listener:
    """A plugin that hears steps and warnings."""

    def __init__(self, on_step: OnStep | None = None) -> None:
        self.on_step = on_step
        self.texts: list[str] = []

    @hookimpl
    def surfkit_event(self, event: object) -> None:
        """Pass a step on, and keep a warning."""
        if isinstance(event, StepDone) and self.on_step is not None:
            try:
                self.on_step(event)
            except KeyboardInterrupt:
                signal.raise_signal(signal.SIGINT)  # as Ctrl-C: the step is finished, and the state saved
        if isinstance(event, Warned):
            self.texts.append(event.text)


@contextmanager
def heard() -> Iterator[list[str]]:
    """Within, warnings are printed and kept."""
    listener = Listener()
    plugins().register(listener)
    try:
        with collect_notes():
            yield listener.texts
    finally:
        plugins().unregister(listener)


@contextmanager
def listening(on_step: OnStep | None) -> Iterator[None]:
    """Within, `on_step` is called after each step."""
    listener = Listener(on_step)
    plugins().register(listener)
    try:
        yield
    finally:
        plugins().unregister(listener)
