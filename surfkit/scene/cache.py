"""Values read from disk for each view, kept in memory up to a byte budget and prefetched by threads."""

from __future__ import annotations

import os
import weakref
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any, Generic, TypeVar

T = TypeVar("T")


class Cache(Sequence[T], Generic[T]):
    """Values by position, read when they are asked for or shortly before.

    The budget is kept by dropping what is needed last: what has been used and is not foreseen again, then what is
    foreseen latest. What is read does not depend on it. Values that are being read count in full; one value is always
    held, however small the budget.
    """

    def __init__(
        self,
        read: Callable[[int], T],
        sizes: Sequence[int],
        budget_bytes: int | None = None,
        threads: int | None = None,
        opened: Callable[[T], T] | None = None,
    ) -> None:
        """Start reading, in the order of the positions.

        Args:
            read: Gives the value of a position; called in a thread.
            sizes: Bytes of each value in memory.
            budget_bytes: Most bytes to keep; None keeps all.
            threads: Readers; as many as there are cores, 4 at most, by default.
            opened: Makes what is given of what is kept, each time, where values are kept in fewer bytes.
        """
        threads = threads or min(4, os.cpu_count() or 1)
        self._read, self._sizes, self._ahead = read, list(sizes), 2 * threads
        self._opened = opened
        self._budget = sum(self._sizes) if budget_bytes is None else budget_bytes
        self._pool = ThreadPoolExecutor(threads, thread_name_prefix="read")
        self._stop = weakref.finalize(self, self._pool.shutdown, wait=False, cancel_futures=True)
        self._kept: dict[int, Future[T]] = {}  # the longest unused first
        self._bytes = 0
        self._needed: dict[int, int] = {}
        self._turn = 0
        self.lowered = False
        """Whether the budget has been changed."""
        self.expect(range(len(self._sizes)))

    def __len__(self) -> int:
        return len(self._sizes)

    def __getitem__(self, at: int, /) -> T:  # type: ignore[override]  # no slices
        """The value of a position; waits until it is read, and reads on.

        Raises:
            BadInput: The file is damaged.
        """
        at = range(len(self))[at]
        self._turn = self._needed.get(at, self._turn)
        try:
            value = self._value(at)
        finally:
            del self._needed[at]
        return value if self._opened is None else self._opened(value)

    def aside(self, at: int) -> T:
        """The value of a position out of turn: when it is to be asked for next, and what is read ahead, stay.

        Raises:
            BadInput: The file is damaged.
        """
        due = self._needed.get(at)
        try:
            value = self._value(at)
        finally:
            del self._needed[at]
            if due is not None:
                self._needed[at] = due
        return value if self._opened is None else self._opened(value)

    def expect(self, coming: Sequence[int]) -> None:
        """Read in this order from now on: positions in the order in which they will be asked for."""
        self._needed = {at: turn for turn, at in reversed(list(enumerate(coming)))}
        self._turn = 0
        self._coming = iter(list(coming))
        self._next: int | None = next(self._coming, None)
        self._fetch()

    def close(self) -> None:
        """Stop reading."""
        self._needed, self._next = {}, None
        self._stop()

    def resize(self, budget_bytes: int) -> None:
        """Keep at most so many bytes from now on, and drop the rest; one value is always held."""
        self._budget = budget_bytes
        self.lowered = True
        self._make_room(0, -1)

    @property
    def sizes(self) -> Sequence[int]:
        """Bytes of each value."""
        return self._sizes

    @property
    def budget(self) -> int:
        """Maximum number of bytes to keep."""
        return self._budget

    @property
    def bytes(self) -> int:
        """Bytes kept or being read now."""
        return self._bytes

    def _value(self, at: int) -> T:
        """Wait for a value, and read on; until it is taken back, its position is the one that is needed first."""
        self._needed[at] = -1
        if at in self._kept:
            future = self._kept[at] = self._kept.pop(at)
        else:
            self._make_room(self._sizes[at], -1)
            future = self._submit(at)
        self._fetch()
        try:
            return future.result()
        except BaseException:
            if self._kept.get(at) is future:  # what went wrong may not go wrong again
                del self._kept[at]
                self._bytes -= self._sizes[at]
            raise

    def _fetch(self) -> None:
        """Read what is needed next, as far as it is worth its room."""
        busy = sum(not future.done() for future in list(self._kept.values())[-self._ahead :])
        while self._next is not None and busy < self._ahead:
            at = self._next
            if at in self._needed and at not in self._kept:
                soon = self._needed[at] - self._turn < self._ahead  # or it waits for what is no longer needed
                if not self._make_room(self._sizes[at], self._needed[at] if soon else len(self._sizes)):
                    return
                self._submit(at)
                busy += 1
            self._next = next(self._coming, None)

    def _submit(self, at: int) -> Future[T]:
        self._bytes += self._sizes[at]
        self._kept[at] = self._pool.submit(self._read, at)
        return self._kept[at]

    def _make_room(self, size: int, turn: int) -> bool:
        """Drop values that are needed after a turn until `size` bytes are free; False if those are not enough."""
        while self._bytes + size > self._budget and self._kept:
            at = next((at for at in self._kept if at not in self._needed), None)
            if at is None:
                at = max(self._kept, key=self._needed.__getitem__)
                if self._needed[at] <= turn:
                    return False
            self._bytes -= self._sizes[at]
            self._kept.pop(at).cancel()
        return self._bytes + size <= self._budget or not self._kept


def share(budget_bytes: int | None, caches: Sequence[int]) -> list[int | None]:
    """A budget for each of several caches, in proportion to what each would keep without one, in bytes."""
    if budget_bytes is None:
        return [None] * len(caches)
    return [int(budget_bytes * size / max(1, sum(caches))) for size in caches]


def out_of_turn(known: Any, at: int) -> Any:
    """The value of a position of a cache or sequence, without disturbing what is read ahead."""
    return known.aside(at) if isinstance(known, Cache) else known[at]
