"""A command that is run on another machine, which sees the same folders.

What is imported here is all that the agents of a cluster load for it: no torch, only what starts and stops a process.
"""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from surfkit.core.version import own_version

DRIVER = "SURFKIT_DRIVER"
"""Names the process that a worker works for; without it, the worker stops."""
INTERRUPTED, CRASHED = 130, 70
"""Exit statuses: someone asked to stop; something went wrong that nobody foresaw."""
POLL_S = 0.2
CARRIED = ("PYTHONPATH", "SURFKIT_PLUGINS")
"""Variables of whoever asks, without which another machine might run other code."""
WATCHDOG = f"""
import os, signal, subprocess, sys
agent = int(os.environ["{DRIVER}"])
for number in (signal.SIGUSR1, signal.SIGUSR2):
    signal.signal(number, signal.SIG_IGN)
child = subprocess.Popen([sys.executable, *sys.argv[1:]], env=os.environ | {{"{DRIVER}": str(os.getpid())}})
signal.signal(signal.SIGTERM, lambda *_: child.terminate())
while True:
    try:
        status = child.wait({POLL_S})
        break
    except subprocess.TimeoutExpired:
        if agent and os.getppid() != agent:
            agent = 0
            child.terminate()
if status < 0:
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    os.kill(os.getpid(), -status)
sys.exit(status)
"""
"""Stands between an agent and the command, and stops it when the agent is gone. An agent of Ray that has to go kills
its children first, without a chance to save anything; that is this process, and the command notices that it is alone.
By SIGUSR2, Slurm tells every process of a job that its time is nearly up; the agent knows what to do then."""


@dataclass(frozen=True)
class Outcome:
    """What became of an errand.

    Attributes:
        status: Exit status; negative for the signal that ended it.
        host: Where.
        why: Why it was not even begun.
    """

    status: int
    host: str
    why: str | None = None


@dataclass
class RemoteJob:
    """A command, and what its machine has to have.

    Attributes:
        words: After `python`.
        log: Gets what it prints; its folder must be there, and writable.
        needs: Paths that must be there, too.
        threads: That it may use.
        version: Of surfkit, which must be the same.
        carried: Variables of the environment of whoever asks.
        hold_s: Seconds to wait for our own end when someone else interrupted the command: when a cluster preempts a
            job, it tells every process, and it is not for us to call the job done.
        process: The one that was started here.
    """

    words: tuple[str, ...]
    log: Path
    needs: tuple[Path, ...] = ()
    threads: int = 1
    version: str = field(default_factory=own_version)
    carried: Mapping[str, str] = field(default_factory=lambda: _carried())
    hold_s: float = 0.0
    process: subprocess.Popen[bytes] | None = None

    def __call__(self) -> Outcome:
        """Run it here and wait for its end; when this process is interrupted, the command saves its state first."""
        host = socket.gethostname()
        if lacking := self.lacking():
            return Outcome(2, host, f"machine {host}: {lacking}")
        try:
            self.begin()
            while self.process.poll() is None:
                time.sleep(POLL_S)
        finally:
            self.stop()
        if self.process.returncode == INTERRUPTED:
            time.sleep(self.hold_s)
        return Outcome(self.process.returncode, host)

    def lacking(self) -> str | None:
        """What this machine has not, in words."""
        for path in (self.log.parent, *self.needs):
            if not path.exists():
                return f"{path} is not there; run folder and data set must lie at the same paths on all machines"
        if not os.access(self.log.parent, os.W_OK):
            return f"{self.log.parent} cannot be written to"
        if own_version() != self.version:
            return f"it has surfkit {own_version()}, and the run is of {self.version}; install the same on all machines"
        return None

    def begin(self) -> None:
        """Start it."""
        limits = {name: str(self.threads) for name in ("OMP_NUM_THREADS", "MKL_NUM_THREADS")}
        with open(self.log, "ab") as log:
            self.process = subprocess.Popen(
                [sys.executable, "-IS", "-c", WATCHDOG, *self.words],
                env={**os.environ, **self.carried, **limits, DRIVER: str(os.getpid())},
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=log,
                start_new_session=True,
            )

    def stop(self) -> None:
        """Ask it to save its state and end, and wait until it has. Safe in a signal handler, unlike `Popen.wait`."""
        if self.process is None or self.process.returncode is not None:
            return
        with suppress(ProcessLookupError, ChildProcessError):
            os.kill(self.process.pid, signal.SIGTERM)
            os.waitid(os.P_PID, self.process.pid, os.WEXITED | os.WNOWAIT)

    def checkpoint(self) -> Any:
        """What submitit calls before a job ends at its time limit or is preempted: the errand that goes on later."""
        from submitit.helpers import DelayedSubmission

        self.stop()
        return DelayedSubmission(replace(self, process=None))


def attend(remote_job: RemoteJob) -> Outcome:
    """Run an errand; a function of its own, as Ray wants it.

    Ray cancels by a simulated Ctrl-C, which means nothing where that is ignored, as by all that a shell begins in the
    background; the driver would then wait for ever.
    """
    if threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGINT, signal.default_int_handler)
    return remote_job()


def _carried() -> dict[str, str]:
    return {name: os.environ[name] for name in CARRIED if name in os.environ}
