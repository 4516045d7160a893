"""What happens while something works: steps and warnings."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager

from surfkit.core.events import StepDone, Warned
from surfkit.core.hooks import hookimpl
from surfkit.core.registry import plugins
from surfkit.runs.run_notes import collect_notes
from surfkit.train.interrupt import ask_to_stop

OnStep = Callable[[StepDone], None]
"""Called after each optimisation step. Whatever it raises, the run saves its state and stops, and `train` raises it."""


class Listener:
    """A plugin that hears steps and warnings."""

    def __init__(self, on_step: OnStep | None = None) -> None:
        self.on_step = on_step
        self.raised: BaseException | None = None
        self.texts: list[str] = []

    @hookimpl
    def surfkit_event(self, event: object) -> None:
        """Pass a step on, and keep a warning."""
        if isinstance(event, StepDone) and self.on_step is not None and self.raised is None:
            try:
                self.on_step(event)
            except BaseException as error:  # raised when the state is saved; `emit` would only report it
                self.raised = error
                if not ask_to_stop():
                    raise KeyboardInterrupt from error
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
    """Within, `on_step` is called after each step; what it raises is raised where the run has stopped."""
    listener = Listener(on_step)
    plugins().register(listener)
    try:
        yield
    except KeyboardInterrupt:
        if listener.raised is None:
            raise
        raise listener.raised from None
    finally:
        plugins().unregister(listener)
