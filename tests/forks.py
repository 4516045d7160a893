"""Processes of surfkit that need not load torch again: they are forked from one that has done nothing but that."""

import multiprocessing
import os
import sys
from collections.abc import Callable
from multiprocessing.process import BaseProcess
from pathlib import Path

CONTEXT = multiprocessing.get_context("forkserver")
CONTEXT.set_forkserver_preload(["torch.fx.experimental.symbolic_shapes", "surfkit.pipeline", "surfkit.cli.train"])


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
    import torch

    from surfkit.cli import main

    torch.set_num_threads(1)
    os.environ.clear()
    os.environ.update(given)
    with open(log, "ab") as file:
        os.dup2(file.fileno(), 1)
        os.dup2(file.fileno(), 2)
    if before is not None:
        before()
    sys.exit(main(words))
