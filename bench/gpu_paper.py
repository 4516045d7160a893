"""The ablations of CityGaussianV2 at their length, on a GPU that is there for minutes: `bench/gpu_paper.sh`.

    bench/gpu_paper.sh [PART=SECONDS ...] [--device cpu --steps 60 --scale 8 ...]

Parts run in the order in which they are named. What one leaves of its seconds is for those after it. Without any:

    parity=90  the tests that are skipped without a GPU
    table=50   the table of docs/gpu.md: `bench/gpu.py` without its trainings
    rows=380   shibuya-synth, 87 views of 640 x 426 px, with mesh and F1: `table:gradient` rows 1 and 4, which learn
               side by side, so that they compare at equal steps also if they are cut; then `table:model` rows 1 and 3
               (row 2 is row 1 of the other table, and trained once); then row 4, after depth maps for it

and 20 seconds to stop in order: 540 in all. Expected of two rows of 30,000 steps at a time: 10 s to start and to read
photographs, 300 s at 100 steps a second each, then PSNR, 25 s for the mesh, and F1, which takes minutes of CPU time.
What is left of the rows is for further calls.

The result, OUT/gpu_paper.json, is written every few seconds and whenever something ends. It is whole at any time, and
says of each part and row that it is finished, not begun, or where it was cut, with what was measured until then. The
same command goes on, also after kill -9: WORK keeps what is finished, and the last checkpoints. Another WORK begins
anew.

Exit status: 0 if all that was named is finished, 3 if something was cut, 1 if something failed, 2 for wrong arguments,
130 if it was interrupted.
"""

from __future__ import annotations

import argparse
import os
import re
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

from machine import RESULTS, save

from surfkit.core.check import BadInput
from surfkit.core.codec import read_json, write_json
from surfkit.core.signals import terminable
from surfkit.io.datasets.data import ReadSettings
from surfkit.raster.select import select
from surfkit.runs import journal
from surfkit.runs.execute.base import Pool
from surfkit.runs.run_status import status
from surfkit.study.ablation import offered_tables
from surfkit.study.ablation_screen import AblationScreen
from surfkit.study.rows import Trial, TrialResult, finished
from surfkit.study.study import AblationPlan, ablate, refuse_unusable, trials
from surfkit.study.truth import Truth

ROOT = Path(__file__).resolve().parents[1]
PACK = ROOT.parent / "shared/data/shibuya-synth"
PARTS = {"parity": 90.0, "table": 50.0, "rows": 380.0}
"""Seconds of each part."""
STOP_S = 20.0
"""For what is cut, to save its state; after that the process is killed."""
ROWS = {"gradient": ("1", "4"), "model": ("1", "2", "3", "4")}
"""Rows by table."""
WITH_DEPTH = ("model", ("4",))
"""The row that learns from depth maps."""
WAVES = (("gradient", ("1", "4")), ("model", ("1", "2", "3")), WITH_DEPTH)
"""In which order they are trained."""
TESTS = ("tests/raster/nvrtc", "tests/raster", "tests/train")
TEST_EVERY = 8
SAVE_EVERY_S = 10.0
ENDED = "exit status"
"""Begins the last line of the log of a program that came to its end."""
CUT, FAILED = 3, 1


class Screen(AblationScreen):
    """Saves the report when a row has ended."""

    def __init__(self, bench: Bench) -> None:
        super().__init__()
        self.bench = bench

    def end(self, trial: Trial, outcome: TrialResult, report: Mapping[str, Any]) -> None:
        """See `AblationWatcher.end`."""
        super().end(trial, outcome, report)
        if outcome.failed is not None:
            self.bench.failed[trial.folder] = outcome.failed
        self.bench.save()


class Bench:
    """What is measured, and what is known of it.

    Args:
        options: Of the command line.

    Raises:
        BadInput: There is no such device or data set.
    """

    def __init__(self, options: argparse.Namespace) -> None:
        self.options, self.work = options, options.work.resolve()
        self.title = select(options.device)[1]
        reading, tables = ReadSettings(scale=options.scale, test_every=TEST_EVERY), offered_tables()
        base = AblationPlan(
            tables["gradient"],
            (reading.of(options.data),),
            self.work / "rows",
            options.steps,
            device=options.device,
            truth=(Truth(options.gt or options.data / "gt/mesh.ply", options.tau),),
            workers=Pool(options.at_once),
            shared=False,  # no two rows have a stage in common
            checkpoint_every=options.checkpoint_every,
        )
        refuse_unusable(base)
        self.plans = {name: replace(base, table=tables[name]) for name in ROWS}
        every = {name: trials(plan) for name, plan in self.plans.items()}
        self.wanted = [(name, int(at), every[name][int(at) - 1]) for name, numbers in ROWS.items() for at in numbers]
        self.failed: dict[Path, str] = {}
        self.known: dict[Path, dict[str, Any]] = {}
        self.spent_file = self.work / "seconds.json"
        self.spent = read_json(self.spent_file, dict[str, float]) if self.spent_file.exists() else {}
        self.part, self.since = "", 0.0
        self.one = threading.Lock()

    def begin(self, part: str) -> None:
        """From now on, seconds are those of a part."""
        self.spent.setdefault(part, 0.0)
        self.part, self.since = part, time.monotonic()

    def save(self) -> dict[str, Any]:
        """Write the result as far as it is known, and return its parts."""
        with self.one:
            if self.part:
                now = time.monotonic()
                self.spent[self.part] += now - self.since
                self.since = now
            parts = {"parity": self.parity(), "table": self.table(), "rows": self.rows()}
            parts = {name: {"seconds": round(self.spent.get(name, 0.0), 1), **it} for name, it in parts.items()}
            write_json(self.spent_file, self.spent)
            about = {
                "device": self.title,
                "data": self.options.data.resolve().name,
                "scale": self.options.scale,
                "rows at once": self.options.at_once,
            }
            save("gpu_paper", about | {"seconds given": self.options.parts, "parts": parts}, self.options.out)
            return parts

    def parity(self) -> dict[str, Any]:
        """What came out of each test so far."""
        log = self.work / "parity.log"
        ended = re.findall(r"^(tests/\S+::.*?) (PASSED|FAILED|SKIPPED|ERROR)\b", text_of(log), re.M)
        count = {name.lower(): sum(how == name for _, how in ended) for name in ("PASSED", "SKIPPED")}
        broken = [test for test, how in ended if how in ("FAILED", "ERROR")]
        return {"state": state_of(log, f"after {len(ended)} tests"), **count, "failed": broken}

    def table(self) -> dict[str, Any]:
        """The figures of `bench/gpu.py` so far."""
        path = self.work / "table.json"
        figures = read_json(path, dict[str, Any])["figures"] if path.exists() else {}
        return {"state": state_of(self.work / "table.log", f"after {max(0, len(figures) - 1)} figures"), **figures}

    def rows(self) -> dict[str, Any]:
        """Where each row stands."""
        found = [{"table": name, "row": at, **self.row(trial)} for name, at, trial in self.wanted]
        done = sum(row["state"] == "finished" for row in found)
        failed, begun = any(row["state"].startswith("failed") for row in found), "rows" in self.spent
        cut = f"cut after {done} of {len(found)} rows" if begun else "not begun"
        state = "finished" if done == len(found) else "failed: see the rows" if failed else cut
        return {"state": state, "rows": found}

    def row(self, trial: Trial) -> dict[str, Any]:
        """Where a row stands, with what is measured until then; PSNR along the way is of a few held-out photographs."""
        if trial.folder in self.known:
            return self.known[trial.folder] | {"label": trial.label}
        about = {"label": trial.label, "run": trial.folder.name}
        if not (trial.folder / "run.json").exists():
            why = self.failed.get(trial.folder)
            return about | {"state": "not begun" if why is None else f"failed: {why}"}
        where, measured = status(trial.folder), finished(trial)
        lines = journal.read(trial.folder / journal.JOURNAL_FILE)
        state = f"cut after {where.step:,} of {where.steps:,} steps"
        if where.step == where.steps:
            state += ", in its mesh or measurements"
        if trial.folder in self.failed:
            state = f"failed: {self.failed[trial.folder]}"
        elif self.plans["model"].is_done(trial, TrialResult(measured)):
            state = "finished"
        found = about | {
            "state": state,
            "measured": measured,
            "steps": where.step,
            "steps_per_second": where.steps_per_second,
            "points": where.points,
            "edits": sum(line["event"] == "PointsEdited" for line in lines),
            "peak_memory_bytes": where.peak_memory_bytes,
            "peak_gpu_bytes": where.peak_gpu_bytes,
            "psnr_on_the_way": [
                {"step": line["index"], "views": len(line["psnr"]), "psnr": mean(line["psnr"].values())}
                for line in lines
                if line["event"] == "Measured" and line["psnr"]
            ],
            "notes": list(where.notes),
        }
        if state == "finished":
            self.known[trial.folder] = found
        return found

    def run(self, part: str, until: float) -> None:
        """Run a part, or go on with it, until a time of the monotonic clock at most."""
        options, log = self.options, self.work / f"{part}.log"
        if part == "rows":
            with interrupted_at(until):
                self.train(until)
        elif text_of(log).endswith(f"{ENDED} 0\n"):
            print(f"{part}: finished before, see {log}", flush=True)
        elif part == "parity":
            run_program(["-m", "pytest", "-vv", "-m", "cuda", *TESTS], until, log)
        else:
            words = ["--device", options.device, "--rounds", options.rounds, "--points", *options.points, "--recipes"]
            words += ["--out", self.work, "--name", "table", "--go-on"]
            run_program(["bench/gpu.py", *words], until, log)

    def train(self, until: float) -> None:
        """Train rows, or go on with them."""
        for name, numbers in WAVES:
            if (name, numbers) == WITH_DEPTH:
                log, scale = self.work / "depth.log", self.options.scale
                words = ["prepare", "depth", self.options.data.resolve(), "--test-every", TEST_EVERY]
                words += ["--device", self.options.device, *([] if scale is None else ["--scale", scale])]
                run_program(["-m", "surfkit", *words], until, log)
                if (state := state_of(log, "while maps were estimated")) != "finished":
                    print(f"rows: no depth maps for {name} {numbers[0]}: {state}; see {log}", flush=True)
                    return
            with Screen(self) as screen:
                ablate(replace(self.plans[name], rows=numbers), screen)


def text_of(log: Path) -> str:
    """What is in a log; "" if there is none."""
    return log.read_text(errors="replace") if log.exists() else ""


def state_of(log: Path, until: str) -> str:
    """What became of the program of a log: "finished", "cut" with how far it had come, how it failed, "not begun"."""
    *lines, last = ["", *filter(None, text_of(log).splitlines())]
    if not log.exists():
        return "not begun"
    if not last.startswith(ENDED):
        return f"cut {until}"
    return "finished" if last == f"{ENDED} 0" else f"failed: {last}: {lines[-1]}"


def mean(values: Sequence[float]) -> float:
    """Their mean."""
    return round(sum(values) / len(values), 3)


def run_program(words: Sequence[object], until: float, log: Path) -> None:
    """Run Python with some words; it is cut at a time of the monotonic clock, also if this process is killed."""
    left = until - time.monotonic()
    if left < 1:
        return
    limit = ["timeout", "--kill-after=5", f"{left:.0f}", sys.executable]
    with (
        open(log, "wb", buffering=0) as file,
        subprocess.Popen([*limit, *map(str, words)], cwd=ROOT, stdout=file, stderr=file, env=ENVIRONMENT) as process,
    ):
        try:
            ended = process.wait()
        except KeyboardInterrupt:
            process.terminate()
            raise
        if ended not in (124, 137):
            file.write(f"\n{ENDED} {ended}\n".encode())


ENVIRONMENT = os.environ | {"PYTHONUNBUFFERED": "1"}


@contextmanager
def interrupted_at(until: float) -> Iterator[None]:
    """Within, the work is asked at a time of the monotonic clock to stop, as by SIGTERM; it saves its state first."""
    timer = threading.Timer(max(0.0, until - time.monotonic()), os.kill, (os.getpid(), signal.SIGTERM))
    timer.daemon = True
    timer.start()
    try:
        yield
    except KeyboardInterrupt:
        if time.monotonic() < until:
            raise
    finally:
        timer.cancel()


@contextmanager
def saved_often(bench: Bench) -> Iterator[None]:
    """Within, the result is written every few seconds."""
    over = threading.Event()

    def keep() -> None:
        while not over.wait(SAVE_EVERY_S):
            with suppress(OSError, BadInput):  # a file that has just been replaced; the next time it is there
                bench.save()

    thread = threading.Thread(target=keep, daemon=True)
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join()


def measure(options: argparse.Namespace) -> int:
    """Run the parts and return the exit status."""
    began, until = time.monotonic(), time.monotonic()
    signal.alarm(round(sum(options.parts.values()) + STOP_S))  # the system ends what hangs
    bench = Bench(options)
    bench.work.mkdir(parents=True, exist_ok=True)
    bench.save()
    try:
        with saved_often(bench):
            for part, seconds in options.parts.items():
                until += seconds
                bench.begin(part)
                print(f"{part}: until {until - began:.0f} s", flush=True)
                try:
                    bench.run(part, until)
                finally:
                    state = bench.save()[part]["state"]
                    print(f"{part}: {state}, after {time.monotonic() - began:.0f} s", flush=True)
    except KeyboardInterrupt:
        print("bench/gpu_paper.sh: interrupted; the same command goes on", file=sys.stderr)
        return 130
    states = [it["state"] for name, it in bench.save().items() if name in options.parts]
    if any(state.startswith("failed") for state in states):
        return FAILED
    return 0 if all(state == "finished" for state in states) else CUT


def seconds_of(word: str) -> tuple[str, float]:
    """A part and its seconds, from NAME=SECONDS."""
    name, _, value = word.partition("=")
    if name not in PARTS or not value.isdecimal() or int(value) < 1:
        parts = ", ".join(PARTS)
        raise argparse.ArgumentTypeError(f"{word!r}: give PART=SECONDS, such as rows=360, with a part of {parts}")
    return name, float(value)


def main() -> int:
    about, lines = argparse.RawDescriptionHelpFormatter, __doc__
    parser = argparse.ArgumentParser("bench/gpu_paper.sh", description=lines, formatter_class=about)
    parser.add_argument("parts", nargs="*", type=seconds_of, metavar="PART=SECONDS")
    parser.add_argument("--data", type=Path, default=PACK)
    parser.add_argument("--gt", type=Path, help="the true mesh; DATA/gt/mesh.ply if left out")
    parser.add_argument("--tau", type=float, default=1.0, help="for F1, in units of the true mesh")
    parser.add_argument("--out", type=Path, default=RESULTS, help="the folder of gpu_paper.json")
    parser.add_argument("--work", type=Path, default=ROOT / "runs/gpu_paper", help="the folder of runs and logs")
    parser.add_argument("--device", default="cuda")
    parser.add_argument("--steps", type=int, help="of a row; 30,000 if left out")
    parser.add_argument("--scale", type=float, help="divide the size of photographs by it")
    parser.add_argument("--at-once", type=int, default=2, help="rows that are trained at the same time")
    parser.add_argument(
        "--checkpoint-every", type=int, default=5_000, help="steps; what is cut in order saves one, too"
    )
    parser.add_argument(
        "--points", type=int, nargs="+", default=[1_000_000, 5_000_000, 10_000_000], help="of the table"
    )
    parser.add_argument("--rounds", type=int, default=7, help="of which a figure of the table is the median")
    options = parser.parse_args()
    options.parts = dict(options.parts) or PARTS
    try:
        with terminable():
            return measure(options)
    except BadInput as error:
        print(f"bench/gpu_paper.sh: {error}", file=sys.stderr)
        return 2


if __name__ == "__main__":
    sys.exit(main())
