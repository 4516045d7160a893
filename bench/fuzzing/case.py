"""One case: a copy of what is whole, damaged, and a command that must take it well."""

from __future__ import annotations

import contextlib
import io
import os
import shutil
import tempfile
import time
import traceback
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any
from unittest.mock import patch

from matplotlib import font_manager  # noqa: F401 (makes its folders of settings and fonts now, while no case runs)

from . import limits
from .damage import NUMBERS, Damage, apply
from .limits import Watch, damaged_output, giving_out, limited
from .targets import MEMORY, OUTPUT, TARGETS

HELD = 400 << 20
"""Bytes of memory that a case may add to the most that was held before."""
WRITTEN = ("out", "cache", "data/undistorted", "data/estimated_depths")
"""Where commands may write, below the folder of a case."""


@dataclass
class Finding:
    """Something that must not happen: what, and the first case that led to it."""

    what: str
    target: str
    words: str
    damages: list[Any]
    said: str
    times: int = 1


class Fuzz:
    """Makes cases of one target in a folder of its own."""

    watch: Watch | None = None

    def __init__(self, name: str, folder: Path) -> None:
        Fuzz.watch = Fuzz.watch or Watch()
        self.name, self.target, self.here, self.whole = name, TARGETS[name], folder / "case", folder / "whole"
        self.target.make(self.here)  # in its place: a run folder knows where its data are
        shutil.move(self.here, self.whole)
        found = [path for pattern in self.target.files for path in sorted(self.whole.glob(pattern)) if path.is_file()]
        self.files = [*(path.relative_to(self.whole).as_posix() for path in found), *self.target.others]
        self.turn = 0
        self.commands: dict[tuple[str, ...], Any] = {}

    def case(self, given: list[Damage], words: str | None = None) -> Finding | None:
        """What is wrong with how a command takes damage."""
        words = words or self.target.words[self.turn % len(self.target.words)]
        self.turn += 1
        shutil.rmtree(self.here, ignore_errors=True)
        shutil.copytree(self.whole, self.here)
        for damage in given:
            apply(damage, self.here)
            if damage.file.startswith("--"):
                words += f" {damage.file} {NUMBERS[damage.what % len(NUMBERS)]}"
        others = {damage.file: damage for damage in given if damage.file in (OUTPUT, MEMORY)}
        what, said = self.judged(words.format(here=self.here).split(), others)
        return None if what is None else Finding(what, self.name, words, [asdict(d) for d in given], said[-1500:])

    def judged(self, words: list[str], others: dict[str, Damage]) -> tuple[str | None, str]:
        """What is wrong with how a command ends, if anything is, and what it said; `others` are damages of no file."""
        from surfkit.cli import main, parse
        from surfkit.core.memory import peak_memory_bytes

        before, held, out = self.state(), peak_memory_bytes(), io.StringIO()
        self.watch.found.clear()
        self.watch.allowed = (
            *(f"{self.here}/{place}" for place in WRITTEN),
            f"{tempfile.gettempdir()}/surfkit-doctor-",
        )
        start = time.process_time()
        try:
            with (
                damaged_output(others.get(OUTPUT), out) as to,
                contextlib.redirect_stdout(to),
                contextlib.redirect_stderr(out),
                limited(),
                self.remembered(parse),
                giving_out(others.get(MEMORY)),
                patch.dict(os.environ, SURFKIT_CACHE=str(self.here / "cache")),
            ):
                status = main(words)
        except BaseException as error:
            where = [f for f in traceback.extract_tb(error.__traceback__) if f.filename.startswith(limits.PACKAGE)][-1]
            place = f"{Path(where.filename).name} {where.name}"
            return f"{type(error).__name__} in {place}", out.getvalue() + traceback.format_exc()
        finally:
            self.watch.allowed = None
        said, seconds = out.getvalue(), time.process_time() - start
        if status == 141 and OUTPUT in others:
            status = 0
        if MEMORY in others:
            said = said.replace("out of memory", "")
        return self.complaint(status, said, seconds, peak_memory_bytes() - held, before), out.getvalue()

    @contextlib.contextmanager
    def remembered(self, module: Any) -> Iterator[None]:
        """Within, the same words are parsed only once, and the disk is not waited for: both take longest."""
        parse, fsync = module.parse, os.fsync

        def once(command: type, argv: list[str], prog: str) -> Any:
            key = (prog, *argv)
            if key not in self.commands or "r.json" in self.files:
                self.commands[key] = parse(command, argv, prog)
            return self.commands[key]

        module.parse, os.fsync = once, lambda file: None
        try:
            yield
        finally:
            module.parse, os.fsync = parse, fsync

    def complaint(self, status: int, said: str, seconds: float, grown: int, before: dict) -> str | None:
        """What is wrong with an exit status, what was said, what was taken and what was changed."""
        lines = said.strip().splitlines()
        if status not in (0, 1, 2, 3):
            return f"exit status {status}"
        own = lines and (lines[-1].startswith("surfkit: ") or any(line.startswith("error: ") for line in lines))
        if status in (1, 2) and not own:
            return f"exit status {status} without a line of its own at the end"
        for word in ("Traceback", "Warning:", "bad_alloc", "out of memory", "gets no more events"):
            if line := next((line for line in lines if word in line), None):
                return f"said {line.replace(str(self.here), '')[:200]!r}"
        if self.watch.found or self.state() != before:
            return f"wrote outside the run folder: {self.watch.found[:1]}"
        if grown > HELD:
            return f"took {grown >> 20} MiB"
        return f"took {seconds:.0f} s of CPU time" if seconds > limits.CPU_SECONDS else None

    def state(self) -> dict[str, tuple[int, int]]:
        """Size and time of every file that is not to be changed."""
        found = {}
        for path in self.here.rglob("*"):
            name = path.relative_to(self.here).as_posix()
            if not name.startswith(WRITTEN) and path.is_file():
                found[name] = (path.stat().st_size, path.stat().st_mtime_ns)
        return found
