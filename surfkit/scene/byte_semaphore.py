"""A number of bytes that threads share."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager


class ByteSemaphore:
    """A semaphore over bytes: threads wait until there is room; a single one may exceed the limit."""

    def __init__(self, most: int) -> None:
        self.most, self.taken = most, 0
        self._changed = threading.Condition()

    @contextmanager
    def taking(self, count: int) -> Iterator[None]:
        """Within, so many bytes are taken; waits until there is room."""
        with self._changed:
            self._changed.wait_for(lambda: not self.taken or self.taken + count <= self.most)
            self.taken += count
        try:
            yield
        finally:
            with self._changed:
                self.taken -= count
                self._changed.notify_all()
