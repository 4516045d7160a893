"""Real tables whose rows share stages: in this process, in others, killed and continued, on several data sets."""

import contextlib
import hashlib
import json
import os
import random
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest
from needs import needs_native
from two_blocks import data, recipe

from surfkit.apps import ablation_forecast
from surfkit.apps.ablation_forecast import foretell, lines, needs_of, stage_steps
from surfkit.compress.vectree import Vectree
from surfkit.core.check import BadInput
from surfkit.core.lock import locked
from surfkit.densify.prune import PruneByImportance
from surfkit.io.datasets.data import Data
from surfkit.mesh.tsdf import TSDF
from surfkit.runs.execute.base import Job, JobResult, Pool
from surfkit.runs.pipeline import run
from surfkit.study import rows
from surfkit.study.ablation import Row, Table
from surfkit.study.recipes.surface_recipes import SURFACE
from surfkit.study.rows import OUTCOME_FILE, TrialJob, TrialResult, main, outcome_of
from surfkit.study.shared_stages import finished_keys, keys_of, next_wave, sharing_lines
from surfkit.study.study import AblationPlan, ablate, trials

__all__ = ["data", "recipe"]

BENCH = Path(__file__).parents[2] / "bench" / "kill.py"
FILES = ("point_cloud.ply", "mesh.ply", "compressed/model.surfkit")
STAGES = [
    ("pretrain", 1, 3, ["base", "prune", "mesh", "VQ"]),
    ("plan", 1, 3, ["base", "prune", "mesh", "VQ"]),
    ("tune", 1, 2, ["base", "mesh", "VQ"]),
    ("tune", 1, 0, ["prune"]),
    ("mesh", 1, 1, ["mesh", "VQ"]),
    ("compress", 1, 0, ["VQ"]),
]


class Silent:
    """Watches, and remembers the order."""

    def __init__(self):
        self.begun, self.ended = [], []

    def begin(self, trial, at, count, report):
        self.begun.append(trial.label)

    def end(self, trial, outcome, report):
        self.ended.append(trial.label)


def table_of(recipe) -> Table:
    """Rows that share pretraining, the plan, all blocks, or a mesh."""
    return Table(
        "shares",
        "Rows that share stages",
        recipe,
        (
            Row("base"),
            Row("prune", {"tune.prune": (PruneByImportance(at=(6,), ratio=0.5),)}, kept=False),
            Row("mesh", {"mesh": TSDF()}),
            Row("VQ", {"compress": Vectree(codes=16)}),
        ),
    )


@pytest.fixture(scope="module")
def table(recipe) -> Table:
    return table_of(recipe)


@pytest.fixture(scope="module")
def whole(table, data, tmp_path_factory):
    """The table in this process, in its folder, with its report."""
    out = tmp_path_factory.mktemp("whole")
    return out, ablate(AblationPlan(table, (data,), out, device="cpu"), Silent())


def counts(report):
    return [(each["stage"], each["computed"], each["taken"], each["rows"]) for each in report["stages"]]


def digests(out: Path) -> dict[str, str]:
    """What must not differ between two tables: files of the runs, and the steps in their journals."""
    found = {}
    for folder in (out / "runs").iterdir():
        for path in (folder / name for name in FILES):
            if path.exists():
                found[f"{folder.name}/{path.name}"] = hashlib.sha256(path.read_bytes()).hexdigest()
        for path in [folder / "events.jsonl", *folder.glob("blocks/*/events.jsonl")]:
            steps = [line for line in map(json.loads, path.open()) if line["event"] == "StepDone"]
            found[str(path.relative_to(out))] = repr([(line["index"], line["losses"]) for line in steps])
        found[folder.name] = json.dumps(json.loads((folder / "metrics.json").read_text())["images"])
    found["left over"] = " ".join(sorted(path.name for path in out.rglob(".*")))
    return found


def test_shared_stages_are_computed_once_and_nothing_changes(whole, table, data, tmp_path):
    out, report = whole
    assert sorted(counts(report), key=str) == sorted(STAGES, key=str)
    told = "pretrain computed once, used by 4 runs: base, prune, mesh, VQ"
    assert sharing_lines(report)[0] == told and f"- {told}\n" in (out / "ablation.md").read_text()
    for trial in trials(AblationPlan(table, (data,), out, device="cpu")):
        alone = tmp_path / trial.label
        metrics = run(trial.recipe, data, alone, rows.Compute("cpu"))
        shared = json.loads((trial.folder / "metrics.json").read_text())
        assert shared["images"] == metrics["images"] and shared["points"] == metrics["points"]
        for name in FILES:
            assert (alone / name).exists() == (trial.folder / name).exists()
            assert not (alone / name).exists() or (alone / name).read_bytes() == (trial.folder / name).read_bytes()
    base, prune, mesh, small = report["data_sets"][0]["rows"]
    assert base["mean"]["cpu_seconds"] == mesh["mean"]["cpu_seconds"] == small["mean"]["cpu_seconds"]
    assert prune["mean"]["points"] < base["mean"]["points"]


def test_without_sharing_each_row_computes_all(whole, table, data, tmp_path):
    report = ablate(AblationPlan(table, (data,), tmp_path, rows=("1", "3"), device="cpu", shared=False), Silent())
    assert report["stages"] == [] and not (tmp_path / "stages").exists()
    found, wanted = digests(tmp_path), digests(whole[0])
    assert found and all(wanted[name] == value for name, value in found.items())


@pytest.mark.usefixtures("forked_jobs")
def test_a_pool_gives_the_same_and_computes_shared_stages_once(whole, table, data, tmp_path):
    watch = Silent()
    report = ablate(AblationPlan(table, (data,), tmp_path, device="cpu", workers=Pool(workers=2, threads=1)), watch)
    assert digests(tmp_path) == digests(whole[0])
    assert sorted(counts(report), key=str) == sorted(STAGES, key=str)
    assert watch.begun == ["base", "prune", "mesh", "VQ"] and watch.ended[0] == "base" and watch.ended[-1] == "VQ"
    means = [[row["mean"]["points"] for row in each["data_sets"][0]["rows"]] for each in (report, whole[1])]
    assert repr(means[0]) == repr(means[1]), "numbers of points stay integers"


def test_waves_compute_no_stage_twice(table, data, tmp_path):
    every = trials(AblationPlan(table, (data,), tmp_path, seeds=2))
    first = next_wave(every, set())
    assert [(trial.label, trial.seed) for trial in first] == [("base", 0), ("base", 1)]
    keys = {trial.label: keys_of(trial) for trial in every if trial.seed == 0}
    done = {key for trial in first for key in keys_of(trial).values()}
    rest = [trial for trial in every if trial not in first]
    assert [trial.label for trial in next_wave(rest, done)] == ["prune", "mesh"] * 2
    assert finished_keys(every) == set() and keys["base"]["tune"] == keys["VQ"]["tune"] != keys["prune"]["tune"]


@needs_native
@pytest.mark.skipif(not hasattr(os, "fork"), reason="processes are forked, so that torch is loaded once")
def test_a_table_that_is_killed_ends_in_the_same_bits(whole, data, tmp_path):
    words = [sys.executable, __file__, str(data.path), str(tmp_path / "out")]
    paths = os.pathsep.join([str(BENCH.parent), str(Path(__file__).parents[1])])
    done = subprocess.run(words, env=os.environ | {"PYTHONPATH": paths}, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-2000:]
    assert int(done.stdout) >= 6, "kills"
    report = json.loads((tmp_path / "out" / "ablation.json").read_text())
    assert digests(tmp_path / "out") == digests(whole[0])
    assert sorted(counts(report), key=str) == sorted(STAGES, key=str)


def kill_and_continue(data: Data, out: Path) -> int:
    """Run the table in processes that die at a file operation, until one ends; the number of those that died.

    They are forked from one that has not begun any thread.
    """
    import kill

    kill.load_all()
    table, draw = table_of(recipe.__wrapped__()), random.Random(0)
    for kills in range(60):
        if (pid := os.fork()) == 0:
            with open(os.devnull, "w") as nowhere, contextlib.redirect_stderr(nowhere):
                try:
                    kill.Deadly(out, 0 if kills > 7 else draw.randint(60, 260)).install()
                    ablate(AblationPlan(table, (data,), out, device="cpu"), Silent())
                    os._exit(0)
                finally:
                    os._exit(70)
        status = os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])
        if status != -signal.SIGKILL:
            break
    if status != 0:
        raise SystemExit(f"exit status {status} after {kills} kills")
    return kills


def test_a_worker_whose_driver_is_gone_stops(table, data, tmp_path, monkeypatch):
    (trial,) = trials(AblationPlan(table, (data,), tmp_path, rows=("1",)))[:1]
    job = rows.job_of(0, TrialJob(trial, "cpu"))
    monkeypatch.setenv("SURFKIT_DRIVER", "1" if os.getppid() != 1 else "2")

    def forever(work):
        while True:
            time.sleep(3600)

    monkeypatch.setattr(rows, "attempt", forever)
    assert main([job.command[-1]]) == 130 and not (trial.folder / OUTCOME_FILE).exists()


def test_what_becomes_of_a_process_that_dies(table, data, tmp_path):
    trial = trials(AblationPlan(table, (data,), tmp_path))[0]
    work = TrialJob(trial)
    job = Job(0, trial.folder, lambda: 0, ())
    assert outcome_of(work, JobResult(job, -9, kind="oom")).failed == (
        f"its process ended by SIGKILL while memory ran out; see {trial.folder / 'log.txt'}"
    )
    assert outcome_of(work, JobResult(job, 2, "machine m: no disk")).failed == "machine m: no disk"
    assert outcome_of(work, JobResult(job, 130)).failed.startswith("its process ended with status 130; see ")
    rows.write_json(trial.folder / OUTCOME_FILE, TrialResult({"psnr": 1.5, "points": 7}, "no mesh"))
    assert outcome_of(work, JobResult(job, 0)) == TrialResult({"psnr": 1.5, "points": 7}, "no mesh")


@pytest.mark.usefixtures("forked_jobs")
def test_a_row_that_fails_in_a_pool_does_not_stop_the_others(table, data, tmp_path):
    broken = replace(table, rows=(Row("bad", {"start": SURFACE.start}, kept=False), table.rows[0]))
    report = ablate(AblationPlan(broken, (data,), tmp_path, device="cpu", workers=Pool(workers=2, threads=1)), Silent())
    bad, base = report["data_sets"][0]["rows"]
    assert bad["failed"].startswith(f"seed 0: {data.path}: the start")
    assert base["mean"]["psnr"] > 0 and not base["failed"]


def test_two_processes_on_one_table(table, data, tmp_path):
    with locked(tmp_path), pytest.raises(BadInput, match=f"{tmp_path}: process {os.getpid()} on"):
        ablate(AblationPlan(table, (data,), tmp_path, device="cpu"), Silent())
    assert not (tmp_path / "ablation.json").exists()


def test_data_sets_side_by_side(table, data, tmp_path):
    from surfkit.testing.synthetic import Flight, photograph, write_colmap

    write_colmap(tmp_path / "other", photograph(Flight(kind="grid", views=16, width=32, height=24, points=200)))
    other = Data(tmp_path / "other")
    watch = Silent()
    report = ablate(AblationPlan(table, (data, other), tmp_path / "out", rows=("1", "3"), device="cpu"), watch)
    assert watch.begun == ["base", "mesh"] * 2
    one, two = report["data_sets"]
    assert [one["data"]["path"], two["data"]["path"]] == [str(data.path.resolve()), str(other.path)]
    assert one["rows"][0]["mean"]["psnr"] != two["rows"][0]["mean"]["psnr"]
    assert sorted(each["stage"] for each in report["stages"]) == sorted(["pretrain", "plan", "tune", "mesh"] * 2)
    page = (tmp_path / "out" / "ablation.md").read_text()
    assert page.count("# table:shares") == 1 and f"Data: {data.path.name}, other;" in page
    with pytest.raises(BadInput, match="is there twice"):
        AblationPlan(table, (data, data), tmp_path)
    with pytest.raises(BadInput, match="1 ground truths for 2"):
        AblationPlan(table, (data, other), tmp_path, truth=(object(),))


def test_a_forecast_counts_shared_stages_once(table, data, tmp_path, capsys, forked_probe):
    plan = AblationPlan(table, (data,), tmp_path, device="cpu")
    every = trials(plan)
    assert stage_steps(every[0].recipe) == {"pretrain": 12, "tune": 24}
    needs = needs_of(every, set(), True)
    assert (needs.runs, needs.others, needs.steps, needs.alone, needs.stages) == (4, 0, 60, 144, 3)
    assert needs_of(every, {keys_of(every[0])["pretrain"]}, True).steps == 48
    assert needs_of(every, set(), False).steps == 144
    foretell(plan, every, 5)
    said = capsys.readouterr().err
    assert "4 runs, 60 optimisation steps, 84 fewer" in said and "of disk" in said
    assert needs.longest == 36


def test_a_forecast_measures_with_the_threads_of_a_worker_and_divides_by_them(table, data, tmp_path, monkeypatch):
    pool, asked = Pool(workers=2, threads=3), []
    monkeypatch.setattr(ablation_forecast, "forecast", lambda *given: (asked.append(given[3]), (None, []))[1])
    plan = AblationPlan(table, (data,), tmp_path, device="cpu", workers=pool)
    foretell(plan, trials(plan), 5)
    assert [one.threads for one in asked] == [3]
    found = SimpleNamespace(step_seconds=(0.5,), seconds=600.0 + 0.5 * 12, mesh=None, depth_seconds=0.0, run_bytes=1)
    found = SimpleNamespace(**vars(found), room=SimpleNamespace(run_bytes=9), points_known=False, points=5_000)
    needs = replace(needs_of(trials(plan), set(), True), runs=4, steps=1_200, longest=100)
    said = next(lines(plan, "here", needs, trials(plan)[0].recipe, found))
    assert "about 25 min (50 min of computing, 2 rows at a time)" in said and "with about 5,000 points" in said
    said = next(lines(plan, "here", replace(needs, longest=3_600), trials(plan)[0].recipe, found))
    assert "about 40 min (50 min of" in said  # no row is divided


if __name__ == "__main__":
    print(kill_and_continue(Data(Path(sys.argv[1])), Path(sys.argv[2])))
