"""The five protocols: what they fix, and that they read folders in the layouts in which people download the data."""

import json
from dataclasses import replace

import numpy as np
import pytest

from surfkit.apps.benchmark.folder_check import look
from surfkit.apps.benchmark.protocol_words import description
from surfkit.apps.benchmark.protocols import DTU, GAUU_SCENE, MATRIXCITY, PROTOCOLS, SHIBUYA, TANKS_AND_TEMPLES
from surfkit.core.check import BadInput
from surfkit.core.registry import name_of
from surfkit.evaluate.geometry.transform import apply, read_transform
from surfkit.io.datasets.read import read
from surfkit.study.dtu_truth import DTUTruth
from surfkit.testing.synthetic import write_colmap
from tests.apps.benchmark.made_up import dtu, flown, shrunk, tanks, truth_points, write_cloud
from tests.data_set_folders import with_tests_apart

DIGESTS = {
    "gauu-scene-1": "102451fd3fba",
    "matrixcity-1": "d44581545007",
    "tanks-and-temples-1": "5249f10f2e91",
    "dtu-1": "80ce102b7e95",
    "shibuya-1": "40b0cc592ca8",
}
"""Whoever changes a declaration gives it a new version: published figures name the one that they were measured by."""


def test_a_version_is_never_declared_otherwise():
    assert {each.tag: each.digest for each in PROTOCOLS.values()} == DIGESTS
    other = replace(SHIBUYA, steps=2_001)
    assert other.digest != SHIBUYA.digest and replace(other, steps=2_000).digest == SHIBUYA.digest


def test_facts_of_the_city_protocols():
    views = {"residence": 95, "russian": 125, "modern": 90, "aerial": 125, "street": 815}
    for scene in (*GAUU_SCENE.scenes, *MATRIXCITY.scenes):
        comparison = scene.truth.comparison.for_scene(
            type("Frame", (), {"metres": scene.reading.metres_per_unit}), np.diag([scene.truth.per_unit] * 3 + [1])
        )
        assert comparison.visible == views[scene.name] and comparison.align == "similarity" and comparison.tau is None
        assert comparison.voxel == pytest.approx(0.0035), "0.35 m, in the units of the truth"
        assert scene.reading.longest == (1000 if scene.name == "street" else 1600)
    assert {name_of(scene.reading.split) for scene in GAUU_SCENE.scenes} == {"gauu-scene"}
    assert [scene.training for scene in GAUU_SCENE.scenes] == [(958, 958), (500, 508), (625, 638)]
    recipes = [GAUU_SCENE.recipe(GAUU_SCENE.contenders[0], scene) for scene in GAUU_SCENE.scenes]
    assert [recipe.partition.blocks for recipe in recipes] == [(4, 2), (3, 3), (3, 3)]
    assert GAUU_SCENE.recipe(GAUU_SCENE.contenders[1], GAUU_SCENE.scenes[0]).length == 60_000
    assert GAUU_SCENE.estimator.size == MATRIXCITY.estimator.size == "large"


def test_facts_of_the_object_protocols():
    tau = {"barn": 0.01, "caterpillar": 0.005, "courthouse": 0.025, "ignatius": 0.003, "meetingroom": 0.01}
    assert {scene.name: scene.truth.tau for scene in TANKS_AND_TEMPLES.scenes} == tau | {"truck": 0.005}
    scans = "24 37 40 55 63 65 69 83 97 105 106 110 114 118 122".split()
    assert [scene.name for scene in DTU.scenes] == [f"scan{number}" for number in scans]
    assert [scene.truth.photographs for scene in DTU.scenes] == [49] * 7 + [64] * 8
    for scene in (*DTU.scenes, *TANKS_AND_TEMPLES.scenes):
        assert scene.reading.test_every == 0
    assert {SHIBUYA.recipe(each, SHIBUYA.scenes[0]).length for each in SHIBUYA.contenders} == {2_000, None}


@pytest.mark.parametrize("protocol", PROTOCOLS.values(), ids=list(PROTOCOLS))
def test_every_row_can_be_built_and_every_source_is_told(protocol):
    names = {scene.name for scene in protocol.scenes} | {"mean"}
    for contender in protocol.contenders:
        assert set(contender.published) <= names
        for scene in protocol.scenes:
            assert protocol.recipe(contender, scene).length is None or protocol.table(scene, [contender]).rows
    for scene in protocol.scenes:
        assert {needed.source for needed in (*scene.needed, *scene.truth.needed())} <= set(protocol.sources)
    assert all("https://" in told for told in protocol.sources.values())
    text = "\n".join(description(protocol))
    assert protocol.tag in text and all(
        f"scene {scene.name}, folder {scene.folder}" in text for scene in protocol.scenes
    )
    json.dumps(text)


def sound(protocol, root, *rows):
    """Nothing but numbers is wrong for some rows, in a protocol without LPIPS, whose weights need not be there."""
    protocol = replace(protocol, columns=tuple(name for name in protocol.columns if name != "lpips"))
    found = look(protocol, root, protocol.scenes, protocol.chosen_contenders(rows))
    assert [each for each in found if "where there must be" not in each.what] == []


def test_a_folder_of_gauu_scene(tmp_path):
    write_colmap(tmp_path / "LFLS", flown())
    write_cloud(tmp_path / "LFLS/LFLS.ply", truth_points(flown()))
    protocol = shrunk(GAUU_SCENE, "residence")
    sound(protocol, tmp_path, "2dgs")
    (scene,) = protocol.scenes
    assert [view.name for view in read(scene.data(tmp_path)).held_out] == [
        f"view_{at:03d}.png" for at in range(0, 9, 9)
    ]
    (depth,) = (f for f in look(protocol, tmp_path, (scene,), protocol.contenders[:1]) if "depth" in f.what)
    assert depth.place == str(tmp_path / "LFLS/estimated_depths") and "8 of 8 depth maps are missing" in depth.what
    assert "estimator:depth-anything-v2 --estimator.size large --longest 1600" in depth.remedy


def test_a_folder_of_matrixcity(tmp_path):
    truth = flown(views=6)
    with_tests_apart(tmp_path / "street", truth)
    (tmp_path / "street/train/block_all").rename(tmp_path / "street/train/block_A")
    (tmp_path / "street/test/block_all_test").rename(tmp_path / "street/test/block_A_test")
    write_cloud(tmp_path / "point_cloud_ds20/street/Block_A.ply", truth_points(truth) / 100)
    protocol = shrunk(MATRIXCITY, "street")
    sound(protocol, tmp_path, "2dgs")
    (scene,) = protocol.scenes
    found = read(scene.data(tmp_path))
    assert len(found.train) == 4 and len(found.held_out) == 2
    truth = scene.truth.truth(tmp_path, tmp_path / "out", found)
    assert np.allclose(read_transform(truth.comparison.transform), np.diag([0.01, 0.01, 0.01, 1]))


def test_a_folder_of_tanks_and_temples(tmp_path):
    made = tanks(tmp_path)
    protocol = shrunk(TANKS_AND_TEMPLES, "barn")
    (scene,) = protocol.scenes
    with pytest.raises(BadInput, match="Barn_COLMAP_SfM.log: 9 cameras; it must have 410"):
        scene.truth.check(tmp_path)
    scene = replace(scene, truth=replace(scene.truth, photographs=9))
    sound(replace(protocol, scenes=(scene,)), tmp_path, "2dgs")
    truth = scene.truth.truth(tmp_path, tmp_path / "out", read(scene.data(tmp_path)))
    points = truth_points(made)
    assert np.allclose(
        apply(read_transform(truth.comparison.transform), points), (points * 2 + [1, 2, 3]) * 3, atol=1e-6
    )
    assert truth.tau == 0.01 and truth.comparison.crop.endswith("Barn/Barn.json")


def test_a_scan_of_dtu(tmp_path):
    dtu(tmp_path)
    protocol = shrunk(DTU, "scan24")
    sound(protocol, tmp_path, "2dgs")
    (scene,) = protocol.scenes
    ground = np.stack(np.meshgrid(*[np.linspace(-1.5, 1.5, 61)] * 2), -1).reshape(-1, 2)
    write_cloud(tmp_path / "Points/stl/stl024_total.ply", np.c_[ground * 10 + [5, 0], np.full(len(ground), -5.0)])
    corners = "-1.5 -1.5 0.3\n1.5 -1.5 0.3\n1.5 1.5 0.3\n-1.5 1.5 0.3\n"
    head = "ply\nformat ascii 1.0\nelement vertex 4\nproperty float x\nproperty float y\nproperty float z\n"
    faces = "element face 2\nproperty list uchar int vertex_indices\nend_header\n"
    (tmp_path / "mesh.ply").write_text(head + faces + corners + "3 0 1 2\n3 0 2 3\n")
    found_scene = read(scene.data(tmp_path))
    truth = scene.truth.truth(tmp_path, tmp_path / "out", found_scene)
    found = truth.compare(tmp_path / "mesh.ply", tmp_path / "geometry", found_scene)
    chamfer = found["geometry"]["chamfer_dtu"]
    assert chamfer["accuracy"] == pytest.approx(3.0, abs=0.05), "0.3 units are 3 mm"
    assert chamfer["completeness"] == pytest.approx(3.0, abs=0.05)
    assert isinstance(truth, DTUTruth) and truth.figure == "chamfer" and truth.known(found)
    assert not replace(truth, path=tmp_path / "mesh.ply").known(found)
    next((tmp_path / "scan24/mask").iterdir()).unlink()
    with pytest.raises(BadInput, match="8 masks for 9 photographs"):
        scene.truth.truth(tmp_path, tmp_path / "out", found_scene)


def test_a_folder_of_shibuya(tmp_path):
    write_colmap(tmp_path, flown(test_every=8))
    write_cloud(tmp_path / "gt/mesh.ply", truth_points(flown()))
    told = [each.what for each in look(SHIBUYA, tmp_path, SHIBUYA.scenes, SHIBUYA.contenders)]
    assert "0 faces, where there must be 54,282" in told and "9 pictures, where there must be 100" in told
    sound(shrunk(SHIBUYA, "shibuya"), tmp_path)
