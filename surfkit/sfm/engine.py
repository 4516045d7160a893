"""pycolmap as surfkit uses it: silent, in a thread that Ctrl-C can end, and its faults as one line."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any, TypeVar

from surfkit.core.check import BadInput
from surfkit.readers.capture import load_pycolmap

T = TypeVar("T")
POLL_S = 0.2
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
    token, result, failed = load_engine().CancellationToken(), [], []

    def body() -> None:
        try:
            result.append(work(token))
        except BaseException as error:  # handed to the main thread
            failed.append(error)

    thread = threading.Thread(target=body, name=what)
    thread.start()
    try:
        while thread.is_alive():
            thread.join(POLL_S)
    except BaseException:
        token.cancel()
        thread.join()
        raise
    if failed:
        if isinstance(failed[0], (RuntimeError, ValueError, IndexError)) and not isinstance(failed[0], BadInput):
            said = " ".join(str(failed[0]).split())[:300]
            raise BadInput(f"{what} failed in pycolmap: {said}; delete the scene's prepare/ and try again") from failed[
                0
            ]
        raise failed[0]
    return result[0]
