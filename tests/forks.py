"""Processes of surfkit that need not load torch again: they are forked from one that has done nothing but that."""

import multiprocessing
import os
import runpy
import sys
from collections.abc import Callable
from multiprocessing.process import BaseProcess
from pathlib import Path

CONTEXT = multiprocessing.get_context("forkserver")
CONTEXT.set_forkserver_preload(["torch.fx.experimental.symbolic_shapes", "surfkit.runs.pipeline", "surfkit.apps.train"])


def started(
    words: list[str], log: Path, cache: Path | None = None, before: Callable[[], object] | None = None
) -> BaseProcess:
    """A new process that runs the command line in one thread.

    Args:
        words: What follows `surfkit`.
        log: A file for what it prints.
        cache: Folder of the user's cache; that of this process if None.
        before: Called first.
    """
    given = os.environ | ({} if cache is None else {"SURFKIT_CACHE": str(cache)})
    process = CONTEXT.Process(target=_command, args=(words, log, given, before))
    process.start()
    return process


def _command(words: list[str], log: Path, given: dict[str, str], before: Callable[[], object] | None) -> None:
    from surfkit.cli import main

    _prepare(given, log, 1)
    if before is not None:
        before()
    sys.exit(main(words))


class Probing:
    """What `probe` asks of a context of `multiprocessing`: its process has the environment of its parent at its start.

    A forked process would have that in which the first one of all was started, in some other test.
    """

    Pipe = staticmethod(CONTEXT.Pipe)

    @staticmethod
    def Process(target: Callable[..., None], args: tuple, daemon: bool) -> BaseProcess:
        return CONTEXT.Process(target=_within, args=(dict(os.environ), target, args), daemon=daemon)


def _within(given: dict[str, str], target: Callable[..., None], args: tuple) -> None:
    _surroundings(given)
    target(*args)


class Forked:
    """What `Pool` asks of `subprocess.Popen`, of a process of Python; that it is forked from is its driver."""

    def __init__(self, words, env, stdin, stdout, stderr, start_new_session):
        assert stdout is stderr and start_new_session
        self.process = CONTEXT.Process(target=_python, args=(words[1:], env, stdout.name))
        self.process.start()

    @property
    def returncode(self):
        return self.process.exitcode

    def poll(self):
        return self.process.exitcode

    def terminate(self):
        self.process.terminate()

    def wait(self):
        self.process.join()
        return self.process.exitcode


def _python(words: list[str], given: dict[str, str], log: Path) -> None:
    """`python -c CODE` or `python -m MODULE`, with what follows."""
    from surfkit.runs.execute.remote import DRIVER

    os.setsid()
    _prepare(given | {DRIVER: str(os.getppid())}, log, int(given["OMP_NUM_THREADS"]))
    how, what, *rest = words
    sys.argv = [what, *rest]
    if how == "-c":
        exec(what, {"__name__": "__main__"})
    else:
        runpy.run_module(what, run_name="__main__", alter_sys=True)


def _prepare(given: dict[str, str], log: Path, threads: int) -> None:
    """This process gets an environment, threads, and a file for what it prints."""
    import torch

    torch.set_num_threads(threads)
    _surroundings(given)
    with open(log, "ab") as file:
        os.dup2(file.fileno(), 1)
        os.dup2(file.fileno(), 2)


def _surroundings(given: dict[str, str]) -> None:
    os.environ.clear()
    os.environ.update(given)
