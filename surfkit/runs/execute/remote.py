"""A command that is run on another machine, which sees the same folders.

The agents of a cluster import only this module and what it imports: no torch, only what starts and stops a process.
"""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

from surfkit.core.version import own_version
from surfkit.scene.available_memory import oom_kills

DRIVER = "SURFKIT_DRIVER"
"""Environment variable with the process that started a worker; when that process is gone, the worker stops."""
INTERRUPTED_STATUS, CRASHED_STATUS = 130, 70
"""Exit statuses: asked to stop; an unexpected error."""
CHILD_POLL_S = 0.2
FORWARDED = ("PYTHONPATH", "SURFKIT_PLUGINS", "SURFKIT_MAX_MEGAPIXELS")
"""Environment variables of the driver that decide which code runs, and which photographs are read."""
WATCHDOG = f"""
import os, signal, subprocess, sys
agent = int(os.environ["{DRIVER}"])
for number in (signal.SIGUSR1, signal.SIGUSR2):
    signal.signal(number, signal.SIG_IGN)
mask = signal.pthread_sigmask
mask(signal.SIG_BLOCK, [signal.SIGTERM])
child = subprocess.Popen(
    [sys.executable, *sys.argv[1:]],
    env=os.environ | {{"{DRIVER}": str(os.getpid())}},
    preexec_fn=lambda: mask(signal.SIG_UNBLOCK, [signal.SIGTERM]),
)
signal.signal(signal.SIGTERM, lambda *_: child.terminate())
mask(signal.SIG_UNBLOCK, [signal.SIGTERM])
while True:
    try:
        status = child.wait({CHILD_POLL_S})
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
"""A process between an agent and the command that stops the command when the agent is gone. An agent of Ray that is
stopped first kills its children, which then cannot save anything; it kills this process, and the command notices that.
With SIGUSR2, Slurm tells every process of a job that its time limit is near; only the agent reacts to it."""


@dataclass(frozen=True)
class RemoteResult:
    """The end of a remote job.

    Attributes:
        status: Exit status; negative for the signal that ended it.
        host: The machine it ran on.
        why: Why it was not started; None if it was.
        kind: Of a failure that the command itself could not record: its machine cannot run it ("data"), or the kernel
            killed it for lack of memory ("oom"); else None.
    """

    status: int
    host: str
    why: str | None = None
    kind: Literal["data", "oom"] | None = None


@dataclass
class RemoteJob:
    """A command, and what its machine must have.

    Attributes:
        words: Arguments of `python`.
        log: File for its output; its folder must exist and be writable.
        needs: Other paths that must exist.
        threads: Number of CPU threads that it may use.
        version: Of surfkit; must be the same on the machine.
        variables: Environment variables of the driver.
        hold_s: Seconds to wait before returning after the command was interrupted. A cluster that preempts a job sends
            a signal to every process, and will end this one soon; returning earlier would mark the job as done.
        process: The process that was started here.
    """

    words: tuple[str, ...]
    log: Path
    needs: tuple[Path, ...] = ()
    threads: int = 1
    version: str = field(default_factory=own_version)
    variables: Mapping[str, str] = field(default_factory=lambda: _forwarded())
    hold_s: float = 0.0
    process: subprocess.Popen[bytes] | None = None

    def __call__(self) -> RemoteResult:
        """Run it here and wait for its end; when this process is interrupted, the command saves its state first."""
        host, kills = socket.gethostname(), oom_kills()
        if missing := self.missing():
            return RemoteResult(2, host, f"machine {host}: {missing}", "data")
        with interrupts_noted() as came:
            process = self.begin()
            try:
                while process.poll() is None and not came:
                    time.sleep(CHILD_POLL_S)
            finally:
                self.stop()
        if came:
            raise KeyboardInterrupt
        if process.returncode == INTERRUPTED_STATUS:
            time.sleep(self.hold_s)
        killed = process.returncode == -signal.SIGKILL and oom_kills() > kills
        return RemoteResult(process.returncode, host, kind="oom" if killed else None)

    def missing(self) -> str | None:
        """What this machine lacks to run it, as a message; None if nothing."""
        for path in (self.log.parent, *self.needs):
            if not path.exists():
                return f"{path} is not there; run folder and data set must lie at the same paths on all machines"
        if not os.access(self.log.parent, os.W_OK):
            return f"{self.log.parent} cannot be written to"
        if own_version() != self.version:
            return f"it has surfkit {own_version()}, and the run is of {self.version}; install the same on all machines"
        return None

    def begin(self) -> subprocess.Popen[bytes]:
        """Start the process."""
        limits = {name: str(self.threads) for name in ("OMP_NUM_THREADS", "MKL_NUM_THREADS")}
        with open(self.log, "ab") as log:
            self.process = process = subprocess.Popen(
                [sys.executable, "-IS", "-c", WATCHDOG, *self.words],
                env={**os.environ, **self.variables, **limits, DRIVER: str(os.getpid())},
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=log,
                start_new_session=True,
            )
        return process

    def stop(self) -> None:
        """Ask it to save its state and end, and wait until it has. Safe in a signal handler, unlike `Popen.wait`."""
        if self.process is None or self.process.returncode is not None:
            return
        with suppress(ProcessLookupError, ChildProcessError):
            os.kill(self.process.pid, signal.SIGTERM)
            os.waitid(os.P_PID, self.process.pid, os.WEXITED | os.WNOWAIT)

    def checkpoint(self) -> Any:
        """What submitit calls before a job ends at its time limit or is preempted: the job to submit again."""
        from submitit.helpers import DelayedSubmission

        self.stop()
        return DelayedSubmission(replace(self, process=None))


@contextmanager
def interrupts_noted() -> Iterator[list[int]]:
    """Within, Ctrl-C only adds to the list that is given: it may come twice, and before the process is known."""
    came: list[int] = []
    if threading.current_thread() is not threading.main_thread():
        yield came
        return
    before = signal.signal(signal.SIGINT, lambda *_: came.append(1))
    try:
        yield came
    finally:
        signal.signal(signal.SIGINT, before)


def run_remote_job(remote_job: RemoteJob) -> RemoteResult:
    """Run a remote job; a function, as Ray needs one.

    Ray cancels by a simulated Ctrl-C, which `RemoteJob` sees even where the shell that started Ray ignores it.
    """
    return remote_job()


def _forwarded() -> dict[str, str]:
    return {name: os.environ[name] for name in FORWARDED if name in os.environ}
