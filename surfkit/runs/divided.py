"""A stage that several processes train together, started and watched by this one (Grendel-GS, Zhao et al. 2025).

Each process has its share of the points and of the optimizer's state, and draws a strip of each picture
(`train.divide`, `train.exchange`). Checkpoints are those of a single process, so that a run goes on with any number of
processes. One that ends before its time ends all of them, with an error.
"""

from __future__ import annotations

import multiprocessing
import os
import shutil
import signal
import sys
import tempfile
import threading
import time
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext, suppress
from dataclasses import dataclass, replace
from datetime import timedelta
from typing import Any

import torch
import torch.distributed as dist

from surfkit.core.check import BadInput, Fault
from surfkit.core.events import FileWritten, StageBegan, StageEnded, Warned, emit, say
from surfkit.core.files import DISK_FULL
from surfkit.core.hooks import hookimpl
from surfkit.core.memory import is_out_of_memory, peak_memory_bytes
from surfkit.core.registry import plugins
from surfkit.io.datasets.read import read
from surfkit.raster.api import Maps
from surfkit.raster.base import Rasterizer
from surfkit.raster.native_rasterizer import NativeRasterizer
from surfkit.runs.folder import Run, RunStage
from surfkit.runs.photo_light import held_out_response
from surfkit.runs.run_stage import Intervals, StageJob, begin, drawn_now, return_to_checkpoint, trainer_of
from surfkit.runs.start import align_priors
from surfkit.scene.scene import View
from surfkit.train import checkpoint
from surfkit.train.data_cache import CacheSettings, read_ahead
from surfkit.train.divide import refuse_undivided
from surfkit.train.exchange import DividedRasterizer
from surfkit.train.faults import Diverged, has_checkpoint, out_of_memory
from surfkit.train.interrupt import graceful
from surfkit.train.memory_meter import MemoryMeter
from surfkit.train.processes import Processes
from surfkit.train.progress import TrainingDisplay
from surfkit.train.progress_bars import bars
from surfkit.train.shards import load_share, save_shares
from surfkit.train.state import StageState
from surfkit.train.trainer import Trainer

POLL_S = 0.05
"""Between two looks at the processes."""
LAST_WORDS_S = 1.0
"""What the others of a process that has ended are given to say why, before they are ended too."""
SILENCE = timedelta(minutes=30)
"""After which a process that hears nothing from the others ends."""


@dataclass(frozen=True)
class Work:
    """What each process is told.

    Attributes:
        run: The run.
        at: Its stage, whose state is in its checkpoint.
        intervals: When checkpoints and pictures are written.
        caches: Where photographs are kept, of each process.
        count: Processes.
        threads: Of each.
        folder: In which they find each other.
    """

    run: Run
    at: RunStage
    intervals: Intervals
    caches: CacheSettings
    count: int
    threads: int
    folder: str


def refuse_processes(run: Run, count: int, rasterizer: Rasterizer, caches: CacheSettings) -> None:
    """BadInput, before anything is written, for what several processes cannot do together."""
    if count == 1:
        return
    recipe = run.recipe
    if not 1 <= count <= 64:
        raise BadInput(f"--processes {count}: give 1 to 64")
    if not recipe.has_stages:
        raise BadInput(f"--processes {count}: the method of the recipe trains no points; leave it out")
    if recipe.partition is not None:
        raise BadInput(
            f"--processes {count}: the recipe divides the scene into blocks, which are trained by themselves; "
            "choose executor:pool, or partition:none"
        )
    if recipe.refine:
        raise BadInput(f"--processes {count}: refine.0 works on the whole model in one process; add refine.0:none")
    if caches.points.place not in ("auto", "device"):
        raise BadInput(f"--processes {count}: --points-on {caches.points.place} is for one process; leave it out")
    refuse_undivided("pretrain", recipe.pretrain, recipe.primitive, rasterizer)


def optimise_divided(job: StageJob, state: StageState | None, count: int, caches: CacheSettings) -> StageState:
    """What `run_stage.optimise` does, by `count` processes; where numbers are not finite, likewise.

    Raises:
        Fault: A process ended before its time; the last checkpoint is whole.
        KeyboardInterrupt: The run was asked to stop, and its state is saved.
    """
    at, trainer = job.stage, trainer_of(job)

    def fresh() -> StageState:
        return begin(job, trainer)

    if state is None:
        checkpoint.save(at.checkpoint, fresh())
    else:
        say(f"{at.out}: going on after step {state.index} of {at.stage.steps}")
    cores = len(os.sched_getaffinity(0)) if sys.platform == "linux" else os.cpu_count() or 1
    if count > cores:
        emit(Warned(f"--processes {count}: there are {cores} cores for them, so they wait for each other; give less"))
    budget = replace(caches, cache=f"{max(1, caches.bytes() // count // 1_000_000)}MB")
    threads = max(1, torch.get_num_threads() // count)
    while True:
        state = None
        with tempfile.TemporaryDirectory(prefix="surfkit-processes-") as folder:
            diverged = together(Work(job.run, at, job.intervals, budget, count, threads, folder))
        if diverged is None:
            return checkpoint.load(at.checkpoint)
        halvings = checkpoint.load(at.checkpoint).halvings
        return_to_checkpoint(at, halvings, diverged, fresh)


def together(work: Work) -> Diverged | None:
    """Start the processes, pass on what the first tells, and wait for their end; what has let them end early."""
    spawn = multiprocessing.get_context("spawn")
    said = spawn.SimpleQueue()
    processes = [spawn.Process(target=_process, args=(rank, work, said), daemon=True) for rank in range(work.count)]
    ends: dict[str, Any] = {}

    def listen() -> None:
        while not said.empty():
            kind, what = said.get()
            if kind == "event":
                emit(what)
            else:
                ends.setdefault(kind, what)

    try:
        with graceful() as request:
            with without_interrupts():
                for process in processes:
                    process.start()
            asked = False
            while any(process.exitcode is None for process in processes):
                listen()
                if any(process.exitcode for process in processes):
                    time.sleep(LAST_WORDS_S)
                    break
                if request.asked and not asked:
                    asked = True
                    for process in processes:
                        with suppress(ProcessLookupError):
                            os.kill(process.pid or 0, signal.SIGTERM)
                time.sleep(POLL_S)
            listen()
            codes = [process.exitcode or 0 for process in processes]  # before the others are ended
    finally:
        for process in processes:
            if process.pid is not None and process.exitcode is None:
                process.kill()
            if process.pid is not None:
                process.join()
    if request.asked or "stopped" in ends:
        say(f"stopped; the same command goes on from the last checkpoint in {work.at.out}")
        raise KeyboardInterrupt
    if "diverged" in ends:
        return Diverged(*ends["diverged"])
    refuse_early_end(work, codes, ends)
    return None


@contextmanager
def without_interrupts() -> Iterator[None]:
    """Within, started processes do not receive Ctrl-C, which a terminal sends to all: this one passes it on."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT])
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def refuse_early_end(work: Work, codes: list[int], ends: dict[str, Any]) -> None:
    """BadInput or Fault where a process has not come to its end, from exit codes and what the processes have said."""
    if "bad" in ends:
        raise BadInput(ends["bad"])
    if "memory" in ends:
        raise out_of_memory(work.at.out, f" in one of {work.count} processes")
    if "disk" in ends:
        raise OSError(*ends["disk"])  # which a run of one process meets too
    early = [rank for rank, code in enumerate(codes) if code]
    if not early:
        return
    killed = [rank for rank in early if codes[rank] < 0]
    if killed:  # the others may have said that they hear nothing of it
        how = f"process {killed[0]} was ended by signal {-codes[killed[0]]}"
    else:
        rank, text = ends.get("crash", (early[0], "it ended early"))
        how = f"process {rank} failed: {text}"
    kept = "the last checkpoint is whole, and the same command goes on from there"
    what = kept if has_checkpoint(work.at.out) else "give the same command again"
    raise Fault(f"{work.at.out}: {how}; all {work.count} have been ended; {what}")


class Forward:
    """Sends the events of a process to the one that has started it."""

    def __init__(self, said: Any) -> None:
        self.said = said

    @hookimpl
    def surfkit_event(self, event: Any) -> None:
        """Send one."""
        self.said.put(("event", event))


def _end_orphaned(folder: str) -> None:
    """End this process when the one that started it is gone: the next run in the folder must have it alone."""
    parent = multiprocessing.parent_process()
    assert parent is not None, "it was started by another"
    parent.join()
    shutil.rmtree(folder, ignore_errors=True)  # it was left to that one
    os._exit(1)


def _process(rank: int, work: Work, said: Any) -> None:
    """The life of one of the processes."""
    threading.Thread(target=_end_orphaned, args=(work.folder,), daemon=True).start()
    torch.set_num_threads(work.threads)
    if sys.platform == "linux":
        os.environ.setdefault("GLOO_SOCKET_IFNAME", "lo")
    if rank:  # one speaks for all
        silent = os.open(os.devnull, os.O_WRONLY)
        os.dup2(silent, 1)
        os.dup2(silent, 2)
    else:
        plugins().register(Forward(said), "processes")
    try:
        store = f"file://{work.folder}/store"
        dist.init_process_group("gloo", init_method=store, rank=rank, world_size=work.count, timeout=SILENCE)
        with bars() if rank == 0 else nullcontext():
            if train_share(work, Processes.joined()):
                said.put(("stopped", rank))
        dist.destroy_process_group()  # else its threads may abort this process at its end
        return
    except Diverged as error:
        said.put(("diverged", (error.index, error.view, str(error).partition(": ")[2])))
    except BadInput as error:
        said.put(("bad", str(error)))
    except (MemoryError, RuntimeError, OSError) as error:
        if is_out_of_memory(error):
            said.put(("memory", rank))
        elif isinstance(error, OSError) and error.errno in DISK_FULL:
            said.put(("disk", (error.errno, error.strerror, error.filename)))
        elif isinstance(error, Fault):
            said.put(("crash", (rank, str(error))))
        else:
            said.put(("crash", (rank, f"{type(error).__name__}: {' '.join(str(error).split())[:300]}")))
    except Exception:
        said.put(("crash", (rank, " ".join(traceback.format_exc().split())[-600:])))
    os._exit(1)  # what others wait for in a collective call, nobody brings any more


def train_share(work: Work, processes: Processes) -> bool:
    """Take the steps that are left with the points of this process; whether it was asked to stop before the end."""
    run, at, first = work.run, work.at, processes.rank == 0
    meter, scene = MemoryMeter(), read(run.data)
    meter.scene_read()
    state = load_share(at.checkpoint, processes)
    known = align_priors(run, scene, begun=True)
    given = read_ahead(run.data, scene, at.stage.losses, work.caches, known)
    rasterizer = DividedRasterizer(NativeRasterizer(), processes)
    more = given.priors, given.masks, given.expect
    trainer = Trainer(at.stage, at.primitive, scene.train, given.photos, rasterizer, *more)
    draw, seconds = drawing_all(work, trainer, state, scene.held_out), state.seconds
    emit(StageBegan(at.name, at.stage.steps, trainer.count(state.points), state.index + 1))
    with graceful() as request, TrainingDisplay(at.title, at.stage.steps) if first else nullcontext() as display:
        for done in trainer.run(state):
            if display is not None:
                display.show(done)
            meter.step(state, given, trainer.uploads)
            every, is_last = work.intervals, done.index == at.stage.steps
            if every.pictures and done.index % every.pictures == 0 and not is_last:
                draw(done.index)
            is_over = any(processes.of_each(request.asked))
            if is_over or is_last or done.index % every.checkpoint == 0:
                state.peak_memory_bytes = max(state.peak_memory_bytes, peak_memory_bytes())
                with meter.adding("checkpoints"):
                    save_shares(at.checkpoint, state, processes)
                emit(FileWritten(at.checkpoint, "checkpoint"))
                meter.tell()
            if is_over and not is_last:
                return True
    emit(StageEnded(at.name, at.stage.steps, trainer.count(state.points), state.seconds - seconds))
    return False


def drawing_all(work: Work, trainer: Trainer, state: StageState, held_out: Any) -> Callable[[int], None]:
    """A function that draws a few held-out views after a step: all processes draw, the first writes."""
    from surfkit.evaluate.images.progress_pictures import ProgressPictures

    along = ProgressPictures(work.at.out / "progress", held_out) if held_out else None
    respond = held_out_response(work.run, work.at)

    def maps_of(view: View) -> Maps:
        maps = drawn_now(trainer, state, view)
        return maps if respond is None else respond(view, maps)

    def look(index: int) -> None:
        if along is not None:
            drawn = {view.name: maps_of(view) for view in along.views}
            if dist.get_rank() == 0:
                along.look(index, lambda view: drawn[view.name])

    return look
