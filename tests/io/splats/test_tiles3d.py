"""3D Tiles: every splat in a box, on Earth where it belongs, coarse tiles above fine ones, nothing half-written."""

import json
from dataclasses import replace

import numpy as np
import pyproj
import pytest
import torch
from scipy.spatial.transform import Rotation

from surfkit.core.check import BadInput
from surfkit.core.events import Warned
from surfkit.io.glb import read_glb
from surfkit.io.splats.gltf_reader import read_splats
from surfkit.io.splats.splat_table import SplatTable, Tile
from surfkit.io.splats.tiles3d import Tiles3D
from surfkit.scene.scene import Frame
from surfkit.testing.format_checks import splat_table

ORIGIN = np.array([500_123.0, 5_783_283.0, 120.0])
ECEF = (3657232.9425397757, 1404012.0004179883, 5016568.267984122)  # of ORIGIN in EPSG:32634, by pyproj 3.7
MAPPED = Frame(ORIGIN, 1 / 30, metres=1.0, crs="EPSG:32634", shift=(500_000.0, 5_783_000.0, 0.0))
TO_Z_UP = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])  # what viewers do with the content of tiles


def tile(table, *children, error=0.0):
    return Tile(table, table.means.amin(0).double().numpy(), table.means.amax(0).double().numpy(), error, children)


def levels(table):
    """A tree of two levels above the splats: half of them, a quarter of them."""
    fine = [tile(table.take(rows)) for rows in table.means[:, 0].argsort().tensor_split(2)]
    middle = [tile(leaf.splats.take(slice(None, None, 2)), leaf, error=0.1) for leaf in fine]
    return tile(table.take(slice(None, None, 4)), *middle, error=0.4)


def on_the_map(table):
    return replace(table, means=10 * table.means.double() + torch.from_numpy(ORIGIN))


def tileset(path):
    return json.loads((path / "tileset.json").read_text())


def walked(node, above=()):
    yield node, above
    for child in node.get("children", ()):
        yield from walked(child, (*above, node))


def corners(node):
    box = np.array(node["boundingVolume"]["box"])
    assert (box[3:].reshape(3, 3) == np.diag(np.diag(box[3:].reshape(3, 3)))).all()
    return box[:3] - np.diag(box[3:].reshape(3, 3)), box[:3] + np.diag(box[3:].reshape(3, 3))


def surface(table):
    """(N, 60, 3) points three standard deviations from the centres."""
    towards = np.random.default_rng(0).normal(size=(60, 3))
    towards = np.concatenate([towards, np.eye(3), -np.eye(3)])
    towards /= np.linalg.norm(towards, axis=1, keepdims=True)
    turns = Rotation.from_quat(np.roll(table.quats.numpy(), -1, 1)).as_matrix()
    radii = 3 * np.exp(table.ellipsoid_log_scales().double().numpy())
    return table.means.double().numpy()[:, None] + np.einsum("nij,nj,pj->npi", turns, radii, towards)


@pytest.mark.parametrize("compress", ["spz", "none"])
def test_boxes_contain_the_splats_and_those_of_their_children(tmp_path, compress):
    table = splat_table("surfel", 400, 1)
    table = replace(table, log_scales=table.log_scales + torch.randn(400, 2))
    Tiles3D(compress=compress).write(tmp_path / "t", on_the_map(table), MAPPED, levels(on_the_map(table)))
    seen = 0
    for node, above in walked(tileset(tmp_path / "t")["root"]):
        points = surface(read_splats(tmp_path / "t" / node["content"]["uri"])).reshape(-1, 3)
        seen += 1
        for outer in (node, *above):
            low, high = corners(outer)
            assert (points >= low - 1e-6).all() and (points <= high + 1e-6).all()
    assert seen == 5
    low, high = corners(tileset(tmp_path / "t")["root"])
    assert (high - low < 200).all(), "a box about nothing but the splats"


def test_splats_lie_on_earth_where_proj_has_them(tmp_path):
    table = on_the_map(splat_table(count=300))
    table.means[0] = torch.from_numpy(ORIGIN)
    Tiles3D(compress="none").write(tmp_path / "t", table, MAPPED)
    found = tileset(tmp_path / "t")
    transform = np.array(found["root"]["transform"]).reshape(4, 4).T
    np.testing.assert_allclose(transform[:3, 3], ECEF, rtol=0, atol=1e-5)
    np.testing.assert_allclose(transform[:3, :3].T @ transform[:3, :3], np.eye(3), atol=1e-12)
    content = read_glb(tmp_path / "t/tiles/0.glb")
    matrix = np.array(content.root["nodes"][0]["matrix"]).reshape(4, 4).T
    stored = np.frombuffer(content.block, "<f4", 900, content.root["bufferViews"][0]["byteOffset"]).reshape(-1, 3)
    local = (stored @ matrix[:3, :3].T + matrix[:3, 3]) @ TO_Z_UP.T  # as CesiumJS does
    np.testing.assert_allclose(local[0], 0, rtol=0, atol=1e-5)
    moved = (table.means.numpy() - ORIGIN) / [0.9996, 0.9996, 1]
    np.testing.assert_allclose(
        local, moved, rtol=0, atol=0.005, err_msg="metres on the ground along the axes of the grid"
    )
    up = np.array(ECEF) / np.linalg.norm(ECEF)
    assert transform[:3, 2] @ up > 0.999


@pytest.mark.parametrize(
    ("crs", "geoid", "height", "said"),
    [
        ("EPSG:25834", "", 120.0, "EPSG:25834 does not say what heights are above"),
        ("EPSG:25834+7837", "", 120.0, "PROJ knows no geoid for them; give"),
        ("EPSG:25834+7837", "34.5", 154.5, None),
        ("EPSG:32634", "34.5", 154.5, None),
    ],
)
def test_heights_above_sea_level_are_raised_by_the_geoid_or_told_of(tmp_path, monkeypatch, crs, geoid, height, said):
    told = []
    monkeypatch.setattr("surfkit.io.splats.tileset.emit", told.append)
    table = on_the_map(splat_table(count=20))
    Tiles3D(compress="none", geoid=geoid).write(tmp_path / "t", table, replace(MAPPED, crs=crs))
    place = np.reshape(tileset(tmp_path / "t")["root"]["transform"], (4, 4))[3, :3]
    found = pyproj.Transformer.from_crs("EPSG:4978", "EPSG:4979", always_xy=True).transform(*place)[2]
    assert found == pytest.approx(height, abs=1e-3)
    assert said is None or said in told[0].text
    kept = tileset(tmp_path / "t")["asset"]["extras"].get("notes", [])
    assert kept == [each.text for each in told], "who opens the tiles has not seen the terminal"


def test_what_has_no_place_on_earth_leaves_nothing_behind(tmp_path):
    table = on_the_map(splat_table(count=20))
    for frame, said in (
        (replace(MAPPED, crs="EPSG:3857"), "1 m to the east or north is"),
        (replace(MAPPED, metres=0.3048), "EPSG:32634 is in units of metre"),
        (replace(MAPPED, crs="EPSG:5513"), "its axes point south and west"),
    ):
        with pytest.raises(BadInput, match=said):
            Tiles3D().write(tmp_path / "t", table, frame)
    with pytest.raises(BadInput, match="--geoid 40: .*coordinate reference"):
        Tiles3D(geoid="40").write(tmp_path / "t", table, replace(MAPPED, crs=None))
    assert not list(tmp_path.iterdir())


def test_the_json_is_what_cesiumjs_expects(tmp_path):
    table = splat_table(count=300)
    Tiles3D(error_px=2.0).write(tmp_path / "t", table, tree=levels(table))
    found = tileset(tmp_path / "t")
    names = ["KHR_gaussian_splatting", "KHR_gaussian_splatting_compression_spz_2"]
    assert found["asset"]["version"] == "1.1" and found["extensionsUsed"] == ["3DTILES_content_gltf"]
    assert found["extensions"]["3DTILES_content_gltf"] == {"extensionsUsed": names, "extensionsRequired": names}
    assert found["root"]["refine"] == "REPLACE"
    errors = [
        (node["geometricError"], [outer["geometricError"] for outer in above]) for node, above in walked(found["root"])
    ]
    assert [round(error, 6) for error, _ in errors] == [3.2, 0.8, 0, 0.8, 0]  # 16 pixels for 2
    assert all(found["geometricError"] > outer[0] >= error for error, outer in errors if outer)
    for node, above in walked(found["root"]):
        count = len(read_splats(tmp_path / "t" / node["content"]["uri"]))
        assert count == {0: 75, 1: 75, 2: 150}[len(above)]


def test_without_a_place_on_earth_up_is_z_and_one_line_says_so(tmp_path, monkeypatch):
    told = []
    monkeypatch.setattr("surfkit.io.splats.tileset.emit", told.append)
    table = splat_table(count=20)
    Tiles3D(compress="none").write(tmp_path / "t", table, Frame(np.zeros(3), 1.0, metres=2.0))
    assert [type(event) for event in told] == [Warned] and "no coordinate reference system" in told[0].text
    root = tileset(tmp_path / "t")["root"]
    transform = np.array(root["transform"]).reshape(4, 4).T
    np.testing.assert_allclose(transform @ [0, -1, 0, 1], [0, 0, 1, 1])  # down is y in the input
    found = read_splats(tmp_path / "t/tiles/0.glb")
    np.testing.assert_allclose(found.means, 2 * table.means, rtol=1e-6)
    np.testing.assert_allclose(found.log_scales, table.log_scales + np.log(2), atol=1e-5)
    Tiles3D(georeference=False).write(tmp_path / "u", on_the_map(table), MAPPED)
    assert len(told) == 1 and "transform" not in tileset(tmp_path / "u")["root"]


def test_large_tiles_are_divided_and_no_splat_is_lost(tmp_path):
    table = splat_table(count=4_500, degree=0)
    Tiles3D(compress="none", most_splats=1_000).write(tmp_path / "t", table)
    root = tileset(tmp_path / "t")["root"]
    parts = [read_splats(tmp_path / "t" / child["content"]["uri"]) for child in root["children"]]
    assert len(parts) == 8 and "content" not in root and all(500 < len(part) < 1_000 for part in parts)
    means = torch.cat([part.means for part in parts])
    assert sorted(map(tuple, means.tolist())) == sorted(map(tuple, table.means.tolist()))
    low, high = corners(root)
    assert root["geometricError"] == pytest.approx(np.linalg.norm(high - low)), "nothing is as far off as it is large"
    assert all(child["geometricError"] == 0 for child in root["children"])
    tree = tile(table.take(slice(0, 900)), tile(table), error=1.0)
    Tiles3D(compress="none", most_splats=1_000).write(tmp_path / "t", table, tree=tree)
    root = tileset(tmp_path / "t")["root"]
    assert len(root["children"]) == 8 and root["content"] and root["geometricError"] == 16
    tree = tile(table.take(slice(0, 1_100)), tile(table), error=1.0)
    with pytest.raises(BadInput, match="1100 splats; most_splats is 1000"):
        Tiles3D(most_splats=1_000).write(tmp_path / "u", table, tree=tree)


@pytest.mark.parametrize("count", [0, 1])
def test_few_splats(tmp_path, count):
    table = splat_table("surfel", count, 1)
    Tiles3D().write(tmp_path / "t", table)
    root = tileset(tmp_path / "t")["root"]
    assert ("content" in root) == bool(count) and len(root["boundingVolume"]["box"]) == 12


def test_nothing_is_half_written(tmp_path, monkeypatch):
    table = splat_table(count=30)
    Tiles3D().write(tmp_path / "t", table)
    before = (tmp_path / "t/tileset.json").read_bytes()
    spoilt = replace(table, sh0=table.sh0.clone())
    spoilt.sh0[4, 0] = torch.inf
    with pytest.raises(BadInput, match="tile 0-0: sh0 of splat 4 of 30"):
        Tiles3D().write(tmp_path / "t", table, tree=tile(table, tile(spoilt), error=1.0))
    assert (tmp_path / "t/tileset.json").read_bytes() == before and len(list(tmp_path.iterdir())) == 1
    Tiles3D(compress="none").write(tmp_path / "t", splat_table(count=5))
    assert len(read_splats(tmp_path / "t/tiles/0.glb")) == 5
    (tmp_path / "photos").mkdir()
    (tmp_path / "photos/a.jpg").touch()
    with pytest.raises(OSError, match="without tileset.json; name another"):
        Tiles3D().write(tmp_path / "photos", table)
    assert (tmp_path / "photos/a.jpg").exists()


def test_a_table_on_its_own_is_one_tile(tmp_path):
    assert isinstance(splat_table(), SplatTable)
    Tiles3D().write(tmp_path / "t", splat_table(count=50))
    assert [path.name for path in (tmp_path / "t/tiles").iterdir()] == ["0.glb"]
    assert tileset(tmp_path / "t")["root"]["geometricError"] == 0 < tileset(tmp_path / "t")["geometricError"]
