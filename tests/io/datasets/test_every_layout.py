"""Every layout of data sets trains from the command line, and ends where the same scene in another layout does."""

import json
import shutil
import struct
import zlib

import numpy as np
import pytest
from data_set_folders import FLIGHT, blender, city, nerfstudio, odm, save, surveyed, views_of, with_tests_apart
from PIL import Image

from surfkit.cli import main
from surfkit.io.datasets.raw_dataset import load_pycolmap
from surfkit.io.splats.ply import read_splats
from surfkit.testing.synthetic import Flight, look, photograph, write_colmap

EVERY = ("--test-every", "3")


def colmap(folder, truth, binary=False):
    write_colmap(folder, truth, binary, tracks=True)
    return folder


def rigged(folder, truth):
    """A rig of two cameras that takes all the photographs in three frames, as the orbit is symmetric."""
    pycolmap = load_pycolmap()
    if not hasattr(pycolmap, "Rig"):
        pytest.skip("this pycolmap knows no rigs")
    source = pycolmap.Reconstruction(str(colmap(folder, truth) / "sparse/0"))
    poses = {number: image.cam_from_world() for number, image in source.images.items()}
    model, rig, mount = pycolmap.Reconstruction(), pycolmap.Rig(rig_id=1), poses[2] * poses[1].inverse()
    sensors = [pycolmap.sensor_t(pycolmap.SensorType.CAMERA, number) for number in (1, 2)]
    rig.add_ref_sensor(sensors[0])
    rig.add_sensor(sensors[1], mount)
    for number in (1, 2):
        lens = source.cameras[1]
        model.add_camera(pycolmap.Camera(model="PINHOLE", width=40, height=30, params=lens.params, camera_id=number))
    model.add_rig(rig)
    for at, number in enumerate((1, 3, 5), 1):
        frame = pycolmap.Frame(frame_id=at, rig_id=1, rig_from_world=poses[number])
        for sensor, image in zip(sensors, (number, number + 1), strict=True):
            frame.add_data_id(pycolmap.data_t(sensor, image))
        model.add_frame(frame)
        for camera, image in ((1, number), (2, number + 1)):
            name = source.images[image].name
            model.add_image(pycolmap.Image(name=name, image_id=image, camera_id=camera, frame_id=at))
        model.register_frame(at)
    for _, point in sorted(source.points3D.items()):
        model.add_point3D(point.xyz, pycolmap.Track(), point.color)
    shutil.rmtree(folder / "sparse/0")
    (folder / "sparse/0").mkdir()
    model.write_binary(str(folder / "sparse/0"))
    assert {path.name for path in (folder / "sparse/0").iterdir()} >= {"rigs.bin", "frames.bin"}
    return folder


def several(folder, truth):
    """Two models, the second of which is whole."""
    colmap(folder, truth)
    (folder / "sparse/0").rename(folder / "sparse/1")
    write_colmap(folder, photograph(FLIGHT))
    lines = (folder / "sparse/0/images.txt").read_text().splitlines(keepends=True)
    (folder / "sparse/0/images.txt").write_text("".join(lines[:4]))
    return folder


def otherwise_spelt(folder, truth):
    """Nested, in capitals, with another ending, and turned by EXIF."""
    images, turn = colmap(folder, truth) / "images", Image.Exif()
    turn[0x0112] = 6
    (images / "left").mkdir()
    (images / "view_002.png").rename(images / "left/view_002.png")
    (images / "view_001.png").rename(images / "VIEW_001.PNG")
    Image.open(images / "view_003.png").save(images / "view_003.tif", exif=turn)
    (images / "view_003.png").unlink()
    return folder


def bent(model, params):
    """With a lens that bends, and photographs through it."""

    def build(folder, truth):
        colmap(folder, truth)
        (folder / "sparse/0/cameras.txt").write_text(f"1 {model} 40 30 {params}\n")
        lens = load_pycolmap().Camera(model=model, width=40, height=30, params=[float(word) for word in params.split()])
        return through(folder, truth, lens)

    return build


def through(folder, truth, lens):
    """Photographs through a pycolmap camera, exact to half a value of 255."""
    size = (lens.height, lens.width)
    pixels = np.stack(np.meshgrid(np.arange(size[1]) + 0.5, np.arange(size[0]) + 0.5), -1).reshape(-1, 2)
    rays = np.concatenate([lens.cam_from_img(pixels), np.ones((len(pixels), 1))], 1)
    for view in views_of(truth):
        _, color = look(FLIGHT, truth.scene.frame.input_pose(view.camera.world_to_camera), rays)
        save(folder / "images" / view.name, (color.reshape(*size, 3) * 255).round().astype(np.uint8))
    return folder


def bent_nerfstudio(folder, truth):
    lens = {"fl_x": 36, "fl_y": 36.4, "cx": 21.2, "cy": 14.4, "k1": -0.08, "k2": 0.02, "p1": 0.001, "p2": -0.002}
    folder.mkdir()
    nerfstudio(folder, truth, lambda contents: contents.update(lens))
    return through(
        folder, truth, load_pycolmap().Camera(model="OPENCV", width=40, height=30, params=list(lens.values()))
    )


def reduced(by):
    """With photographs of twice the size, and a folder of those of this size."""

    def build(folder, truth):
        colmap(folder, truth).joinpath("images").rename(folder / f"images_{by:g}")
        size = (round(40 * by), round(30 * by))
        for path in (folder / f"images_{by:g}").iterdir():
            save(folder / "images" / path.name, np.zeros((size[1], size[0], 3), np.uint8))  # must not be looked at
        return folder

    return build


def masked(habit):
    """With every photograph masked where it is spoilt."""

    def build(folder, truth):
        for path in (colmap(folder, truth) / "images").iterdir():
            pixels, keep = np.array(Image.open(path)), np.full((30, 40), 255, np.uint8)
            pixels[10:20, 10:20], keep[10:20, 10:20] = (255, 0, 255), 0
            save(path, pixels)
            place = habit.format(name=path.name, stem=path.stem)
            save(folder / place, keep)
        return folder

    return build


def of_sixteen_bits(folder, truth):
    """PNG files of 16 bits a channel, half of them with alpha; Pillow cannot write them."""
    for at, path in enumerate(sorted((colmap(folder, truth) / "images").iterdir())):
        wide = np.array(Image.open(path)).astype(">u2") * 257
        if at % 2:
            wide = np.concatenate([wide, np.full((30, 40, 1), 65535, ">u2")], 2).astype(">u2")
        rows = b"".join(b"\0" + row.tobytes() for row in wide)
        parts = {
            b"IHDR": struct.pack(">IIBBBBB", 40, 30, 16, 6 if at % 2 else 2, 0, 0, 0),
            b"IDAT": zlib.compress(rows),
        }
        chunks = [
            struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))
            for kind, body in (parts | {b"IEND": b""}).items()
        ]
        path.write_bytes(b"\x89PNG\r\n\x1a\n" + b"".join(chunks))
    return folder


def plain_odm(folder, truth):
    folder.mkdir()
    return odm(folder, truth)


def odm_on_the_map(folder, truth):
    plain_odm(folder, truth)
    (folder / "opensfm/reconstruction.json").rename(folder / "opensfm/reconstruction.topocentric.json")
    (folder / "opensfm/reference_lla.json").write_text('{"latitude": 47.5, "longitude": 8.9, "altitude": 430.0}')
    save(folder / "odm_georeferencing/preview.png", np.zeros((2, 2), np.uint8))
    (folder / "odm_georeferencing/coords.txt").write_text("WGS84 UTM 32N\n492000 5260000\n")
    return folder


def plain_nerfstudio(folder, truth):
    folder.mkdir()
    return nerfstudio(folder, truth)


def survey(folder, truth):
    return surveyed(folder, np.array([432_123.25, 5_412_345.5, 312.0]))


def cities(kind):
    return lambda folder, truth: city(folder, truth, kind)


SAME = {
    "colmap-text": (colmap, EVERY),
    "colmap-binary": (lambda folder, truth: colmap(folder, truth, binary=True), EVERY),
    "colmap-rig": (rigged, EVERY),
    "colmap-several": (several, EVERY),
    "colmap-chosen": (several, (*EVERY, "--model", "sparse/1")),
    "colmap-otherwise-spelt": (otherwise_spelt, EVERY),
    "colmap-opencv": (bent("OPENCV", "36 36.4 21.2 14.4 -0.08 0.02 0.001 -0.002"), EVERY),
    "colmap-fisheye": (bent("OPENCV_FISHEYE", "36 36.4 21.2 14.4 0.05 0.01 0 0"), EVERY),
    "colmap-survey": (survey, (*EVERY, "--metres-per-unit", "1")),
    "images-2": (reduced(2), (*EVERY, "--scale", "2")),
    "images-1.25": (reduced(1.25), (*EVERY, "--scale", "1.25")),
    "masks-name": (masked("masks/{name}.png"), EVERY),
    "masks-stem": (masked("masks/{stem}.png"), EVERY),
    "masks-beside": (masked("images/{stem}_mask.png"), EVERY),
    "sixteen-bits": (of_sixteen_bits, EVERY),
    "nerfstudio": (plain_nerfstudio, EVERY),
    "nerfstudio-opencv": (bent_nerfstudio, EVERY),
    "odm": (plain_odm, EVERY),
    "odm-utm": (odm_on_the_map, EVERY),
    "city-tests-apart": (with_tests_apart, ()),
}
"""Layouts of the same views and sparse points, with what is said at the command line."""
OTHERS = {
    "blender": (blender, ("--white",)),
    "matrixcity-aerial": (cities("aerial"), ("recipe:citygs2-coarse",)),
    "matrixcity-street": (cities("street"), ("recipe:citygs2-coarse",)),
    "matrixcity-beside": (cities("beside"), ("recipe:citygs2-coarse",)),
    "gauu-scene": (colmap, ("--split", "gauu-scene")),
}
"""Layouts that lack the points, or keep other views from training."""


def trained(folder, truth, layout):
    """What `surfkit train` leaves after 100 steps: metrics, run.json, cameras and points in the frame of the input."""
    build, words = (SAME | OTHERS)[layout]
    data, out = build(folder / "data", truth), folder / "run"
    if isinstance(data, tuple):
        data, words = data[0], ("--test-data", str(data[1]))
    recipe = () if any(word.startswith("recipe:") for word in words) else ("recipe:2dgs",)
    # Points that multiply in so short a run are thrown far by splats that are still large.
    small = ("pretrain.densify:none", "--steps", "100", "--primitive.sh-degree", "0", "--pictures-every", "0")
    assert main(["train", *recipe, *words, "--data", str(data), "--out", str(out), *small]) == 0
    record, cameras = (json.loads((out / f"{name}.json").read_text()) for name in ("run", "cameras"))
    metrics = json.loads((out / "metrics.json").read_text())
    assert metrics["steps"] == 100
    return metrics["images"]["psnr"], record, cameras, read_splats(out / "point_cloud.ply").means.double().numpy()


@pytest.fixture(scope="module")
def truth():
    return photograph(FLIGHT)


@pytest.fixture(scope="module")
def usual(truth, tmp_path_factory):
    return trained(tmp_path_factory.mktemp("usual"), truth, "colmap-text")[0]


@pytest.mark.parametrize("layout", SAME)
def test_the_same_scene_ends_alike(tmp_path, truth, usual, layout):
    psnr, record, cameras, points = trained(tmp_path, truth, layout)
    other_pixels = layout.startswith("masks") or layout.endswith(("opencv", "fisheye"))
    assert psnr == pytest.approx(usual, abs=0.2 if other_pixels else 0.02)
    frame = record["frame"]
    assert sum(camera["held_out"] for camera in cameras) == 2 and len(cameras) == 6
    centres = np.array([camera["position"] for camera in cameras]) + frame["offset"]
    mean = centres[[not camera["held_out"] for camera in cameras]].mean(0)
    np.testing.assert_allclose(mean, frame["origin"], atol=1e-6)
    assert np.linalg.norm(points - frame["origin"], axis=1).max() < 3 / frame["scale"], "points in the frame of cameras"
    said = {"colmap-survey": (1, None), "odm-utm": (1, "EPSG:32632")}.get(layout, (None, None))
    assert (frame["metres_per_unit"], frame["crs"]) == said and any(frame["offset"]) == (said[0] is not None)


@pytest.mark.parametrize("layout", OTHERS)
def test_others_train_too(tmp_path, truth, layout):
    psnr, record, cameras, _ = trained(tmp_path, truth, layout)
    assert psnr > (15 if layout != "blender" else 11) and len(cameras) == 6
    assert sum(camera["held_out"] for camera in cameras) == (1 if layout == "gauu-scene" else 2)
    assert record["frame"]["metres_per_unit"] == (1 if layout.startswith("matrixcity") else None)


def test_a_distorted_copy_of_a_scene_is_as_good(tmp_path):
    """The same flight through a lens that bends, and through the pinhole camera that undistorting makes of it."""
    flight = Flight(views=8, width=96, height=72, points=2000, test_every=4)
    truth, pycolmap = photograph(flight), load_pycolmap()
    bent = pycolmap.Camera(model="OPENCV", width=96, height=72, params=[86, 87, 50, 35, -0.25, 0.05, 0.01, -0.02])
    straight = pycolmap.undistort_camera(pycolmap.UndistortCameraOptions(), bent)
    scores = []
    for lens in (bent, straight):
        folder = tmp_path / lens.model.name
        write_colmap(folder, truth)
        words = " ".join(repr(float(value)) for value in lens.params)
        line = f"1 {lens.model.name} {lens.width} {lens.height} {words}\n"
        (folder / "sparse/0/cameras.txt").write_text(line)
        through(folder, truth, lens)
        words = ("--data", str(folder), "--out", str(folder / "run"), "--steps", "600", "--test-every", "4")
        assert (
            main(["train", "recipe:2dgs", "mesh:none", "pretrain.densify:none", *words, "--pictures-every", "0"]) == 0
        )
        scores.append(json.loads((folder / "run/metrics.json").read_text())["images"]["psnr"])
    assert scores[0] == pytest.approx(scores[1], abs=0.2) and min(scores) > 22, scores
