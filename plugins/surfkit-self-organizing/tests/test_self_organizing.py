"""The loss by hand in float64, trainings that are interrupted, blocks, and files of SOG in another order."""

import io
import json
import math
import warnings
import zipfile
from dataclasses import replace

import numpy as np
import pytest
import surfkit_self_organizing
import torch
from PIL import Image
from surfkit_self_organizing.attributes import attributes_of, grid_order, table_attributes, turned
from surfkit_self_organizing.format import GridSOG
from surfkit_self_organizing.smooth import COLUMN, ROW, SmoothGrid, roughness

from surfkit.core.registry import plugins
from surfkit.io.datasets.data import Data
from surfkit.io.splats.splat_files import format_for, format_of, read_splat_file
from surfkit.partition import QuantileGrid
from surfkit.plugin import (
    ADC,
    SOG,
    BadInput,
    Gaussian3D,
    Points,
    PruneByOpacity,
    Recipe,
    Regularizer,
    RegularizerInput,
    Splats,
    SplatTable,
    Stage,
    Target,
    Trainer,
    checkpoint,
    components,
    refuse_unfit_stage,
    rescale,
)
from surfkit.raster.select import select
from surfkit.runs.blocks.train_blocks import Compute
from surfkit.runs.pipeline import run
from surfkit.runs.run_stage import Intervals
from surfkit.study.ablation import build, offered_tables
from surfkit.testing import check
from surfkit.testing.inputs import splats, survey
from surfkit.testing.synthetic import Flight, photograph, write_colmap

EVERYTHING = SmoothGrid(positions=0.5, colors=2.0, harmonics=0.25, scales=0.75, rotations=3.0, opacities=1.5)


@pytest.fixture(autouse=True)
def offered():
    """The plugin, as if it were installed, where it is not."""
    there = SmoothGrid in components(Regularizer).values()
    if not there:
        plugins().register(surfkit_self_organizing, "self-organizing of this test")
    yield
    if not there:
        plugins().unregister(surfkit_self_organizing)


@pytest.mark.parametrize("part", [SmoothGrid(), replace(EVERYTHING, start=999, sigma=0.4, delta=2.0), GridSOG()])
def test_the_parts_keep_to_the_contract_of_their_kind(part):
    check(part)


def by_hand(values: np.ndarray, row: np.ndarray, column: np.ndarray, delta: float, sigma: float) -> np.ndarray:
    """(M, D) Huber loss of each component, by a sum over all pairs of points."""
    apart = lambda at: at[:, None] - at  # noqa: E731 (only here)
    down, across = apart(row), apart(column)
    near = (np.abs(down) <= math.ceil(3 * sigma)) & (np.abs(across) <= math.ceil(3 * sigma))
    weight = np.where(near, np.exp(-(down**2 + across**2) / (2 * sigma**2)), 0)
    off = np.abs(values - weight @ values / weight.sum(1, keepdims=True))
    return np.where(off <= delta, off**2 / 2, delta * (off - delta / 2))


def holed(count: int, width: int, draw: np.random.Generator) -> tuple[torch.Tensor, torch.Tensor]:
    """Rows and columns of points in random places of a grid with about as many empty ones."""
    place = draw.permutation(2 * count)[:count]
    return torch.from_numpy(place // width), torch.from_numpy(place % width)


@pytest.mark.parametrize("sigma", [0.3, 1.0, 2.5])
def test_the_loss_is_that_of_a_sum_over_pairs_and_its_gradient_that_of_differences(sigma):
    draw = np.random.default_rng(0)
    given = splats("gaussian", 16)
    given = given.with_named({name: value.double() for name, value in given.named().items()})
    row, column = holed(16, 6, draw)
    columns = {name: value.numpy() for name, value in attributes_of(given).items()}
    weights = {name: getattr(EVERYTHING, name) for name in columns}
    expected = sum(
        weights[name] * by_hand(value, row.numpy(), column.numpy(), 0.3, sigma).sum() / 16
        for name, value in columns.items()
    )
    found = roughness(attributes_of(given), weights, row, column, 0.3, sigma)
    assert float(found) == pytest.approx(expected, rel=1e-12)

    leaves = [value.clone().requires_grad_() for value in given.named().values()]

    def loss(*values: torch.Tensor) -> torch.Tensor:
        changed = given.with_named(dict(zip(given.named(), values, strict=True)))
        return roughness(attributes_of(changed), weights, row, column, 0.3, sigma)

    assert torch.autograd.gradcheck(loss, leaves, eps=1e-7, atol=1e-7)


def test_rotations_that_are_the_same_are_not_apart():
    quats = torch.randn(30, 4, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    assert torch.allclose(turned(quats), turned(-2 * quats), atol=1e-15)
    kept = turned(quats)
    assert torch.allclose((kept * quats).sum(1).abs(), quats.norm(dim=1))
    assert (kept.gather(1, kept.abs().argmax(1, keepdim=True)) > 0).all()


def step_of(index: int, columns: dict[str, torch.Tensor], count: int, seed: int = 5) -> RegularizerInput:
    def stat(name: str, *shape: int) -> torch.Tensor:
        return columns.setdefault(name, torch.zeros(count, *shape))

    target = Target(view=None, photo=torch.zeros(3, 1, 1), seed=seed, index=index)
    return RegularizerInput(index, 100, target, None, None, stat)


def leaves_of(given: Splats) -> Splats:
    return given.with_named({name: value.clone().requires_grad_() for name, value in given.named().items()})


def test_points_are_sorted_when_it_is_due_and_keep_their_places_until_then():
    given, columns = splats("gaussian", 90), {}
    term = replace(EVERYTHING, start=3, every=4)
    places = {}
    for index in range(4, 13):
        # Other splats in every step: places that were found anew would differ.
        moved = given.take(torch.randperm(90, generator=torch.Generator().manual_seed(index)))
        value = term.in_step(moved, step_of(index, columns, 90, seed=index))
        places[index] = columns[ROW].clone(), columns[COLUMN].clone()
        width = SOG.picture_width(90)
        at = ((columns[ROW] - 1) * width + columns[COLUMN] - 1).long()
        assert at.sort().values.tolist() == list(range(90))
        if index in (4, 8, 12):
            expected = np.argsort(grid_order(attributes_of(moved), index))
            assert np.array_equal(at.numpy(), expected)
        else:
            assert all(torch.equal(a, b) for a, b in zip(places[index], places[index - 1], strict=True))
        assert float(value) > 0
    assert [term.weight_at(index, 30_000) for index in (3, 4, 30_000)] == [0, 0.3, 0.3]


def test_empty_places_and_points_without_a_place_have_no_part_in_the_loss():
    given, columns = splats("gaussian", 90), {}
    EVERYTHING.in_step(given, step_of(1, columns, 90))
    drop = torch.rand(90, generator=torch.Generator().manual_seed(1)) < 0.3
    left = {name: torch.cat([value[~drop], torch.zeros(7)]) for name, value in columns.items()}
    old = given.take(~drop)
    both = leaves_of(old.and_then(given.first(7)))
    value = EVERYTHING.in_step(both, step_of(2, left, len(both)))
    value.backward()
    weights = {name: getattr(EVERYTHING, name) for name in attributes_of(old)}
    row, column = ((columns[name][~drop] - 1).long() for name in (ROW, COLUMN))
    assert float(value.detach()) == pytest.approx(
        float(roughness(attributes_of(old), weights, row, column, EVERYTHING.delta, EVERYTHING.sigma)), rel=1e-6
    )
    for name, leaf in both.named().items():
        assert not leaf.grad[-7:].any(), name
        assert leaf.grad[:-7].flatten(1).any() if leaf.dim() > 1 else leaf.grad[:-7].any(), name
    nobody = leaves_of(given)
    EVERYTHING.in_step(nobody, step_of(2, {}, 90)).backward()
    assert not nobody.means.grad.any()


def test_a_weight_of_0_leaves_an_attribute_alone():
    given = leaves_of(splats("gaussian", 90))
    SmoothGrid(colors=0.0, rotations=0.0)(given).backward()
    changed = {name for name, leaf in given.named().items() if leaf.grad is not None and leaf.grad.any()}
    assert changed == {"scales", "opacities"}


def begun(stage: Stage):
    truth, primitive, draw = survey(6, 32, 24, 150), Gaussian3D(sh_degree=1), torch.Generator().manual_seed(0)
    photos = [(truth.exact[view.name].color * 255).round().to(torch.uint8) for view in truth.scene.train]
    trainer = Trainer(stage, primitive, truth.scene.train, photos, select("cpu")[0])
    return trainer, trainer.begin(Points.fresh(primitive.init(truth.scene.cloud, draw)), draw)


def test_a_training_with_edits_goes_on_from_a_checkpoint_to_the_same_bits(tmp_path):
    stage = Stage(
        steps=30,
        sh_every=5,
        densify=ADC(start=5, every=7, until=24, threshold=1e-6, reset_every=1_000),
        prune=(PruneByOpacity(start=10, until=30, every=5, below=0.05, recovery=0),),
        regularizers={"smooth": replace(EVERYTHING, start=3, every=8)},
    )
    trainer, state = begun(stage)
    others = {}
    while state.index < stage.steps:
        trainer.step(state)
        if state.index in (19, 24):  # before a step that sorts again, and between two of them
            path = tmp_path / f"{state.index}.safetensors"
            checkpoint.save(path, state)
            others[state.index] = checkpoint.load(path)
            assert 0 < int((state.points.stats[ROW] > 0).sum()) < len(state.points)
    for other in others.values():
        list(begun(stage)[0].run(other))
        assert len(state.points) == len(other.points) > 150
        for group, again in zip(state.points.groups, other.points.groups, strict=True):
            assert group.keys() == again.keys()
            assert all(torch.equal(value, again[name]) for name, value in group.items())


def test_a_trained_grid_is_smoother_than_one_without_the_loss():
    def unlike(weight: float) -> float:
        stage = Stage(steps=60, regularizers={"smooth": SmoothGrid(weight=weight, every=10)})
        trainer, state = begun(stage)
        list(trainer.run(state))
        return float(SmoothGrid()(Gaussian3D(sh_degree=1).activate(state.points.params, 1)))

    assert unlike(20.0) < 0.6 * unlike(0.0)


def test_blocks_are_smoothed_each_by_itself(tmp_path):
    write_colmap(tmp_path / "scene", photograph(Flight(views=12, width=32, height=24, points=120)))
    stage, out = Stage(steps=8, regularizers={"smooth": SmoothGrid(every=3)}), tmp_path / "run"
    recipe = Recipe(primitive=Gaussian3D(), pretrain=stage, partition=QuantileGrid((2, 1)), tune=stage, mesh=None)
    run(recipe, Data(tmp_path / "scene"), out, Compute("cpu"), Intervals(checkpoint=4, pictures=0))
    for name in ("000", "001"):
        points = checkpoint.load(out / "blocks" / name / "tune" / "checkpoint.safetensors").points
        at = torch.stack([points.stats[ROW], points.stats[COLUMN]], 1)
        assert (at > 0).all() and len(at.unique(dim=0)) == len(points) > 10


def some_table(count: int = 300) -> SplatTable:
    given = splats("gaussian", count)
    logits = torch.logit(given.opacities)
    return SplatTable("gaussian", given.means, given.quats, given.scales.log(), logits, given.sh0[:, 0], given.sh_rest)


def pictures(path) -> dict[str, np.ndarray]:
    with zipfile.ZipFile(path) as archive:
        count = json.loads(archive.read("meta.json"))["count"]
        images = {name: Image.open(io.BytesIO(archive.read(name))) for name in archive.namelist() if "webp" in name}
        return {
            name: np.asarray(image.convert("RGBA")).reshape(-1, 4)[:count].astype(int) for name, image in images.items()
        }


def test_files_hold_the_splats_of_other_sog_files_in_the_order_of_the_grid(tmp_path):
    table = some_table(256)  # a power of two: harmonics need no k-means, whose draws depend on the order
    for form in (SOG(), GridSOG()):
        form.write(tmp_path / f"model{form.suffix}", table)
    curve, grid = (read_splat_file(tmp_path / f"model{form.suffix}") for form in (SOG(), GridSOG()))
    order = grid_order(table_attributes(table), 0)
    # The place of each splat along the curve, by what was written for it.
    place = torch.cdist(grid.means.double(), curve.means.double()).argmin(1)
    assert place.sort().values.tolist() == list(range(256))
    for name in ("means", "quats", "log_scales", "opacity_logits", "sh0", "sh_rest"):
        assert torch.equal(getattr(grid, name), getattr(curve, name)[place]), name
    assert torch.allclose(grid.means, table.means[order], atol=1e-3)
    facts = [
        json.loads(zipfile.ZipFile(tmp_path / f"model{form.suffix}").read("meta.json")) for form in (SOG(), GridSOG())
    ]
    assert facts[0] == facts[1]


def test_pictures_are_smoother_than_along_a_curve(tmp_path):
    draw = torch.Generator().manual_seed(0)
    look, width = torch.rand(1_000, 2, generator=draw), SOG.picture_width(1_000)
    colors = torch.cat([look, look.sum(1, keepdim=True)], 1)  # they do not depend on positions
    table = replace(some_table(1_000), sh0=colors, log_scales=-3 - colors)
    rough = {}
    for form in (SOG(), GridSOG()):
        form.write(tmp_path / f"model{form.suffix}", table)
        for name in ("scales.webp", "sh0.webp"):
            found = pictures(tmp_path / f"model{form.suffix}")[name][: 1_000 // width * width].reshape(-1, width, 4)
            rough[name, form.suffix] = np.abs(np.diff(found, axis=0)).mean() + np.abs(np.diff(found, axis=1)).mean()
    for name in ("scales.webp", "sh0.webp"):
        assert rough[name, ".grid.sog"] < 0.7 * rough[name, ".sog"], name


def test_the_name_of_a_file_chooses_the_order(tmp_path):
    assert type(format_for(tmp_path / "a.sog")) is SOG
    assert type(format_for(tmp_path / "a.grid.sog")) is GridSOG
    for name in ("a.sog", "a.grid.sog", "a.dat"):
        GridSOG().write(tmp_path / name, some_table(20))
        assert type(format_of(tmp_path / name)) is SOG
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        GridSOG().write(tmp_path / "none.grid.sog", some_table(20).take(torch.zeros(20, dtype=torch.bool)))
    assert len(read_splat_file(tmp_path / "none.grid.sog")) == 0


def test_the_recipe_has_its_row_and_scales_with_the_steps():
    recipe = build(offered_tables()["methods"])["Self-Organizing Gaussians"]
    assert recipe.pretrain == surfkit_self_organizing.SELF_ORGANIZING.pretrain
    refuse_unfit_stage("pretrain", recipe.pretrain, recipe.primitive)
    assert rescale(recipe, 400 / 30_000).pretrain.regularizers["smooth"].every == 50


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ({"weight": -1.0}, "weight is -1; it must be 0 or more"),
        ({"rotations": float("nan")}, "rotations is nan; it must be 0 or more"),
        ({"scales": float("inf")}, "scales is inf; it must be 0 or more, and finite"),
        ({"delta": 0.0}, "delta is 0; it must be above 0"),
        ({"sigma": float("inf")}, "sigma is inf; it must be above 0"),
        ({"start": -1}, "start -1, every 1000; give 0 steps or more"),
        ({"every": 0}, "start 0, every 0; give 0 steps or more, and 1 or more"),
        (dict.fromkeys(("colors", "scales", "rotations", "opacities"), 0.0), "are 0, so that nothing is smoothed"),
    ],
)
def test_settings_that_mean_nothing_are_refused(settings, said):
    with pytest.raises(BadInput, match=said):
        SmoothGrid(**settings)


def test_splats_whose_tensors_stand_for_something_else_are_refused():
    with pytest.raises(BadInput, match="splats of the kind 'anchor'; choose another primitive"):
        SmoothGrid().in_step(replace(splats("gaussian", 20), kind="anchor"), step_of(1, {}, 20))
