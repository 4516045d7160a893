"""`surfkit prepare photos`, from a folder of photographs of a known scene to a data set on the map."""

import json
import os
import re
import shutil
import sys
from hashlib import sha256

import numpy as np
import pytest
from PIL import Image

from surfkit.apps.sfm import colmap_database as matching
from surfkit.apps.sfm import dataset_export as deliver
from surfkit.apps.sfm import feature_cache as features
from surfkit.apps.sfm import mapping
from surfkit.apps.sfm.engine import load_engine
from surfkit.apps.sfm.similarity import umeyama
from surfkit.cli import main
from surfkit.depth.plane_sweep import PlaneSweep
from surfkit.io.datasets.data import Data
from surfkit.io.datasets.read import observations, read
from surfkit.scene.earth import from_utm
from surfkit.testing.write_exif import write_exif

from .pictures import arc, picture, save

ORIGIN = np.array([512_000.0, 5_800_000.0, 90.0])
QUICK = ("--max-features", "1500")
POSES = {f"view {at}.jpg": pose for at, pose in enumerate(arc(6))}
CENTRES = {name: -pose[:3, :3].T @ pose[:3, 3] for name, pose in POSES.items()}
WRONG = "view 3.jpg"


def position(centre):
    latitude, longitude = from_utm(centre[:1] + ORIGIN[0], centre[1:2] + ORIGIN[1], 33, False)
    return float(latitude[0]), float(longitude[0]), float(centre[2] + ORIGIN[2])


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Six photographs with positions, one of them wrong, of a scene; three of another; a black one and a copy."""
    root = tmp_path_factory.mktemp("flight") / "photos"
    rng = np.random.default_rng(0)
    for name, pose in POSES.items():
        noise = rng.normal(0, 0.02, 3) + (500.0 * (name == WRONG), 0, 0)
        write_exif(save(root / name, picture(pose)), position(CENTRES[name] + noise))
    for at, pose in enumerate(arc(3, 3.0)):
        save(root / "other" / f"{at}.jpg", picture(pose, seed=9))
    Image.new("RGB", (240, 180)).save(root / "black.jpg")
    shutil.copy(root / "view 0.jpg", root / "zcopy.jpg")
    return root


@pytest.fixture(scope="module")
def prepared(folder):
    assert main(["prepare", "photos", str(folder), *QUICK]) == 0
    return folder.parent / "photos-scene"


def cameras(scene):
    """Centres in the coordinates of the data set, by name."""
    views = (*scene.train, *scene.held_out)
    poses = {view.name: scene.frame.input_pose(view.camera.world_to_camera) for view in views}
    return {name: -pose[:3, :3].T @ pose[:3, 3] for name, pose in poses.items()}


def test_cameras_are_found_and_placed(prepared):
    scene = read(Data(prepared))
    found = cameras(scene)
    assert found.keys() == POSES.keys()
    truth = np.stack([CENTRES[name] + ORIGIN for name in found])
    ours = np.stack(list(found.values()))
    best = umeyama(ours - ORIGIN, truth - ORIGIN, np.ones(6))
    shape = np.linalg.norm(best.points(ours - ORIGIN) - (truth - ORIGIN), axis=1)
    assert shape.max() < 0.1, "of cameras 20 m away"
    assert np.linalg.norm(ours - truth, axis=1).max() < 0.3
    assert scene.frame.crs == "EPSG:32633+5773", "above sea level, as EXIF says"
    beside = json.loads((prepared / "sparse/0/georeference.json").read_text())
    assert (beside["crs"], beside["vertical_crs"]) == ("EPSG:32633", "EPSG:5773"), "for programs that know no other"
    assert scene.frame.metres == 1
    assert scene.frame.shift == (512_000, 5_800_000, 0)
    focal = {view.camera.fx / view.camera.width for view in scene.train}
    assert len(focal) == 1 and focal.pop() == pytest.approx(260 / 240, rel=0.03)
    heights = scene.frame.to_input(scene.cloud.xyz.numpy())[:, 2] - ORIGIN[2]
    assert abs(np.median(heights)) < 0.2 and 2.5 < heights.max() < 5, "ground at 0, box 3 m, ball 4.4 m"
    assert scene.cloud.rgb.float().std() > 20


def test_points_lie_where_photographs_show_them(prepared):
    data = Data(prepared)
    scene = read(data)
    seen = observations(data, scene)
    view = scene.train[0]
    spots = seen.seen[view.name]
    xyz = np.column_stack([seen.xyz[spots.points], np.ones(len(spots.points))]) @ view.camera.world_to_camera.numpy().T
    pixels = np.column_stack([view.camera.fx, view.camera.fy]) * xyz[:, :2] / xyz[:, 2:3] + (
        view.camera.cx,
        view.camera.cy,
    )
    off = np.linalg.norm(pixels - spots.at * (view.camera.width, view.camera.height), axis=1)
    assert len(off) > 50 and np.median(off) < 1


def test_the_report_says_what_became_of_each(prepared):
    report = json.loads((prepared / "report.json").read_text())
    assert (report["photographs"], report["registered"]) == (11, 6)
    why = report["not_registered"]
    assert why["black.jpg"] == "black" and why["zcopy.jpg"] == "a copy of view 0.jpg"
    assert {why[f"other/{at}.jpg"] for at in range(3)} == {
        "in another group of photographs, without matches to the largest: sparse/1"
    }
    assert report["models"][1]["photographs"] == 3 and "georeference" not in report["models"][1]
    place = report["models"][0]["georeference"]
    assert list(place["left_out"]) == [WRONG] and place["left_out"][WRONG] == pytest.approx(500, abs=1)
    assert max(place["rms_m"].values()) < 0.2
    [lens] = report["models"][0]["weighed"]["focal_lengths_px"]
    assert lens["exif"] is None and lens["photographs"] == 6 and lens["final"] == pytest.approx(260, rel=0.03)
    assert set(report["seconds"]) == {
        "photographs", "features", "pairs", "matches", "cameras", "georeference", "undistortion"
    }  # fmt: skip
    with Image.open(prepared / "cameras.png") as drawn:
        assert np.asarray(drawn.convert("RGB")).std() > 10


def test_the_other_group_can_be_read_too(prepared):
    scene = read(Data(prepared, model="sparse/1"))
    assert scene.frame.crs is None and len(cameras(scene)) == 3
    heights = scene.frame.to_input(scene.cloud.xyz.numpy())[:, 2]
    assert np.mean([centre[2] for centre in cameras(scene).values()]) > np.percentile(heights, 95), "level"


def watched(monkeypatch):
    """Names of the stages that work."""
    seen = []
    for module, name in ((features, "_keep"), (matching, "_compare"), (mapping, "_incremental")):
        plain = getattr(module, name)
        monkeypatch.setattr(module, name, lambda *given, plain=plain, name=name: seen.append(name) or plain(*given))
    return seen


def files(scene):
    """A hash of each file of a model."""
    return {str(path.relative_to(scene)): sha256(path.read_bytes()).hexdigest() for path in scene.rglob("*.bin")}


def images(scene):
    return {path.name: np.asarray(Image.open(path), np.int16) for path in (scene / "images").rglob("*.jpg")}


def same_images(scene, other):
    """Whether the photographs of two data sets are the same, but for rounding."""
    ours, theirs = images(scene), images(other)
    return ours.keys() == theirs.keys() and all(
        ours[name].shape == theirs[name].shape and np.abs(ours[name] - theirs[name]).max() <= 4 for name in ours
    )


def assert_same_model(scene, other):
    """The same cameras and points but for rounding: once they were not the same to the bit, as pycolmap may add up."""
    assert files(scene).keys() == files(other).keys()
    ours, theirs = read(Data(scene)), read(Data(other))
    assert cameras(ours).keys() == cameras(theirs).keys()
    for name, centre in cameras(ours).items():
        assert np.linalg.norm(centre - cameras(theirs)[name]) < 1e-3
    assert len(ours.cloud.xyz) == pytest.approx(len(theirs.cloud.xyz), rel=0.01)


def test_what_is_complete_is_not_repeated(folder, prepared, monkeypatch):
    before, seen = files(prepared), watched(monkeypatch)
    assert main(["prepare", "photos", str(folder), *QUICK]) == 0
    assert seen == [] and files(prepared) == before


def test_the_last_bits_of_a_model_are_rounded_away(prepared, tmp_path):
    """Threads of the solver change them from call to call."""
    engine, rng, written = load_engine(), np.random.default_rng(0), []

    def shaken(values):
        return np.asarray(values) + rng.normal(0, 1e-14, len(values))

    for name in ("one", "other"):
        model = mapping.read_model(prepared / "prepare/models/0")
        exact = {number: point.xyz for number, point in model.points3D.items()}
        for camera in model.cameras.values():
            camera.params = shaken(camera.params)
        for frame in model.frames.values():
            pose = frame.rig_from_world
            turn = engine.Rotation3d(shaken(pose.rotation.quat))
            frame.rig_from_world = engine.Rigid3d(turn, shaken(pose.translation))
        for point in model.points3D.values():
            point.xyz = shaken(point.xyz)
        mapping.round_off(engine, model)
        assert (
            max(np.abs(model.points3D[number].xyz - xyz).max() for number, xyz in exact.items())
            < mapping.MODEL_ROUNDING
        )
        (tmp_path / name).mkdir()
        model.write_binary(tmp_path / name)
        written.append({path.name: path.read_bytes() for path in (tmp_path / name).iterdir()})
    assert len(written[0]) >= 3 and written[0] == written[1]


def test_cameras_found_anew_leave_the_scene_as_it_is(folder, prepared, tmp_path, monkeypatch):
    def contents(root):
        return {
            path.relative_to(root): path.read_bytes()
            for path in (*root.glob("sparse/*/*"), *root.glob("images/**/*.jpg"))
        }

    before, plain = contents(prepared), mapping.round_off
    for noise, same in ((1e-10, True), (1e-3, False)):
        scene = tmp_path / str(noise)
        shutil.copytree(prepared, scene)
        shutil.rmtree(scene / "prepare/models")

        def round_off(engine, model, noise=noise):
            plain(engine, model)
            for at, point in model.points3D.items():
                point.xyz = point.xyz + noise * np.sin(at * np.arange(1, 4))

        monkeypatch.setattr(mapping, "round_off", round_off)
        assert main(["prepare", "photos", str(folder), "--out", str(scene), *QUICK]) == 0
        found, after = mapping.read_model(scene / "prepare/models/0"), contents(scene)
        exact = mapping.read_model(prepared / "prepare/models/0").points3D
        assert any((found.points3D[at].xyz != exact[at].xyz).any() for at in exact), "they are of other bits"
        assert (after == before) is same and after.keys() == before.keys()


def test_interrupted_at_each_stage_it_goes_on(folder, prepared, tmp_path, monkeypatch, capsys):
    for module, name in ((features, "_keep"), (matching, "_compare"), (mapping, "_incremental")):
        plain, calls = getattr(module, name), []

        def stop(*given, plain=plain, calls=calls, name=name):
            calls.append(1)
            if len(calls) == (3 if name == "_keep" else 1):
                raise KeyboardInterrupt
            return plain(*given)

        with monkeypatch.context() as patch:
            patch.setattr(module, name, stop)
            assert main(["prepare", "photos", str(folder), "--out", str(tmp_path / "s"), *QUICK]) == 130
        assert not (tmp_path / "s/sparse").exists() and not (tmp_path / "s/prepare/.surfkit-lock").exists()
    seen = watched(monkeypatch)
    assert main(["prepare", "photos", str(folder), "--out", str(tmp_path / "s"), *QUICK]) == 0
    assert "_keep" not in seen
    assert_same_model(tmp_path / "s", prepared)
    assert "Traceback" not in capsys.readouterr().err


def test_killed_with_another_lens_no_photograph_of_it_stays(folder, prepared, tmp_path, monkeypatch):
    shutil.copytree(prepared, tmp_path / "s")
    words = ["prepare", "photos", str(folder), "--out", str(tmp_path / "s"), *QUICK]
    write, record, calls = deliver._write, deliver.write_json, []

    def stop(*given):
        calls.append(1)
        if len(calls) > 3:
            raise KeyboardInterrupt
        return write(*given)

    with monkeypatch.context() as patch:
        patch.setattr(deliver, "_write", stop)
        patch.setattr(deliver, "write_json", lambda *given: None if len(calls) > 3 else record(*given))  # it is dead
        assert main([*words, "--lens", "OPENCV"]) == 130
    assert not same_images(tmp_path / "s", prepared)
    assert main(words) == 0
    assert same_images(tmp_path / "s", prepared)
    assert_same_model(tmp_path / "s", prepared)


def test_without_gps_it_is_level_and_features_are_kept(folder, prepared, tmp_path, monkeypatch, capsys):
    shutil.copytree(prepared, tmp_path / "s")
    seen = watched(monkeypatch)
    assert main(["prepare", "photos", str(folder), "--out", str(tmp_path / "s"), "--no-gps", *QUICK]) == 0
    assert "no known scale: --no-gps" in capsys.readouterr().err
    assert seen == []
    scene = read(Data(tmp_path / "s"))
    assert scene.frame.crs is None
    found = cameras(scene)
    ours, truth = np.stack(list(found.values())), np.stack([CENTRES[name] for name in found])
    assert umeyama(ours, truth, np.ones(6)).turn[2, 2] > np.cos(np.radians(3))


def test_a_photograph_more_takes_over_the_others(folder, prepared, tmp_path, monkeypatch):
    shutil.copytree(folder, tmp_path / "photos", copy_function=shutil.copy2)
    shutil.copytree(prepared, tmp_path / "s")
    save(tmp_path / "photos/late.jpg", picture(arc(7)[6]))
    compared, plain = [], matching._compare

    def compare(engine, given, settings):
        opened = engine.Database.open(given.database)
        before = opened.num_matched_image_pairs()
        opened.close()
        plain(engine, given, settings)
        compared.append(before)

    monkeypatch.setattr(matching, "_compare", compare)
    seen = []
    keep = features._keep
    monkeypatch.setattr(features, "_keep", lambda *given: seen.append(given[1].name) or keep(*given))
    assert main(["prepare", "photos", str(tmp_path / "photos"), "--out", str(tmp_path / "s"), *QUICK]) == 0
    assert seen == ["late.jpg"] and compared[0] == 36, "the pairs of nine photographs"
    assert set(cameras(read(Data(tmp_path / "s")))) == {*POSES, "late.jpg"}


@pytest.mark.parametrize(
    "count, said", [(1, "1 of 2 photographs can be used; not usable: 'black.jpg (black)'"), (0, "0 of 1")]
)
def test_too_few_photographs(folder, tmp_path, capsys, count, said):
    (tmp_path / "p").mkdir()
    for name in ["black.jpg", "view 0.jpg"][: count + 1]:
        shutil.copy(folder / name, tmp_path / "p" / name)
    assert main(["prepare", "photos", str(tmp_path / "p")]) == 2
    err = capsys.readouterr().err
    assert said in err and "Traceback" not in err


def test_photographs_that_do_not_overlap(folder, tmp_path, capsys):
    for at in range(3):
        save(tmp_path / "p" / f"{at}.jpg", picture(arc(1)[0], seed=20 + at))
    assert main(["prepare", "photos", str(tmp_path / "p"), *QUICK]) == 2
    said = capsys.readouterr().err.splitlines()[-1]
    assert "3 photographs ('0.jpg', '1.jpg' and 1 more: matches no other" in said


def test_a_system_without_positions_is_refused_before_the_work(folder, tmp_path, capsys):
    for at in range(3):
        save(tmp_path / "p" / f"{at}.jpg", picture(arc(3)[at]))
    words = ["prepare", "photos", str(tmp_path / "p"), "--crs", "EPSG:2180"]
    assert main(words) == 2 and "no photograph has one" in capsys.readouterr().err
    assert main([*words, "--no-gps"]) == 2 and "leave out one of the two" in capsys.readouterr().err
    assert main([*words[:3], "--checkpoints", "2"]) == 2 and "--gcp FILE" in capsys.readouterr().err
    assert not list(tmp_path.rglob("*.npz"))


def test_a_scene_of_other_photographs_is_not_replaced(tmp_path, capsys):
    flights = {"a": "a{}.jpg", "b": "b{}.jpg", "c": "a{}.jpg", "both/a": "{}.jpg", "both/b": "{}.jpg"}
    for seed, (folder, name) in enumerate(flights.items()):
        for at in range(3):
            save(tmp_path / folder / name.format(at), picture(arc(3)[at], seed))
    scene = tmp_path / "s"
    words = ["prepare", "photos", "--out", str(scene), "--no-gps"]
    assert main([*words, str(tmp_path / "a")]) == 0
    kept = {path: path.read_bytes() for path in scene.rglob("*") if path.is_file() and path.name != "stages.json"}
    capsys.readouterr()
    for folder, said in (("b", "none of them is in"), ("c", "most of those names in")):
        assert main([*words, str(tmp_path / folder)]) == 2
        told = capsys.readouterr().err
        assert (
            "was prepared from other photographs, 'a0.jpg'" in told and said in told and "name another folder" in told
        )
        assert all(path.read_bytes() == content for path, content in kept.items())
    for path in (tmp_path / "a").iterdir():  # copied, and EXIF written anew
        shutil.copyfile(path, tmp_path / "c" / path.name)
        write_exif(tmp_path / "c" / path.name, (52.3, 15.1, 90.0))
    (tmp_path / "c/a2.jpg").unlink()
    save(tmp_path / "c/a3.jpg", picture(arc(4)[3]))
    assert main([*words, str(tmp_path / "c")]) == 0
    assert {path.name for path in (scene / "images").iterdir()} == {"a0.jpg", "a1.jpg", "a3.jpg"}
    for path in (tmp_path / "c").iterdir():  # where they lay, all saved anew and brighter
        Image.fromarray(np.minimum(np.asarray(Image.open(path)) * 1.1, 255).astype(np.uint8)).save(path, quality=80)
    capsys.readouterr()
    assert main([*words, str(tmp_path / "c")]) == 0
    assert "no photograph is as it was" in capsys.readouterr().err
    for name in ("a0.jpg", "a3.jpg"):  # in another folder, most of them of another flight
        save(tmp_path / "d" / name, picture(arc(3)[0], 9))
    shutil.copyfile(tmp_path / "c/a1.jpg", tmp_path / "d/a1.jpg")
    capsys.readouterr()
    assert main([*words, str(tmp_path / "d")]) == 2 and "show something else" in capsys.readouterr().err
    assert main(["prepare", "photos", "--out", str(tmp_path / "two"), str(tmp_path / "both")]) == 0
    looked = json.loads((tmp_path / "two/prepare/photographs.json").read_text())
    assert [photo["name"] for photo in looked] == [f"{folder}/{at}.jpg" for folder in "ab" for at in range(3)]
    assert {path.parent.name for path in (tmp_path / "two/images").rglob("*.jpg")} == {"a", "b"}


@pytest.mark.skipif(sys.platform != "linux", reason="names of folders are Unicode there")
def test_a_folder_whose_name_is_not_utf8(tmp_path):
    folder = tmp_path / os.fsdecode(b"\xff")
    for at in range(3):
        save(folder / f"{at}.jpg", picture(arc(3)[at]))
    words = ["prepare", "photos", "--no-gps", "--out", str(tmp_path / "s"), str(folder)]
    assert main(words) == 0
    (tmp_path / "s/prepare/source.txt").write_bytes(b"\xfe")  # damaged: taken for another folder
    assert main(words) == 0


def test_what_would_be_overwritten_is_refused(folder, tmp_path, capsys):
    assert main(["prepare", "photos", str(folder), "--out", str(folder / "scene")]) == 2
    assert "lies in the folder of photographs" in capsys.readouterr().err
    (tmp_path / "s/sparse").mkdir(parents=True)
    assert main(["prepare", "photos", str(folder), "--out", str(tmp_path / "s")]) == 2
    assert "has sparse that this command did not make" in capsys.readouterr().err
    assert main(["prepare", "photos", str(tmp_path / "no")]) == 2
    assert "no such folder" in capsys.readouterr().err


def test_training_on_photographs_says_what_to_do(folder, tmp_path, capsys):
    words = ["train", "recipe:2dgs", "--out", str(tmp_path / "run"), "--data"]
    assert main([*words, str(folder)]) == 2
    assert f"surfkit prepare photos {folder}" in capsys.readouterr().err
    (tmp_path / "set").mkdir()
    shutil.copytree(folder, tmp_path / "set/images")
    assert main([*words, str(tmp_path / "set")]) == 2
    assert f"surfkit prepare photos {tmp_path / 'set/images'}" in capsys.readouterr().err


def test_ground_control_places_it_and_checkpoints_are_reported(folder, prepared, tmp_path, monkeypatch, capsys):
    shutil.copytree(prepared, tmp_path / "s")
    corners = [(-7, -2, 3), (-1.5, -2, 3), (-7, 3, 3), (-1.5, 3, 3), (2, -7, 0), (6, 5, 0), (-9, 6, 0), (0, 0, 0)]
    lines = ["WGS84 UTM 33N"]
    for at, corner in enumerate(corners):
        x, y, z = np.array(corner) + ORIGIN
        for name, pose in POSES.items():
            ray = pose[:3, :3] @ corner + pose[:3, 3]
            across, down = 260 * ray[:2] / ray[2] + (120, 90)
            if 0 <= across <= 240 and 0 <= down <= 180:
                lines.append(f"{x} {y} {z} {across} {down} {name.replace(' ', '_')} P{at}")
    shutil.copytree(folder, tmp_path / "p")
    for path in (tmp_path / "p").glob("view *.jpg"):  # names in a list have no spaces
        path.rename(path.with_name(path.name.replace(" ", "_")))
    (tmp_path / "gcp_list.txt").write_text("\n".join(lines))
    words = ["--gcp", str(tmp_path / "gcp_list.txt"), "--checkpoints", "3", *QUICK]
    seen = watched(monkeypatch)
    assert main(["prepare", "photos", str(tmp_path / "p"), "--out", str(tmp_path / "s"), *words]) == 0
    assert "_keep" not in seen, "features are those of the same files by other names"
    assert "checkpoints (RMS)" in capsys.readouterr().out
    ground = json.loads((tmp_path / "s/report.json").read_text())["models"][0]["ground_control"]
    assert len(ground["control"]) == 5 and len(ground["checkpoints"]) == 3
    assert max(ground["checkpoints_rms_m"].values()) < 0.05
    scene = read(Data(tmp_path / "s"))
    assert scene.frame.crs == "EPSG:32633"
    for name, centre in cameras(scene).items():
        assert np.linalg.norm(centre - CENTRES[name.replace("_", " ")] - ORIGIN) < 0.2

    flat = [line for line in lines[1:] if float(line.split()[2]) == ORIGIN[2]]
    rows = [(float(x) - ORIGIN[0], float(y) - ORIGIN[1], rest) for x, y, *rest in map(str.split, flat)]
    exchanged = [" ".join([f"{y + 5e5} {x + 5e5}", *rest]) for x, y, rest in rows]
    (tmp_path / "gcp_list.txt").write_text("\n".join([lines[0], *exchanged]))
    words = ["--gcp", str(tmp_path / "gcp_list.txt"), *QUICK]
    assert main(["prepare", "photos", str(tmp_path / "p"), "--out", str(tmp_path / "s"), *words]) == 2
    said = capsys.readouterr().err.splitlines()[-1]
    assert "gcp_list.txt: " in said and "upside down, 1" in said and "m below the ground" in said
    assert read(Data(tmp_path / "s")).frame.crs == "EPSG:32633", "what was there is kept"


def test_geo_txt_places_it_instead_of_exif(folder, prepared, tmp_path, monkeypatch, capsys):
    shutil.copytree(prepared, tmp_path / "s")
    shutil.copytree(folder, tmp_path / "p", copy_function=shutil.copy2)
    move = np.array([1500.0, -300, 20])
    rows = [" ".join([name, *map(str, CENTRES[name] + ORIGIN + move)]) for name in POSES]
    (tmp_path / "p/geo.txt").write_text("\n".join(["WGS84 UTM 33n", *rows]))
    seen = watched(monkeypatch)
    assert main(["prepare", "photos", str(tmp_path / "p"), "--out", str(tmp_path / "s"), *QUICK]) == 0
    assert seen == [], "only the place is another"
    said = capsys.readouterr().err
    assert "6 photographs in EPSG:32633, instead of" in said
    assert "2 km from their positions" in said
    for name, centre in cameras(read(Data(tmp_path / "s"))).items():
        assert np.linalg.norm(centre - CENTRES[name] - ORIGIN - move) < 0.2
    rows = [" ".join(row.split()[:4]) for row in rows]  # without heights: "view 0.jpg", x and y
    (tmp_path / "p/geo.txt").write_text("\n".join(["WGS84 UTM 33n", *rows]))
    assert main(["prepare", "photos", str(tmp_path / "p"), "--out", str(tmp_path / "s"), *QUICK]) == 0
    said = capsys.readouterr()
    assert "sparse/0 is placed in plan" in said.err and " north, of 6 photographs" in said.out
    for name, centre in cameras(read(Data(tmp_path / "s"))).items():
        assert np.linalg.norm((centre - CENTRES[name] - ORIGIN - move)[:2]) < 0.5
    place = json.loads((tmp_path / "s/report.json").read_text())["models"][0]["georeference"]
    assert place["rms_m"]["u"] is None and place["heights"] == "above the middle of the ground"


def test_a_list_that_cannot_be_used_is_refused_before_the_work(folder, tmp_path, capsys):
    (tmp_path / "t.csv").write_text("view 0.jpg,1,2,3")
    words = ["prepare", "photos", str(folder), "--out", str(tmp_path / "s"), "--positions", str(tmp_path / "t.csv")]
    assert main(words) == 2 and "names no coordinate reference system" in capsys.readouterr().err
    assert main([*words[:-1], str(tmp_path / "no.csv")]) == 2 and "no such file" in capsys.readouterr().err
    assert not list(tmp_path.rglob("*.npz"))


def maps_of(scene):
    return {path.name: path.read_bytes() for path in (scene / "estimated_depths").glob("*.npy")}


SMALL_MAPS = ("depth:plane-sweep", "--depth.longest", "48", "--device", "cpu")


def test_depth_maps_are_the_last_stage_and_go_on(folder, prepared, tmp_path, monkeypatch, capsys):
    scene, other = tmp_path / "s", tmp_path / "other"
    for each in (scene, other):
        shutil.copytree(prepared, each)
    words = ["prepare", "photos", str(folder), "--out", str(scene), *QUICK]
    seen, estimate = watched(monkeypatch), PlaneSweep.estimate

    def interrupted(self, given, wanted):
        yield next(estimate(self, given, wanted))
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(PlaneSweep, "estimate", interrupted)
        assert main([*words, *SMALL_MAPS]) == 130
    first = maps_of(scene)
    assert len(first) == 2, "a map and its confidence"
    capsys.readouterr()
    assert main([*words, *SMALL_MAPS]) == 0 and seen == []
    said = capsys.readouterr()
    assert "1 of 6 photographs have depth maps already" in said.err
    assert "of 6 of 6 photographs" in said.out and f"surfkit train recipe:surface --data {scene}" in said.out
    report = json.loads((scene / "report.json").read_text())
    assert (report["depth_maps"]["photographs"], report["depth_maps"]["without"]) == (6, [])
    assert report["depth_maps"]["estimator"]["longest"] == 48 and report["seconds"]["depth maps"] > 0
    sweep = ("estimator:plane-sweep", "--estimator.longest", "48", "--device", "cpu")
    assert main(["prepare", "depth", str(other), *sweep]) == 0
    assert maps_of(scene) == maps_of(other) and maps_of(scene).items() >= first.items()

    made = maps_of(scene)
    assert main([*words, *SMALL_MAPS]) == 0 and maps_of(scene) == made
    assert main([*words, "--lens", "RADIAL"]) == 0
    assert "has depth maps of other cameras or photographs" in capsys.readouterr().err and maps_of(scene) == made
    assert main([*words, "--lens", "RADIAL", *SMALL_MAPS]) == 0
    assert maps_of(scene).keys() == made.keys() and maps_of(scene) != made, "of the new cameras"
    capsys.readouterr()
    assert main([*words, "--lens", "RADIAL"]) == 0
    assert "depth maps of other" not in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("depth:plane-sweep", "--depth.window", "25", "--depth.longest", "32"), "window is 25, and the largest"),
        (("depth:depth-anything-v2", "--depth.weights", "nowhere"), "depth-anything-v2 needs|nowhere cannot be loaded"),
        (
            ("--device", "cpu"),
            "--device cpu is for depth maps and for features and .*; add depth",
        ),
    ],
)
def test_depth_that_cannot_be_made_is_refused_before_the_work(folder, tmp_path, monkeypatch, capsys, words, said):
    seen = watched(monkeypatch)
    assert main(["prepare", "photos", str(folder), "--out", str(tmp_path / "s"), *QUICK, *words]) == 2
    err = capsys.readouterr().err
    assert re.search(said, err) and "Traceback" not in err and seen == []


def test_depth_maps_of_other_programs_stay(folder, prepared, tmp_path, capsys):
    shutil.copytree(prepared, tmp_path / "s")
    path = tmp_path / "s/estimated_depths/view 1.jpg.npy"
    path.parent.mkdir()
    np.save(path, np.ones((3, 4)))
    assert main(["prepare", "photos", str(folder), "--out", str(tmp_path / "s"), *QUICK, *SMALL_MAPS]) == 2
    assert "depth maps that surfkit did not make" in capsys.readouterr().err and np.load(path).shape == (3, 4)
