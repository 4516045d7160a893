"""The `surfkit` command: finds the subcommand, runs it, and prints an error that a user can correct as one line.

Commands come from the hook `surfkit_commands`: those of surfkit from `surfkit/apps`, others from packages, which are
loaded for a word that is none of ours. The module of a command has a dataclass named `COMMAND`: its docstring and its
fields are the help, and its `run()` does the work and returns an exit status, or None for 0; or `COMMAND` has several
of these, by a second word. Only the command that is given is imported: `surfkit --help` loads neither torch nor tyro.
"""

from __future__ import annotations

import difflib
import importlib
import os
import shutil
import sys
import textwrap
from collections.abc import Iterable, Sequence
from contextlib import suppress
from typing import Any

from surfkit.cli.help_cache import HELP_FLAGS, keep, kept_help, show_kept
from surfkit.cli.standard_streams import (
    READER_LEFT,
    outlive_terminal,
    recorded,
    reopen_closed,
    replace_unknown_letters,
    silence_lost_streams,
)
from surfkit.core.check import BadInput, Fault, printable
from surfkit.core.files import DISK_FULL
from surfkit.core.hooks import LazyCommand
from surfkit.core.memory import is_out_of_memory, out_of_memory
from surfkit.core.signals import terminable

COMMANDS: dict[str, LazyCommand] = importlib.import_module("surfkit.apps").surfkit_commands()
"""Those of surfkit. The folder stands above this one, and so is not imported by name."""
BEGIN = (
    "To begin, `surfkit make PHOTOS --out DELIVERY` goes the whole way. Step by step, `surfkit prepare photos FOLDER` "
    "makes a data set of photographs or a video, and `surfkit doctor DATA` checks one that is there."
)
"""What `surfkit --help` says to those who are new."""
MORE = "`surfkit help COMMAND` tells more. `surfkit plugins` lists the commands that packages add."
"""What it ends with."""


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command line and return its exit status.

    2 is for arguments or data that the user can correct, 1 for a run that ran out of memory or disk or met NaN or Inf,
    3 for one with blocks that failed, 130 for one that was interrupted, by Ctrl-C, SIGTERM or a terminal that is closed
    (SIGHUP), and 141 for output that nobody reads any more.

    Args:
        argv: Words after `surfkit`; those of this process if None.
    """
    words = list(sys.argv[1:] if argv is None else argv)
    # Idle threads of torch, and of numpy's OpenBLAS, would otherwise spin, and use as much CPU time as the work itself.
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    os.environ.setdefault("OPENBLAS_THREAD_TIMEOUT", "4")  # wait 2^4 cycles
    reopen_closed()
    replace_unknown_letters()
    outlive_terminal()
    try:
        with terminable():
            status = _guarded(words) if argv is not None else _helped(words)
        sys.stdout.flush()
        return status
    except OSError as error:
        lost = silence_lost_streams()
        if lost and isinstance(error, BrokenPipeError):
            return READER_LEFT
        if not lost and error.errno not in DISK_FULL:
            raise
        where = f"standard {lost[0]}" if lost else os.fsdecode(error.filename or "what was being written")
        with suppress(OSError):
            print(printable(f"surfkit: {where}: {error.strerror}; what is finished is kept"), file=sys.stderr)
        return 1


def overview() -> str:
    """The text of `surfkit --help`."""
    column, width = max(map(len, COMMANDS)) + 4, max(60, shutil.get_terminal_size().columns)
    lines = [
        textwrap.fill(command.summary, width, initial_indent=f"  {name}".ljust(column), subsequent_indent=" " * column)
        for name, command in COMMANDS.items()
    ]
    return "\n".join(
        [
            "surfkit reconstructs surfaces of large scenes from photographs, with Gaussian splatting.",
            "",
            "usage: surfkit COMMAND ...",
            "       surfkit --help | --version",
            "",
            textwrap.fill(BEGIN, width),
            "",
            *lines,
            "",
            textwrap.fill(MORE, width),
        ]
    )


def added_commands() -> dict[str, type | LazyCommand]:
    """The commands of packages, by the word that users type.

    Raises:
        BadInput: Two packages offer one under the same name, or one has the name of a command of surfkit.
    """
    from surfkit.core.registry import offered_once

    found = offered_once("surfkit_commands", "a command")
    return {name: command for name, command in found.items() if name not in COMMANDS}


def _given(words: list[str]) -> LazyCommand:
    """The command that the words give; one without advice if it is not known or not a lazy one."""
    found = COMMANDS.get(words[0]) or added_commands().get(words[0]) if words else None
    return found if isinstance(found, LazyCommand) else LazyCommand("", "")


def _helped(words: list[str]) -> int:
    """The exit status of the words of this process; what `--help` prints is kept for the next time."""
    words = as_help(words)
    if (path := kept_help(words)) is None:
        return _guarded(words)
    if show_kept(path):
        return 0
    with recorded() as text:
        status = _guarded(words)
    print(text.getvalue(), end="")
    if status == 0:
        keep(path, text.getvalue())
    return status


def as_help(words: Sequence[str]) -> list[str]:
    """The same words, with `help COMMAND` rewritten to `COMMAND --help`."""
    return [*words[1:], "--help"] if words[:1] == ["help"] else list(words)


def _guarded(words: list[str]) -> int:
    """The exit status of a command line, with one line on stderr for an error that is not a bug."""
    try:
        return _dispatch(words)
    except KeyboardInterrupt:
        return _interrupted(words)
    except SystemExit as stop:  # --help, and rich when nobody reads its output any more
        if isinstance(stop.code, str):
            raise
        if stop.code == 1:
            silence_lost_streams()
            return READER_LEFT
        return stop.code or 0
    except Exception as error:
        if isinstance(error.__cause__, KeyboardInterrupt):  # while a class was made: Python makes it a RuntimeError
            return _interrupted(words)
        if (found := _error_line(error, words)) is None:
            raise
        text, status = found
        print(printable(f"surfkit: {text}"), file=sys.stderr)
        return status


def _interrupted(words: list[str]) -> int:
    """Say that a command line was interrupted; its exit status."""
    goes_on = "; the same command goes on" if _given(words).goes_on else ""
    print(f"surfkit: interrupted{goes_on}", file=sys.stderr)
    return 130


def _error_line(error: Exception, words: list[str]) -> tuple[str, int] | None:
    """One line for an error that a user can correct, and the exit status; None for a bug."""
    if isinstance(error, (BadInput, Fault)):
        return " ".join(str(error).split()), 2 if isinstance(error, BadInput) else error.status
    if is_out_of_memory(error):
        text = f"{' '.join(words[:1])}: {out_of_memory(error)}"
        _release(error)
        return f"{text}; {_given(words).memory_advice}", 1
    if isinstance(error, (FileExistsError, NotADirectoryError)) and error.filename is not None:
        return f"{os.fsdecode(error.filename)}: a file is in the place of a folder; name another", 2
    if isinstance(error, OSError) and error.filename is not None and error.errno not in DISK_FULL:  # no permission
        return f"{os.fsdecode(error.filename)}: {error.strerror}", 2
    return None


def _release(error: BaseException | None) -> None:
    """Release all that the frames of an error hold, so that there is memory to report it."""
    while error is not None:
        error.__traceback__ = None
        error = error.__cause__ or error.__context__


def _dispatch(words: list[str]) -> int:
    words = as_help(words)
    if not words or words[0] in HELP_FLAGS:
        print(overview())
        return 0
    if words[0] in ("-V", "--version"):
        from surfkit.core.version import own_version

        print(f"surfkit {own_version()}")
        return 0
    name, *rest = words
    from surfkit.cli.parse import parse

    if name not in COMMANDS:
        known = [*COMMANDS, *(added := added_commands())]
        if name not in added:
            raise BadInput(f"no command {name!r}; {_meant(name, known)}commands: {', '.join(known)}")
        command = added[name]
    else:
        command = COMMANDS[name]
    if isinstance(command, LazyCommand):
        command = _loaded(name, command)
    if isinstance(command, dict):
        if not rest or rest[0] not in command:
            wanted = f"surfkit {name} {'|'.join(command)} ..."
            if rest and rest[0] not in (*HELP_FLAGS, "help"):
                raise BadInput(f"{name} has no {rest[0]!r}; {_meant(rest[0], command)}usage: {wanted}")
            first = f"`surfkit {name} {next(iter(command))} --help` tells more."
            print(f"{_given(words).summary}\n\nusage: {wanted}\n\n{first}")
            return 0
        name, command, rest = f"{name} {rest[0]}", command[rest[0]], rest[1:]
    return parse(command, rest, f"surfkit {name}").run() or 0


def _loaded(name: str, command: LazyCommand) -> Any:
    """What the module of a command has as `COMMAND`; BadInput where that of a package cannot be loaded."""
    try:
        return importlib.import_module(command.module).COMMAND
    except (ImportError, AttributeError) as error:
        if name in COMMANDS:
            raise
        raise BadInput(
            f"command {name}: {command.module} of its package cannot be used: {type(error).__name__}: {error}; install "
            "what it needs (`surfkit plugins` names the package)"
        ) from error


def _meant(word: str, known: Iterable[str]) -> str:
    """A question to add to a message, such as "did you mean 'mesh'? "; "" where nothing is near."""
    near = difflib.get_close_matches(word, known, n=1)
    return f"did you mean {near[0]!r}? " if near else ""
