"""`surfkit prepare points`: points between cameras that are known, of a scene of known shape."""

import shutil

import numpy as np
import pytest
from needs import needs_native

from surfkit.apps.sfm import colmap_database as matching
from surfkit.apps.sfm import feature_cache as features
from surfkit.apps.sfm import inspect_photos as photographs
from surfkit.apps.sfm import tie_points
from surfkit.cli import main
from surfkit.io.datasets.data import Data
from surfkit.io.datasets.masks import view_mask
from surfkit.io.datasets.read import observations, read
from surfkit.testing.synthetic import SURFACES

from .pictures import FOCAL, HEIGHT, WIDTH, arc, picture, save

POSES = {f"view {at}.jpg": pose for at, pose in enumerate(arc(5))}
OFFSET = np.array([512_000.0, 5_800_000.0, 90.0])
QUICK = ("--max-features", "1500")
UTM33 = (
    'PROJCS["WGS 84 / UTM zone 33N",GEOGCS["WGS 84",DATUM["WGS 84",SPHEROID["WGS 84",6378137,298.257223563]],'
    'PRIMEM["Greenwich",0],UNIT["degree",0.0174532925199433]],PROJECTION["Transverse_Mercator"],'
    'PARAMETER["central_meridian",15],PARAMETER["scale_factor",0.9996],PARAMETER["false_easting",500000],'
    'UNIT["metre",1],AUTHORITY["EPSG","32633"]]'
)


def pix4d(folder, wrong=0.0):
    """The photographs, and their true cameras as Pix4D writes them; `wrong` moves them apart."""
    lines = ["fileName imageWidth imageHeight", "camera matrix K [3x3]", "camera position t [3x1]"]
    lines += ["camera rotation R [3x3]", "camera model m = K [R|-Rt] X", ""]
    for at, (name, pose) in enumerate(POSES.items()):
        save(folder / "images" / name, picture(pose))
        turn, centre = pose[:3, :3], -pose[:3, :3].T @ pose[:3, 3] + (0, 0, wrong * at)
        matrix = [[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]]
        rows = [*matrix, centre, *turn]
        lines += [f"{name} {WIDTH} {HEIGHT}", *(" ".join(repr(float(value)) for value in row) for row in rows)]
    (folder / "p_calibrated_camera_parameters.txt").write_text("\n".join(lines) + "\n")
    (folder / "p_offset.xyz").write_text(" ".join(str(value) for value in OFFSET))
    (folder / "p_wkt.prj").write_text(UTM33)
    return folder


@pytest.fixture(scope="module")
def prepared(tmp_path_factory):
    folder = pix4d(tmp_path_factory.mktemp("survey") / "data")
    assert main(["prepare", "points", str(folder), *QUICK]) == 0
    return folder


def test_points_lie_on_the_scene_and_cameras_stay(prepared):
    given, scene = read(Data(prepared)), read(Data(prepared.parent / "data-scene"))
    assert (scene.frame.crs, scene.frame.metres, scene.frame.shift) == ("EPSG:32633", 1.0, tuple(OFFSET))
    for view, wanted in zip(scene.train, given.train, strict=True):
        assert view.name == wanted.name
        pose, true = (s.frame.input_pose(v.camera.world_to_camera) for s, v in ((scene, view), (given, wanted)))
        np.testing.assert_allclose(pose[:3, :3], true[:3, :3], atol=1e-9)
        np.testing.assert_allclose(pose[:3, :3].T @ pose[:3, 3], true[:3, :3].T @ true[:3, 3], atol=1e-6)
        lens, known = view.camera, wanted.camera
        np.testing.assert_allclose([lens.fx, lens.fy, lens.cx, lens.cy], [known.fx, known.fy, known.cx, known.cy])
    xyz = scene.frame.to_input(scene.cloud.xyz.numpy()) - OFFSET
    off = np.min([surface.distance(xyz) for surface in SURFACES], axis=0)
    assert len(xyz) > 200 and np.median(off) < 0.03 and np.percentile(off, 95) < 0.2, "of cameras 18 m away"
    assert scene.cloud.rgb.float().std() > 20


def test_each_photograph_knows_its_points(prepared):
    data = Data(prepared.parent / "data-scene")
    scene = read(data)
    seen = observations(data, scene)
    for view in scene.train:
        spots, pose = seen.seen[view.name], view.camera.world_to_camera.numpy()
        local = seen.xyz[spots.points] @ pose[:3, :3].T + pose[:3, 3]
        c = view.camera
        pixels = np.stack([c.fx * local[:, 0], c.fy * local[:, 1]], 1) / local[:, 2:] + (c.cx, c.cy)
        off = np.linalg.norm(pixels - spots.at * (c.width, c.height), axis=1)
        assert len(off) > 50 and np.median(off) < 0.7


@needs_native
def test_what_was_refused_trains_now(prepared, tmp_path, capsys):
    words = ["train", "recipe:surface", "mesh:none", "--steps", "2", "--device", "cpu", "--longest", "120"]
    words += ["--pictures-every", "0", "--out", str(tmp_path / "run"), "--data"]
    assert main([*words, str(prepared)]) == 2
    assert f"`surfkit prepare points {prepared}`" in capsys.readouterr().err
    assert main([*words, str(prepared.parent / "data-scene")]) == 0


def test_interrupted_it_goes_on_and_complete_it_is_not_repeated(prepared, tmp_path, monkeypatch):
    words = ["prepare", "points", str(prepared), "--out", str(tmp_path / "s"), *QUICK]
    seen = []
    for module, name in ((features, "_keep"), (matching, "_compare"), (tie_points, "_without_points")):
        plain = getattr(module, name)

        def stop(*given, plain=plain, name=name):
            seen.append(name)
            if seen.count(name) == 1:
                raise KeyboardInterrupt
            return plain(*given)

        monkeypatch.setattr(module, name, stop)
    for _ in range(3):
        assert main(words) == 130 and not (tmp_path / "s/sparse").exists()
    assert main(words) == 0
    model = {path.name: path.read_bytes() for path in (tmp_path / "s/sparse/0").iterdir()}
    assert model == {path.name: path.read_bytes() for path in (prepared.parent / "data-scene/sparse/0").iterdir()}
    seen.clear()
    assert main(words) == 0 and seen == []


def test_cameras_of_other_photographs_are_noticed(tmp_path, capsys):
    folder = pix4d(tmp_path / "data", wrong=40.0)
    assert main(["prepare", "points", str(folder), *QUICK]) == 2
    assert "are these the cameras of these photographs?" in capsys.readouterr().err


def test_a_photograph_without_features_is_named(tmp_path, capsys):
    folder = pix4d(tmp_path / "data")
    plain = np.broadcast_to(np.linspace(50, 200, WIDTH).astype(np.uint8)[:, None], (HEIGHT, WIDTH, 3))
    save(folder / "images/view 4.jpg", plain)
    assert main(["prepare", "points", str(folder), *QUICK]) == 0
    assert "hardly any features: 'view 4.jpg'" in capsys.readouterr().err
    assert [view.name for view in read(Data(tmp_path / "data-scene", test_every=0)).train] == list(POSES)[:4]


def test_lenses_that_bend_and_coordinates_without_a_system(tmp_path, monkeypatch, capsys):
    """Cameras of Bundler without points, of photographs through a lens, with masks."""
    from scipy.ndimage import map_coordinates

    k1, folder, lines = -0.12, tmp_path / "data", ["# Bundle file v0.3", f"{len(POSES)} 0"]
    x, y = np.meshgrid(np.arange(WIDTH) + 0.5 - WIDTH / 2, np.arange(HEIGHT) + 0.5 - HEIGHT / 2)
    away = np.hypot(x, y) / FOCAL  # of a pixel in the photograph; the ray that it shows is found by iteration
    ray = away.copy()
    for _ in range(50):
        ray = away / (1 + k1 * ray**2)
    factor = ray / np.maximum(away, 1e-9)
    for name, pose in POSES.items():
        wide = picture(pose, width=WIDTH + 40, height=HEIGHT + 40).astype(float)[..., 0]
        at = np.stack([y * factor + HEIGHT / 2 + 20 - 0.5, x * factor + WIDTH / 2 + 20 - 0.5])
        bent = map_coordinates(wide, at, order=1).round().astype(np.uint8)
        save(folder / "images" / name, np.repeat(bent[..., None], 3, 2))
        turn = np.diag([1.0, -1.0, -1.0]) @ pose[:3, :3]
        move = np.diag([1.0, -1.0, -1.0]) @ pose[:3, 3] - turn @ OFFSET
        rows = [(FOCAL, k1, 0.0), *turn, move]
        lines += [" ".join(repr(float(value)) for value in row) for row in rows]
    shutil.copy(folder / "images/view 0.jpg", folder / "images/a copy.jpg")  # without a camera
    hidden = np.full((HEIGHT, WIDTH), 255, np.uint8)
    hidden[:, : WIDTH // 2] = 0
    save(folder / "masks/view 0.png", np.repeat(hidden[..., None], 3, 2))
    (folder / "bundle.out").write_text("\n".join(lines) + "\n")
    (folder / "list.txt").write_text("".join(f"{name}\n" for name in POSES))
    looked, plain = [], photographs._look
    monkeypatch.setattr(photographs, "_look", lambda path, photo: looked.append(path.name) or plain(path, photo))
    assert main(["prepare", "points", str(folder), "--out", str(tmp_path / "s"), *QUICK]) == 0
    assert sorted(looked) == list(POSES), "what is not of the data set is not read"
    assert "masks is ignored in 1 of 5" in capsys.readouterr().err
    data = Data(tmp_path / "s", test_every=0)
    scene = read(data)
    assert [view.mask is not None for view in scene.train] == [True, False, False, False, False]
    kept = view_mask(scene.train[0]).float().mean(0)
    assert (kept[: WIDTH // 2 - 8] == 0).all() and kept[WIDTH // 2 + 8 : -4].min() > 0.9
    across = [spots.at[:, 0] for spots in map(observations(data, scene).seen.get, POSES)]
    assert across[0].min() > 0.47 and len(across[0]) > 20 and across[1].min() < 0.2, "no features under the mask"
    assert (scene.frame.crs, scene.frame.metres) == (None, None)
    assert [view.name for view in scene.train] == list(POSES)
    for view in scene.train:
        pose, true = scene.frame.input_pose(view.camera.world_to_camera), POSES[view.name]
        np.testing.assert_allclose(-pose[:3, :3].T @ pose[:3, 3], OFFSET - true[:3, :3].T @ true[:3, 3], atol=1e-4)
    xyz = scene.frame.to_input(scene.cloud.xyz.numpy()) - OFFSET
    off = np.min([surface.distance(xyz) for surface in SURFACES], axis=0)
    assert len(xyz) > 200 and np.median(off) < 0.04 and np.percentile(off, 90) < 0.3


def test_what_is_refused(prepared, tmp_path, capsys):
    assert main(["prepare", "points", str(prepared), "--out", str(prepared / "s")]) == 2
    assert "lies in the data set" in capsys.readouterr().err
    assert main(["prepare", "points", str(tmp_path)]) == 2
    assert "the folder is empty" in capsys.readouterr().err
    save(tmp_path / "a.jpg", picture(arc(1)[0]))
    assert main(["prepare", "points", str(tmp_path)]) == 2
    assert f"`surfkit prepare photos {tmp_path}`" in capsys.readouterr().err
