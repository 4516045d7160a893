import json
import math
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import pytest

from surfkit.core.check import BadInput
from surfkit.core.codec import MAX_NESTING_DEPTH, dump, load, read_json, read_keys, write_json


@dataclass(frozen=True)
class Scalars:
    count: int
    share: float = 0.5
    name: str = "a"
    on: bool = False
    path: Path | None = None
    size: tuple[int, float] = (1, 2.0)
    either: int | str = 3
    level: Literal[0, 1] = 0


def test_a_recipe_survives_json(world, tmp_path):
    recipe = world.Recipe(
        "x", "fast", world.Stage(grow=None, prune=(world.Relocate(3), world.Adaptive())), world.Stage()
    )
    write_json(tmp_path / "deep" / "recipe.json", recipe)
    assert read_json(tmp_path / "deep" / "recipe.json", world.Recipe) == recipe
    plain = json.loads((tmp_path / "deep" / "recipe.json").read_text())
    assert plain["pretrain"]["prune"][0] == {"use": "relocate", "cap": 3}
    assert plain["tune"]["losses"]["l1"] == {"use": "l1", "weight": 0.8}
    assert os.listdir(tmp_path / "deep") == ["recipe.json"]


def test_scalars():
    value = Scalars(3, math.inf, "ü", True, Path("a/b"), (4, 5.0), "word")
    again = load(Scalars, json.loads(json.dumps(dump(value), allow_nan=False)))
    assert again == value
    assert isinstance(load(Scalars, {"count": 1, "share": 2}).share, float)
    assert math.isnan(load(float, dump(math.nan)))


@pytest.mark.parametrize(
    ("data", "message"),
    [
        ({}, "count missing; Scalars needs count"),
        ({"count": "3"}, 'count: expected a whole number, got "3"'),
        ({"count": True}, "count: expected a whole number, got true"),
        ({"count": 3.0}, "count: expected a whole number, got 3.0"),
        ({"count": 1, "share": "big"}, 'share: expected a number, got "big"'),
        ({"count": 1, "share": False}, "share: expected a number, got false"),
        ({"count": 1, "name": None}, "name: expected text, got null"),
        ({"count": 1, "on": 1}, "on: expected true or false, got 1"),
        ({"count": 1, "path": 7}, "path: expected text, got 7"),
        ({"count": 1, "size": 7}, "size: expected a list, got 7"),
        ({"count": 1, "size": [7]}, "size: expected a list of 2, got 1 elements"),
        ({"count": 1, "size": [7, "x"]}, 'size.1: expected a number, got "x"'),
        ({"count": 1, "either": 1.5}, "either: expected a whole number, got 1.5; or either: expected text, got 1.5"),
        ({"count": 1, "level": True}, "level: expected 0 or 1, got true"),
        ({"count": 1, "cuont": 2}, "cuont: unknown setting; Scalars has count, share"),
        ([1], "expected an object, got [1]"),
    ],
)
def test_wrong_values_are_named(data, message):
    with pytest.raises(BadInput) as caught:
        load(Scalars, data)
    assert str(caught.value).startswith(message)


@pytest.mark.parametrize(
    ("data", "message"),
    [
        ({"pretrain": {"stepz": 1}}, "pretrain.stepz: unknown setting; Stage has steps,"),
        ({"mode": "slow"}, "mode: expected 'fast' or 'fine', got \"slow\""),
        (
            {"pretrain": {"losses": {"a": {"weight": 1}}}},
            'pretrain.losses.a: a Loss without its name; add "use": one of',
        ),
        ({"pretrain": {"grow": {"use": 3}}}, "pretrain.grow: a Grow with 3 as its name"),
        (
            {"pretrain": {"grow": {"use": "adaptve"}}},
            "pretrain.grow: no Grow named 'adaptve'; did you mean 'adaptive'?",
        ),
        ({"pretrain": {"grow": {"use": "l1"}}}, "pretrain.grow: no Grow named 'l1'; known: adaptive, relocate"),
        ({"pretrain": {"grow": "adaptive"}}, 'pretrain.grow: expected an object, got "adaptive"'),
        (
            {"pretrain": {"prune": [{"use": "relocate", "cap": []}]}},
            "pretrain.prune.0.cap: expected a whole number, got []",
        ),
        ({"pretrain": {"losses": {"d": {"use": "depth", "start": -1}}}}, "pretrain.losses.d: start is -1; it must be"),
        ({"tune": {"steps": 0}}, "tune: steps is 0; it must be 1 or more"),
    ],
)
def test_wrong_recipes_are_named_by_path(world, data, message):
    with pytest.raises(BadInput) as caught:
        load(world.Recipe, data)
    assert str(caught.value).startswith(message)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (b'{"a": 1,}', "not JSON: "),
        (b'{"a": 1, "a": 2}', "not JSON: 'a' is there twice"),
        (b"\xff\xfe", "not JSON: "),
        (b'{"count": "x"}', 'count: expected a whole number, got "x"'),
    ],
)
def test_wrong_files_are_named(tmp_path, text, message):
    path = tmp_path / "r.json"
    path.write_bytes(text)
    with pytest.raises(BadInput) as caught:
        read_json(path, Scalars)
    assert str(caught.value).startswith(f"{path}: {message}")


def test_json_may_be_nested_as_deep_as_is_said_and_no_deeper(tmp_path):
    path = tmp_path / "r.json"
    for left, right in (("[", "]"), ('{"a":', "}")):
        path.write_text(left * MAX_NESTING_DEPTH + "1" + right * MAX_NESTING_DEPTH)
        assert dump(read_json(path, Any))
        for depth in (MAX_NESTING_DEPTH + 1, 900, 100_000):
            path.write_text(left * depth + "1" + right * depth)
            with pytest.raises(BadInput, match="r.json: .*nested too"):
                read_json(path, Any)


def test_some_keys_of_an_object(tmp_path):
    path = tmp_path / "r.json"
    path.write_text('{"files": ["a"], "steps": 3, "more": null}')
    hints = {"files": tuple[str, ...], "steps": int}
    assert read_keys(path, hints, "delete it") == {"files": ("a",), "steps": 3}
    for text, said in (
        ("null", "expected an object, got null"),
        ('{"files": [1], "steps": 3}', "files.0: expected text, got 1"),
        ('{"files": []}', "steps: expected a whole number, got null"),
    ):
        path.write_text(text)
        with pytest.raises(BadInput) as caught:
            read_keys(path, hints, "delete it")
        assert str(caught.value) == f"{path}: {said}; delete it"


def test_files_that_are_none(tmp_path):
    with pytest.raises(BadInput, match="no.json: no such file"):
        read_json(tmp_path / "no.json", Any)
    with pytest.raises(BadInput, match="cannot be read"):
        read_json(tmp_path, Any)


def test_a_failed_write_leaves_the_old_file(tmp_path, monkeypatch):
    path = tmp_path / "r.json"
    write_json(path, {"a": 1})
    with pytest.raises(TypeError, match="object cannot be saved"):
        write_json(path, {"a": object()})

    def full(source, target):
        raise OSError("disk full")

    monkeypatch.setattr(os, "replace", full)
    with pytest.raises(OSError, match="disk full"):
        write_json(path, {"a": 2})
    assert read_json(path, Any) == {"a": 1}
    assert os.listdir(tmp_path) == ["r.json"]
