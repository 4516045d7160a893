import contextlib
import errno
import importlib
import io
import os
import re
import signal
import subprocess
import sys
import types
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
import pytest
import torch

from surfkit.cli import COMMANDS, main
from surfkit.cli.parse import parse
from surfkit.core.check import BadInput
from surfkit.core.codec import write_json
from surfkit.core.hooks import hookimpl

OK = ("train", "recipe:discs", "--data", "d")


def command(monkeypatch, run):
    """Put a command named `export` in place that does `run`."""

    @dataclass(frozen=True)
    class Export:
        """Do it."""

        def run(self):
            return run()

    module = types.ModuleType("surfkit.apps.export")
    module.COMMAND = Export
    monkeypatch.setitem(sys.modules, "surfkit.apps.export", module)


def test_help_lists_every_command(capsys):
    assert main(["--help"]) == main([]) == 0
    out = " ".join(capsys.readouterr().out.split())  # texts are wrapped
    assert all(f" {name} {command.summary}" in out for name, command in COMMANDS.items())


def test_version(capsys):
    assert main(["--version"]) == 0
    assert re.fullmatch(r"surfkit \S+\n", capsys.readouterr().out)


def test_settings_and_choices_in_any_order(world, capsys):
    wanted = world.Train(
        replace(
            world.Recipe("Flat\n  discs."),
            pretrain=world.Stage(grow=world.Relocate(cap=5), losses={"l1": world.L1(0.5), "depth": world.Depth()}),
            tune=world.Stage(steps=8),
        ),
        world.Path("d"),
    )
    choices = ["recipe:discs", "pretrain.grow:relocate", "tune:stage"]
    flags = ["--data", "d", "--pretrain.grow.cap", "5", "--pretrain.losses.l1.weight", "0.5", "--tune.steps", "8"]
    for words in ([*choices, *flags], [*flags, *choices], [*flags[:6], *choices[::-1], *flags[6:]]):
        assert main(["train", *words]) == 0
        assert capsys.readouterr().out == f"{wanted}\n"


def test_the_default_part_may_be_named(world, capsys):
    assert main([*OK, "--pretrain.grow.every", "7", "pretrain.grow:adaptive"]) == 0
    assert "Adaptive(every=7" in capsys.readouterr().out


def test_none_and_tuple_positions(world, capsys):
    words = ["train", "recipe:balls", "--data", "d", "pretrain.grow:none", "pretrain.prune.0:adaptive"]
    assert main([*words, "--pretrain.prune.0.every", "3"]) == 0
    out = capsys.readouterr().out
    assert "grow=None" in out and "prune=(Adaptive(every=3" in out


@pytest.mark.parametrize("width", [80, 120])
def test_texts_of_settings_fill_the_lines(capsys, monkeypatch, width):
    """The first word of a line never fits on the line before."""
    monkeypatch.setenv("COLUMNS", str(width))
    assert main(["train", "recipe:citygs2", "--help"]) == 0
    lines = capsys.readouterr().out.replace("│", " ").splitlines()
    lines = [line.strip() if re.match(" {8}\\S", line) else "" for line in lines]
    pairs = [(line, then) for line, then in pairwise(lines) if line and then]
    assert len(pairs) > 50
    ragged = [line for line, then in pairs if len(f"{line} {then.split()[0]}") <= width - 10]
    assert not ragged


def test_help_of_a_command_shows_recipes_and_settings(world, capsys):
    assert main(["train", "--help"]) == 0
    assert re.search(r"recipe:balls +Round balls\.", capsys.readouterr().out)
    assert main(["train", "recipe:discs", "--help"]) == 0
    out = capsys.readouterr().out
    assert "--pretrain.grow.every" in out and "Steps between edits" in out and "pretrain.grow:relocate" in out


@pytest.mark.parametrize(
    ("words", "line"),
    [
        (["trian"], "no command 'trian'; did you mean 'train'? commands: make, train, train-block, mesh, maps,"),
        (["train", "recipe:discs"], "--data PATH missing; see surfkit train --help"),
        (["train", "--data", "d"], "no recipe chosen: add one of recipe:discs, recipe:balls"),
        (["train", "--pretrain.steps", "5"], "no recipe chosen: add one of recipe:discs, recipe:balls"),
        (
            ["train", "recipe:dics", "--data", "d"],
            "no recipe named 'dics'; did you mean 'discs'? known: discs, balls; or",
        ),
        ([*OK, "recipe:balls"], "recipe is chosen twice: recipe:discs, recipe:balls; keep one"),
        ([*OK, "pretrain.grow:adaptve"], "no pretrain.grow named 'adaptve'; did you mean 'adaptive'? known: adaptive,"),
        (
            [*OK, "pretrain.grwo:none"],
            "nothing to choose at 'pretrain.grwo'; did you mean 'pretrain.grow'? choices are",
        ),
        ([*OK, "tune:stag"], "no tune named 'stag'; did you mean 'stage'? known: stage, none"),
        ([*OK, "stray"], "unexpected 'stray'; settings are given as --NAME VALUE"),
        ([*OK, "--pretrain.steps", "3", "--zzzzzz", "3"], "no option --zzzzzz; see surfkit train --help"),
        ([*OK, "--devic", "cpu"], "no option --devic; perhaps you meant --device"),
        ([*OK, "--pretrain.stepz", "3"], "no option --pretrain.stepz; perhaps you meant --pretrain.steps"),
        ([*OK, "--pretrain.stepz=3", "--dat", "x"], "no option --pretrain.stepz; perhaps you meant --pretrain.steps"),
        ([*OK, "--stepz", "3"], "no option --stepz; perhaps you meant --pretrain.steps"),
        (["doctor", "--quik"], "no option --quik; perhaps you meant --quick"),
        (["prepare", "depth"], "PATH missing; see surfkit prepare depth --help"),
        ([*OK, "--zzzzzz"], "no option --zzzzzz; see surfkit train --help"),
        (
            [*OK, "--pretrain.grow.cap", "3"],
            "--pretrain.grow.cap does not apply here; it belongs to pretrain.grow:relocate, which is not chosen",
        ),
        ([*OK, "--pretrain.steps", "many"], "--pretrain.steps: expected a whole number, got 'many'"),
        ([*OK, "--pretrain.losses.l1.weight", "x"], "--pretrain.losses.l1.weight: expected a number, got 'x'"),
        (
            [*OK, "--pretrain.losses.depth.until", "x"],
            "--pretrain.losses.depth.until: expected none or a whole number, got 'x'",
        ),
        ([*OK, "--pretrain.steps"], "--pretrain.steps: a value must follow"),
        (["evaluate", "RUN", "--seen"], "--seen: a value must follow"),
        (["mesh", "RUN", "--lods"], "--lods: a value must follow"),
        (["mesh", "RUN", "--lods", "--formats", "ply"], "--lods: a value must follow"),
        ([*OK, "--device", "tpu"], "--device: expected one of 'auto', 'cpu', got 'tpu'"),
        ([*OK, "--pretrain.losses.depth.start", "-1"], "pretrain.losses.depth: start is -1; it must be 0 or more"),
        (["train", "recipe:no.json", "--data", "d"], "no.json: no such file"),
        (["components", "gorw"], "no kind of component named 'gorw'; did you mean 'grow'? known: grow, loss"),
    ],
)
def test_what_users_get_wrong_is_one_line(world, capsys, words, line):
    assert main(words) == 2
    said = capsys.readouterr().err
    assert said.startswith(f"surfkit: {line}")
    assert said.count("\n") == 1 and said.endswith("\n")


def test_a_recipe_from_a_file(world, capsys, tmp_path):
    path = tmp_path / "my_runs" / "A b" / "recipe.json"
    write_json(path, world.Recipe("mine", pretrain=world.Stage(steps=77)))
    assert main(["train", f"recipe:{path}", "--data", "d", "--pretrain.grow.every", "9"]) == 0
    out = capsys.readouterr().out
    assert "steps=77" in out and "every=9" in out
    write_json(path, {"pretrain": {"stepz": 1}})
    assert main(["train", f"recipe:{path}", "--data", "d"]) == 2
    assert capsys.readouterr().err.startswith(f"surfkit: {path}: pretrain.stepz: unknown setting; Stage has steps")


def test_lists(world, bare, capsys):
    class Listener:
        @hookimpl
        def surfkit_event(self, event):
            pass

    class Broken:
        @hookimpl
        def surfkit_recipes(self):
            raise RuntimeError("no network")

    bare.plugins().register(Listener(), "logger")
    bare.plugins().register(Broken(), "broken")
    assert main(["recipes"]) == 0
    assert capsys.readouterr().out.splitlines() == [
        "recipe  what it is",
        "discs   Flat discs.",
        "balls   Round balls.",
    ]
    assert main(["components", "grow"]) == 0
    assert [line.split() for line in capsys.readouterr().out.splitlines()[1:]] == [
        ["grow", "adaptive", "Clone", "and", "split.", "stand-in"],
        ["grow", "relocate", "Move", "dead", "points", "|", "to", "live", "ones.", "stand-in"],
    ]
    assert main(["plugins"]) == 0
    out = capsys.readouterr().out
    assert re.search(r"^stand-in +l1, depth, adaptive, relocate, recipe:discs, recipe:balls$", out, re.M)
    assert re.search(r"^logger +listens to events$", out, re.M)
    assert re.search(r"^broken +not in use: surfkit_recipes: RuntimeError: no network$", out, re.M)


def test_markdown(world, capsys):
    assert main(["components", "--markdown"]) == 0
    out = capsys.readouterr().out
    assert "## grow\n\nHow points multiply.\n\n### `adaptive`\n\nClone and split.\n" in out
    assert "| `every` | int | `100` | Steps between edits, at least one. |" in out
    assert "## loss" in out


def test_a_terminal_gets_colours(world, bare, monkeypatch):
    screen = io.StringIO()
    screen.isatty = lambda: True
    monkeypatch.setenv("COLUMNS", "100")
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setattr(sys, "stdout", screen)
    bare.plugins().register(types.SimpleNamespace(), "idle")
    assert main(["recipes"]) == 0
    assert "\x1b[" in screen.getvalue() and "Round balls." in screen.getvalue()


def test_bad_input_and_interrupts_are_one_line(monkeypatch, capsys):
    def bad():
        raise BadInput("data:\n  no images")

    def interrupted():
        raise KeyboardInterrupt

    command(monkeypatch, bad)
    assert (main(["export"]), capsys.readouterr().err) == (2, "surfkit: data: no images\n")
    command(monkeypatch, interrupted)
    assert (main(["export"]), capsys.readouterr().err) == (130, "surfkit: interrupted\n")
    monkeypatch.setitem(COMMANDS, "export", replace(COMMANDS["export"], goes_on=True))
    assert (main(["export"]), capsys.readouterr().err) == (130, "surfkit: interrupted; the same command goes on\n")

    def while_a_class_is_made():  # as Python 3.11 has it, where modules are loaded
        raise RuntimeError("Error calling __set_name__ on 'cached_property' instance") from KeyboardInterrupt()

    command(monkeypatch, while_a_class_is_made)
    assert (main(["export"]), capsys.readouterr().err) == (130, "surfkit: interrupted; the same command goes on\n")
    command(monkeypatch, lambda: 3)
    assert main(["export"]) == 3


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP])
def test_sigterm_and_a_closed_terminal_are_an_interrupt(monkeypatch, capsys, hangs_up, number):
    before, after = signal.getsignal(number), []

    def asked():
        try:
            os.kill(os.getpid(), number)
        finally:
            if number == signal.SIGHUP:  # comes again, while what is begun is put away
                os.kill(os.getpid(), number)
            after.append("put away")

    command(monkeypatch, asked)
    assert (main(["export"]), capsys.readouterr().err) == (130, "surfkit: interrupted\n")
    assert signal.getsignal(number) == before and after == ["put away"]


def test_under_nohup_a_closed_terminal_is_ignored(monkeypatch):
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        command(monkeypatch, lambda: os.kill(os.getpid(), signal.SIGHUP))
        assert main(["export"]) == 0 and signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
    finally:
        signal.signal(signal.SIGHUP, before)


@pytest.mark.parametrize("module", ["surfkit", "surfkit.cli"])
def test_it_runs_as_a_module(module, tmp_path):
    """Where the command is not on the PATH; its exit status is that of the process."""
    run = [sys.executable, "-m", module]
    done = subprocess.run([*run, "--version"], capture_output=True, text=True, cwd=tmp_path)
    assert (done.returncode, done.stderr) == (0, "") and done.stdout.startswith("surfkit ")
    done = subprocess.run([*run, "trian"], capture_output=True, text=True, cwd=tmp_path)
    assert done.returncode == 2 and done.stderr.startswith("surfkit: no command 'trian'; did you mean 'train'?")


OUTLIVES = """
import sys
from pathlib import Path
from surfkit.cli.standard_streams import outlive_terminal
outlive_terminal()
outlive_terminal()
print("on the terminal", flush=True)
sys.stdin.readline()
for stream in (sys.stdout, sys.stderr) * 2:
    print("to nobody", file=stream, flush=True)
Path(sys.argv[1]).write_text("saved")
"""


def test_output_to_a_terminal_that_was_closed_ends_nothing(tmp_path):
    ours, theirs = os.openpty()
    words = [sys.executable, "-c", OUTLIVES, str(tmp_path / "state")]
    with subprocess.Popen(words, stdin=subprocess.PIPE, stdout=theirs, stderr=theirs) as process:
        os.close(theirs)
        assert os.read(ours, 100) == b"on the terminal\r\n"
        os.close(ours)
        process.communicate(b"now\n")
    assert process.returncode == 0 and (tmp_path / "state").read_text() == "saved"


def test_our_own_mistakes_keep_their_traceback(monkeypatch):
    def broken():
        raise ValueError("a bug")

    command(monkeypatch, broken)
    with pytest.raises(ValueError, match="a bug"):
        main(["export"])


@pytest.mark.parametrize(
    ("encoding", "text", "shown"),
    [("ascii", "20.1 ± 0.3 m³", b"20.1 ? 0.3 m?"), ("utf-8", "wall-\udce9 ±", b"wall-? \xc2\xb1")],
)
def test_letters_that_the_terminal_lacks_are_question_marks(monkeypatch, encoding, text, shown):
    """Also names of files whose bytes are no UTF-8: the work is done, and then its place is printed."""
    raw = io.BytesIO()
    monkeypatch.setattr(sys, "stdout", io.TextIOWrapper(raw, encoding))
    command(monkeypatch, lambda: print(text))
    assert main(["export"]) == 0 and raw.getvalue() == shown + b"\n"


@pytest.mark.parametrize("unbuffered", ["", "1"])
def test_a_closed_pipe_is_quiet(unbuffered):
    code = "import sys; from surfkit.cli import main; sys.exit(main(['--help']))"
    reader, writer = os.pipe()
    os.close(reader)
    environ = os.environ | {"PYTHONUNBUFFERED": unbuffered}
    words = [sys.executable, "-c", code]
    done = subprocess.run(words, stdout=writer, stderr=subprocess.PIPE, env=environ, check=False)
    os.close(writer)
    assert (done.returncode, done.stderr) == (141, b"")


def ended(words, shell):
    """Exit status and stderr of a command whose streams a shell sets up."""
    code = f"import sys; from surfkit.cli import main; sys.exit(main({list(words)}))"
    line = f'"$0" -c "$1" {shell}'
    environ = os.environ | {"SURFKIT_PLUGINS": "none"}
    done = subprocess.run(["bash", "-c", line, sys.executable, code], capture_output=True, env=environ, check=False)
    return done.returncode, done.stderr.decode()


@pytest.mark.parametrize(
    ("words", "shell", "status", "said"),
    [
        (["--help"], ">&-", 0, ""),
        (["train", "--help"], ">&- <&- 2>&-", 0, ""),
        (["trian"], ">&-", 2, "surfkit: no command 'trian'"),
        (["--help"], ">/dev/full", 1, "surfkit: standard output: No space left on device"),
        (["--help"], "1</dev/null", 1, "surfkit: standard output: Bad file descriptor"),
        (["train", "--help"], "| true; exit ${PIPESTATUS[0]}", 141, ""),
        (["trian"], "2>&1 >/dev/null | true; exit ${PIPESTATUS[0]}", 141, ""),
    ],
)
def test_outputs_that_take_nothing_are_one_line_at_most(words, shell, status, said):
    found, line = ended(words, shell)
    assert found == status and line.startswith(said) and line.count("\n") == bool(said)


def test_rich_that_finds_no_reader_is_as_quiet(monkeypatch):
    def stopped():
        raise SystemExit(1)  # as rich does then

    command(monkeypatch, stopped)
    assert main(["export"]) == 141


def test_a_closed_stdout_takes_no_number_of_a_file(tmp_path):
    """What a library writes to file 1 must not land in a file of ours."""
    code = (
        "import os; from surfkit.cli import main; main(['--help']); file = open('x', 'w'); os.write(1, b'noise');"
        "file.write('ours'); file.close(); os.system('echo more')"
    )
    subprocess.run(["bash", "-c", '"$0" -c "$1" >&-', sys.executable, code], cwd=tmp_path, check=True)
    assert (tmp_path / "x").read_text() == "ours"


class Big:
    """Something large that a frame holds."""

    alive = 0

    def __init__(self):
        Big.alive += 1

    def __del__(self):
        Big.alive -= 1


def numpy_error():
    np.empty(2**60, np.uint8)


def torch_error():
    torch.empty(2**60, dtype=torch.uint8)


def python_error():
    big = Big()  # noqa: F841
    raise MemoryError


def system_error():
    raise OSError(errno.ENOMEM, "Cannot allocate memory")


def qhull_error():
    raise RuntimeError("QH6082 qhull error (qh_memalloc): insufficient memory")


@pytest.mark.parametrize(
    ("fails", "wanted"),
    [
        (numpy_error, " and 1.00 EiB more wanted"),
        (torch_error, " and 1073741824.0 GiB more wanted"),
        (python_error, ""),
        (system_error, ""),
        (qhull_error, ""),
    ],
)
def test_memory_that_gives_out_is_one_line(monkeypatch, capsys, fails, wanted):
    command(monkeypatch, fails)
    assert main(["export"]) == 1
    pattern = rf"surfkit: export: out of memory with [\d.]+ GiB held{re.escape(wanted)}; more memory is needed\n"
    assert re.fullmatch(pattern, capsys.readouterr().err) and Big.alive == 0


@pytest.mark.parametrize("name", [name for name, command in COMMANDS.items() if "--" in command.memory_advice])
def test_what_to_lower_when_memory_gives_out_exists(name):
    command = importlib.import_module(COMMANDS[name].module).COMMAND
    command = command["depth"] if isinstance(command, dict) else command
    flags = re.findall(r"--[\w.-]+", COMMANDS[name].memory_advice)
    choices = re.findall(r"\w+:[\w-]+", COMMANDS[name].memory_advice)
    assert flags
    for words in [choices[at : at + 1] for at in range(max(1, len(choices)))]:
        helped = io.StringIO()
        with contextlib.redirect_stdout(helped), pytest.raises(SystemExit):
            parse(command, [*words, "--help"], "surfkit")
        flags = [flag for flag in flags if not re.search(rf"{re.escape(flag)}\b", helped.getvalue())]
    assert not flags


def test_other_errors_without_a_file_are_mistakes_of_ours(monkeypatch):
    def broken():
        raise OSError(errno.ENOTCONN, "not connected")

    command(monkeypatch, broken)
    with pytest.raises(OSError, match="not connected"):
        main(["export"])


def test_a_full_disk_is_one_line_in_any_command(monkeypatch, capsys):
    def full():
        raise OSError(errno.ENOSPC, "No space left on device")

    command(monkeypatch, full)
    assert main(["export"]) == 1
    assert capsys.readouterr().err.startswith("surfkit: what was being written: No space left on device")


def test_help_loads_neither_torch_nor_tyro():
    code = (
        "import sys, surfkit; from surfkit.cli import main; main(['--help']); main(['--version']);"
        "print([name for name in ('torch', 'numpy', 'tyro') if name in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[-1] == "[]"


def test_help_names_no_none_of_python_and_none_is_a_value(world, capsys):
    assert main(["train", "recipe:discs", "--help"]) == 0
    out = capsys.readouterr().out
    assert "None" not in out and re.search(r"--pretrain\.losses\.depth\.until INT\b", out)
    for word in ("none", "None"):
        words = ["train", "recipe:balls", "--data", "d", "pretrain.losses.depth:depth"]
        assert main([*words, "--pretrain.losses.depth.until", word]) == 0
        assert "until=None" in capsys.readouterr().out


def test_no_part_of_surfkit_shows_none_of_python(capsys):
    for command in ("train", "evaluate", "mesh", "maps"):
        assert main([command, *["recipe:citygs2"] * (command == "train"), "--help"]) == 0
        assert "None" not in capsys.readouterr().out


@pytest.mark.parametrize("width", [60, 100])
def test_prose_of_help_is_wrapped(capsys, monkeypatch, width):
    monkeypatch.setenv("COLUMNS", str(width))
    assert main(["mesh", "--help"]) == 0
    about = capsys.readouterr().out.split("\n\n")[1:-1]
    lines = "\n".join(part for part in about if "─" not in part).splitlines()
    assert len(lines) > 2 and max(map(len, lines)) <= width
    assert main(["--help"]) == 0
    assert max(map(len, capsys.readouterr().out.splitlines()[5:])) <= width


def test_help_of_a_command_by_either_order(world, capsys):
    assert main(["help", "train"]) == main(["train", "--help"]) == 0
    out = capsys.readouterr().out
    assert out[: len(out) // 2] == out[len(out) // 2 :] != ""


@pytest.mark.parametrize(
    ("words", "line"),
    [
        (["discs"], "no recipe chosen: unexpected 'discs'; did you mean recipe:discs?"),
        (["dics", "--data", "d"], "no recipe chosen: unexpected 'dics'; did you mean recipe:discs?"),
        (
            ["a/scene"],
            "unexpected 'a/scene'; did you mean --data a/scene? And no recipe chosen: add one",
        ),
        ([*OK[1:], "relocate"], "unexpected 'relocate'; did you mean pretrain.grow:relocate?"),
        ([*OK[1:], "a/scene"], "unexpected 'a/scene'; did you mean --data a/scene?"),
    ],
)
def test_words_without_their_slot_or_flag(world, capsys, words, line):
    assert main(["train", *words]) == 2
    assert capsys.readouterr().err.startswith(f"surfkit: {line}")
