"""Many cases of a target, in a process of their own, so that a crash and an endless loop are found too."""

from __future__ import annotations

import json
import os
import signal
import tempfile
import time
import traceback
from dataclasses import asdict
from pathlib import Path

from .case import Finding, Fuzz
from .damage import Damage, damages

HUNG_S = 600
"""Without a word from a process: `limits` ends what uses its CPU time, so it waits for something."""


def explore(name: str, folder: Path, cases: int, seed: int, log: Path) -> None:
    """Make cases, and write down each before it is run and what was found; done in a process of its own."""
    from hypothesis import HealthCheck, Phase, given, settings
    from hypothesis import seed as seeded

    fuzz = Fuzz(name, folder)
    if clean := fuzz.case([]):
        raise SystemExit(f"{name}: without any damage: {clean}")
    if not fuzz.files:
        raise SystemExit(f"{name}: no files to damage")

    @seeded(seed)
    @settings(
        max_examples=cases,
        deadline=None,
        database=None,
        phases=[Phase.generate],
        suppress_health_check=list(HealthCheck),
    )
    @given(damages(fuzz.files))
    def explored(listed: list[Damage]) -> None:
        with log.open("a") as file:
            file.write(json.dumps({"case": [asdict(damage) for damage in listed]}) + "\n")
            file.flush()
            if found := fuzz.case(listed):
                file.write(json.dumps({"found": asdict(found)}) + "\n")

    explored()
    with log.open("a") as file:
        file.write(json.dumps({"done": True}) + "\n")


def chunk(name: str, cases: int, seed: int) -> tuple[int, list[Finding]]:
    """Cases in a process of their own: how many, and what was found."""
    with tempfile.TemporaryDirectory() as folder:
        log = Path(folder) / "log"
        log.touch()
        pid = os.fork()
        if pid == 0:
            status = 70
            try:
                quiet = os.open(os.devnull, os.O_WRONLY)
                os.dup2(quiet, 2) if not os.environ.get("FUZZ_SHOW") else None
                explore(name, Path(folder), cases, seed, log)
                status = 0
            except BaseException:
                log.write_text(log.read_text() + json.dumps({"error": traceback.format_exc()}) + "\n")
            finally:
                os._exit(status)
        moved, size = time.monotonic(), 0
        while os.waitid(os.P_PID, pid, os.WEXITED | os.WNOHANG | os.WNOWAIT) is None:
            if log.stat().st_size != size:
                moved, size = time.monotonic(), log.stat().st_size
            if time.monotonic() - moved > HUNG_S:
                os.kill(pid, signal.SIGKILL)
            time.sleep(0.05)
        status = os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])
        rows = [json.loads(line) for line in log.read_text().splitlines()]
    if broken := [row["error"] for row in rows if "error" in row]:
        raise SystemExit(broken[0])
    found = [Finding(**row["found"]) for row in rows if "found" in row]
    made = [row["case"] for row in rows if "case" in row]
    if not rows or "done" not in rows[-1]:
        what = "an endless loop" if status == -signal.SIGKILL else f"the process ended with {status}"
        found.append(Finding(what, name, "", made[-1] if made else [], ""))
    return len(made), found
