"""Masks are found by the names that other programs give them, and are turned into pixels that count."""

import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from surfkit.core.check import BadInput
from surfkit.readers.data import Data
from surfkit.readers.masks import mask_cache, read_mask, view_mask
from surfkit.readers.read import read
from surfkit.run.notes import collect_notes
from surfkit.scene.photos import view_photo
from surfkit.testing.synthetic import Flight, photograph, write_colmap


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    folder = tmp_path_factory.mktemp("made") / "farm"
    write_colmap(folder, photograph(Flight(views=4, width=40, height=30, points=60)))
    return folder


@pytest.fixture
def farm(made, tmp_path):
    return Path(shutil.copytree(made, tmp_path / "farm"))


def left_black(size=(40, 30)):
    pixels = np.full((size[1], size[0]), 255, np.uint8)
    pixels[:, : size[0] // 4] = 0
    return pixels


def put(path, pixels=None):
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(left_black() if pixels is None else pixels).save(path)


def scene_of(farm, **settings):
    with collect_notes() as kept:
        notes = kept.texts
        return read(Data(farm, test_every=0, **settings)), notes


@pytest.mark.parametrize(
    "place",
    [
        "masks/view_001.png.png",
        "masks/view_001.png",
        "masks/VIEW_001.jpg",
        "masks/left/view_001.mask.png",
        "masks/view_001_mask.png",
        "below/masks/view_001.png",
        "images/view_001_mask.png",
        "images/view_001.mask.png",
        "images/view_001.png.mask.png",
    ],
)
def test_the_habits_of_other_programs(farm, place):
    put(farm / place)
    scene, notes = scene_of(farm)
    assert [view.mask for view in scene.train] == [None, farm / place, None, None]
    assert notes == ["what is black in their masks is ignored in 1 of 4 photographs"]
    wanted = torch.from_numpy(left_black() > 0)
    assert (view_mask(scene.train[1]) == wanted).float().mean() > 0.95
    found = mask_cache(scene.train)
    assert found[0] is None and found[1].shape == (30, 40)


def test_photographs_in_folders_have_masks_in_the_same_folders(farm):
    for side in ("left", "right"):
        (farm / "images" / side).mkdir()
    for number, side in enumerate(("left", "right", "left", "right")):
        name = f"view_00{number}.png"
        (farm / "images" / name).rename(farm / "images" / side / f"{number // 2}.png")
        text = (farm / "sparse/0/images.txt").read_text().replace(f" {name}", f" {side}/{number // 2}.png")
        (farm / "sparse/0/images.txt").write_text(text)
    put(farm / "masks/left/0.png")
    put(farm / "masks/right/0.png", 255 - left_black())
    scene, _ = scene_of(farm)
    masks = {view.name: view.mask and view.mask.relative_to(farm / "masks").as_posix() for view in scene.train}
    assert masks == {"left/0.png": "left/0.png", "left/1.png": None, "right/0.png": "right/0.png", "right/1.png": None}


def test_a_folder_by_name(farm):
    put(farm / "people/view_002.png")
    assert scene_of(farm)[0].train[2].mask is None
    assert scene_of(farm, masks=Path("people"))[0].train[2].mask == farm / "people/view_002.png"
    with pytest.raises(BadInput, match="--masks .*none: no such folder of masks"):
        scene_of(farm, masks=Path("none"))


def test_masks_that_fit_no_photograph_are_noticed(farm):
    put(farm / "masks/IMG_1.png")
    _, notes = scene_of(farm)
    assert len(notes) == 1 and "none of the 1 masks has the name of a photograph" in notes[0]


def test_a_mask_of_another_shape_or_a_damaged_one_is_named(farm):
    put(farm / "masks/view_001.png", left_black((40, 20)))
    with pytest.raises(BadInput, match="view_001.png: 40 x 20 px is not the shape of its photograph"):
        scene_of(farm)
    (farm / "masks/view_001.png").write_bytes(b"<html>")
    with pytest.raises(BadInput, match="masks/view_001.png: not a whole picture"):
        scene_of(farm)


@pytest.mark.parametrize("mode", ["L", "1", "RGB", "RGBA", "P"])
def test_every_kind_of_picture(tmp_path, mode):
    Image.fromarray(left_black()).convert(mode).save(tmp_path / "mask.png")
    assert torch.equal(read_mask(tmp_path / "mask.png", (40, 30)), torch.from_numpy(left_black() > 0))


def test_masks_of_zero_and_one_and_of_sixteen_bits(tmp_path):
    for name, pixels in {"one": left_black() // 255, "wide": left_black().astype(np.uint16) * 257}.items():
        Image.fromarray(pixels).save(tmp_path / f"{name}.png")
        assert torch.equal(read_mask(tmp_path / f"{name}.png", (40, 30)), torch.from_numpy(left_black() > 0))
    Image.fromarray(np.zeros((30, 40), np.uint8)).save(tmp_path / "none.png")
    assert not read_mask(tmp_path / "none.png", (40, 30)).any()


def test_a_mask_of_another_size_keeps_its_edges(tmp_path):
    put(tmp_path / "mask.png", left_black((400, 300)))
    assert torch.equal(read_mask(tmp_path / "mask.png", (40, 30)), torch.from_numpy(left_black() > 0))


def test_masks_are_undistorted_with_their_photographs(farm):
    (farm / "sparse/0/cameras.txt").write_text("1 OPENCV 40 30 36 36 20 15 -0.1 0 0 0\n")
    for path in (farm / "images").iterdir():
        Image.fromarray(np.where(left_black() > 0, 200, 20).astype(np.uint8)).save(path)
        put(farm / "masks" / path.name)
    for view in scene_of(farm)[0].train:
        bright = view_photo(view)[0] > 110
        assert view.mask.parent == farm / "undistorted" and (view_mask(view) == bright).float().mean() > 0.98
