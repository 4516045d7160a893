"""What the page of `surfkit train --view` costs a step: nobody looks, and somebody does.

    python bench/live_view.py --rounds 30 --steps 20

One process trains one model. Groups of steps take turns: without a page, with a page that no browser shows, and with
one that a browser looks at which never rests. So they are of the same model and the same minutes, and the medians
of the ratios of neighbours say what the page costs. CPU time is that of the process, the browser included: it has no
screen, asks for pictures and reads them.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
import threading
import time
from collections import defaultdict
from contextlib import ExitStack, suppress
from dataclasses import replace
from pathlib import Path
from statistics import median

import torch
from machine import save

sys.path += [str(Path(__file__).parents[1] / "tests"), str(Path(__file__).parents[1] / "tests" / "apps" / "view")]
from browser import Browser

from surfkit.apps.view.control import TrainingControl
from surfkit.apps.view.live import Live, live_view
from surfkit.apps.view.server import Address
from surfkit.cli.recipes import recipes
from surfkit.io.datasets.data import Data
from surfkit.primitives.points import Points
from surfkit.runs.blocks.train_blocks import Compute
from surfkit.runs.pipeline import run
from surfkit.runs.recipe import with_steps
from surfkit.runs.run_stage import Intervals
from surfkit.testing.synthetic import Flight, photograph, write_colmap
from surfkit.train.progress import TrainingDisplay
from surfkit.train.state import StageState
from surfkit.train.view_order import ViewOrder
from surfkit.train.watch import Stopwatch, Watched, watched, watched_by

WAYS = ("no page", "nobody looks", "somebody looks")


class Turns:
    """Has pages come and go between groups of steps, and keeps the times of the steps of each."""

    def __init__(self, out: Path, steps: int, share: float) -> None:
        self.out, self.steps, self.share = out, steps, share
        self.wall: dict[str, list[list[float]]] = defaultdict(list)
        self.cpu: dict[str, list[float]] = defaultdict(list)
        self.use, self.live, self.way, self.made = ExitStack(), None, "warm-up", -1

    def begin(self, stage: Watched) -> None:
        """See `Watcher.begin`."""
        self.stage = stage
        self.start()

    def look(self, index: int, psnr: float | None) -> None:
        """See `Watcher.look`; the time of a step has what its page does after it."""
        if self.live is not None:
            self.live.control.look(index, psnr)
        now = time.perf_counter()
        self.wall[self.way][-1].append(now - self.last)
        self.last = now
        if len(self.wall[self.way][-1]) == self.steps:
            self.cpu[self.way].append(time.process_time() - self.begun)
            self.turn()

    def end(self) -> None:
        """See `Watcher.end`."""
        self.use.close()

    def turn(self) -> None:
        """The next group of steps: the ways in one order and in the other, in turn."""
        self.use.close()
        self.live, self.made = None, self.made + 1
        lap, at = divmod(self.made, len(WAYS))
        self.way = WAYS[at if lap % 2 == 0 else -1 - at]
        if self.way != "no page":
            self.live = self.use.enter_context(live_view(Address(), self.share))
            self.live.out = self.out
            self.use.callback(self.live.control.end)
            self.live.control.begin(self.stage)
        if self.way == "somebody looks":
            self.use.enter_context(Somebody(self.live))
        time.sleep(0.5)  # so that starting and ending a page are no part of a step
        self.start()

    def start(self) -> None:
        """The first step of a group begins."""
        self.wall[self.way].append([])
        self.last, self.begun = time.perf_counter(), time.process_time()


class Somebody:
    """A browser that moves all the time."""

    def __init__(self, live: Live) -> None:
        self.url, self.over = live.url, threading.Event()
        self.thread = threading.Thread(target=self.act)

    def __enter__(self) -> Somebody:
        self.thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.over.set()
        self.thread.join()

    def act(self) -> None:
        """Move, and read what comes."""
        browser, height = Browser(self.url), 0.0
        while not self.over.is_set():
            height = (height + 0.05) % 3
            browser.stand(height)
            with suppress(TimeoutError):
                browser.socket.recv(timeout=0.05)
        browser.socket.close_timeout = 0.1
        browser.close()


def watching(stage: Watched, steps: int = 20_000) -> float:
    """Seconds of a step that the loop of the training takes for a page without a browser."""
    clock = Stopwatch(StageState(Points.fresh({}, {}), ViewOrder(1), torch.Generator()))
    display, control = TrainingDisplay("bench", steps), TrainingControl()
    began = time.perf_counter()
    with watched_by(control), watched(stage) as look:
        for index in range(steps):
            with clock.stopped(), display.paused():
                look(index, 20.0)
    return (time.perf_counter() - began) / steps


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=30, help="groups of steps of each way")
    parser.add_argument("--steps", type=int, default=20, help="of a group")
    parser.add_argument("--points", type=int, default=20_000)
    parser.add_argument("--width", type=int, default=320)
    parser.add_argument("--share", type=float, default=0.3, help="--view-share")
    asked = parser.parse_args()
    total = asked.steps * (1 + len(WAYS) * asked.rounds)
    with tempfile.TemporaryDirectory() as folder:
        data, out = Path(folder) / "data", Path(folder) / "run"
        flight = Flight(width=asked.width, height=asked.width * 3 // 4, points=asked.points)
        data.mkdir()
        write_colmap(data, photograph(flight))
        recipe = with_steps(recipes()["2dgs"], total)
        recipe = replace(recipe, mesh=None, pretrain=replace(recipe.pretrain, densify=None))  # all steps are alike
        turns = Turns(out, asked.steps, asked.share)
        with watched_by(turns):
            run(recipe, Data(data), out, Compute("cpu"), Intervals(checkpoint=total, pictures=0))
    walls = {way: [sum(times) for times in turns.wall[way][: asked.rounds]] for way in WAYS}
    cpus = {way: turns.cpu[way][: asked.rounds] for way in WAYS}

    def to_no_page(of: dict[str, list[float]]) -> dict[str, float]:
        pairs = {way: zip(of[way], of["no page"], strict=True) for way in WAYS[1:]}
        return {way: round(median([one / other for one, other in each]), 3) for way, each in pairs.items()}

    figures = {
        "points": asked.points,
        "pixels": [flight.width, flight.height],
        "steps of a group": asked.steps,
        "groups of each way": asked.rounds,
        "share": asked.share,
        "load of the machine": round(os.getloadavg()[0], 1),
        "step, ms": {way: round(1000 * median(found) / asked.steps, 1) for way, found in walls.items()},
        "CPU time of a step, ms": {way: round(1000 * median(found) / asked.steps, 1) for way, found in cpus.items()},
        "time, to no page": to_no_page(walls),
        "CPU time, to no page": to_no_page(cpus),
        "being watched by a page that nobody looks at, µs a step": round(1e6 * watching(turns.stage), 1),
    }
    print(save("live_view", figures).read_text())
    return 0


if __name__ == "__main__":
    sys.exit(main())
