"""Made-up data sets with one fault and with all of them: each is told, in one go, and nothing is written."""

import json
import re
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from surfkit.appearance.exposure import Exposure
from surfkit.apps.doctor import examine as examine_module
from surfkit.apps.doctor import geometry
from surfkit.apps.doctor.examine import examine
from surfkit.cli.recipes import recipes
from surfkit.core.codec import dump
from surfkit.core.tree import evolve
from surfkit.depth.patch_match import PatchMatch
from surfkit.depth.plane_sweep import PlaneSweep
from surfkit.io.datasets.data import Data
from surfkit.io.datasets.depth_files import write_map
from surfkit.io.datasets.raw_dataset import load_pycolmap
from surfkit.losses import NormalPrior
from surfkit.partition import QuantileGrid
from surfkit.testing.synthetic import Flight, photograph, write_colmap

BORUSZYN = Path(__file__).parents[3] / "examples" / "boruszyn"
FLIGHT = Flight(kind="grid", views=16, width=64, height=48, points=1_500)
IMAGES, CAMERAS, POINTS = (f"sparse/0/{part}.txt" for part in ("images", "cameras", "points3D"))


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A sound data set, never changed; its ground has no hole and its photographs one exposure."""
    folder = tmp_path_factory.mktemp("made") / "farm"
    write_colmap(folder, photograph(FLIGHT))
    return folder


@pytest.fixture
def farm(made, tmp_path):
    """A copy to damage."""
    return Path(shutil.copytree(made, tmp_path / "farm"))


def told(folder, recipe="2dgs", quick=False, **settings):
    """The findings about a data set by kind; several of one kind are in order."""
    recipe = recipes()[recipe] if isinstance(recipe, str) else recipe
    found = {}
    for finding in examine(Data(folder, **settings), recipe, quick).diagnosis.findings:
        assert "\n" not in finding.text
        found.setdefault(finding.what, []).append(finding)
    return found


def tree(folder):
    return {path: path.stat().st_mtime_ns for path in folder.rglob("*")}


def lines(path, change):
    """Change the lines of a file that are no comments."""
    path.write_text("".join(f"{line}\n" for line in change(path.read_text().splitlines())))


def opposite(v):
    """The pose that looks the other way from the same place: half a turn about the x axis of the camera."""
    w, x, y, z, right, down, ahead = v
    return [-x, w, -z, y, right, -down, -ahead]


def not_finite(*names, camera=None):
    """Write the model as binary files, and put no number into the poses of images and into a PINHOLE camera."""

    def change(folder):
        model = folder / "sparse" / "0"
        load_pycolmap().Reconstruction(str(model)).write_binary(str(model))
        for path in [*model.glob("*.txt"), model / "rigs.bin", model / "frames.bin"]:
            path.unlink(missing_ok=True)
        raw = bytearray((model / "images.bin").read_bytes())
        for name in names:
            at = raw.index(name.encode() + b"\0") - 4 - 24  # x of the translation
            raw[at : at + 8] = np.float64(np.nan).tobytes()
        (model / "images.bin").write_bytes(raw)
        raw = bytearray((model / "cameras.bin").read_bytes())
        for at in range(8, len(raw), 56):
            if raw[at] == camera:
                raw[at + 24 : at + 32] = np.float64(np.nan).tobytes()
        (model / "cameras.bin").write_bytes(raw)

    return change


def pose(at, change):
    """Change the numbers of the pose of an image, q and t."""

    def changed(rows):
        words = rows[2 * at].split(" ")
        words[1:8] = map(str, change([float(word) for word in words[1:8]]))
        return [*rows[: 2 * at], " ".join(words), *rows[2 * at + 1 :]]

    return lambda folder: lines(folder / IMAGES, changed)


def cut(name, share=0.5):
    def change(folder):
        path = folder / "images" / name
        path.write_bytes(path.read_bytes()[: int(share * path.stat().st_size)])

    return change


def paint(name, pixels):
    return lambda folder: Image.fromarray(pixels).save(folder / name)


def gone(name):
    return lambda folder: (folder / "images" / name).unlink()


def lens(text):
    return lambda folder: lines(folder / CAMERAS, lambda rows: [text])


def moved_points(offset, share=1.0):
    """Shift some of the points."""

    def change(rows):
        count = int(share * len(rows))
        words = [row.split(" ") for row in rows]
        for row in words[:count]:
            row[1:4] = [str(float(value) + add) for value, add in zip(row[1:4], offset, strict=True)]
        return [" ".join(row) for row in words]

    return lambda folder: lines(folder / POINTS, change)


def without_middle(folder):
    """Take away the points of a square in the middle of the ground."""

    def change(rows):
        at = np.array([[float(v) for v in row.split(" ")[1:3]] for row in rows])
        low, high = np.quantile(at, [0.02, 0.98], axis=0)
        inside = (np.abs(at - (low + high) / 2) < 0.2 * (high - low)).all(1)
        return [row for row, hidden in zip(rows, inside, strict=True) if not hidden]

    lines(folder / POINTS, change)


def brightened(folder):
    """Every other photograph two stops darker, in linear light."""
    for path in sorted((folder / "images").glob("*.png"))[::2]:
        linear = (np.asarray(Image.open(path)) / 255.0) ** 2.2 / 4
        Image.fromarray((255 * linear ** (1 / 2.2)).round().astype(np.uint8)).save(path)


def masks_of(value):
    def change(folder):
        (folder / "masks").mkdir()
        for path in (folder / "images").glob("*.png"):
            Image.fromarray(np.full((48, 64), value, np.uint8)).save(folder / "masks" / path.name)

    return change


def shifted_far(folder):
    """The whole model far from the origin, as in map coordinates."""
    offset = np.array([0.0, 5e6, 0.0])
    moved_points(offset)(folder)

    def change(rows):
        from scipy.spatial.transform import Rotation

        words = [row.split(" ") for row in rows]
        for row in words[::2]:
            w, x, y, z, *shift = map(float, row[1:8])
            shift = np.array(shift) - Rotation.from_quat([x, y, z, w]).apply(offset)
            row[5:8] = map(repr, map(float, shift))
        return [" ".join(row) for row in words]

    lines(folder / IMAGES, change)


FAULTS = {
    "no-model": (lambda f: shutil.rmtree(f / "sparse"), "data-set", "error", "no COLMAP model"),
    "half-model": (lambda f: (f / POINTS).unlink(), "data-set", "error", "the COLMAP model lacks points3D.txt"),
    "missing": (gone("view_003.png"), "data-set", "error", "1 of 16 photographs are missing: 'view_003"),
    "no-images": (lambda f: (f / "images").rename(f / "photos"), "data-set", "error", "no such folder of photographs"),
    "cut": (cut("view_003.png"), "damaged-photographs", "error", "'view_003.png': not a whole picture: image file is"),
    "empty": (cut("view_003.png", 0), "damaged-photographs", "error", "'view_003.png': not a whole picture: cannot"),
    "size": (
        paint("images/view_003.png", np.random.default_rng(0).integers(0, 255, (40, 64, 3), np.uint8)),
        "sizes",
        "error",
        "'view_003.png': 64 x 40 px, but its camera 1 has 64 x 48",
    ),
    "nan": (
        not_finite("view_003.png"),
        "data-set",
        "error",
        "the pose of 'view_003.png' is not finite",
    ),
    "lens": (lens("1 PINHOLE 64 48 -50 50 32 24"), "camera", "error", "(16 photographs)"),
    "points": (lambda f: (f / POINTS).write_text(""), "no-points", "warning", "`surfkit prepare points "),
    "few": (lambda f: lines(f / POINTS, lambda rows: rows[::20]), "few-points", "warning", "only 75 sparse points"),
    "away": (moved_points((900, 900, 0)), "points-out-of-view", "error", "100% of the sparse points are in view of no"),
    "thin": (moved_points((900, 900, 0), 0.2), "thin-coverage", "warning", "in view of fewer than 3 training"),
    "far": (pose(3, lambda v: [*v[:4], 4e4, *v[5:]]), "far-cameras", "warning", "'view_003.png': "),
    "bare": (
        pose(3, opposite),
        "cameras-without-points",
        "warning",
        "'view_003.png'",
    ),
    "numbers": (shifted_far, "large-coordinates", "note", "point_cloud.ply leaves out an offset"),
    "hole": (
        without_middle,
        "coverage-holes",
        "warning",
        "of the ground below the cameras has no sparse points",
    ),
    "blank": (
        paint("images/view_003.png", np.full((48, 64, 3), 7, np.uint8)),
        "blank-photographs",
        "warning",
        "1 photographs are of one colour throughout, 'view_003.png'",
    ),
    "loose": (paint("images/more.png", np.zeros((9, 9), np.uint8)), "unused-pictures", "note", "1 of 17 pictures"),
    "exposure": (brightened, "exposure", "warning", "add pretrain.appearance:exposure"),
    "black-masks": (masks_of(0), "inverted-masks", "warning", "the masks keep 0% of the pixels"),
    "black-mask": (
        lambda f: [masks_of(255)(f), paint("masks/view_003.png", np.zeros((48, 64), np.uint8))(f)],
        "empty-masks",
        "warning",
        "1 mask keeps nothing of the photograph, 'view_003.png'; correct or delete it",
    ),
    "mask-shape": (
        lambda f: [masks_of(255)(f), paint("masks/view_003.png", np.zeros((48, 20), np.uint8))(f)],
        "masks",
        "error",
        "'mask of view_003.png': 20 x 48 px is not the shape of its photograph",
    ),
}


def test_a_sound_data_set_is_sound_and_is_not_touched(made):
    before = tree(made)
    examined = examine(Data(made), recipes()["2dgs"])
    assert examined.diagnosis.findings == () and examined.diagnosis.sound
    assert tree(made) == before
    found = examined.diagnosis.found
    assert found["layout"] == "colmap" and found["photographs"].startswith("16 with a pose")
    assert found["sizes"] == "64 x 48 px" and found["kinds"] == "PNG RGB" and found["masks"] == "none"
    assert found["cameras"].startswith("PINHOLE 64 x 48") and found["sparse points"].startswith(
        "1,500, each in view of"
    )
    assert examined.diagnosis.will == (
        "train on 14 photographs, and measure on 2 (one of every 8)",
        "start from about 1,500 points (start:sparse)",
    )


def test_the_bundled_scene_has_no_error():
    levels = {finding.level for found in told(BORUSZYN).values() for finding in found}
    assert "error" not in levels


@pytest.mark.parametrize("fault", FAULTS)
def test_a_fault_is_told(farm, fault):
    change, what, level, words = FAULTS[fault]
    change(farm)
    before = tree(farm)
    found = told(farm)
    texts = [finding.text for finding in found[what]]
    assert any(words in text for text in texts), texts
    assert {finding.level for finding in found[what]} == {level}
    assert tree(farm) == before
    if what not in (
        "data-set",
        "camera",
        "points-out-of-view",
        "far-cameras",
        "coverage-holes",
    ):  # of which others follow
        assert set(found) == {what}


def test_all_faults_are_told_at_once(farm):
    gone("view_001.png")(farm)
    cut("view_002.png")(farm)
    cut("view_012.png", 0.7)(farm)
    paint("images/view_003.png", np.random.default_rng(0).integers(0, 255, (40, 64, 3), np.uint8))(farm)
    pose(15, lambda v: [*v[:4], 4e4, *v[5:]])(farm)
    pose(6, opposite)(farm)
    lens_of_seven = "2 PINHOLE 64 48 55 50 32 24"
    lines(farm / CAMERAS, lambda rows: [*rows, lens_of_seven])
    lines(farm / IMAGES, lambda rows: [row.replace(" 1 view_007", " 2 view_007") for row in rows])
    paint("images/view_009.png", np.full((48, 64, 3), 7, np.uint8))(farm)
    paint("images/more.png", np.zeros((9, 9), np.uint8))(farm)
    masks_of(255)(farm)
    paint("masks/view_011.png", np.zeros((48, 20), np.uint8))(farm)
    lines(farm / POINTS, lambda rows: rows[::20])
    not_finite("view_004.png", camera=2)(farm)
    (farm / "list.txt").write_text("view_005.png\nnone.png\n")
    found = told(farm, test_list=farm / "list.txt")
    names = {what: {name for finding in all_ for name in finding.names} for what, all_ in found.items()}
    texts = " ".join(finding.text for finding in found["data-set"])
    for words in ("missing: 'view_001.png'", "pose of 'view_004.png'", "no photograph 'none.png'"):
        assert words in texts
    assert names["damaged-photographs"] == {"view_002.png", "view_012.png"}
    assert names["sizes"] == {"view_003.png"} and names["far-cameras"] == {"view_015.png"}
    assert {"view_006.png"} <= names["cameras-without-points"] and names["camera"] == {"view_007.png"}
    assert names["blank-photographs"] == {"view_009.png"} and names["masks"] >= {"mask of view_011.png"}
    assert "few-points" in found and "unused-pictures" in found
    levels = [finding.level for finding in examine(Data(farm), recipes()["2dgs"]).diagnosis.findings]
    assert levels == sorted(levels, key=("error", "warning", "note").index)


def test_photographs_are_looked_at_even_without_a_model(farm):
    (farm / POINTS).unlink()
    cut("view_002.png")(farm)
    found = told(farm)
    assert "lacks points3D.txt" in found["data-set"][0].text
    assert found["damaged-photographs"][0].names == ("view_002.png",)


def test_many_of_one_kind_are_one_line(farm):
    names = [f"view_{at:03}.png" for at in range(9)]
    for at, name in enumerate(names):
        cut(name, 0.4 + 0.03 * at)(farm)
    not_finite(*(f"view_{at:03}.png" for at in range(10, 14)))(farm)
    found = told(farm)
    damaged = [finding for finding in found["damaged-photographs"] if len(finding.names) > 1]
    assert sum(len(finding.names) for finding in found["damaged-photographs"]) == 9 and len(damaged) == 1
    assert "'view_002.png' and 6 more: not a whole" in damaged[0].text
    (poses,) = found["data-set"]
    assert "view_011.png, view_012.png, view_013.png" in poses.text
    assert poses.names == tuple(f"view_{at:03}.png" for at in range(10, 14))


def test_every_frame_of_a_transforms_file_is_looked_at(farm):
    frames = []
    for at, path in enumerate(sorted((farm / "images").glob("*.png"))):
        matrix = np.diag([1.0, -1, -1, 1])
        matrix[:3, 3] = at, at % 4, 5
        frames.append({"file_path": f"images/{path.name}", "transform_matrix": matrix.tolist()})
    frames[2]["file_path"] = frames[5]["file_path"] = "images/none.png"
    frames[3]["transform_matrix"][0][0] = float("nan")
    frames[4]["fl_x"] = "wide"
    shutil.rmtree(farm / "sparse")
    (farm / "sparse_pc.ply").write_bytes(b"ply\nnothing")
    (farm / "transforms.json").write_text(json.dumps({"fl_x": 50, "w": 64, "h": 48, "frames": frames}))
    found = told(farm)["data-set"]
    texts = [finding.text for finding in found]
    assert any("frames.2: no photograph" in text and "1 more like it: frames.5" in text for text in texts)
    assert any("frames.3: transform_matrix is not" in text for text in texts)
    assert any("frames.4: fl_x is 'wide'" in text for text in texts)
    assert any("sparse_pc.ply" in text for text in texts)


def test_quick_looks_at_headers_only(farm):
    cut("view_003.png")(farm)
    cut("view_004.png", 0)(farm)
    brightened_names = {finding.names for finding in told(farm, quick=True)["damaged-photographs"]}
    assert brightened_names == {("view_004.png",)}


def test_what_depends_on_the_recipe(farm):
    brightened(farm)
    learning = evolve(recipes()["2dgs"], "pretrain.appearance", Exposure())
    assert "exposure" not in told(farm, learning)
    blocks = told(farm, "2dgs-blocks")["exposure"][0].text
    assert "pretrain.appearance:exposure tune.appearance:exposure" in blocks and "surfkit prepare points" in blocks
    assert "there are no depth priors" in told(farm, "citygs2-coarse")["depth-priors"][0].text
    (farm / "estimated_depths").mkdir()
    np.save(farm / "estimated_depths" / "view_001.png.npy", np.ones((3, 4), np.float32))
    own = json.dumps({"aligned": True, "estimator": dump(PlaneSweep()), "longest": 32})
    (farm / "estimated_depths" / "depth.json").write_text(own)
    _, other = told(farm, evolve(recipes()["citygs2-coarse"], "depth", PlaneSweep(longest=40)))["depth-priors"]
    assert other.text.startswith(f"{farm / 'estimated_depths'} has ") and "other settings of plane-sweep" in other.text
    assert "photographs of 32 px" in other.text
    (farm / "estimated_depths" / "depth.json").unlink()
    (priors,) = told(farm, "citygs2-coarse")["depth-priors"]
    assert priors.text.startswith("13 of 14 photographs have no depth prior") and len(priors.names) == 13
    near = evolve(recipes()["2dgs"], "pretrain.near", 10.0)
    assert "nearer to the camera than the near plane" in told(farm, near)["near-plane"][0].text


def test_what_blocks_are_tuned_without_is_told(farm):
    whole = recipes()["2dgs"]
    (said,) = told(farm, replace(whole, partition=QuantileGrid((1, 1))), quick=True)["blocks"]
    assert said.level == "warning" and "tune.losses.normal:normal" in said.text
    assert "blocks" not in told(farm, whole, quick=True) and "blocks" not in told(farm, "citygs2", quick=True)


def test_depth_priors_without_the_normals_that_a_loss_wants(farm):
    wanting = evolve(recipes()["2dgs"], "pretrain.losses.more", NormalPrior())
    assert "surfkit prepare depth" in told(farm, wanting)["depth-priors"][0].text
    sweeping, matching = (told(farm, evolve(wanting, "depth", estimator)) for estimator in (PlaneSweep(), PatchMatch()))
    assert "depth:patch-match does" in sweeping["prior-normals"][0].text
    assert "prior-normals" not in matching
    ones, normal = np.ones((3, 4), np.float32), np.zeros((3, 3, 4), np.float32)
    names = [path.name for path in sorted((farm / "images").iterdir())]
    for at, name in enumerate(names):
        write_map(farm, name, ones, ones, normal if at < 5 else None)
    (lacking,) = told(farm, wanting)["prior-normals"]
    assert lacking.level == "warning" and "10 of 14 depth priors have no normals" in lacking.text
    assert "loss normal-prior" in lacking.text and f"`surfkit prepare depth {farm} --again`" in lacking.text
    assert told(farm, "citygs2-coarse", quick=True) == {}, "its loss looks at depth alone"
    assert "constant: view_0" in told(farm, "citygs2-coarse")["depth-maps"][0].text, "as training says of their numbers"
    for name in names:
        write_map(farm, name, ones, ones, normal)
    assert told(farm, wanting, quick=True) == {}


def test_cameras_in_one_place(farm):
    def change(rows):
        same = rows[0].split(" ")[1:-1]
        return [" ".join([row.split(" ")[0], *same, row.split(" ")[-1]]) if row else row for row in rows]

    lines(farm / IMAGES, change)
    found = told(farm)
    assert len(found["equal-poses"][0].names) == 14


def test_no_folder_and_a_wrong_layout(tmp_path, farm):
    assert "no such folder" in told(tmp_path / "none")["data-set"][0].text
    assert "no Reader named" in told(farm, layout="nonsense")["data-set"][0].text
    (tmp_path / "empty").mkdir()
    assert "the folder is empty" in told(tmp_path / "empty")["data-set"][0].text
    assert "holds out all 16 photographs" in told(farm, test_every=1)["data-set"][0].text


def test_distorted_photographs_are_not_undistorted_yet(farm):
    lens("1 SIMPLE_RADIAL 64 48 55 32 24 -0.05")(farm)
    before = tree(farm)
    examined = examine(Data(farm, scale=2), recipes()["2dgs"])
    assert tree(farm) == before
    assert any(text.startswith("undistort 16 photographs, once, into") for text in examined.diagnosis.will)
    assert "reduce photographs of 64 x 48 px to 32 x 24" in examined.diagnosis.will
    assert replace(examined.diagnosis, findings=()).sound


ODD = {
    "a-pose-beyond-all-numbers": pose(3, lambda v: [*v[:4], 1e300, *v[5:]]),
    "all-poses-beyond-all-numbers": lambda f: [pose(at, lambda v: [*v[:4], 1e300, *v[5:]])(f) for at in range(16)],
    "far-points": moved_points((3e37, 0, 0), 0.5),
    "points-in-one-place": lambda f: lines(
        f / POINTS, lambda rows: [f"{i} 1 1 1 9 9 9 0" for i, _ in enumerate(rows, 1)]
    ),
    "one-point": lambda f: lines(f / POINTS, lambda rows: rows[:1]),
    "one-photograph": lambda f: lines(f / IMAGES, lambda rows: rows[:2]),
    "a-panorama": lens("1 EQUIRECTANGULAR 64 48"),
    "a-fisheye": lens("1 OPENCV_FISHEYE 64 48 30 30 32 24 9 9 9 9"),
    "no-size": lens("1 PINHOLE 0 0 50 50 32 24"),
    "wild-distortion": lens("1 FULL_OPENCV 64 48 50 50 32 24 1e9 -1e9 3 4 5 6 7 8"),
    "a-folder-for-a-photograph": lambda f: [gone("view_003.png")(f), (f / "images/view_003.png").mkdir()],
    "text-for-a-photograph": lambda f: (f / "images/view_003.png").write_text("nothing"),
    "no-photographs": lambda f: [path.unlink() for path in (f / "images").iterdir()],
}


@pytest.mark.parametrize("oddity", ODD)
def test_nothing_odd_is_too_much(farm, oddity):
    ODD[oddity](farm)
    told(farm)
    told(farm, quick=True, test_every=0)


def test_every_shot_of_an_odm_project_is_looked_at(farm):
    shutil.rmtree(farm / "sparse")
    shots = {
        path.name: {"rotation": [np.pi, 0, 0], "translation": [at, at % 4, 9], "camera": "c"}
        for at, path in enumerate(sorted((farm / "images").iterdir()))
    }
    shots["view_003.png"]["rotation"][1] = shots["view_004.png"]["translation"][0] = float("nan")
    gone("view_001.png")(farm)
    cut("view_002.png")(farm)
    camera = {"projection_type": "brown", "width": 64, "height": 48, "focal_x": 0.9, "focal_y": 0.9}
    model = [{"cameras": {"c": camera}, "shots": shots, "points": {}}]
    (farm / "reconstruction.json").write_text(json.dumps(model))
    found = told(farm)
    texts = [finding.text for finding in found["data-set"]]
    assert any("1 of 16 photographs are missing: 'view_001.png'" in text for text in texts)
    assert any("'view_003.png' is not finite" in text and "more like it: view_004.png" in text for text in texts)
    assert found["damaged-photographs"][0].names == ("view_002.png",)


def test_photographs_without_a_model_are_counted_and_named_with_their_folders(farm):
    """As drones write them: numbered from 1 in each folder, beside other files."""
    shutil.rmtree(farm / "sparse")
    for folder, at in (("100MEDIA", 3), ("101MEDIA", 4)):
        (farm / folder).mkdir()
        shutil.copy(farm / f"images/view_00{at}.png", farm / folder / "DJI_0001.png")
    shutil.rmtree(farm / "images")
    (farm / "101MEDIA/DJI_0002.JPG").write_bytes(b"")
    (farm / "101MEDIA/._DJI_0001.JPG").write_bytes(b"of macOS")
    found = examine(Data(farm), recipes()["2dgs"]).diagnosis
    assert found.found["photographs"].startswith("3, none with a pose")
    (damaged,) = [one for one in found.findings if one.what == "damaged-photographs"]
    assert damaged.names == ("101MEDIA/DJI_0002.JPG",) and damaged.text.endswith("again, or leave them out")


def test_masks_beside_photographs_are_no_unused_pictures(farm):
    moved = Path(shutil.move(farm, farm.parent / "masks"))
    for name in ("view_003_mask.png", "view_004.mask.png"):
        paint(f"images/{name}", np.full((48, 64), 255, np.uint8))(moved)
    assert told(moved) == {}
    paint("images/more.png", np.zeros((9, 9), np.uint8))(moved)
    assert told(moved)["unused-pictures"][0].names == ("images/more.png",)


def test_light_that_differs_is_told_with_figures(tmp_path):
    folder = tmp_path / "tracked"
    write_colmap(folder, photograph(FLIGHT), tracks=True)
    assert "exposure" not in told(folder)
    brightened(folder)
    (light,) = told(folder)["exposure"]
    assert light.level == "warning" and "add pretrain.appearance:camera-response" in light.text
    stops = re.search(r"exposures differ by (\d.\d) stops and white balance by", light.text)
    assert 1.7 <= float(stops[1]) <= 2.1, "as they were made darker"
    darkest = re.search("'view_(\\d+).png' is the darkest", light.text)
    assert int(darkest[1]) % 2 == 0, "every other one, from the first on"
    assert "exposure" not in told(folder, quick=True)


def test_light_of_many_photographs_is_compared_where_some_of_them_are(tmp_path, monkeypatch):
    """Points drawn from the whole scene are too few in each photograph to tell."""
    folder = tmp_path / "tracked"
    write_colmap(folder, photograph(FLIGHT), tracks=True)
    brightened(folder)
    monkeypatch.setattr(examine_module, "sampled", lambda shots, *_: shots[4:10])
    monkeypatch.setattr(geometry, "COMPARED_POINTS", 40)
    (light,) = told(folder)["exposure"]
    named = re.findall(r"'view_(\d+).png'", light.text)
    assert all(4 <= int(at) < 10 for at in named) and " the brightest of 6 that were compared" in light.text
