"""Kills a training run at random moments until it is done, and compares its end with that of an undisturbed one.

    python bench/kill.py [--kills 20] [--seed 0] [--blocks] [--disk] [--out kill.json]

Every attempt is a process of its own that runs the command line. It ends by SIGKILL after a random time, at a random
file operation inside the run folder (open, rename, remove, make a folder, before or after a flush to the disk), or in
the middle of writing a checkpoint, of which a random part is then on the disk. The same command goes on from there.
The comparison is of every byte of the points, of the optimiser's state, of the random generator and of the journal's
list of steps. With --blocks, the run is one in two blocks, and each of them is compared too. With --disk, the runs that
are killed keep their points in files, and the other one in memory.
Exits 1 if anything differs.
"""

from __future__ import annotations

import argparse
import contextlib
import gc
import hashlib
import json
import os
import random
import signal
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

STEPS = 24
WORDS = f"train recipe:2dgs --steps {STEPS} --checkpoint-every 7 --pictures-every 20 --device cpu"
SETTINGS = "--primitive.sh-degree 1 --pretrain.densify.every 5 --pretrain.densify.start 10"
DISK = "pretrain.optimizer:adam-in-view"
BLOCKS = "partition:quantile-grid --partition.blocks 2 1 assign:picture-share --tune.sh-every 1"
KINDS = ("time", "operation", "torn")


@dataclass
class Deadly:
    """Counts file operations inside a folder, and ends the process at one of them.

    Attributes:
        folder: Operations elsewhere do not count.
        at: Number of the operation that is the last; 0 for none.
        torn: Number of the checkpoint that is cut while it is written; 0 for none.
        share: Of its bytes that reach the disk.
    """

    folder: Path
    at: int = 0
    torn: int = 0
    share: float = 0.5
    count: int = field(default=0, init=False)
    written: int = field(default=0, init=False)

    def install(self) -> None:
        """Watch from now on."""
        import safetensors.torch

        fsync, save_file = os.fsync, safetensors.torch.save_file

        def flushed(file: int) -> None:
            self.operation()
            fsync(file)
            self.operation()

        def load_state(tensors: object, path: Path, metadata: object = None) -> None:
            save_file(tensors, path, metadata)
            self.written += 1
            if self.written == self.torn:
                os.truncate(path, int(self.share * os.path.getsize(path)))
                die()

        os.fsync, safetensors.torch.save_file = flushed, load_state
        sys.addaudithook(self.audit)

    def audit(self, event: str, args: tuple) -> None:
        """See what Python is about to do."""
        if event in ("open", "os.rename", "os.remove", "os.mkdir", "os.rmdir") and isinstance(args[0], (str, Path)):
            if str(args[0]).startswith(str(self.folder)):
                self.operation()

    def operation(self) -> None:
        """Count one."""
        self.count += 1
        if self.count == self.at:
            die()


def die() -> None:
    """End this process as the kernel does when memory runs out."""
    os.kill(os.getpid(), signal.SIGKILL)


def load_all() -> None:
    """Load what a run loads, once: attempts are forked from here."""
    import torch.fx.experimental.symbolic_shapes  # noqa: F401
    from PIL import Image

    from surfkit.cli.recipes import recipes
    from surfkit.io.datasets.raw_dataset import load_pycolmap

    recipes()
    load_pycolmap()
    Image.init()
    gc.collect()
    gc.freeze()


def attempt(words: list[str], prepare: Callable[[], object], after_s: float | None = None) -> int:
    """Exit status of one process that trains, negative for the signal that ended it; killed `after_s` if given."""
    pid = os.fork()
    if pid == 0:
        status = 70
        try:
            with open(os.devnull, "w") as nowhere, contextlib.redirect_stdout(nowhere):
                os.dup2(nowhere.fileno(), 2) if not os.environ.get("KILL_SHOW") else None
                prepare()
                from surfkit.cli import main

                status = main(words)
        finally:
            os._exit(status)
    if after_s is not None:
        until = time.monotonic() + after_s
        while time.monotonic() < until and os.waitid(os.P_PID, pid, os.WEXITED | os.WNOHANG | os.WNOWAIT) is None:
            time.sleep(0.002)
        with contextlib.suppress(ProcessLookupError):
            os.kill(pid, signal.SIGKILL)
    return os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])


def digests(out: Path) -> dict[str, str]:
    """What must not differ between two runs, each as a digest."""
    from safetensors import safe_open

    found = {"points": hashlib.sha256((out / "point_cloud.ply").read_bytes()).hexdigest()}
    for path in sorted(out.rglob("checkpoint.safetensors")):
        of = "" if path.parent.name == "pretrain" else f"{path.parent.relative_to(out)}: "
        with safe_open(path, framework="pt") as file:
            for name in file.keys():
                found[of + name] = hashlib.sha256(file.get_tensor(name).numpy().tobytes()).hexdigest()
    for path in sorted(out.rglob("events.jsonl")):
        of = "" if path.parent == out else f"{path.parent.relative_to(out)}: "
        lines = [json.loads(line) for line in path.read_text().splitlines()]
        steps = [(line["index"], line["losses"], line["points"]) for line in lines if line["event"] == "StepDone"]
        found[of + "journal"] = hashlib.sha256(json.dumps(steps).encode()).hexdigest()
    found["metrics"] = json.dumps(json.loads((out / "metrics.json").read_text())["images"])
    found["left over"] = " ".join(sorted(path.name for path in out.rglob(".*")))
    return found


@dataclass
class Kills:
    """Runs that are killed, and what they came to."""

    data: Path
    folder: Path
    draw: random.Random
    more: str = ""
    where: str = ""
    wanted: dict[str, str] = field(default_factory=dict)
    operations: int = 0
    seconds: float = 0.0
    kills: list[dict[str, object]] = field(default_factory=list)
    runs: int = 0
    differing: list[str] = field(default_factory=list)

    def words(self, out: Path, where: str | None = None) -> list[str]:
        """The command line of a run."""
        given = f"{WORDS} {SETTINGS} {self.more} {self.where if where is None else where}"
        return [*given.split(), "--data", str(self.data), "--out", str(out)]

    def undisturbed(self) -> None:
        """Run once without a kill: what must come out, how long it takes, and how many file operations it has."""
        out, count = self.folder / "whole", self.folder / "operations"
        start, deadly = time.perf_counter(), Deadly(out)

        def prepare() -> None:
            deadly.install()
            leave = os._exit

            def noted(status: int) -> None:
                count.write_text(str(deadly.count))
                leave(status)

            os._exit = noted

        if attempt(self.words(out, where=""), prepare) != 0:
            raise SystemExit("the undisturbed run failed; KILL_SHOW=1 shows why")
        self.seconds, self.operations = time.perf_counter() - start, int(count.read_text())
        self.wanted = digests(out)

    def disturbed(self, kills: int) -> None:
        """Kill and go on until so many kills are done, then finish and compare."""
        out = self.folder / "run-0"
        while len(self.kills) < kills:
            status, kind, where = self.strike(out)
            if status == -signal.SIGKILL:
                self.kills.append({"kind": kind, "at": where, "run": self.runs})
            elif status == 0:
                out = self.compared(out)
            else:
                raise SystemExit(f"exit status {status} after {self.kills[-1:]}; KILL_SHOW=1 shows why")
        if (status := attempt(self.words(out), lambda: None)) != 0:
            raise SystemExit(f"exit status {status} after {self.kills[-1:]}; KILL_SHOW=1 shows why")
        self.compared(out)

    def strike(self, out: Path) -> tuple[int, str, float]:
        """One attempt that is to be killed: its exit status, how, and when."""
        kind = KINDS[len(self.kills) % len(KINDS)]
        if kind == "time":
            after = self.draw.uniform(0, 0.8 * self.seconds)
            return attempt(self.words(out), lambda: None, after), kind, after
        at = self.draw.randint(1, self.operations * 4 // 5 if kind == "operation" else 12 if self.more == BLOCKS else 4)
        deadly = Deadly(out, at) if kind == "operation" else Deadly(out, torn=at, share=self.draw.random())
        return attempt(self.words(out), deadly.install), kind, at

    def compared(self, out: Path) -> Path:
        """Note what differs at the end of a run; the folder of the next."""
        found = digests(out)
        self.differing += [
            f"{out.name}: {name}" for name in self.wanted | found if found.get(name) != self.wanted.get(name)
        ]
        self.runs += 1
        return self.folder / f"run-{self.runs}"


def main() -> int:
    """Run it."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--kills", type=int, default=20)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--blocks", action="store_true")
    parser.add_argument("--disk", action="store_true", help="runs that are killed keep their points in files")
    parser.add_argument("--out", type=Path)
    chosen = parser.parse_args()
    os.environ.update(OMP_NUM_THREADS="1", OMP_WAIT_POLICY="PASSIVE")
    load_all()
    from surfkit.testing.synthetic import Flight, photograph, write_colmap

    with tempfile.TemporaryDirectory() as folder:
        data = Path(folder) / "data"
        flight = Flight(width=48, height=36, points=200)
        write_colmap(data, photograph(flight))
        more, where = BLOCKS if chosen.blocks else DISK * chosen.disk, "--points-on disk" * chosen.disk
        job = Kills(data, Path(folder), random.Random(chosen.seed), more, where)
        job.undisturbed()
        job.disturbed(chosen.kills)
    report = {
        "kills": job.kills, "finished_runs": job.runs, "compared": sorted(job.wanted), "differing": job.differing,
        "undisturbed_seconds": round(job.seconds, 2), "file_operations": job.operations,
    }  # fmt: skip
    text = json.dumps(report, indent=2)
    print(text)
    if chosen.out:
        chosen.out.write_text(text + "\n")
    return 1 if job.differing else 0


if __name__ == "__main__":
    sys.exit(main())
