"""Every row of every table builds, and a table is what the paper means by one."""

import json
from dataclasses import replace

import pytest

from surfkit.core.check import BadInput
from surfkit.core.codec import dump, load
from surfkit.core.tree import evolve
from surfkit.densify.filters import Elongation
from surfkit.densify.signal import LossGradient
from surfkit.losses.depth import DepthRegression
from surfkit.pipeline import with_steps
from surfkit.recipe import Recipe, without_unused
from surfkit.recipes import surface
from surfkit.recipes.ablations import COARSE_BASELINE, GRADIENT, MODEL, SURFACE, TABLES
from surfkit.recipes.surface import STEREO
from surfkit.report.ablation import Row, Table, build, built_on, limit_points, pick, scaled

ROWS = [(name, row.label) for name, table in TABLES.items() for row in table.rows]
FALLBACKS = Table(
    "ladder",
    "A kept row, one given up, and one more.",
    COARSE_BASELINE,
    (
        Row("start", {"seed": 1}),
        Row("given up", {"seed": 2, "pretrain.sh_every": 7}, kept=False),
        Row("end", {"primitive.sh_degree": 0}),
    ),
)


@pytest.mark.parametrize(("name", "label"), ROWS)
def test_every_row_is_a_recipe(name, label):
    table = TABLES[name]
    recipe = build(table)[label]
    assert load(Recipe, json.loads(json.dumps(dump(recipe), allow_nan=False))) == recipe
    if recipe.length is None:
        return
    short = with_steps(recipe, 600)
    assert short.pretrain.steps == 600
    if table is not SURFACE:
        assert short.pretrain.densify.until == 300 and short.pretrain.losses["normal"].start == 140
    assert label in recipe.about and name in recipe.about


@pytest.mark.parametrize(("name", "label"), ROWS)
def test_every_row_changes_what_it_is_built_on(name, label):
    table = TABLES[name]
    row = next(row for row in table.rows if row.label == label)
    below = built_on(table)[label]
    before = build(table)[below] if below else table.base
    after = build(table)[label]
    for path, value in row.change.items():
        before = evolve(before, path, value)
    assert without_unused(before) == replace(after, about=before.about)
    if table is SURFACE:
        assert (before == (build(table)[below] if below else table.base)) == (below is None), "a row changes something"
    else:
        assert after.pretrain.policies, "these tables are about how points multiply"


def test_the_last_kept_row_of_the_table_of_surfaces_is_the_recipe_and_each_row_wants_its_maps():
    recipes = build(SURFACE)
    last = [row.label for row in SURFACE.rows if row.kept][-1]
    assert recipes[last] == replace(surface.SURFACE, about=recipes[last].about)
    first, *others, alone = recipes.values()
    assert first.depth is None and "depth" not in first.pretrain.losses and first.pretrain.densify is not None
    assert all(recipe.depth is not None and recipe.mesh is not None for recipe in others)
    assert alone == replace(STEREO, about=alone.about) and scaled(alone, SURFACE, 2_000) == alone
    assert limit_points(recipes[last], 500).start.most == 500


@pytest.mark.parametrize("name", ["model", "gradient"])
def test_every_row_has_its_published_figures(name):
    for row in TABLES[name].rows:
        assert row.paper.keys() == {"psnr", "ssim", "f1", "points"}
        assert row.paper["psnr"] > 20 > row.paper["ssim"] and row.paper["points"] > 9e6
    assert TABLES[name].name == name


def test_rows_build_on_the_last_kept_one():
    recipes = build(FALLBACKS)
    assert list(recipes) == ["start", "given up", "end"]
    assert [recipe.seed for recipe in recipes.values()] == [1, 2, 1]
    assert [recipe.pretrain.sh_every for recipe in recipes.values()] == [1_000, 7, 1_000]
    assert [recipe.primitive.sh_degree for recipe in recipes.values()] == [3, 3, 0]
    assert built_on(FALLBACKS) == {"start": None, "given up": "start", "end": "start"}


def test_the_model_table_adds_up():
    stages = [recipe.pretrain for recipe in build(MODEL).values()]
    assert [bool(stage.densify.filters) for stage in stages] == [False, True, True, True]
    dgd = LossGradient(terms=("ssim",), boost=0.9)
    assert [stage.signal for stage in stages] == [LossGradient(), LossGradient(), dgd, dgd]
    assert [stage.losses.get("depth") for stage in stages] == [None] * 3 + [DepthRegression(start=0.5, end=0.0025)]


def test_the_gradient_table_changes_the_signal_and_then_the_loss():
    stages = [recipe.pretrain for recipe in build(GRADIENT).values()]
    terms = [None, ("ssim", "l1"), ("ssim", "normal"), ("ssim",), ("ssim",), ("ssim", "depth")]
    assert [stage.signal for stage in stages] == [LossGradient(terms=names) for names in terms]
    assert ["depth" in stage.losses for stage in stages] == [False] * 4 + [True] * 2
    same = [evolve(evolve(stage, "signal", LossGradient()), "losses", {}) for stage in stages]
    assert all(stage == same[0] for stage in same) and same[0].densify.filters == (Elongation(),)
    assert list(built_on(GRADIENT).values()) == [None, *["SSIM + RGB + normal"] * 3, "SSIM", "SSIM, depth as a loss"]


def test_the_baseline_is_the_published_one():
    stage = COARSE_BASELINE.pretrain
    normal = stage.losses["normal"]
    assert COARSE_BASELINE.primitive.sh_degree == 3 and stage.steps == 30_000
    assert (normal.weight, normal.start, normal.depth) == (0.0125, 7_000, "median")
    assert (stage.densify.cull_opacity, stage.densify.filters, stage.signal.terms) == (0.005, (), None)
    assert "distortion" not in stage.losses


def test_a_row_that_cannot_be_built_says_which():
    table = Table("bad", "", COARSE_BASELINE, (Row("base"), Row("worse", {"pretrain.densfy": None})))
    with pytest.raises(BadInput, match="table:bad, row 'worse': pretrain has no 'densfy'"):
        build(table)
    with pytest.raises(BadInput, match="two rows 'a'"):
        Table("bad", "", COARSE_BASELINE, (Row("a"), Row("b"), Row("a")))


def test_a_row_with_a_shorter_run_stays_shorter():
    table = Table("short", "", COARSE_BASELINE, (Row("long"), Row("short", {"pretrain.steps": 7_500})))
    steps = [scaled(recipe, table, 1_000).pretrain.steps for recipe in build(table).values()]
    assert steps == [1_000, 250]
    assert scaled(table.base, table, None) is table.base
    with pytest.raises(BadInput, match="--steps 0"):
        scaled(table.base, table, 0)


def test_rows_are_picked_by_number_or_label():
    assert pick(FALLBACKS, []) == ["start", "given up", "end"]
    assert pick(FALLBACKS, ["3", "start"]) == ["start", "end"]
    for wrong in ("0", "4", "strt"):
        with pytest.raises(BadInput, match=f"no row named '{wrong}'.*known: start, given up, end; .* 1 to 3"):
            pick(FALLBACKS, [wrong])
