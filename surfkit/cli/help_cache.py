"""The text of `surfkit COMMAND --help`, kept in the user's cache: to make it, torch and every component are loaded."""

from __future__ import annotations

import hashlib
import os
import shutil
import sys
from collections.abc import Iterator, Sequence
from contextlib import suppress
from importlib.metadata import entry_points
from importlib.util import find_spec
from pathlib import Path

from surfkit.core.caches import cache_root
from surfkit.core.check import BadInput

HELP_FLAGS = {"-h", "--help"}
MAX_TEXTS = 64
"""Texts that are kept; the oldest go first."""
ENVIRONMENT = ("SURFKIT_PLUGINS", "TERM", "NO_COLOR", "FORCE_COLOR", "PYTHONIOENCODING", "LANG", "LC_ALL")
"""Variables that the text may depend on."""


def kept_help(words: Sequence[str]) -> Path | None:
    """The file that has, or will have, what `--help` shows for these words; None where no text is kept.

    Its name stands for all that the text follows from: the words, the terminal, and each file of surfkit and of the
    packages of plugins, by size and time. Words that name a file, such as a run whose recipe decides, are not kept.
    """
    if not HELP_FLAGS & set(words) or any(Path(word.partition(":")[2] or word).exists() for word in words):
        return None
    terminal = (shutil.get_terminal_size().columns, sys.stdout.isatty(), sys.stdout.encoding)
    found = hashlib.sha256(repr((sys.version, list(words), terminal)).encode())
    found.update(repr([os.environ.get(name) for name in ENVIRONMENT]).encode())
    for line in _sources():
        found.update(line.encode(errors="surrogateescape"))
    with suppress(BadInput):
        return cache_root() / "help" / f"{found.hexdigest()}.txt"
    return None


def show_kept(path: Path) -> bool:
    """Print a kept text, and whether there is one."""
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, ValueError):
        return False
    print(text, end="")
    return True


def keep(path: Path, text: str) -> None:
    """Keep a text; where that cannot be, as in a home folder that is read-only, it is made again the next time."""
    with suppress(OSError):
        path.parent.mkdir(parents=True, exist_ok=True)
        beside = path.with_suffix(f".{os.getpid()}")
        beside.write_text(text, encoding="utf-8")
        beside.replace(path)
        texts = sorted(path.parent.iterdir(), key=lambda one: one.stat().st_mtime)
        for old in texts[:-MAX_TEXTS]:
            old.unlink(missing_ok=True)


def _sources() -> Iterator[str]:
    """Path, size and time of every file that help may follow from."""
    places = {str(Path(__file__).parents[1])}
    for point in entry_points(group="surfkit"):
        yield f"{point.name} {point.value}"
        with suppress(ImportError, ValueError):
            spec = find_spec(point.module.partition(".")[0])
            places |= set(spec.submodule_search_locations or [spec.origin or ""]) if spec else set()
    for place in sorted(places):
        files = [place] if os.path.isfile(place) else []
        for folder, inner, names in os.walk(place):
            inner[:] = [name for name in inner if name != "__pycache__"]
            files += [os.path.join(folder, name) for name in names]
        for file in sorted(files):
            with suppress(OSError):
                state = os.stat(file)
                yield f"{file} {state.st_size} {state.st_mtime_ns}"
