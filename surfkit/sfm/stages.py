"""Stages that are not repeated: each keeps what it came to, with a key of all that this depends on, and its time."""

from __future__ import annotations

import hashlib
import json
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

from surfkit.core.check import BadInput
from surfkit.core.codec import dump, read_json, write_json

T = TypeVar("T")
RECORD = "stages.json"


@dataclass(frozen=True)
class Stage:
    """A stage that is complete.

    Attributes:
        key: Of all that its result depends on.
        seconds: That it took, all calls with this key together.
        complete: Whether it came to its end.
    """

    key: str
    seconds: float
    complete: bool = True


class Stages:
    """The stages of a folder."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        try:
            self.known = read_json(folder / RECORD, dict[str, Stage])
        except BadInput:
            self.known = {}

    def run(self, name: str, key: str, make: Callable[[], T], load: Callable[[], T] | None = None) -> T:
        """What a stage comes to: loaded if it was complete with the same key, else made.

        Args:
            name: Of the stage.
            key: Of all that its result depends on.
            make: Makes and keeps the result.
            load: Reads what was kept; BadInput if it is gone. None makes it each time, where `make` itself knows what
                is there.
        """
        before = self.known.get(name)
        if load is not None and before is not None and before.key == key and before.complete:
            try:
                return load()
            except BadInput:
                before = None
        spent = before.seconds if before is not None and before.key == key else 0.0
        began, ended = time.perf_counter(), False
        try:
            result = make()
            ended = True
        finally:
            self.known[name] = Stage(key, round(spent + time.perf_counter() - began, 2), ended)
            write_json(self.folder / RECORD, self.known)
        return result

    def seconds(self) -> dict[str, float]:
        """The time of each stage, in their order."""
        return {name: stage.seconds for name, stage in self.known.items()}


def key_of(*values: Any) -> str:
    """A digest of values that the codec knows."""
    text = json.dumps([dump(value) for value in values], sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:24]
