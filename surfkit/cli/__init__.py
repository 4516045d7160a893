"""The `surfkit` command: finds the subcommand, runs it, and turns what a user can put right into one line.

Each command is a module of this folder with a dataclass named `COMMAND`: its docstring and its fields are the help,
and its `run()` does the work and returns an exit status, or None for 0; or `COMMAND` has several of these, by a second
word. The module is imported only when its command
is asked for, so `surfkit --help` loads neither torch nor tyro.
"""

from __future__ import annotations

import difflib
import importlib
import os
import select
import sys
from collections.abc import Sequence

from surfkit.core.check import BadInput, Fault

COMMANDS = {
    "train": "Reconstruct a surface from photographs with known cameras.",
    "tune": "Tune one block of a run, in a process or on a machine of its own.",
    "mesh": "Make the mesh of a finished run, or make it again with other settings.",
    "evaluate": "Measure a finished run on photographs it has not seen, or its mesh against true geometry.",
    "doctor": "Examine a data set before training: faults, and what a run takes.",
    "status": "Tell where a run stands.",
    "curves": "Draw how the points, the loss or the memory of runs went, step by step.",
    "export": "Write the result of a run for other programs.",
    "prepare": "Make what a data set may need before training: `prepare depth`.",
    "ablate": "Train every row of an ablation table, and compare the rows.",
    "recipes": "List the recipes that `surfkit train recipe:NAME` accepts.",
    "components": "List the parts that recipes are made of, by kind.",
    "plugins": "List the plugins: where each comes from, what it offers, why it failed.",
}
"""What there is to run, with the line that `surfkit --help` shows."""


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command line and return its exit status.

    2 is for words and data that the user can put right, 1 for a run that ran out of memory, disk or finite numbers, 3
    for one with blocks that failed, and 130 for one that was interrupted.

    Args:
        argv: Words after `surfkit`; those of this process if None.
    """
    words = list(sys.argv[1:] if argv is None else argv)
    # Idle threads of torch would otherwise spin, and burn as much processor time as the work itself.
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    try:
        status = _guarded(words)
        sys.stdout.flush()
        return status
    except BrokenPipeError:
        if _reader_left():
            return 141  # what a shell reports for a program that SIGPIPE ends
        raise


def overview() -> str:
    """The text of `surfkit --help`."""
    width = max(map(len, COMMANDS))
    lines = [f"  {name:<{width}}  {text}" for name, text in COMMANDS.items()]
    return "\n".join(
        [
            "surfkit reconstructs surfaces of large scenes from photographs, with Gaussian splatting.",
            "",
            "usage: surfkit COMMAND ...",
            "       surfkit --help | --version",
            "",
            *lines,
            "",
            "`surfkit COMMAND --help` tells more.",
        ]
    )


def _guarded(words: list[str]) -> int:
    """The exit status of a command line, with one line on stderr for what is not a mistake of ours."""
    try:
        return _dispatch(words)
    except (BadInput, Fault) as error:
        print(f"surfkit: {' '.join(str(error).split())}", file=sys.stderr)
        return 2 if isinstance(error, BadInput) else error.status
    except BrokenPipeError:
        raise
    except OSError as error:  # no permission, a folder in the place of a file, a disk that is gone
        if error.filename is None:
            raise
        print(f"surfkit: {os.fsdecode(error.filename)}: {error.strerror}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("surfkit: interrupted", file=sys.stderr)
        return 130
    except SystemExit as stop:  # --help, and rich when nobody reads its output any more
        if isinstance(stop.code, str):
            raise
        return stop.code or 0


def _dispatch(words: list[str]) -> int:
    if not words or words[0] in ("-h", "--help", "help"):
        print(overview())
        return 0
    if words[0] in ("-V", "--version"):
        from surfkit.core.version import own_version

        print(f"surfkit {own_version()}")
        return 0
    name, *rest = words
    if name not in COMMANDS:
        near = difflib.get_close_matches(name, COMMANDS, n=1)
        hint = f"did you mean {near[0]!r}? " if near else ""
        raise BadInput(f"no command {name!r}; {hint}commands: {', '.join(COMMANDS)}")
    command = importlib.import_module(f"surfkit.cli.{name}").COMMAND
    from surfkit.cli.parse import parse

    if isinstance(command, dict):
        if not rest or rest[0] not in command:
            wanted = f"surfkit {name} {'|'.join(command)} ..."
            if rest and rest[0] not in ("-h", "--help", "help"):
                raise BadInput(f"nothing named {rest[0]!r} to {name}; usage: {wanted}")
            print(f"{COMMANDS[name]}\n\nusage: {wanted}\n\n`surfkit {name} {next(iter(command))} --help` tells more.")
            return 0
        name, command, rest = f"{name} {rest[0]}", command[rest[0]], rest[1:]
    return parse(command, rest, f"surfkit {name}").run() or 0


def _reader_left() -> bool:
    """Whether it is our own output that broke; it then goes nowhere, so that Python can exit without a word."""
    try:
        output = sys.stdout.fileno()
    except OSError:  # not a file, so not a pipe either
        return False
    watch = select.poll()
    watch.register(output, 0)
    broken = any(state & (select.POLLERR | select.POLLHUP) for _, state in watch.poll(0))
    if broken:
        os.dup2(os.open(os.devnull, os.O_WRONLY), output)
    return broken
