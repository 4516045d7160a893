"""The whole model made smaller after its blocks are merged."""

import json
import shutil
from dataclasses import replace

import pytest
import torch

from surfkit.apps.run_summary import result_rows
from surfkit.core.check import BadInput
from surfkit.core.lock import locked
from surfkit.core.registry import components
from surfkit.core.tree import evolve
from surfkit.densify.prune import PruneByImportance
from surfkit.io.datasets.data import Data
from surfkit.io.datasets.read import read
from surfkit.io.splats.ply import read_splats
from surfkit.losses.depth import DepthRegression
from surfkit.partition import PictureShare, QuantileGrid
from surfkit.primitives import Gaussian3D
from surfkit.raster.select import select
from surfkit.runs import pipeline
from surfkit.runs.blocks.train_blocks import Compute
from surfkit.runs.folder import Run
from surfkit.runs.pipeline import load_run, run
from surfkit.runs.recipe import Recipe, with_steps
from surfkit.runs.run_stage import Intervals, drawing, return_to_checkpoint
from surfkit.runs.run_status import status
from surfkit.study.recipes.city import CITY_FIRST
from surfkit.testing import check_refine
from surfkit.testing.synthetic import Flight, photograph, write_colmap
from surfkit.train import checkpoint
from surfkit.train.faults import Diverged, NotFinite
from surfkit.train.refine import DistilSH, PruneAndRecover, Refine
from surfkit.train.refine.light_gaussian import DISTILLATION, RECOVERY
from surfkit.train.stage import Stage

EVERY = Intervals(checkpoint=2, pictures=0)


@pytest.fixture(scope="module")
def data(tmp_path_factory) -> Data:
    folder = tmp_path_factory.mktemp("scene")
    write_colmap(folder, photograph(Flight(views=12, width=32, height=24, points=200)))
    return Data(folder)


@pytest.fixture(scope="module")
def recipe() -> Recipe:
    """One block, then half of the points for 4 steps, then colours of degree 1 for 6."""
    stage, recover, distil = Stage(steps=6, sh_every=1), PruneAndRecover(), DistilSH(sh_degree=1, copies=2)
    return Recipe(
        primitive=Gaussian3D(sh_degree=2),
        pretrain=stage,
        partition=QuantileGrid((1, 1)),
        assign=PictureShare(),
        tune=stage,
        refine=(
            replace(recover, stage=replace(recover.stage, steps=4)),
            replace(distil, stage=replace(distil.stage, steps=6)),
        ),
    )


@pytest.fixture(scope="module")
def finished(data, recipe, tmp_path_factory):
    out = tmp_path_factory.mktemp("finished") / "run"
    run(recipe, data, out, Compute("cpu"), EVERY)
    return out


def state_of(out, part):
    return checkpoint.load_last(out / part / "checkpoint.safetensors")[0]


def test_what_is_left(finished):
    assert [len(state_of(finished, part).points) for part in ("tune", "refine0", "refine1")] == [200, 100, 100]
    splats = read_splats(finished / "point_cloud.ply")
    assert splats.means.shape == (100, 3) and splats.sh_rest.shape == (100, 3, 3)
    loaded, state, _ = load_run(finished)
    assert loaded.last.name == "refine1" and loaded.last.primitive.sh_degree == 1 and state.index == 6
    for folder, steps in ((finished, 6), (finished / "refine0", 4), (finished / "refine1", 6)):
        lines = map(json.loads, (folder / "events.jsonl").read_text().splitlines())
        assert [line["index"] for line in lines if line["event"] == "StepDone"] == [*range(1, steps + 1)]
    told = status(finished)
    assert (told.state, told.stage, told.step, told.steps, told.points) == ("finished", "refine1", 6, 6, 100)
    metrics = json.loads((finished / "metrics.json").read_text())
    assert metrics["points"] == 100
    assert {name: one["points"] for name, one in metrics["before"].items()} == {"refine0": 200, "refine1": 100}
    shown = dict(result_rows(metrics))
    assert shown["before refine0"] != shown["before refine1"] and "200 points" in shown["before refine0"]
    spent = [state_of(finished, part).cpu_seconds for part in ("tune", "refine0", "refine1")]
    assert 0 < spent[0] < spent[1] < spent[2] == metrics["cpu_seconds"], "all stages count"


def test_refinement_begins_with_the_harmonics_of_the_model(finished):
    """Its own steps are too few for any, and distillation leaves one degree."""
    assert PruneAndRecover().stage.sh_every == DistilSH().stage.sh_every == 1_000
    assert [state_of(finished, part).sh_degree for part in ("tune", "refine0", "refine1")] == [2, 2, 1]


def test_recovery_goes_on_from_the_merged_model(finished):
    """Its points are some of the merged ones, moved by four steps of Adam at most."""
    before, after = (state_of(finished, part).points.params for part in ("tune", "refine0"))
    nearest = (after["means"][:, None] - before["means"]).norm(dim=-1).min(1)
    assert float(nearest.values.max()) < 4 * 3e-7 * 3**0.5 * 1.5
    assert len(set(nearest.indices.tolist())) == 100


def test_distillation_learns_what_the_model_drew_before(finished, data):
    """Beside the photographs too, the student is nearer to the teacher than the teacher without those harmonics is."""
    loaded, student, scene = load_run(finished)
    teacher = state_of(finished, "refine0")
    assert torch.equal(teacher.points.params["opacities"], student.points.params["opacities"]), "they are frozen"
    cut = replace(teacher.points, params=loaded.recipe.refine[1].params(teacher.points.params))
    (*_, before, last), rasterizer = loaded.stages, select("cpu")[0]
    drawn = [
        drawing(stage, state, rasterizer, geometry=False)
        for stage, state in ((before, teacher), (last, student), (last, replace(teacher, points=cut, sh_degree=1)))
    ]
    views = loaded.recipe.refine[1].views(scene.train, 0)
    taught, learnt, plain = (torch.stack([draw(view).color for view in views]) for draw in drawn)
    assert float((learnt - taught).abs().mean()) < 0.9 * float((plain - taught).abs().mean())


def test_interrupted_and_continued(finished, data, recipe, tmp_path, monkeypatch):
    save, count = checkpoint.save, 0

    def stop(path, state):
        nonlocal count
        save(path, state)
        count += 1
        if path.parent.name.startswith("refine") and state.index == 2:
            raise KeyboardInterrupt

    monkeypatch.setattr(checkpoint, "save", stop)
    for part in ("refine0", "refine1"):
        with pytest.raises(KeyboardInterrupt):
            run(recipe, data, tmp_path, Compute("cpu"), EVERY)
        assert state_of(tmp_path, part).index == 2
        with pytest.raises(BadInput, match="stopped after step 2"):
            load_run(tmp_path)
    monkeypatch.undo()
    run(recipe, data, tmp_path, Compute("cpu"), EVERY)
    assert (tmp_path / "point_cloud.ply").read_bytes() == (finished / "point_cloud.ply").read_bytes()


def interrupt(*_):
    raise KeyboardInterrupt


def test_a_longer_run_refines_anew(finished, data, recipe, tmp_path, monkeypatch):
    out = tmp_path / "run"
    shutil.copytree(finished, out)
    longer = replace(recipe, pretrain=replace(recipe.pretrain, steps=8))
    with pytest.raises(KeyboardInterrupt), monkeypatch.context() as patch:
        patch.setattr(pipeline, "tune_blocks", interrupt)
        run(longer, data, out, Compute("cpu"), EVERY)
    assert status(out).stage == "pretrain"
    run(longer, data, out, Compute("cpu"), EVERY)
    assert not torch.equal(
        state_of(out, "refine0").points.params["sh0"], state_of(finished, "refine0").points.params["sh0"]
    )


def test_the_time_left_is_that_of_the_refinement(finished, tmp_path):
    out = tmp_path / "run"
    shutil.copytree(finished, out)
    journal = out / "refine1" / "events.jsonl"
    lines = [json.loads(text) for text in journal.read_text().splitlines()]
    lines = [line | {"time": 10.0 * line["index"]} for line in lines if line["event"] == "StepDone"][:4]
    began = {"event": "StageBegan", "time": 0.0, "stage": "refine1", "steps": 6, "points": 100, "first": 1}
    journal.write_text("".join(json.dumps(line) + "\n" for line in [began, *lines]))
    with locked(out):
        assert status(out).seconds_left == pytest.approx(20.0)


def test_numbers_that_stay_infinite_name_the_rates_of_the_refinement(data, recipe, tmp_path):
    with pytest.raises(NotFinite, match=r"lower refine\.1\.stage\.rates"):
        return_to_checkpoint(Run(tmp_path, recipe, data).last, 2, Diverged(3, "a.png", "infinite"), interrupt)


def test_a_file_in_the_place_of_a_folder(data, recipe, tmp_path):
    (tmp_path / "refine0").touch()
    with pytest.raises(BadInput, match="refine0: a file"):
        run(recipe, data, tmp_path, Compute("cpu"), EVERY)


def test_a_refinement_less_or_another_is_named(finished, data, recipe):
    other = replace(recipe.refine[1], copies=3)
    for refine, told in (
        (recipe.refine[:1], r"refine.1 \{.*, and this one has null"),
        ((recipe.refine[0], other, PruneAndRecover()), r"refine.1.copies 2, and this one has 3"),
    ):
        with pytest.raises(BadInput, match=told):
            run(replace(recipe, refine=refine), data, finished, Compute("cpu"), EVERY)


def test_a_finished_run_is_refined_further(finished, data, recipe, tmp_path):
    """To the same bits as in one go, without a step of what is there made again."""
    out = tmp_path / "run"
    run(replace(recipe, refine=recipe.refine[:1]), data, out, Compute("cpu"), EVERY)
    journals = [out / "events.jsonl", out / "blocks" / "000" / "events.jsonl", out / "refine0" / "events.jsonl"]
    before = [path.read_text().count("StepDone") for path in journals]
    metrics = run(recipe, data, out, Compute("cpu"), EVERY)
    assert [path.read_text().count("StepDone") for path in journals] == before
    assert (out / "point_cloud.ply").read_bytes() == (finished / "point_cloud.ply").read_bytes()
    assert metrics["steps"] == 6 + 6 + 4 + 6


def test_longer_and_refined_at_once_is_refused(data, tmp_path):
    """Of the two, the message names the refinement: it is what the folder lacks."""
    plain = Recipe(pretrain=Stage(steps=2, sh_every=1))
    run(plain, data, tmp_path, Compute("cpu"), EVERY)
    with pytest.raises(BadInput, match=r"refine\.0 null"):
        run(with_steps(replace(plain, refine=(PruneAndRecover(),)), 4), data, tmp_path, Compute("cpu"), EVERY)


def test_what_is_known_is_not_told_again(data, recipe, tmp_path, capsys):
    depth = replace(recipe.refine[0].stage, losses=Stage().losses | {"depth": DepthRegression()})
    short = replace(recipe, partition=None, refine=(PruneAndRecover(stage=depth),))
    run(evolve(short, "pretrain.losses", depth.losses), data, tmp_path, Compute("cpu"), EVERY)
    assert capsys.readouterr().err.count("has no depth priors") == 1


def test_depth_priors_teach_nothing_where_the_model_does():
    losses = Stage().losses | {"depth": DepthRegression()}
    with pytest.raises(BadInput, match="refine.1: .*depth .*priors"):
        Recipe(refine=(PruneAndRecover(stage=Stage(losses=losses)), DistilSH(stage=Stage(losses=losses))))


def test_cameras_beside_those_of_the_photographs(data):
    scene = read(data)
    views = DistilSH(jitter=0.01, copies=40).views(scene.train, 0)
    there = torch.stack([view.camera.centre for view in scene.train]).repeat(40, 1)
    shift = torch.stack([view.camera.centre for view in views]) - there
    assert len(views) == 40 * len(scene.train)
    assert float(shift.std()) == pytest.approx(0.01, rel=0.1) and abs(float(shift.mean())) < 0.002
    turned = [view.camera.world_to_camera[:3, :3] for view in views[: len(scene.train)]]
    assert all(torch.equal(a, b.camera.world_to_camera[:3, :3]) for a, b in zip(turned, scene.train, strict=True))
    first, again, other = (DistilSH().views(scene.train, seed)[0].camera.centre for seed in (0, 0, 1))
    assert torch.equal(first, again) and not torch.equal(first, other)


def test_citygaussian():
    recover, distil = CITY_FIRST.refine
    assert recover.stage.prune == (PruneByImportance(at=(0,), ratio=0.5),) and recover.stage.steps == 30_000
    assert with_steps(CITY_FIRST, 1_000).refine[0].stage.prune[0].at == (0,), "at once, whatever the length"
    for rates, stage, fall, each in ((RECOVERY, recover.stage, 0.95, 400), (DISTILLATION, distil.stage, 0.9, 500)):
        ratio = rates["sh0"].at(each * 2, stage.steps) / rates["sh0"].at(each, stage.steps)
        assert ratio == pytest.approx(fall, rel=1e-3)
    assert DISTILLATION["means"].start == pytest.approx(RECOVERY["means"].at(30_000, 40_000), rel=0.01)
    assert DISTILLATION["opacities"].at(5, 10) == 0


class Keeps(DistilSH):
    """Says that colours are simpler than they are."""

    def params(self, params):
        return params


class Wanders(PruneAndRecover):
    """Looks from where there is no photograph."""

    def views(self, views, seed):
        return DistilSH().views(views, seed)


@pytest.mark.parametrize("refine", [*(cls() for cls in components(Refine).values()), Keeps(), Wanders()])
def test_conformance(refine, data):
    try:
        for mesher in refine.meshers:
            mesher.ready()
    except BadInput as lacking:
        pytest.skip(str(lacking))
    scene, primitive = read(data), Gaussian3D(sh_degree=3)
    params = primitive.init(scene.cloud, torch.Generator().manual_seed(0))
    if isinstance(refine, (Keeps, Wanders)):
        with pytest.raises(AssertionError, match=type(refine).__name__):
            check_refine(refine, primitive, params, scene.train)
    else:
        check_refine(refine, primitive, params, scene.train)


@pytest.mark.parametrize("wrong", [{"sh_degree": 4}, {"jitter": -1.0}, {"copies": 0}])
def test_settings_that_cannot_be(wrong):
    with pytest.raises(BadInput, match="distil"):
        DistilSH(**wrong)
