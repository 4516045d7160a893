"""The `surfkit` command: finds the subcommand, runs it, and prints an error that a user can correct as one line.

Each command is a module of this folder with a dataclass named `COMMAND`: its docstring and its fields are the help,
and its `run()` does the work and returns an exit status, or None for 0; or `COMMAND` has several of these, by a second
word. The module is imported by its name, which may be a keyword of Python, and only when its command is asked for.
So `surfkit --help` loads neither torch nor tyro. Packages add commands by the hook `surfkit_commands`; they are loaded
for a word that is none of ours.
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

from surfkit.cli.help_cache import HELP, keep, kept_help, show_kept
from surfkit.cli.streams import (
    READER_LEFT,
    outlive_terminal,
    recorded,
    reopen_closed,
    replace_unknown_letters,
    silence_lost_streams,
)
from surfkit.core.check import BadInput, Fault, printable
from surfkit.core.files import DISK_FULL
from surfkit.core.memory import is_out_of_memory, out_of_memory
from surfkit.core.signals import terminable

COMMANDS = {
    "train": "Train a model, and make its mesh, from photographs with known cameras.",
    "tune": "Train one block of a large scene, in its own process or on another machine.",
    "mesh": "Make the mesh of a finished run, or make it again with other settings.",
    "maps": "Draw maps of a finished run: surface model, orthophoto, contour lines, point cloud, differences.",
    "texture": "Give the mesh of a finished run a texture from the photographs, as OBJ, GLB and 3D Tiles.",
    "compress": "Compress the model of a finished run, or a file of splats.",
    "lod": "Make levels of detail of a finished run, or make them again with other settings.",
    "evaluate": "Measure a finished run on held-out photographs, or its mesh against ground truth.",
    "render": "Draw a finished run along a path of the camera, as a video or as pictures.",
    "view": "Look at a finished run, or a file of splats, a mesh or points, in a browser.",
    "doctor": "Check a data set before training: errors in it, and the memory, disk and time of a run.",
    "status": "Show the progress of a run.",
    "curves": "Draw a chart of the points, the loss or the memory of runs over the steps.",
    "report": "Write a report of runs or of an ablation table as one HTML file.",
    "import": "Take splats from a file of any program, to measure, mesh or export them like those of a run.",
    "export": "Write the splats of a run or of a file in another format, for other programs.",
    "prepare": "Find cameras, points or depth: `prepare photos`, `prepare points`, `prepare depth`.",
    "ablate": "Train every row of an ablation table, and compare the rows.",
    "tables": "List the ablation tables that `surfkit ablate` accepts, or the rows of one.",
    "recipes": "List the recipes that `surfkit train recipe:NAME` accepts.",
    "components": "List the components that recipes are made of, by kind.",
    "plugins": "List the plugins: package, components, and the error if one does not load.",
    "new": "Write the files of a new plugin, with a working part and its tests: `new plugin`.",
}
"""What there is to run, with the line that `surfkit --help` shows."""
BEGIN = (
    "To begin, `surfkit prepare photos FOLDER` makes a data set of photographs or a video, and `surfkit doctor DATA` "
    "checks one that is there."
)
"""What `surfkit --help` says to those who are new."""
MORE = "`surfkit help COMMAND` tells more. `surfkit plugins` lists the commands that packages add."
"""What it ends with."""
RESUMED = ("train", "tune", "prepare", "ablate", "maps", "texture", "render")
"""Commands that go on with what an interrupted one has done."""
MEMORY_ADVICE = {
    "train": "smaller photographs (--longest, --scale) or fewer points need less",
    "import": "smaller photographs (--longest, --scale) or mesh:none need less",
    "mesh": "mesh:tsdf, a larger --mesh.voxel or a lower --memory need less, mesh:tetra with a higher --mesh.faint too",
    "maps": "a smaller --tile needs less",
    "texture": "a lower --memory, a larger --texel or a smaller --size need less",
    "lod": "a lower --memory or --lod.steps 0 need less",
    "evaluate": "with --gt fewer --samples, a larger --voxel or a smaller --crop need less, else smaller photographs",
    "render": "a smaller --size needs less",
    "doctor": "--probe 0, --quick or smaller photographs (--longest, --scale) need less",
    "prepare": "a lower --longest or --estimator.longest needs less",
}
"""What a user can lower when a command runs out of memory."""


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
        textwrap.fill(text, width, initial_indent=f"  {name}".ljust(column), subsequent_indent=" " * column)
        for name, text in COMMANDS.items()
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


def added_commands() -> dict[str, type]:
    """The commands of packages, by the word that users type.

    Raises:
        BadInput: Two packages offer one under the same name, or one has the name of a command of surfkit.
    """
    from surfkit.core.registry import offered_once

    found = offered_once("surfkit_commands", "a command")
    if taken := sorted(found.keys() & COMMANDS.keys()):
        raise BadInput(
            f"a package offers a command named {taken[0]!r}, which surfkit has (`surfkit plugins` lists them); "
            "uninstall it, or leave it out with SURFKIT_PLUGINS=none"
        )
    return found


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
        goes_on = "; the same command goes on" if words and words[0] in RESUMED else ""
        print(f"surfkit: interrupted{goes_on}", file=sys.stderr)
        return 130
    except SystemExit as stop:  # --help, and rich when nobody reads its output any more
        if isinstance(stop.code, str):
            raise
        if stop.code == 1:
            silence_lost_streams()
            return READER_LEFT
        return stop.code or 0
    except Exception as error:
        if (found := _error_line(error, words)) is None:
            raise
        text, status = found
        print(printable(f"surfkit: {text}"), file=sys.stderr)
        return status


def _error_line(error: Exception, words: list[str]) -> tuple[str, int] | None:
    """One line for an error that a user can correct, and the exit status; None for a bug."""
    if isinstance(error, (BadInput, Fault)):
        return " ".join(str(error).split()), 2 if isinstance(error, BadInput) else error.status
    if is_out_of_memory(error):
        text = f"{' '.join(words[:1])}: {out_of_memory(error)}"
        _release(error)
        return f"{text}; {MEMORY_ADVICE.get(words[0], 'more memory is needed')}", 1
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
    if not words or words[0] in HELP:
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
        return parse(added[name], rest, f"surfkit {name}").run() or 0
    command = importlib.import_module(f"surfkit.cli.{name}").COMMAND
    if isinstance(command, dict):
        if not rest or rest[0] not in command:
            wanted = f"surfkit {name} {'|'.join(command)} ..."
            if rest and rest[0] not in (*HELP, "help"):
                raise BadInput(f"{name} has no {rest[0]!r}; {_meant(rest[0], command)}usage: {wanted}")
            print(f"{COMMANDS[name]}\n\nusage: {wanted}\n\n`surfkit {name} {next(iter(command))} --help` tells more.")
            return 0
        name, command, rest = f"{name} {rest[0]}", command[rest[0]], rest[1:]
    return parse(command, rest, f"surfkit {name}").run() or 0


def _meant(word: str, known: Iterable[str]) -> str:
    """A question to add to a message, such as "did you mean 'mesh'? "; "" where nothing is near."""
    near = difflib.get_close_matches(word, known, n=1)
    return f"did you mean {near[0]!r}? " if near else ""
