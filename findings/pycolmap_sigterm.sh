#!/usr/bin/env bash
# Importing pycolmap replaces what SIGTERM does: a process that is told to end prints a report of a crash.
#
# pycolmap 4.2.1. The import installs handlers for SIGTERM, SIGSEGV, SIGABRT, SIGBUS, SIGFPE and SIGILL, of its logging
# library. A process that has only imported it, and is asked to end by `kill`, a job scheduler or `Popen.terminate`, writes
# "*** SIGTERM received" and the trace of its stack to stderr. `signal.getsignal` still says that nothing is installed, and a
# handler that Python installed before the import is not called any more. What helps is
# `signal.signal(signal.SIGTERM, signal.getsignal(signal.SIGTERM))` after the import, in the main thread.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet pycolmap==4.2.1 numpy==2.4.6
"$folder/venv/bin/python" - <<'PYTHON'
import signal
import subprocess
import sys

SLEEPING = """
import signal, sys, time
if "handler" in sys.argv:
    signal.signal(signal.SIGTERM, lambda number, frame: sys.exit(7))
{}
if "again" in sys.argv:
    signal.signal(signal.SIGTERM, signal.getsignal(signal.SIGTERM))
print(signal.getsignal(signal.SIGTERM) == signal.SIG_DFL, flush=True)
time.sleep(60)
"""


def ended(first, *words):
    """Exit status and stderr of a process that does something and sleeps, and is then asked to end."""
    command = [sys.executable, "-c", SLEEPING.format(first), *words]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    default = process.stdout.readline().strip()
    process.terminate()
    told = process.communicate(timeout=60)[1]
    print(f"{first or 'nothing'} {' '.join(words)}: SIG_DFL {default}, status {process.returncode}, {len(told)} letters on stderr")
    return process.returncode, default, "SIGTERM" in told and "stack trace" in told


assert ended("") == (-signal.SIGTERM, "True", False)
assert ended("import pycolmap") == (-signal.SIGTERM, "True", True), "the behaviour has changed"
assert ended("", "handler") == (7, "False", False)
assert ended("import pycolmap", "handler") == (-signal.SIGTERM, "False", True), "the behaviour has changed"
assert ended("import pycolmap", "handler", "again") == (7, "False", False)
PYTHON
