"""Panoramas of a world whose colour is a formula of the direction, as several programs describe them."""

import json

import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from surfkit.cli import main
from surfkit.core.check import BadInput
from surfkit.io.datasets.data import Data
from surfkit.io.datasets.fingerprint import changed, fingerprint
from surfkit.io.datasets.masks import mask_cache, view_mask
from surfkit.io.datasets.panoramas import CUBE_FACES
from surfkit.io.datasets.raw_dataset import load_pycolmap
from surfkit.io.datasets.read import observations, read
from surfkit.runs.run_notes import collect_notes
from surfkit.scene.photos import view_photo
from surfkit.scene.pixels import DEFAULT_PIXELS

WIDTH, HEIGHT = 256, 128
NAMES = ("a.png", "b.png", "c.png")
TURNS = Rotation.from_euler("xyz", [[10, 20, 30], [-70, 5, 160], [0, 90, -45]], degrees=True).as_matrix()
"""From the world to each camera: x right, y down, z ahead."""
PLACES = np.array([[0, 0, 0], [1, 2, 0.5], [-2, 1, 1.0]])
DOTS = np.random.default_rng(3).normal(size=(40, 3)) * 4


def colour(directions):
    """(..., 3) values, 0 to 255, of (..., 3) directions in the world."""
    unit = directions / np.linalg.norm(directions, axis=-1, keepdims=True)
    waves = [[2.0, 1.0, -1.0], [-1.0, 2.5, 0.5], [0.7, -1.2, 2.2]]
    return 127.5 + 110 * np.sin(unit @ np.array(waves).T + [0.3, 1.1, -0.4])


def ahead():
    """(H, W, 3) directions of the pixels of a panorama in the frame of its camera, x right, y down, z ahead."""
    v, u = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    longitude, up = (u / WIDTH - 0.5) * 2 * np.pi, (0.5 - v / HEIGHT) * np.pi
    return np.stack([np.sin(longitude) * np.cos(up), -np.sin(up), np.cos(longitude) * np.cos(up)], -1)


def pixels(turn, place, points):
    """(P, 2) where a panorama shows points."""
    x, y, z = ((points - place) @ turn.T).T
    return np.stack([np.arctan2(x, z) / 2 / np.pi * WIDTH, np.arctan2(y, np.hypot(x, z)) / np.pi * HEIGHT], 1) + (
        WIDTH / 2,
        HEIGHT / 2,
    )


def photographs(folder):
    folder.mkdir(parents=True)
    for name, turn in zip(NAMES, TURNS, strict=True):
        Image.fromarray(colour(ahead() @ turn).round().astype(np.uint8)).save(folder / name)


def colmap(folder, tracks=True):
    photographs(folder / "images")
    model = folder / "sparse/0"
    model.mkdir(parents=True)
    (model / "cameras.txt").write_text(f"1 EQUIRECTANGULAR {WIDTH} {HEIGHT} {WIDTH} {HEIGHT}\n")
    lines = []
    for at, (turn, place) in enumerate(zip(TURNS, PLACES, strict=True), 1):
        x, y, z, w = Rotation.from_matrix(turn).as_quat()
        numbers = " ".join(map(repr, map(float, [w, x, y, z, *(-turn @ place)])))
        spots = pixels(turn, place, DOTS) if tracks else []
        marks = " ".join(f"{u!r} {v!r} {row + 1}" for row, (u, v) in enumerate(np.asarray(spots).tolist()))
        lines += [f"{at} {numbers} 1 {NAMES[at - 1]}", marks]
    (model / "images.txt").write_text("\n".join(lines) + "\n")
    ends = [" ".join(f"{at} {row}" for at in (1, 2, 3)) if tracks else "" for row in range(len(DOTS))]
    rows = [f"{row + 1} {x!r} {y!r} {z!r} 9 9 9 0.1 {ends[row]}" for row, (x, y, z) in enumerate(DOTS.tolist())]
    (model / "points3D.txt").write_text("\n".join(rows) + "\n")


def opensfm(folder):
    """OpenSfM, camera_functions.h: the bearing is (cos lat sin lon, -sin lat, cos lat cos lon)."""
    photographs(folder / "images")
    shots = {}
    for name, turn, place in zip(NAMES, TURNS, PLACES, strict=True):
        shots[name] = {"rotation": Rotation.from_matrix(turn).as_rotvec().tolist(), "camera": "c"}
        shots[name]["translation"] = (-turn @ place).tolist()
    points = {str(row): {"coordinates": dot, "color": [9, 9, 9]} for row, dot in enumerate(DOTS.tolist())}
    cameras = {"c": {"projection_type": "spherical", "width": WIDTH, "height": HEIGHT}}
    (folder / "opensfm").mkdir()
    whole = [{"cameras": cameras, "shots": shots, "points": points}]
    (folder / "opensfm/reconstruction.json").write_text(json.dumps(whole))
    lines = ["OPENSFM_TRACKS_VERSION_v2"]
    for name, turn, place in zip(NAMES, TURNS, PLACES, strict=True):
        shares = (pixels(turn, place, DOTS) - (WIDTH / 2, HEIGHT / 2)) / WIDTH
        lines += [f"{name}\t{row}\t{row}\t{x!r}\t{y!r}\t0\t9\t9\t9" for row, (x, y) in enumerate(shares.tolist())]
    (folder / "opensfm/tracks.csv").write_text("\n".join(lines) + "\n")


def metashape(folder):
    """Metashape manual, "Spherical cameras": u = w/2 + f atan(X / Z), v = h/2 + f atan(Y / sqrt(X^2 + Z^2))."""
    photographs(folder / "images")
    cameras = ""
    for at, (turn, place) in enumerate(zip(TURNS, PLACES, strict=True)):
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = turn.T, place
        numbers = " ".join(map(repr, pose.ravel().tolist()))
        cameras += f'<camera id="{at}" sensor_id="0" label="{NAMES[at]}"><transform>{numbers}</transform></camera>'
    size = f'<resolution width="{WIDTH}" height="{HEIGHT}"/>'
    sensor = f'<sensors><sensor id="0" label="s" type="spherical">{size}</sensor></sensors>'
    text = f'<document version="2.0.0"><chunk label="c">{sensor}<cameras>{cameras}</cameras></chunk></document>'
    (folder / "cameras.xml").write_text(text)


def nerfstudio(folder):
    """nerfstudio, cameras.py: the middle is -z of OpenGL's axes, to the right of it x, above it y."""
    photographs(folder / "images")
    frames = []
    for name, turn, place in zip(NAMES, TURNS, PLACES, strict=True):
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = turn.T @ np.diag([1, -1, -1]), place
        frames.append({"file_path": f"images/{name}", "transform_matrix": pose.tolist()})
    whole = {"camera_model": "EQUIRECTANGULAR", "w": WIDTH, "h": HEIGHT, "frames": frames}
    (folder / "transforms.json").write_text(json.dumps(whole))


def directions(camera):
    """(H, W, 3) directions of the pixels of a view in the world, by its pose and lens alone."""
    v, u = np.mgrid[: camera.height, : camera.width] + 0.5
    local = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones_like(u)], -1)
    return local @ camera.world_to_camera.numpy()[:3, :3]


@pytest.mark.parametrize("program", [colmap, opensfm, metashape, nerfstudio])
def test_the_views_of_panoramas_show_what_lies_where_they_look(tmp_path, program):
    program(tmp_path)
    with collect_notes() as kept:
        scene = read(Data(tmp_path, test_every=3))
    assert any("3 panoramas are cut into 6 views each" in text for text in kept.texts)
    assert len(scene.held_out) == 6 and len(scene.train) == 12, "the views of a panorama are held out together"
    assert {view.name.rpartition("/")[2] for view in scene.held_out} == {f"a-{face}.png" for face in CUBE_FACES}
    for view in (*scene.train, *scene.held_out):
        difference = view_photo(view).permute(1, 2, 0).numpy() - colour(directions(view.camera))
        assert np.abs(difference).max() < 2, view.name
        name = f"{view.name.rpartition('/')[2].rpartition('-')[0]}.png"
        pose = scene.frame.input_pose(view.camera.world_to_camera)
        np.testing.assert_allclose(-pose[:3, :3].T @ pose[:3, 3], PLACES[NAMES.index(name)], atol=1e-6)
    sides = {(view.camera.width, view.camera.height) for view in scene.train}
    focal = WIDTH / 2 / np.pi
    assert sides == {(88, 88)} and scene.train[0].camera.fx == pytest.approx(focal), "as fine as the panorama"
    seen = np.concatenate([directions(view.camera).reshape(-1, 3) for view in scene.held_out])
    seen /= np.linalg.norm(seen, axis=1, keepdims=True)
    everywhere = np.random.default_rng(0).normal(size=(300, 3))
    everywhere /= np.linalg.norm(everywhere, axis=1, keepdims=True)
    assert (seen @ everywhere.T).max(0).min() > np.cos(1 / focal), "no gap between the views"


def test_the_panorama_of_pycolmap_is_the_formula():
    camera = load_pycolmap().Camera(model="EQUIRECTANGULAR", width=WIDTH, height=HEIGHT, params=[WIDTH, HEIGHT])
    v, u = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    spots = np.asarray(camera.img_from_cam(ahead().reshape(-1, 3)))
    np.testing.assert_allclose(spots, np.stack([u, v], -1).reshape(-1, 2), atol=1e-9)


@pytest.mark.parametrize("program", [colmap, opensfm])
def test_sparse_points_are_seen_in_the_views(tmp_path, program):
    program(tmp_path)
    data = Data(tmp_path, test_every=0)
    scene = read(data)
    seen = observations(data, scene)
    assert np.isfinite(seen.error_px).all()
    for at in range(3):
        found = set()
        for view in scene.train[6 * at : 6 * at + 6]:
            camera, rows = view.camera, seen.seen[view.name].points
            local = scene.frame.to_local(DOTS[rows]) @ camera.world_to_camera.numpy()[:3, :3].T
            local = local + camera.world_to_camera.numpy()[:3, 3]
            spots = np.stack([camera.fx * local[:, 0], camera.fy * local[:, 1]], 1) / local[:, 2:]
            spots = (spots + (camera.cx, camera.cy)) / (camera.width, camera.height)
            assert (local[:, 2] > 0).all()
            np.testing.assert_allclose(seen.seen[view.name].at, spots, atol=1e-6)
            found |= set(rows.tolist())
        assert found == set(range(len(DOTS))), "every point lies in some view"


def test_masks_of_panoramas_are_cut_with_them(tmp_path):
    colmap(tmp_path, tracks=False)
    (tmp_path / "masks").mkdir()
    mask = np.where(ahead()[..., 1:] > 0.5, 0, 255).astype(np.uint8)[..., 0]  # black below
    for name in NAMES:
        Image.fromarray(mask).save(tmp_path / "masks" / name)
    Image.fromarray(np.zeros_like(mask)).save(tmp_path / "masks" / NAMES[-1])
    with collect_notes() as notes:
        scene = read(Data(tmp_path))
        cached = mask_cache(scene.train)
        assert not all(cached[at].any() for at in range(len(scene.train))), "the views down show nothing"
    empty = [text for text in notes.texts if "nothing of the photograph" in text]
    assert empty == [f"1 mask keeps nothing of the photograph, {NAMES[-1]!r}; correct or delete it"], (
        "of views, no word"
    )
    for view in (view for view in scene.train if not view.name.startswith(NAMES[-1].partition(".")[0])):
        v, u = np.mgrid[:88, :88] + 0.5
        local = np.stack([u - 44, v - 44, np.full_like(u, WIDTH / 2 / np.pi)], -1)
        inside = np.array(CUBE_FACES[view.name.rpartition("-")[2].removesuffix(".png")], float)
        down = (local @ inside)[..., 1] / np.linalg.norm(local, axis=-1)
        kept, clear = view_mask(view).numpy(), np.abs(down - 0.5) > 0.02
        assert (kept == (down < 0.5))[clear].all(), view.name


def test_panoramas_are_cut_once(tmp_path):
    colmap(tmp_path, tracks=False)
    first = read(Data(tmp_path))
    times = {view.path: view.path.stat().st_mtime_ns for view in first.train}
    assert all(path.parent == tmp_path / "panoramas" for path in times)
    assert {view.path: view.path.stat().st_mtime_ns for view in read(Data(tmp_path)).train} == times


def test_doctor_does_not_call_panoramas_unused(tmp_path, capsys):
    colmap(tmp_path)
    assert main(["doctor", str(tmp_path), "recipe:2dgs", "--probe", "0"]) == 0
    told = capsys.readouterr()
    assert all(text in told.out + told.err for text in ("3 with a pose", "cut 3 panoramas into 6 views each"))
    assert "not used" not in told.out + told.err


def test_lists_of_held_out_panoramas(tmp_path):
    colmap(tmp_path, tracks=False)
    (tmp_path / "test.txt").write_text("c.png\n")
    scene = read(Data(tmp_path, test_list=tmp_path / "test.txt"))
    assert {view.name for view in scene.held_out} == {f"c-{face}.png" for face in CUBE_FACES}


def test_a_part_of_a_panorama_is_refused(tmp_path):
    colmap(tmp_path, tracks=False)
    Image.new("RGB", (WIDTH, 100)).save(tmp_path / "images/b.png")
    with pytest.raises(BadInput, match="b.png: 256 x 100 px.*twice"):
        read(Data(tmp_path))


def scene_of(folder, **settings):
    with collect_notes() as kept:
        return read(Data(folder, **{"test_every": 0} | settings)), kept.texts


def towards(view):
    """(h, w, 3) of a view: the direction of each pixel in the axes of its panorama, of length 1."""
    number = NAMES.index(f"{view.name.rpartition('-')[0]}.png")
    local = directions(view.camera) @ TURNS[number].T
    return local / np.linalg.norm(local, axis=-1, keepdims=True)


def test_a_scale_reduces_the_views(tmp_path):
    colmap(tmp_path, tracks=False)
    scene, _ = scene_of(tmp_path, scale=2)
    assert {(view.camera.width, view.camera.height) for view in scene.train} == {(44, 44)}
    for view in scene.train:
        difference = view_photo(view).permute(1, 2, 0).numpy() - colour(directions(view.camera))
        assert np.abs(difference).max() < 4, view.name
    assert scene_of(tmp_path, longest=30)[0].train[0].camera.width == 30
    halves = tmp_path / "images_2"
    halves.mkdir()
    for name in NAMES:
        Image.open(tmp_path / "images" / name).reduce(2).point(lambda value: value // 2).save(halves / name)
    darker, notes = scene_of(tmp_path, scale=2)
    assert any("images_2 are used" in text for text in notes) and darker.train[0].camera.fx == scene.train[0].camera.fx
    assert np.abs(view_photo(darker.train[0]).numpy() * 2.0 - view_photo(scene.train[0]).numpy()).max() < 6


def test_twelve_bits_in_panoramas_are_stretched(tmp_path):
    """One of 10 bits alone: white is that of 12 bits for it, too."""
    colmap(tmp_path, tracks=False)
    for at, name in enumerate(NAMES):
        grey = np.asarray(Image.open(tmp_path / "images" / name).convert("L")).astype(np.uint16)
        Image.fromarray(grey * (4 if at == 0 else 16)).save(tmp_path / "images" / name)
    scene, notes = scene_of(tmp_path)
    (line,) = [text for text in notes if "16 bits" in text]
    assert "3 photographs of 16 bits" in line and "4,095 is taken for white" in line
    for view in scene.train:
        grey = colour(directions(view.camera)) @ (0.299, 0.587, 0.114) * (0.25 if view.name[0] == "a" else 1)
        assert np.abs(view_photo(view)[1].numpy() - grey).max() < 3 and view.pixels == DEFAULT_PIXELS, view.name


def transparent_below(folder):
    """Panoramas whose lower part is transparent, and of another colour; but for the last, which is opaque."""
    for name in NAMES:
        below = (ahead()[..., 1] > 0.5) & (name != NAMES[-1])
        rgb = np.where(below[..., None], 255, np.asarray(Image.open(folder / "images" / name)))
        Image.fromarray(np.dstack([rgb, np.where(below, 0, 255)]).astype(np.uint8)).save(folder / "images" / name)


def test_transparent_panoramas(tmp_path):
    """Each way in one folder, where the views of one must not be taken for those of another."""
    colmap(tmp_path, tracks=False)
    transparent_below(tmp_path)
    for settings, level in (({"alpha": "ignore"}, 255), ({}, 0), ({"white": True}, 255), ({"alpha": "mask"}, None)):
        scene, _ = scene_of(tmp_path, **settings)
        for view in scene.train:
            down, photo = towards(view)[..., 1], view_photo(view).permute(1, 2, 0).numpy()
            down = down if view.name[0] != "c" else np.full_like(down, -1)
            kept = down < 0.45
            if level is None:
                clear = np.abs(down - 0.5) > 0.02
                assert (view_mask(view).numpy() == (down < 0.5))[clear].all(), view.name
                kept = view_mask(view).numpy()  # up to the edge there is no colour of what is transparent
            else:
                assert view.mask is None and np.abs(photo[down > 0.55] - float(level)).max(initial=0) < 3, settings
            assert np.abs(photo - colour(directions(view.camera)))[kept].max(initial=0) < 24, view.name


def test_panoramas_that_are_missing_are_skipped(tmp_path):
    colmap(tmp_path)
    (tmp_path / "images/b.png").unlink()
    with pytest.raises(BadInput, match="1 of 3 .*missing: 'b.png'.*--missing skip"):
        read(Data(tmp_path, test_every=0))
    data = Data(tmp_path, test_every=0, missing="skip")
    scene = read(data)
    assert [view.name for view in scene.train] == [f"{name}-{face}.png" for name in "ac" for face in CUBE_FACES]
    assert set(observations(data, scene).seen) == {view.name for view in scene.train}


def test_a_panorama_that_has_changed_is_noticed(tmp_path):
    colmap(tmp_path, tracks=False)
    before = fingerprint(scene_of(tmp_path)[0])
    assert changed(before, fingerprint(scene_of(tmp_path)[0], before)) == []
    path = tmp_path / "images/b.png"
    Image.fromarray(255 - np.asarray(Image.open(path))).save(path)
    found = changed(before, fingerprint(scene_of(tmp_path)[0], before))
    assert {change.name for change in found} == {f"b-{face}.png" for face in CUBE_FACES}


def test_depth_maps_of_panoramas_are_told(tmp_path):
    nerfstudio(tmp_path)
    assert not any("depth maps" in text for text in scene_of(tmp_path)[1])
    whole = json.loads((tmp_path / "transforms.json").read_text())
    Image.new("I;16", (WIDTH, HEIGHT), 1000).save(tmp_path / "depth.png")
    whole["frames"][0]["depth_file_path"] = whole["frames"][1]["depth_file_path"] = "depth.png"
    (tmp_path / "transforms.json").write_text(json.dumps(whole))
    _, notes = scene_of(tmp_path)
    assert any("depth maps of 2 of them are not cut with them, and not used" in text for text in notes)


def test_panoramas_beside_perspective_photographs(tmp_path):
    nerfstudio(tmp_path)
    whole = json.loads((tmp_path / "transforms.json").read_text())
    del whole["camera_model"]
    for frame in whole["frames"]:
        frame["camera_model"] = "EQUIRECTANGULAR"
    plain = {"camera_model": "PINHOLE", "fl_x": 50, "w": 40, "h": 30, "file_path": "images/p.png"}
    whole["frames"].append(plain | {"transform_matrix": whole["frames"][0]["transform_matrix"]})
    Image.new("RGB", (40, 30)).save(tmp_path / "images/p.png")
    (tmp_path / "transforms.json").write_text(json.dumps(whole))
    scene, _ = scene_of(tmp_path, test_every=3)
    assert len(scene.train) == 12 and [view.name for view in scene.held_out][-1] == "images/p.png"
    assert len(scene.held_out) == 7


def test_views_of_the_name_of_another_photograph(tmp_path):
    colmap(tmp_path, tracks=False)
    path = tmp_path / "sparse/0/images.txt"
    path.write_text(path.read_text().replace("b.png", "a.jpg"))
    Image.open(tmp_path / "images/b.png").save(tmp_path / "images/a.jpg")
    with pytest.raises(BadInput, match="'a-back.png' .*twice"):
        read(Data(tmp_path))


def test_a_panorama_above_the_limit_of_the_user(tmp_path, monkeypatch):
    colmap(tmp_path, tracks=False)
    monkeypatch.setenv("SURFKIT_MAX_MEGAPIXELS", "0.02")
    with pytest.raises(BadInput, match="a.png: 256 x 128 px .*limit"):
        read(Data(tmp_path))


def test_points_are_not_triangulated_between_panoramas(tmp_path, capsys):
    nerfstudio(tmp_path / "data")
    assert main(["prepare", "points", str(tmp_path / "data"), "--out", str(tmp_path / "scene")]) == 2
    assert "3 panoramas, 'images/a.png'" in capsys.readouterr().err


def test_the_edge_of_a_panorama_is_no_edge_in_a_view(tmp_path):
    """Noise, and the same noise half a turn on: what lies in the middle of one lies at both edges of the other."""
    colmap(tmp_path, tracks=False)
    noise = np.random.default_rng(1).integers(0, 256, (HEIGHT, WIDTH, 3), np.uint8)
    Image.fromarray(noise).save(tmp_path / "images/a.png")
    Image.fromarray(np.roll(noise, WIDTH // 2, 1)).save(tmp_path / "images/b.png")
    found = {view.name: view_photo(view).numpy().astype(float) for view in scene_of(tmp_path)[0].train}
    for face, other in (("front", "back"), ("back", "front"), ("left", "right"), ("right", "left")):
        assert np.abs(found[f"a-{face}.png"] - found[f"b-{other}.png"]).max() <= 1, face
    assert np.abs(found["a-up.png"] - found["b-up.png"][:, ::-1, ::-1]).max() <= 1


def test_every_line_says_how_panoramas_get_the_points_that_depth_maps_need(tmp_path, capsys):
    """Of nerfstudio's panoramas, which have no tracks, `prepare points` makes none, and `prepare depth` needs some."""
    nerfstudio(tmp_path / "data")
    data, out = str(tmp_path / "data"), str(tmp_path / "run")
    assert main(["doctor", data, "recipe:surface", "--quick", "--probe", "0"]) == 2
    said = [capsys.readouterr().out]
    assert "error: the run begins at depth maps" in said[0]
    for command in (["prepare", "depth"], ["train", "recipe:surface", "--out", out, "--data"]):
        assert main([*command, data]) == 2
        said.append(capsys.readouterr().err)
    for text in said:
        assert text.count("panoramas, whose points surfkit does not find: align them with COLMAP or OpenSfM") >= 2
        assert "surfkit prepare" not in text
