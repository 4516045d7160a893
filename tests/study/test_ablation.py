"""Every row of every table builds, and a table is what the paper means by one."""

import json
from dataclasses import replace

import pytest

from surfkit.core.check import BadInput
from surfkit.core.codec import dump, load
from surfkit.core.hooks import hookimpl
from surfkit.core.registry import plugins, reload
from surfkit.core.tree import evolve
from surfkit.densify.filters import Elongation
from surfkit.densify.prune import PruneByImportance
from surfkit.densify.signal import LossGradient
from surfkit.densify.trim import Trim
from surfkit.losses.depth import DepthRegression
from surfkit.partition.grid import ContractedGrid
from surfkit.runs.recipe import Recipe, with_steps, without_unused
from surfkit.study import ablation
from surfkit.study.ablation import Row, Table, build, built_on, limit_points, offered_tables, pick, scaled
from surfkit.study.metric_columns import MESH_COLUMNS, TABLE_COLUMNS
from surfkit.study.recipes import city
from surfkit.study.recipes import surface_recipes as surface
from surfkit.study.recipes.ablations import (
    COARSE_BASELINE,
    GRADIENT_TABLE,
    METHODS_TABLE,
    MODEL_TABLE,
    PARTITION_TABLE,
    SURFACE_TABLE,
    TABLES,
    TRIM_TABLE,
)
from surfkit.study.recipes.surface_recipes import STEREO
from surfkit.study.row_comparison import compare

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
    assert with_steps(recipe, 600).length == 600
    short = scaled(recipe, table, 600)
    assert short.length == round(600 * recipe.length / (table.base.length or 1))
    if table in (MODEL_TABLE, GRADIENT_TABLE) and label != "CityGaussian":
        assert short.pretrain.densify.until == 300 and short.pretrain.losses["normal"].start == 140
        assert short.tune.steps == 600, "also where pretraining is shorter"
    assert label in recipe.about and name in recipe.about


@pytest.mark.parametrize(("name", "label"), ROWS)
def test_every_row_changes_what_it_is_built_on(name, label):
    table = TABLES[name]
    row = next(row for row in table.rows if row.label == label)
    below = built_on(table)[label]
    assert row.on in (None, below)
    before = row.recipe or (build(table)[below] if below else table.base)
    after = build(table)[label]
    for path, value in row.change.items():
        before = evolve(before, path, value)
    assert without_unused(before) == replace(after, about=before.about)
    if table is METHODS_TABLE:
        assert (row.recipe is None) == (below is None), "the first row is the base, the others are recipes"
    elif table in (SURFACE_TABLE, TRIM_TABLE, PARTITION_TABLE):
        assert (before == (build(table)[below] if below else table.base)) == (below is None), "a row changes something"
    else:
        assert after.pretrain.policies, "these tables are about how points multiply"


def test_the_last_kept_row_of_the_table_of_surfaces_is_the_recipe_and_each_row_wants_its_maps():
    recipes = build(SURFACE_TABLE)
    last = [row.label for row in SURFACE_TABLE.rows if row.kept][-1]
    assert recipes[last] == replace(surface.SURFACE, about=recipes[last].about, test_every=8)
    first, *others, alone = recipes.values()
    assert first.depth is None and "depth" not in first.pretrain.losses and first.pretrain.densify is not None
    assert all(recipe.depth is not None and recipe.mesh is not None for recipe in others)
    assert alone == replace(STEREO, about=alone.about, test_every=8) and scaled(alone, SURFACE_TABLE, 2_000) == alone
    assert limit_points(recipes[last], 500).start.most == 500


@pytest.mark.parametrize("name", ["model", "gradient"])
def test_every_row_has_its_published_figures(name):
    known = (
        set(TABLE_COLUMNS)
        - {"cpu_seconds", "peak_gpu_bytes", "psnr_aligned", "ssim_aligned", *MESH_COLUMNS}
        - {"accuracy", "completeness", "chamfer"}
        - ({"bytes", "peak_memory_bytes", "fps"} if name == "gradient" else set())
    )
    for row in TABLES[name].rows:
        if row.label.startswith("control") or row.label == "stereo alone":
            assert not row.paper, "the control is not in print, nor is stereo"
            continue
        assert row.paper.keys() == known
        assert (
            1 > row.paper["ssim"] > row.paper["f1"] > 0.39 > row.paper["recall"] - 0.05 and 21 < row.paper["psnr"] < 24
        )
        assert 0.2 < row.paper["lpips"] < 0.41
        precision, recall = row.paper["precision"], row.paper["recall"]
        assert row.paper["f1"] == pytest.approx(2 * precision * recall / (precision + recall), abs=0.003)
        assert row.paper["points"] > 4e6 and row.paper["seconds"] > 4_000
    assert TABLES[name].name == name


def test_published_differences_are_those_that_the_paper_writes_about():
    rows = {row["label"]: row["paper_difference"] for row in compare(MODEL_TABLE, {})}
    dgd = rows["+ DGD"]
    assert (dgd["psnr"], dgd["ssim"], dgd["f1"]) == (1.06, 0.038, 0.018), "1.0 PSNR, 0.04 SSIM, and almost 0.02 F1"
    assert rows["+ SH degree 2"]["fps"] == pytest.approx(3.2) and "fps" not in rows["control: one block"]
    assert rows["+ prune (LightGaussian)"]["psnr"] == -0.04, "it excludes trim, which stands above it"
    papers = {row.label: row.paper for row in MODEL_TABLE.rows}
    assert papers["+ trim (Ours-b)"]["bytes"] / papers["+ parallel tuning"]["bytes"] == pytest.approx(0.42, abs=0.01)
    assert papers["+ VQ (Ours-s)"]["bytes"] / papers["+ SH degree 2"]["bytes"] == pytest.approx(0.34, abs=0.01)


def test_rows_build_on_the_last_kept_one():
    recipes = build(FALLBACKS)
    assert list(recipes) == ["start", "given up", "end"]
    assert [recipe.seed for recipe in recipes.values()] == [1, 2, 1]
    assert [recipe.pretrain.sh_every for recipe in recipes.values()] == [1_000, 7, 1_000]
    assert [recipe.primitive.sh_degree for recipe in recipes.values()] == [3, 3, 0]
    on = replace(FALLBACKS, rows=(*FALLBACKS.rows, Row("aside", {"seed": 9}, on="given up")))
    assert build(on)["aside"].pretrain.sh_every == 7 and built_on(on)["aside"] == "given up"
    with pytest.raises(BadInput, match="row 'early': .*'late'; known: none"):
        replace(FALLBACKS, rows=(Row("early", on="late"), Row("late")))
    with pytest.raises(BadInput, match="row 'x', paper: .*'PSNR'"):
        Row("x", paper={"PSNR": 20.0})
    assert built_on(FALLBACKS) == {"start": None, "given up": "start", "end": "start"}


def test_the_model_table_adds_up():
    recipes = build(MODEL_TABLE)
    stages = [recipe.pretrain for recipe in recipes.values()][:4]
    assert [bool(stage.densify.filters) for stage in stages] == [False, True, True, True]
    dgd = LossGradient(terms=("ssim",), boost=0.9)
    assert [stage.signal for stage in stages] == [LossGradient(), LossGradient(), dgd, dgd]
    assert [stage.losses.get("depth") for stage in stages] == [None] * 3 + [DepthRegression(start=0.5, end=0.0025)]

    def same(label: str, recipe: Recipe, **others: object) -> bool:
        found = recipes[label]
        return replace(found, about="", mesh=None, **others) == replace(recipe, about="", mesh=None, **others)

    assert same("+ depth regression", city.CITY_COARSE)
    tenth = (Trim(ratio=0.1),)
    assert same("+ trim (Ours-b)", replace(city.CITY, tune=replace(city.CITY.tune, prune=tenth)))
    assert same("+ VQ (Ours-s)", replace(city.CITY_SMALL, tune=replace(city.CITY_SMALL.tune, prune=tenth)))
    assert same("+ 7k pretrain (Ours-t)", replace(city.CITY_TINY, tune=replace(city.CITY_TINY.tune, prune=tenth)))
    assert same("+ parallel tuning", replace(city.CITY, tune=replace(city.CITY.tune, prune=())))
    assert same("control: one block", replace(recipes["+ parallel tuning"], partition=ContractedGrid(blocks=(1, 1))))
    assert same("CityGaussian", city.CITY_FIRST)
    pruned = recipes["+ prune (LightGaussian)"].tune.prune
    assert [type(part) for part in pruned] == [PruneByImportance], "without trim: the two exclude each other"
    assert (
        built_on(MODEL_TABLE)["+ prune (LightGaussian)"]
        == "+ parallel tuning"
        == built_on(MODEL_TABLE)["+ trim (Ours-b)"]
    )
    planned = recipes["+ partition of 2DGS"].partition_pretrain
    assert planned.steps == 7_000 and planned.signal.terms is None and "depth" not in planned.losses
    assert planned.densify == COARSE_BASELINE.pretrain.densify and planned.losses == COARSE_BASELINE.pretrain.losses
    assert same("+ partition of 2DGS", recipes["+ 7k pretrain (Ours-t)"], partition_pretrain=None)


def test_the_gradient_table_changes_the_signal_and_then_the_loss():
    stages = [recipe.pretrain for recipe in build(GRADIENT_TABLE).values() if recipe.has_stages]
    signals = [None, ("ssim", "l1"), ("ssim", "normal"), ("ssim",), ("ssim",), ("ssim",), ("ssim", "depth")]
    boosts = [0.0] * 4 + [0.9, 0.0, 0.0]
    expected = [LossGradient(terms, boost) for terms, boost in zip(signals, boosts, strict=True)]
    assert [stage.signal for stage in stages] == expected
    assert ["depth" in stage.losses for stage in stages] == [False] * 5 + [True] * 2
    same = [evolve(evolve(stage, "signal", LossGradient()), "losses", {}) for stage in stages]
    assert all(stage == same[0] for stage in same) and same[0].densify.filters == (Elongation(),)
    assert list(built_on(GRADIENT_TABLE).values()) == [
        None,
        *["SSIM + RGB + normal"] * 4,
        "SSIM",
        "SSIM, depth as a loss",
        "SSIM + RGB + normal",
    ]


def test_the_baseline_is_the_published_one():
    stage = COARSE_BASELINE.pretrain
    normal = stage.losses["normal"]
    assert COARSE_BASELINE.primitive.sh_degree == 3 and stage.steps == 30_000
    assert (normal.weight, normal.start, normal.depth) == (0.0125, 7_000, "median")
    assert (stage.densify.cull_opacity, stage.densify.filters, stage.signal.terms) == (0.005, (), None)
    assert "distortion" not in stage.losses


def test_a_row_that_cannot_be_built_says_which():
    table = Table("bad", "", COARSE_BASELINE, (Row("base"), Row("worse", {"pretrain.densfy": None})))
    with pytest.raises(BadInput, match="table:bad, row 'worse': .*'densfy'"):
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
        with pytest.raises(BadInput, match=f"no row .*'{wrong}'.*known: start, given up, end; .* 1 to 3"):
            pick(FALLBACKS, [wrong])
    degrees = Table("degrees", "", COARSE_BASELINE, tuple(Row(f"{n}", {"primitive.sh_degree": n}) for n in range(4)))
    assert pick(degrees, ["2"]) == ["2"], "the row of that name, which is the third"
    assert pick(degrees, ["4"]) == ["3"]


def test_a_row_may_be_a_recipe_of_its_own():
    other = replace(COARSE_BASELINE, seed=5)
    rows = (Row("base", {"seed": 1}), Row("other", {"primitive.sh_degree": 0}, recipe=other), Row("next", {"seed": 7}))
    built = build(Table("mixed", "Rows of two kinds.", COARSE_BASELINE, rows))
    assert replace(built["other"], about=other.about) == evolve(other, "primitive.sh_degree", 0)
    assert replace(built["next"], about=other.about) == evolve(evolve(other, "primitive.sh_degree", 0), "seed", 7)


def test_no_row_builds_on_those_that_another_package_adds():
    tail = (Row("c", {"seed": 3}, kept=False), Row("alone", {"primitive.sh_degree": 0}, group=ablation.BASELINE))
    own = Table("mine", "", COARSE_BASELINE, (Row("a", {"seed": 1}), Row("b", {"seed": 2}), *tail))
    first = ablation.with_rows_of_others(own, (Row("x", {"seed": 7}), Row("y", {"primitive.sh_degree": 1})), own)
    both = ablation.with_rows_of_others(first, (Row("z", {"primitive.sh_degree": 1}),), own)
    assert built_on(both) == {"a": None, "b": "a", "c": "b", "x": "b", "y": "x", "z": "b", "alone": "b"}
    assert {label: build(both)[label] for label in build(own)} == build(own)
    aside = replace(own, rows=(replace(own.rows[0], kept=False), replace(tail[1], kept=False)))
    both = ablation.with_rows_of_others(aside, (Row("x", {"seed": 7}),), aside)
    assert built_on(both) == {"a": None, "x": None, "alone": None}


def test_packages_add_rows_to_tables_of_others(monkeypatch):
    class Plugin:
        @hookimpl
        def surfkit_rows(self):
            ours = (Row("ours", {"seed": 3}),)
            return {"methods": ours, "trim": ours, "lost": (Row("nowhere"),)}

    told = []
    monkeypatch.setattr(ablation, "emit", told.append)
    plugins().register(Plugin(), "stand-in")
    try:
        tables = offered_tables()
    finally:
        reload()
    rows = tables["methods"].rows
    assert rows[: len(METHODS_TABLE.rows)] == METHODS_TABLE.rows
    assert rows[-1] == Row("ours", {"seed": 3}, on=next(row.label for row in reversed(METHODS_TABLE.rows) if row.kept))
    labels = [row.label for row in tables["trim"].rows]
    assert labels[-2:] == ["ours", "stereo alone"], "what has no splats stays apart from what has"
    assert "lost" not in tables
    assert [event.text for event in told] == [
        "plugin stand-in adds rows to table:lost, which no package offers; they are left out"
    ]
