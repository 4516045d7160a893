"""Streamed SOG: each level whole in chunks of runs, a binary tree of boxes that hold them, nothing half-written."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial import cKDTree

from surfkit.core.check import BadInput
from surfkit.io.splats.sog import SOG
from surfkit.io.splats.streamed_sog import LOD_INDEX, StreamedSOG, nearest_box
from surfkit.scene.morton import morton_order
from surfkit.testing.format_checks import splat_table

from .test_tiles3d import MAPPED, levels, on_the_map, surface, tile


def index_of(path):
    return json.loads((path / LOD_INDEX).read_text())


def nodes(node):
    yield node
    for child in node.get("children", ()):
        yield from nodes(child)


def leaves(index):
    return [node for node in nodes(index["tree"]) if "lods" in node]


def chunks(path, index):
    return [SOG().read(path / name) for name in index["filenames"]]


def written(tmp_path, table, tree=None, **settings):
    path = tmp_path / "scene"
    StreamedSOG(chunk_splats=1000, **settings).write(path, table, None, tree)
    return path, index_of(path)


def test_the_index_is_as_the_specification_has_it(tmp_path):
    table = splat_table("gaussian", 400, 1)
    path, index = written(tmp_path, table, levels(table))
    assert (index["version"], index["lodLevels"], index["lodErrors"]) == (1, 3, True)
    assert index["counts"] == [400, 200, 100] and index["count"] == 700
    found = chunks(path, index)
    runs = {at: np.zeros(len(chunk), int) for at, chunk in enumerate(found)}
    for node in nodes(index["tree"]):
        assert ("children" in node) != ("lods" in node) and len(node.get("children", (0, 0))) == 2
        for child in node.get("children", ()):
            assert (np.array(child["bound"]["min"]) >= node["bound"]["min"]).all()
            assert (np.array(child["bound"]["max"]) <= node["bound"]["max"]).all()
    for leaf in leaves(index):
        assert leaf["errors"][0] == 0 and (np.diff(leaf["errors"]) >= 0).all() and len(leaf["errors"]) == 3
        for level, run in leaf["lods"].items():
            part = slice(run["offset"], run["offset"] + run["count"])
            runs[run["file"]][part] += 1
            assert index["filenames"][run["file"]].startswith(f"{level}_")
            points = surface(found[run["file"]].take(part)).reshape(-1, 3)
            room = 1e-3 * np.abs(points).max()  # positions and scales of the chunk are rounded
            assert (points >= np.array(leaf["bound"]["min"]) - room).all()
            assert (points <= np.array(leaf["bound"]["max"]) + room).all()
    assert all((count == 1).all() for count in runs.values())


def test_the_finest_level_is_the_model_and_coarse_ones_are_shared_out(tmp_path):
    table = splat_table("surfel", 400, 1)
    tree = levels(table)
    path, index = written(tmp_path, table, tree)
    found = chunks(path, index)
    for level, splats in ((0, table), (1, None), (2, tree.splats)):
        some = [chunk for name, chunk in zip(index["filenames"], found, strict=True) if name.startswith(f"{level}_")]
        means = torch.cat([chunk.means for chunk in some]).double().numpy()
        if splats is not None:
            given = splats.means.double().numpy()
            away, at = cKDTree(given).query(means)
            assert away.max() < 2e-3 and sorted(at) == list(range(len(given)))
    halves = [
        {round(float(x), 2) for level in ("0", "1", "2") for x in found[run[level]["file"]].means[
            run[level]["offset"] : run[level]["offset"] + run[level]["count"], 0]}
        for run in (leaf["lods"] for leaf in leaves(index))
    ]  # fmt: skip
    left, right = sorted(halves, key=min)
    assert max(left) <= min(right) + 0.02  # coarse splats go to the side where they lie


def test_runs_are_along_a_curve(tmp_path):
    table = splat_table("gaussian", 400, 0)
    path, index = written(tmp_path, table, levels(table))
    for leaf in leaves(index):
        run = leaf["lods"]["0"]
        means = chunks(path, index)[run["file"]].means[run["offset"] : run["offset"] + run["count"]].double().numpy()
        steps = np.linalg.norm(np.diff(means, axis=0), axis=1).sum()
        shuffled = np.linalg.norm(np.diff(np.random.default_rng(0).permutation(means), axis=0), axis=1).sum()
        assert steps < 0.5 * shuffled
        assert len(np.unique(morton_order(means))) == len(means)


def test_one_tile_is_divided_and_chunks_are_no_larger_than_wanted(tmp_path):
    table = splat_table("gaussian", 5000, 0)
    path, index = written(tmp_path, table, leaf_splats=1000)
    assert index["lodLevels"] == 1 and index["counts"] == [5000]
    assert max(len(chunk) for chunk in chunks(path, index)) <= 1000
    assert len(leaves(index)) == 8 and sum(leaf["lods"]["0"]["count"] for leaf in leaves(index)) == 5000


def test_a_place_less_deep_has_its_splats_in_each_level(tmp_path):
    table = splat_table("gaussian", 300, 0)
    left, right = (table.take(rows) for rows in table.means[:, 0].argsort().tensor_split(2))
    deep = tile(right.take(slice(None, None, 2)), tile(right), error=0.1)
    root = replace(tile(table, tile(left), deep, error=0.3), splats=table.take(slice(0, 0)))
    _, index = written(tmp_path, table, root)
    assert index["lodLevels"] == 2
    assert {leaf["lods"]["1"]["count"] for leaf in leaves(index)} == {150, 75}


def test_coordinates_leave_out_the_offset(tmp_path):
    table = on_the_map(splat_table("gaussian", 100, 0))
    StreamedSOG().write(tmp_path / "scene", table, MAPPED)
    index = index_of(tmp_path / "scene")
    assert np.abs([index["tree"]["bound"]["min"], index["tree"]["bound"]["max"]]).max() < 1000
    assert chunks(tmp_path / "scene", index)[0].means.double().mean(0).numpy() == pytest.approx(
        table.means.mean(0).numpy(), abs=0.1
    )


def test_other_folders_stay_and_the_same_splats_give_the_same_bytes(tmp_path):
    table = splat_table("gaussian", 100, 1)
    (tmp_path / "own").mkdir()
    (tmp_path / "own" / "a.txt").write_text("mine")
    with pytest.raises(OSError, match="without lod-meta.json"):
        StreamedSOG().write(tmp_path / "own", table)
    for name in ("one", "two"):
        StreamedSOG().write(tmp_path / name, table, None, levels(table))
    files = [sorted((p.relative_to(tmp_path / n), p.read_bytes()) for p in (tmp_path / n).rglob("*") if p.is_file())
             for n in ("one", "two")]  # fmt: skip
    assert files[0] == files[1]
    broken = replace(table, means=table.means.clone().index_fill_(0, torch.tensor([3]), np.nan))
    with pytest.raises(BadInput, match="splat 3"):
        StreamedSOG().write(tmp_path / "one", broken)
    assert (tmp_path / "one" / LOD_INDEX).is_file()


def test_the_nearest_box():
    corners = np.array([[[0, 0, 0], [1, 1, 1]], [[1, 0, 0], [3, 1, 1]]], float)
    places = np.array([[0.5, 0.5, 0.5], [1, 0.5, 0.5], [2, 0, 0], [9, 0, 0], [-1, 0, 0]], float)
    assert nearest_box(places, corners).tolist() == [0, 0, 1, 1, 0]
