"""Tables of users: JSON and Python."""

import json
import re
from dataclasses import replace

import pytest
from pages import ROOT

from surfkit.core.check import BadInput
from surfkit.core.codec import dump
from surfkit.core.tree import evolve
from surfkit.densify.signal import LossGradient
from surfkit.losses.depth import DepthRegression
from surfkit.study.ablation import build, built_on
from surfkit.study.metric_columns import TABLE_COLUMNS
from surfkit.study.recipes import RECIPES
from surfkit.study.table_file import is_table_file, read_table

ROWS = [
    {"label": "plain", "paper": {"psnr": 20.5}, "group": "First"},
    {"label": "+ depth", "change": {"pretrain.losses.depth": {"use": "depth", "start": 0.3, "end": 0.1}}},
    {"label": "+ signal", "change": {"pretrain.signal": {"use": "loss-gradient", "terms": ["ssim"]}}, "kept": False},
    {"label": "+ weight", "change": {"pretrain.losses.depth.start": 0.2, "pretrain.densify": None}, "on": "+ depth"},
    {"label": "3DGS", "recipe": "3dgs", "change": {"primitive.sh_degree": 1}, "kept": False},
]
TABLE = {"name": "mine", "about": "What I try", "base": "2dgs", "rows": ROWS}


def written(tmp_path, table, name="mine.json"):
    path = tmp_path / name
    path.write_text(table if isinstance(table, str) else json.dumps(table))
    return path


def test_a_table_in_json(tmp_path):
    table = read_table(str(written(tmp_path, TABLE)))
    assert (table.name, table.about, table.base) == ("mine", "What I try", RECIPES["2dgs"])
    recipes = {label: replace(recipe, about=table.base.about) for label, recipe in build(table).items()}
    depth = evolve(table.base, "pretrain.losses.depth", DepthRegression(start=0.3, end=0.1))
    assert recipes["plain"] == table.base and recipes["+ depth"] == depth
    assert recipes["+ signal"] == evolve(depth, "pretrain.signal", LossGradient(terms=("ssim",)))
    weight = evolve(evolve(depth, "pretrain.losses.depth.start", 0.2), "pretrain.densify", None)
    assert recipes["+ weight"] == weight and built_on(table)["+ weight"] == "+ depth"
    assert recipes["3DGS"].primitive == evolve(RECIPES["3dgs"], "primitive.sh_degree", 1).primitive
    assert table.rows[0].paper == {"psnr": 20.5} and table.rows[0].group == "First" and not table.rows[2].kept


def test_recipes_may_be_written_out(tmp_path):
    own = dump(replace(RECIPES["3dgs"], seed=4))
    table = TABLE | {"base": own, "rows": [{"label": "own"}, {"label": "other", "recipe": dump(RECIPES["2dgs"])}]}
    recipes = build(read_table(str(written(tmp_path, table))))
    assert recipes["own"].seed == 4 and recipes["other"].primitive == RECIPES["2dgs"].primitive


def changing(**change):
    return TABLE | {"rows": [{"label": "x", "change": change}]}


@pytest.mark.parametrize(
    ("table", "message"),
    [
        ("{", "not JSON: .* line 1"),
        (TABLE | {"rows": []}, "rows: .*none"),
        (TABLE | {"rows": [{"labl": "x"}]}, "rows.0.labl: unknown setting; RowJson has label, change, recipe, kept, "),
        (TABLE | {"base": "2dsg"}, "base: .*'2dsg'; .*'2dgs'?.*the recipe itself"),
        (TABLE | {"base": {"sed": 1}}, "base.sed: unknown setting"),
        (TABLE | {"rows": [{"label": "x", "recipe": 3}]}, "rows.0.recipe: expected an object"),
        (changing(**{"pretrain.densfy": None}), "rows.0.change.pretrain.densfy: pretrain.densfy: unknown setting"),
        (changing(**{"pretrian.steps": 3}), "rows.0.change.pretrian.steps: the recipe has no 'pretrian'; it has about"),
        (changing(**{"pretrain.steps.x": 3}), "pretrain.steps is 30000, .*'x' "),
        (changing(**{"pretrain.densify.filters.0": 3}), "has no position '0'; it has 0 elements"),
        (changing(**{"pretrain.signal": {"terms": []}}), "a Signal without its name; add \"use\": one of "),
        (changing(**{"pretrain.signal": {"use": "no"}}), "pretrain.signal: no Signal named 'no'; known: "),
        (changing(**{"pretrain.steps": 0}), "pretrain: a stage has 0 steps"),
        (TABLE | {"rows": [{"label": "x"}, {"label": "x"}]}, "two rows 'x'"),
        (TABLE | {"rows": [{"label": "x", "on": "y"}]}, "row 'x': no row above named 'y'"),
        (TABLE | {"rows": [{"label": "x", "paper": {"PSNR": 1.0}}]}, "row 'x', paper: no column named 'PSNR'"),
    ],
)  # fmt: skip
def test_what_is_wrong_in_json_is_said_with_its_place(tmp_path, table, message):
    path = written(tmp_path, table)
    with pytest.raises(BadInput, match=message) as caught:
        read_table(str(path))
    assert str(caught.value).startswith(f"{path}: ") and "\n" not in str(caught.value)


PYTHON = """
from surfkit import Row, Table
from surfkit.study.recipes import RECIPES

ONE = Table("one", "First", RECIPES["2dgs"], (Row("base"), Row("few", {"pretrain.steps": 5})))
TWO = Table("two", "Second", RECIPES["3dgs"], (Row("base"),))
"""


def test_tables_in_python(tmp_path):
    path = written(tmp_path, PYTHON + "TABLE = ONE\n", "a.py")
    assert [recipe.pretrain.steps for recipe in build(read_table(str(path))).values()] == [30_000, 5]
    path = written(tmp_path, PYTHON + "TABLES = (ONE, TWO)\n", "b.py")
    assert read_table(f"{path}:two").about == "Second"
    with pytest.raises(BadInput, match="tables one, two; .*b.py:one"):
        read_table(str(path))
    with pytest.raises(BadInput, match="b.py: .*'three'; known: one, two"):
        read_table(f"{path}:three")
    path = written(tmp_path, PYTHON + "TABLES = {'x': TWO}\n", "c.py")
    assert read_table(str(path)).name == "two"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("x = 1\ny = z\n", "bad.py, line 2: NameError: name 'z' is not defined"),
        ("x = (\n", "bad.py, line 1: SyntaxError: "),
        ("x = 1\n", "bad.py: .*neither TABLE nor TABLES; .*surfkit.Table"),
        ("TABLE = 3\n", "bad.py: TABLE or TABLES holds 3"),
        ("TABLES = []\n", "bad.py: TABLES is empty"),
        (PYTHON + "TABLE = Table('t', '', TWO.base, (Row('r', {'sed': 1}),))\n", "table:t, row 'r': Recipe has"),
        (PYTHON + "TABLE = Table('t', '', TWO.base, (Row('r'), Row('r')))\n", "bad.py, line 7: table:t has two rows"),
    ],
)  # fmt: skip
def test_what_is_wrong_in_python_is_said_with_its_line(tmp_path, text, message):
    path = written(tmp_path, text, "bad.py")
    with pytest.raises(BadInput, match=message) as caught:
        read_table(str(path))
    assert str(caught.value).startswith(str(path)) and "\n" not in str(caught.value)


def test_files_are_told_from_names():
    assert all(map(is_table_file, ("a.json", "b/c.py", "x.py:two", "my_table.json")))
    assert not any(map(is_table_file, ("model", "table:model", "a.txt", "--x", "py:two")))


def test_the_tables_in_the_pages(tmp_path):
    page = (ROOT / "docs" / "evaluation.md").read_text()
    (text,) = re.findall(r"^```json\n(.*?)^```", page, re.M | re.S)
    table = read_table(str(written(tmp_path, text)))
    assert built_on(table)["+ SH degree 1"] == "+ elongation filter"
    recipe = build(table)["+ SH degree 1"]
    assert recipe.primitive.sh_degree == 1 and recipe.pretrain.densify.filters[0].min_ratio == 0.02
    (text,) = re.findall(r"^```python\n(.*?)^```", page, re.M | re.S)
    steps = build(read_table(str(written(tmp_path, text, "steps.py"))))
    assert [recipe.pretrain.steps for recipe in steps.values()] == [7_000, 30_000]
    for name in TABLE_COLUMNS:
        assert f"`{name}`" in page
