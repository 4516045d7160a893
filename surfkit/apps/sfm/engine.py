"""pycolmap as surfkit uses it: silent, in a thread that Ctrl-C can end, and its faults as one line."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, TypeVar

from surfkit.core.check import BadInput
from surfkit.core.signals import asking
from surfkit.io.datasets.raw_dataset import load_pycolmap

T = TypeVar("T")
INTERRUPT_POLL_S = 0.2
"""How often the main thread looks for Ctrl-C."""


def load_engine() -> Any:
    """The module pycolmap, which then says nothing below errors; BadInput for one too old."""
    pycolmap = load_pycolmap()
    if not hasattr(pycolmap, "CancellationToken"):
        version = getattr(pycolmap, "__version__", "")
        raise BadInput(
            f"`surfkit prepare photos` needs pycolmap 4.2 or newer, this is {version}: pip install -U pycolmap"
        )
    pycolmap.logging.minloglevel = pycolmap.logging.ERROR.value
    return pycolmap


def run(what: str, work: Callable[[Any], T]) -> T:
    """What a long function of pycolmap returns; it runs in a thread, and Ctrl-C cancels it.

    Args:
        what: The work, for messages.
        work: Takes a `CancellationToken` to hand on.

    Raises:
        BadInput: pycolmap failed.
    """
    token, ended = load_engine().CancellationToken(), threading.Event()
    result, failed = [], []

    def body() -> None:
        try:
            result.append(work(token))
        except BaseException as error:  # handed to the main thread
            failed.append(error)
        finally:
            ended.set()

    thread = threading.Thread(target=body, name=what)
    try:
        thread.start()
        while not ended.wait(
            INTERRUPT_POLL_S
        ):  # Thread.join, interrupted, takes a running thread for one that has ended
            pass
    except BaseException:
        with _undisturbed():
            token.cancel()
            if thread.ident is not None:  # a process that ends before its thread is aborted
                ended.wait()
        raise
    if not failed:
        return result[0]
    error = failed[0]
    if isinstance(error, (RuntimeError, ValueError, IndexError)) and not isinstance(error, BadInput):
        said = " ".join(str(error).split())[:300]
        raise BadInput(f"{what} failed in pycolmap: {said}; delete the scene's prepare/ and try again") from error
    raise error


@contextmanager
def _undisturbed() -> Iterator[None]:
    """Within, a signal that would raise an error does nothing: an impatient user sends several."""
    if threading.current_thread() is not threading.main_thread():  # no other one gets any
        yield
        return
    handlers = {number: signal.getsignal(number) for number in asking()}
    raising = {number: handler for number, handler in handlers.items() if callable(handler)}
    for number in raising:
        signal.signal(number, lambda *_: None)
    try:
        yield
    finally:
        for number, handler in raising.items():
            signal.signal(number, handler)
