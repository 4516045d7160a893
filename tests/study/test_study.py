"""Running tables, with runs that only pretend to train."""

import csv
import io
import json
import shutil
from dataclasses import replace
from pathlib import Path

import pytest
from PIL import Image
from rich.console import Console

from surfkit.core import registry
from surfkit.core.check import BadInput
from surfkit.core.codec import write_json
from surfkit.core.events import Progress, emit
from surfkit.core.registry import find
from surfkit.densify import CountCap, Elongation
from surfkit.densify.base import Prune
from surfkit.io.datasets.data import Data
from surfkit.io.datasets.depth_prior import SWITCHED_OFF
from surfkit.io.datasets.fingerprint import fingerprint as data_fingerprint
from surfkit.io.datasets.read import read
from surfkit.losses.depth import DepthRegression
from surfkit.runs import run_cache as shared
from surfkit.runs.folder import Run
from surfkit.runs.methods.stereo_fusion import StereoFusion
from surfkit.study import rows
from surfkit.study.ablation import Row, Table, build
from surfkit.study.ablation_screen import AblationScreen
from surfkit.study.recipes.ablations import COARSE_BASELINE, MODEL_TABLE, TABLES, stereo_alone
from surfkit.study.recipes.surface_recipes import STEREO
from surfkit.study.rows import TrialResult
from surfkit.study.study import (
    AblationPlan,
    ablate,
    fingerprint,
    report_of,
    report_so_far,
    run_folder,
    trials,
    unfinished,
)
from surfkit.study.table_text import lines, markdown
from surfkit.study.truth import Truth
from surfkit.testing.synthetic import Flight, photograph, write_colmap
from surfkit.train.progress import TrainingDisplay

TABLE = Table(
    "twins",
    "Two rows with one recipe, and a third",
    COARSE_BASELINE,
    (
        Row("base", paper={"psnr": 21.12, "ssim": 0.637, "f1": 0.41, "points": 9_540_000}),
        Row("same", {"pretrain.sh_every": 1_000}, kept=False),
        Row("less | more", {"primitive.sh_degree": 1}, paper={"psnr": 22.24, "points": 9_510_000}),
    ),
)


def rows_in(report):
    """The rows on the first data set."""
    return report["data_sets"][0]["rows"]


class Silent:
    """Watches, and remembers."""

    def __init__(self):
        self.begun = []

    def begin(self, trial, at, count, report):
        self.begun.append((trial.label, trial.seed, at, count))

    def end(self, trial, outcome, report):
        pass


class Runs:
    """Stands in for training: PSNR is 20 + seed, and 3 more with degree 1; a run may fail or be interrupted."""

    def __init__(self):
        self.calls = []
        self.raises = {}

    def __call__(self, recipe, data, out, device, **rest):
        key = (recipe.primitive.sh_degree, recipe.seed)
        self.calls.append(key)
        if key in self.raises:
            raise self.raises[key]
        images = {"psnr": 20.0 + recipe.seed + 3 * (recipe.primitive.sh_degree == 1), "ssim": 0.5, "per_image": {}}
        metrics = {"images": images, "points": 100 * key[0], "seconds": 90.0, "cpu_seconds": 100.0}
        write_json(out / "metrics.json", metrics)
        return metrics


@pytest.fixture(scope="module")
def data(tmp_path_factory) -> Data:
    folder = tmp_path_factory.mktemp("scene")
    write_colmap(folder, photograph(Flight(views=9, width=24, height=18, points=40)))
    return Data(folder)


@pytest.fixture
def runs(monkeypatch):
    stand_in = Runs()
    monkeypatch.setattr(rows.pipeline, "run", stand_in)
    return stand_in


def test_equal_recipes_run_once_and_seeds_come_in_turn(data, runs, tmp_path):
    watch = Silent()
    report = ablate(AblationPlan(TABLE, (data,), tmp_path, steps=300, seeds=2), watch)
    assert runs.calls == [(3, 0), (1, 0), (3, 1), (1, 1)]
    assert watch.begun == [("base", 0, 1, 4), ("less | more", 0, 2, 4), ("base", 1, 3, 4), ("less | more", 1, 4, 4)]
    base, same, less = rows_in(report)
    assert base["runs"] == same["runs"] and base["runs"] != less["runs"]
    assert same["difference"]["psnr"]["mean"] == 0
    assert less["difference"]["psnr"] == {"mean": 3.0, "standard_error": 0.0, "seeds": 2, "base": 20.5}
    assert base["mean"]["psnr"] == 20.5 and base["sd"]["psnr"] == pytest.approx(0.5**0.5)
    for run in base["runs"] + less["runs"]:
        assert (tmp_path / run["folder"] / "metrics.json").exists()
    assert len(list((tmp_path / "runs").iterdir())) == 4


def test_a_limit_on_points_holds_in_every_row(data, tmp_path):
    plan = AblationPlan(MODEL_TABLE, (data,), tmp_path, max_points=500)
    recipes = [trial.recipe for trial in trials(plan) if trial.label != "stereo alone"]
    assert [recipe.pretrain.densify.filters[-1] for recipe in recipes] == [CountCap(500)] * (len(MODEL_TABLE.rows) - 1)
    assert recipes[1].pretrain.densify.filters == (Elongation(), CountCap(500))
    stages = [(path, stage) for recipe in recipes for path, stage, _ in recipe.stages() if stage.densify is not None]
    assert {path for path, _ in stages} == {"pretrain", "partition_pretrain", "tune"}, "in blocks, too"
    assert all(stage.densify.most_points == 500 for _, stage in stages)
    free = trials(replace(plan, max_points=None))
    ours, others = ({each.folder for each in found if each.recipe.has_stages} for found in (trials(plan), free))
    assert not ours & others
    assert "at most 500 points" in markdown(report_of(plan, [], {}))
    with pytest.raises(BadInput, match="points"):
        trials(replace(plan, max_points=0))


def test_rows_that_make_a_mesh_alone_are_run_where_meshes_are_compared(data, tmp_path):
    table = replace(TABLE, rows=(*TABLE.rows, stereo_alone(on="base")))
    plan = AblationPlan(table, (data,), tmp_path, steps=300)
    assert [trial.label for trial in unfinished(plan)] == ["base", "less | more"]
    compared = replace(plan, truth=(Truth(data.path, 1.0),))
    for wanted in (compared, replace(plan, rows=("stereo alone",))):
        last = unfinished(wanted)[-1]
        assert last.label == "stereo alone" and isinstance(last.recipe.method, StereoFusion)
    every = build(table)
    assert every["stereo alone"].depth is not None, "it makes the depth maps that it fuses"


@pytest.mark.parametrize("name", [name for name in TABLES if name != "appearance"])
def test_every_table_has_stereo_alone_as_its_baseline(name):
    """Of appearances, which are measured by colours, stereo has none."""
    found = [recipe for recipe in build(TABLES[name]).values() if recipe.method == STEREO.method]
    assert len(found) == 1 and found[0].depth == STEREO.depth


def test_what_is_saved(data, runs, tmp_path):
    report = ablate(AblationPlan(TABLE, (data,), tmp_path, steps=300, seeds=2), Silent())
    assert json.loads((tmp_path / "ablation.json").read_text()) == report
    assert (report["table"], report["steps"], report["seeds"]) == ("twins", 300, 2)
    assert report["data_sets"][0]["data"]["path"] == str(data.path)
    assert report["versions"].keys() >= {"surfkit", "torch", "python"}
    assert rows_in(report)[2]["change"] == {"primitive.sh_degree": 1} and rows_in(report)[1]["kept"] is False
    page = (tmp_path / "ablation.md").read_text()
    own = "| 3 | less \\| more | 1 | 2/2 | 0.500 ± 0.000 (+0.000 ± 0.000) | **23.50 ± 0.71** (+3.00 ± 0.00) | "
    assert own + "**100 ± 0** (-66.7 ± 0.0 %) | 1.5 ± 0.0 (+0.0 ± 0.0 %) | 1.7 ± 0.0 (+0.0 ± 0.0 %) |" in page
    assert "| 22.24 (+1.12) | 9.51 M (-0.3 %) |\n" in page
    assert "| 2 | (same) | 1 |" in page and page.startswith("# table:twins\n")
    widths = {line.replace("\\|", "").count("|") for line in page.splitlines() if line.startswith("|")}
    assert widths == {13}
    assert {path.suffix for path in tmp_path.glob("ablation.*")} == {".json", ".md", ".tex", ".csv"}


def test_an_interrupted_table_goes_on(data, runs, tmp_path):
    whole = ablate(AblationPlan(TABLE, (data,), tmp_path / "whole", seeds=2), Silent())
    runs.raises = {(3, 1): KeyboardInterrupt()}
    plan = AblationPlan(TABLE, (data,), tmp_path / "broken", seeds=2)
    with pytest.raises(KeyboardInterrupt):
        ablate(plan, Silent())
    half = json.loads((plan.out / "ablation.json").read_text())
    assert [len(row["runs"]) for row in rows_in(half)] == [1, 1, 1] and not any(row["failed"] for row in rows_in(half))
    runs.raises, runs.calls = {}, []
    assert ablate(plan, Silent()) == whole
    assert runs.calls == [(3, 1), (1, 1)]


def test_a_finished_table_needs_nothing(data, runs, tmp_path):
    plan = AblationPlan(TABLE, (data,), tmp_path)
    first = ablate(plan, Silent())
    runs.calls = []
    assert ablate(plan, Silent()) == first and runs.calls == []
    more = ablate(replace(plan, seeds=2), Silent())
    assert runs.calls == [(3, 1), (1, 1)] and rows_in(more)[0]["runs"][0] == rows_in(first)[0]["runs"][0]
    runs.calls = []
    ablate(replace(plan, steps=20), Silent())
    assert len(runs.calls) == 2, "other steps are other runs"


def test_rows_of_other_data_do_not_stand_beside_those_that_are_there(runs, tmp_path, capsys):
    """Photographs were replaced after some rows were finished: the others would be trained on what is there now."""
    write_colmap(tmp_path / "scene", photograph(Flight(views=9, width=24, height=18, points=40)))
    plan = AblationPlan(TABLE, (Data(tmp_path / "scene"),), tmp_path / "out")
    first = ablate(plan, Silent())
    for trial in trials(plan):
        write_json(trial.folder / "inputs.json", data_fingerprint(read(trial.data)))
    more = replace(plan, seeds=2, rows=("1",))
    assert len(ablate(more, Silent())["data_sets"][0]["rows"][0]["runs"]) == 2, "the data are as they were"
    photo = read(plan.data[0]).train[3].path
    Image.new("RGB", (24, 18)).save(photo)
    runs.calls = []
    with pytest.raises(BadInput, match=rf"--out {plan.out} .*photograph {photo.name}"):
        ablate(replace(plan, seeds=2), Silent())
    assert runs.calls == [] and rows_in(ablate(plan, Silent()))[0]["runs"] == rows_in(first)[0]["runs"]
    assert f"shown as they are: --out {plan.out} has rows" in " ".join(capsys.readouterr().err.split())


def test_a_row_that_draws_nothing_is_done_without_lpips(data, tmp_path):
    plan = AblationPlan(TABLE, (data,), tmp_path, columns=("lpips",))
    trial, spent = trials(plan)[0], {"seconds": 1.0, "cpu_seconds": 1.0}
    assert plan.is_done(trial, TrialResult(spent)) and not plan.is_done(trial, TrialResult())
    assert not plan.is_done(trial, TrialResult(spent | {"psnr": 20.0}))
    assert plan.is_done(trial, TrialResult(spent | {"psnr": 20.0, "lpips": 0.3}))


def test_some_rows_now_and_the_others_later(data, runs, tmp_path):
    report = ablate(AblationPlan(TABLE, (data,), tmp_path, rows=("3",)), Silent())
    assert runs.calls == [(1, 0)] and rows_in(report)[0]["runs"] == [] and rows_in(report)[2]["difference"] == {}
    report = ablate(AblationPlan(TABLE, (data,), tmp_path, rows=("same",)), Silent())
    assert runs.calls == [(1, 0), (3, 0)] and rows_in(report)[2]["difference"]["psnr"]["mean"] == 3


def test_a_row_that_fails_does_not_stop_the_others(data, runs, tmp_path):
    runs.raises = {(3, 0): RuntimeError("step 7:\n  the losses are nan")}
    plan = AblationPlan(TABLE, (data,), tmp_path, seeds=2)
    report = ablate(plan, Silent())
    assert runs.calls == [(3, 0), (1, 0), (1, 1)], "a failed row is not tried with other seeds"
    base, same, less = rows_in(report)
    assert base["failed"].startswith("seed 0: RuntimeError: step 7: the losses are nan; see ")
    assert base["failed"] == same["failed"] and base["runs"] == [] and base["mean"] == {}
    assert less["failed"] is None and less["mean"]["psnr"] == 23.5 and less["difference"] == {}
    (trace,) = tmp_path.rglob("failed.txt")
    assert "in __call__" in trace.read_text()
    assert "- base: failed: seed 0: RuntimeError" in (tmp_path / "ablation.md").read_text()
    assert [row[3] for row in lines(report)[1]] == ["failed", "failed", "2/2"]
    runs.raises = {}
    again = ablate(plan, Silent())
    assert not any(row["failed"] for row in rows_in(again)) and not list(tmp_path.rglob("failed.txt"))


def test_input_that_a_single_run_refuses_fails_its_row(data, runs, tmp_path):
    runs.raises = {(1, 0): BadInput("no depth\nprior")}
    report = ablate(AblationPlan(TABLE, (data,), tmp_path), Silent())
    assert rows_in(report)[2]["failed"] == "seed 0: no depth prior" and not list(tmp_path.rglob("failed.txt"))


def test_what_no_row_could_use_is_refused_before_anything_is_written(data, runs, tmp_path):
    plan = AblationPlan(TABLE, (data,), tmp_path / "out")
    for wrong, message in (
        (replace(plan, data=(Data(tmp_path / "nowhere"),)), "no such folder"),
        (replace(plan, data=(replace(data, test_every=0),)), "kept from training"),
        (replace(plan, steps=0), "--steps 0"),
        (replace(plan, rows=("4",)), "no row named '4'"),
        (replace(plan, device="cuda"), "--device cuda"),
    ):
        with pytest.raises(BadInput, match=message):
            ablate(wrong, Silent())
    with pytest.raises(BadInput, match="--seeds 0"):
        replace(plan, seeds=0)
    assert runs.calls == [] and not plan.out.exists()
    plan.out.write_text("")
    with pytest.raises(BadInput, match="a file, not a folder"):
        ablate(plan, Silent())


def test_f1_of_every_row_in_a_volume_of_its_own(data, runs, monkeypatch, tmp_path, capsys):
    from surfkit.study import truth

    calls = []

    class Opened:
        def __init__(self, folder):
            self.recipe, self.out = COARSE_BASELINE, folder
            self.data, self.mesh, self.mesh_record, self.metrics = (
                data,
                folder / "mesh.ply",
                folder,
                folder / "metrics.json",
            )

    def measure(files, settings, out, views, frame):
        if "bad" in calls:
            raise BadInput("nowhere near")
        calls.append(settings.crop)
        emit(Progress("counting the views of each point", 1, 9))
        write_json(out / "crop.json", {})
        found = {"f1": 0.25 * len(calls), "truth": str(files[1]), "tau": settings.tau}
        return {"geometry": found, "mesh": {"components": len(calls)}}

    monkeypatch.setattr(truth, "opened", Opened)
    monkeypatch.setattr(truth, "read_unchanged", lambda run: read(run.data))
    monkeypatch.setattr(truth, "measure_geometry", measure)
    gt = tmp_path / "gt.ply"
    vertices = "".join(f"{x} {y} 0\n" for x in range(20) for y in range(20))
    head = "ply\nformat ascii 1.0\nelement vertex 400\nproperty float x\nproperty float y\nproperty float z\n"
    gt.write_text(f"{head}end_header\n{vertices}")
    plan = AblationPlan(TABLE, (data,), tmp_path / "out", truth=(truth.Truth(gt, 0.5),))
    assert all(trial.recipe.mesh is not None for trial in trials(plan)), "rows without a mesh get one"
    report = ablate(plan, Silent())
    assert [row["mean"]["f1"] for row in rows_in(report)] == [0.25, 0.25, 0.5]
    assert rows_in(report)[2]["difference"]["f1"]["mean"] == 0.25
    assert capsys.readouterr().err.count("counting the views of each point") == 2, "it takes minutes"
    assert calls == ["auto", "auto"], "no row is measured in the volume of another"
    assert "| **0.500** (+0.250) | **100** (-66.7 %) | 1.5 (+0.0 %) |" in (plan.out / "ablation.md").read_text()
    assert ablate(plan, Silent()) == report and len(calls) == 2 and len(runs.calls) == 2
    calls.append("bad")
    other = ablate(replace(plan, truth=(truth.Truth(gt, 0.25),)), Silent())
    assert len(runs.calls) == 2 and rows_in(other)[0]["failed"] == "seed 0: nowhere near", "nothing is trained again"
    assert rows_in(other)[0]["mean"]["psnr"] == 20 and "f1" not in rows_in(other)[0]["mean"]
    with pytest.raises(BadInput, match="gone.ply"):
        ablate(replace(plan, out=tmp_path / "new", truth=(truth.Truth(tmp_path / "gone.ply"),)), Silent())
    assert not (tmp_path / "new").exists()


def test_a_fingerprint_tells_what_a_run_is_made_from(data, monkeypatch):
    recipe = COARSE_BASELINE

    def made_by(recipe, data):
        return fingerprint(recipe, data, shared.versions(recipe))

    first = made_by(recipe, data)
    assert first == made_by(replace(recipe, about="in other words"), data) and len(first) == 12
    others = [
        made_by(replace(recipe, seed=1), data),
        made_by(recipe, replace(data, scale=2.0)),
        made_by(recipe, Data(data.path.parent)),
    ]
    newer = [replace(plugin, version="99") for plugin in shared.records()]
    monkeypatch.setattr(shared, "records", lambda: newer)
    others.append(made_by(recipe, data))
    assert len({first, *others}) == 5


def test_other_code_of_a_plugin_is_another_run(data, tmp_path, monkeypatch):
    """Its author changes the code, and the version much later."""
    info = tmp_path / "acme-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: acme\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text("[surfkit]\nacme = acme_parts\n")
    (tmp_path / "acme_parts").mkdir()
    start = "from dataclasses import dataclass\nfrom surfkit import Prune, hookimpl\nfrom acme_parts.rule import ODD\n"
    part = "@dataclass(frozen=True)\nclass Odd(Prune):\n    def edit(self, points, step):\n        return ODD\n"
    hook = "@hookimpl\ndef surfkit_components():\n    return {'odd': Odd}\n"
    (tmp_path / "acme_parts" / "__init__.py").write_text(start + part + hook)
    rule = tmp_path / "acme_parts" / "rule.py"
    rule.write_text("ODD = None\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setenv("SURFKIT_PLUGINS", "acme")
    registry.reload()
    try:
        using = replace(COARSE_BASELINE, pretrain=replace(COARSE_BASELINE.pretrain, prune=(find(Prune, "odd")(),)))
        known, first = shared.versions(using), run_folder(tmp_path, using, data)
        assert known.keys() == {"surfkit", "acme"} and known["acme"].startswith("1.0+") and "+" not in known["surfkit"]
        assert shared.versions(COARSE_BASELINE).keys() == {"surfkit"}, "no part of it is the plugin's"
        without = run_folder(tmp_path, COARSE_BASELINE, data)
        rule.write_text("ODD = 1 - 1\n")
        assert run_folder(tmp_path, using, data) != first
        assert run_folder(tmp_path, COARSE_BASELINE, data) == without
        rule.write_text("ODD = None\n")
        assert run_folder(tmp_path, using, data) == first
        named_by_all = tmp_path / fingerprint(COARSE_BASELINE, data, shared.versions())  # as of an older version
        assert named_by_all != without
        named_by_all.mkdir()
        assert run_folder(tmp_path, COARSE_BASELINE, data) == named_by_all
    finally:
        monkeypatch.undo()
        registry.reload()


def test_rows_that_could_not_run_as_named_are_blank_and_marked(data, tmp_path, monkeypatch):
    """Their depth losses were switched off: their figures are those of the row above."""
    made = {"images": {"psnr": 20.0, "ssim": 0.5}, "points": 9, "seconds": 1.0, "cpu_seconds": 1.0}

    def run_it(recipe, data, folder, *_args, **_kwargs):
        write_json(folder / "metrics.json", made)
        lacks = Run(folder, recipe, data).wants_priors
        write_json(folder / "run.json", {"notes": [f"no depth priors, so {SWITCHED_OFF}"] if lacks else []})
        return made

    monkeypatch.setattr(rows.pipeline, "run", run_it)
    losses = COARSE_BASELINE.pretrain.losses | {"depth": DepthRegression()}
    rows_with_depth = (Row("plain"), Row("depth", {"pretrain.losses": losses}))
    table = Table("depths", "Depth", COARSE_BASELINE, rows_with_depth)
    report = ablate(AblationPlan(table, (data,), tmp_path / "out"), Silent())
    plain, depth = rows_in(report)
    assert plain["mean"]["psnr"] == 20 and plain["not_as_named"] is None
    assert depth["mean"] == {} and "depth map" in depth["not_as_named"] and depth["failed"] is None
    assert [run["folder"] for run in depth["runs"]] and not unfinished(AblationPlan(table, (data,), tmp_path / "out"))
    first, second = csv.DictReader((tmp_path / "out/ablation.csv").open())
    assert first["psnr"] == "20.0" and not first["not_as_named"]
    assert second["psnr"] == "" and "depth map" in second["not_as_named"] and second["folder"]
    tex = (tmp_path / "out/ablation.tex").read_text()
    line = next(line for line in tex.splitlines() if line.startswith("depth"))
    assert line.startswith(r"depth$^\dagger$ &") and not set("0123456789") & set(line)
    assert r"$^\dagger$" in tex.split("bottomrule")[1] and "depth map" in tex.split("bottomrule")[1]
    assert "not run as named" in markdown(report)


def test_f1_with_other_settings_or_of_another_file_is_measured_again(tmp_path):
    file = tmp_path / "gt.ply"
    file.write_text("a truth")
    automatic, given = Truth(file), Truth(file, 0.5)

    def metrics(truth):
        return {
            "geometry": {"f1": 0.5, "truth": str(file), "tau": 0.5, "table": truth.record | {"truth": truth.stamp}},
            "mesh": {},
        }

    assert given.known(metrics(given)) and automatic.known(metrics(automatic))
    assert not automatic.known(metrics(given)), "the threshold was given, and is now that of the spacing"
    assert not given.known({"geometry": {"f1": 0.9, "truth": str(file), "tau": 0.5, "align": "rigid"}}), "by evaluate"
    assert not given.known({"geometry": metrics(given)["geometry"]}), "by an older version, without the mesh by itself"
    before = metrics(given)
    del before["geometry"]["table"]["shares_crop"]
    assert not given.known(before), "by an older version, in the volume of the row that was measured first"
    before = metrics(given)
    file.write_text("another truth")
    assert not given.known(before)
    file.unlink()
    assert given.known(before), "what was measured is shown where the truth is gone"


def test_a_terminal_shows_one_live_table(data, monkeypatch, tmp_path, capsys):
    out = io.StringIO()
    console = Console(file=out, width=120, force_terminal=True)

    class Training(Runs):
        def __call__(self, recipe, data, out, device, **rest):
            with TrainingDisplay("pretrain", 1, console) as display:
                assert display.bar is None, "no second live display"
                display.outer("pretrain", 1, 1, "step 1/1")
            return super().__call__(recipe, data, out, device, **rest)

    training = Training()
    training.raises = {(1, 0): RuntimeError("too bad")}
    monkeypatch.setattr(rows.pipeline, "run", training)
    with AblationScreen(console) as screen:
        ablate(AblationPlan(TABLE, (data,), tmp_path), screen)
    text = out.getvalue()
    assert "run 1 of 2: base, seed 0" in text and "step 1/1" in text and "━" in text
    assert "21.12" in text and "run 2 of 2: less | more, seed 0: failed: RuntimeError: too bad" in text
    assert TrainingDisplay("pretrain", 1).outer is None


def test_without_a_terminal_each_run_is_two_lines(data, runs, tmp_path, capsys):
    with AblationScreen(Console(file=io.StringIO())) as screen:
        ablate(AblationPlan(TABLE, (data,), tmp_path), screen)
    said = capsys.readouterr().err.splitlines()
    assert len(said) == 4 and said[0].startswith("run 1 of 2: base, seed 0, in ")
    assert said[3] == "run 2 of 2: less | more, seed 0: PSNR 23.00 dB, SSIM 0.500, 100 points, 1.5 minutes"


def test_runs_on_folders_of_one_name_are_told_apart(data, runs, tmp_path, monkeypatch, capsys):
    for name in ("north", "south"):
        shutil.copytree(data.path, tmp_path / name / "dense")
    (tmp_path / "here").symlink_to(tmp_path / "south" / "dense")
    monkeypatch.chdir(tmp_path / "north" / "dense")
    both = (Data(Path()), Data(tmp_path / "here"))
    with AblationScreen(Console(file=io.StringIO())) as screen:
        ablate(AblationPlan(TABLE, both, tmp_path / "out", rows=("base",)), screen)
    said = capsys.readouterr().err
    assert "base, seed 0 on north/dense, in" in said and "base, seed 0 on south/dense, in" in said


def test_meshes_of_other_programs_are_rows(data, monkeypatch, tmp_path):
    """They are measured once, and stand below the rows; a bad one does not stop others."""
    from surfkit.study import foreign_meshes as others
    from surfkit.study import truth

    calls = []

    def measure(files, settings, out, views, frame):
        calls.append(files[0].name)
        if files[0].name == "bad.ply":
            raise BadInput("nowhere\nnear")
        out.mkdir(parents=True)
        write_json(out / "crop.json", {})
        return {
            "geometry": {"f1": 0.7, "normals": {"p90": 30.0}},
            "mesh": {"components": 3, "crossing": {"share": 0.1}},
        }

    monkeypatch.setattr(truth, "measure_geometry", measure)
    corners = "0 0 0\n1 0 0\n0 1 0\n"
    head = "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n"
    face = "element face 1\nproperty list uchar int vertex_indices\nend_header\n"
    for name in ("good", "bad", "gt"):
        (tmp_path / f"{name}.ply").write_text(f"{head}{face}{corners}3 0 1 2\n")
    meshes = tuple(others.OtherMesh.parsed(f"{name}={tmp_path}/{name}.ply") for name in ("good", "bad"))
    table = replace(TABLE, rows=TABLE.rows[:1], columns=("components", "crossing_share"))
    known = truth.Truth(tmp_path / "gt.ply", 0.5)
    plan = AblationPlan(table, (data,), tmp_path / "out", rows=("base",), truth=(known,), meshes=meshes)
    monkeypatch.setattr("surfkit.study.study.unfinished", lambda plan: [])
    report = ablate(plan, Silent())
    base, good, bad = rows_in(report)
    assert (good["number"], good["group"], good["mean"]["f1"], good["built_on"]) == (2, "Other programs", 0.7, None)
    assert (
        good["mean"]["components"] == 3 and good["mean"]["normals_p90"] == 30 and good["mean"]["crossing_share"] == 0.1
    )
    assert (bad["mean"], bad["failed"], bad["group"]) == ({}, "nowhere near", "") and base["failed"] is None
    assert (plan.out / good["runs"][0]["folder"] / "metrics.json").exists()
    text = (plan.out / "ablation.md").read_text()
    assert "| 2 | good |  | file |" in text and "| 10.000 % |" in text and "bad: failed: nowhere near" in text
    assert "normals" not in text, "which this table does not show"
    assert rows_in(report_so_far(plan))[1]["mean"] == good["mean"]
    ablate(plan, Silent())
    assert calls == ["good.ply", "bad.ply", "bad.ply"], "what is measured is not measured again"
    wider = replace(plan, data=(replace(data, metres_per_unit=2.0),))
    assert rows_in(report_so_far(wider))[1]["mean"] == {}, "in another unit"
    (tmp_path / "good.ply").write_text((tmp_path / "good.ply").read_text() + "\n")
    assert rows_in(report_so_far(plan))[1]["mean"] == {}, "another file"


@pytest.mark.parametrize(
    ("words", "change", "message"),
    [
        (["x"], {}, "--meshes x: give LABEL=FILE"),
        (["x={f}/gone.ply"], {}, "--meshes x: .*gone.ply: no such file"),
        (["x={f}/gt.ply"], {"truth": ()}, "name it with --gt"),
        (["base={f}/gt.ply"], {}, "table:twins has such a row already"),
        (["x={f}/gt.ply", "x={f}/gt.ply"], {}, "choose another label"),
    ],
)
def test_meshes_that_cannot_be_rows(data, tmp_path, words, change, message):
    from surfkit.study import foreign_meshes as others
    from surfkit.study import truth

    (tmp_path / "gt.ply").write_text("a truth")
    with pytest.raises(BadInput, match=message):
        meshes = tuple(others.OtherMesh.parsed(word.format(f=tmp_path)) for word in words)
        AblationPlan(
            TABLE, (data,), tmp_path, **{"truth": (truth.Truth(tmp_path / "gt.ply", 0.5),), **change}, meshes=meshes
        )
