"""Masks are found by the names that other programs give them, and are turned into pixels that count."""

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from surfkit.core.check import BadInput
from surfkit.io.datasets import masks
from surfkit.io.datasets.data import Data
from surfkit.io.datasets.fingerprint import changed, fingerprint
from surfkit.io.datasets.masks import mask_cache, read_mask, view_mask
from surfkit.io.datasets.read import build_scene, read, read_capture, reader_of
from surfkit.runs.run_notes import collect_notes
from surfkit.scene.photos import view_photo
from surfkit.scene.scene import Mask, Scene, SparsePoints
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
        "images/view_001_MASK.JPG",
        "images/VIEW_001.PNG_mask.tif",
    ],
)
def test_the_habits_of_other_programs(farm, place):
    put(farm / place)
    scene, notes = scene_of(farm)
    assert [view.mask for view in scene.train] == [None, Mask(farm / place), None, None]
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
    masks = {view.name: view.mask and view.mask.path.relative_to(farm / "masks").as_posix() for view in scene.train}
    assert masks == {"left/0.png": "left/0.png", "left/1.png": None, "right/0.png": "right/0.png", "right/1.png": None}


def test_a_folder_by_name(farm):
    put(farm / "people/view_002.png")
    assert scene_of(farm)[0].train[2].mask is None
    assert scene_of(farm, masks=Path("people"))[0].train[2].mask == Mask(farm / "people/view_002.png")
    with pytest.raises(BadInput, match="--masks .*none: no such"):
        scene_of(farm, masks=Path("none"))


def test_masks_that_fit_no_photograph_are_noticed(farm):
    put(farm / "masks/IMG_1.png")
    _, notes = scene_of(farm)
    assert len(notes) == 1 and "none of the 1 masks has the name of a photograph" in notes[0]


def test_a_mask_of_another_shape_or_a_damaged_one_is_named(farm):
    put(farm / "masks/view_001.png", left_black((40, 20)))
    with pytest.raises(BadInput, match=r"view_001\.png: 40 x 20 px"):
        scene_of(farm)
    (farm / "masks/view_001.png").write_bytes(b"<html>")
    with pytest.raises(BadInput, match="masks/view_001.png: not a whole"):
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


@pytest.mark.parametrize("mode", ["RGB", "P", "RGBA"])
def test_the_brightest_channel_counts_however_colours_are_stored(tmp_path, mode):
    stripes = np.array([(0, 0, 0), (200, 0, 0), (0, 200, 0), (0, 0, 200), (90, 90, 90)], np.uint8)
    picture = Image.fromarray(np.tile(np.repeat(stripes, 8, 0), (30, 1, 1))).convert("RGB")
    (picture.quantize(8) if mode == "P" else picture.convert(mode)).save(tmp_path / "mask.png")
    kept = read_mask(tmp_path / "mask.png", (40, 30))[0].reshape(5, 8)
    assert kept.all(1).tolist() == [False, True, True, True, False] and kept.any(1).tolist() == kept.all(1).tolist()


@pytest.mark.parametrize(("low", "high", "kind"), [(0, 2, np.uint8), (100, 120, np.uint8), (0, 1000, np.uint16)])
def test_of_two_values_the_higher_one_is_kept(tmp_path, low, high, kind):
    Image.fromarray(np.where(left_black() > 0, high, low).astype(kind)).save(tmp_path / "mask.png")
    kept = torch.from_numpy(left_black() > 0)
    assert torch.equal(read_mask(tmp_path / "mask.png", (40, 30)), kept)
    assert torch.equal(read_mask(tmp_path / "mask.png", (20, 15)), kept[1::2, 1::2])


def test_labels_are_told_once_for_a_folder(tmp_path):
    labels = np.repeat(np.array([[0, 1, 2, 255]], np.uint8), 30, 0).repeat(10, 1)
    soft = np.tile(np.arange(256).astype(np.uint8), (30, 1))
    for name, pixels in {"a": labels, "b": labels, "soft/c": soft, "two/d": left_black()}.items():
        path = tmp_path / f"{name}.png"
        path.parent.mkdir(exist_ok=True)
        Image.fromarray(pixels).save(path)
        with collect_notes() as notes:
            read_mask(path, (40, 30))
        assert [text.startswith(f"{path}: the mask has more values") for text in notes.texts] == [True] * (name == "a")


@pytest.mark.parametrize(("value", "kept"), [(0, False), (1, True), (2, False), (100, False), (255, True)])
def test_a_mask_of_one_value(tmp_path, value, kept):
    Image.fromarray(np.full((30, 40), value, np.uint8)).save(tmp_path / "mask.png")
    found = read_mask(tmp_path / "mask.png", (40, 30))
    assert found.all() if kept else not found.any()


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
        assert view.mask.path.parent == farm / "undistorted" and (view_mask(view) == bright).float().mean() > 0.98


def cut_out(kept, colour=0):
    """A mask of one colour, opaque where something is kept."""
    return np.dstack([np.full((*kept.shape, 3), colour, np.uint8), np.where(kept, 255, 0).astype(np.uint8)])


def sides():
    """What four masks keep: all of it, all of it, a half, and three quarters."""
    kept = np.ones((4, 30, 40), bool)
    kept[2, :, :20], kept[3, :10], kept[3, 10:15, :20] = False, False, False
    return kept


@pytest.mark.parametrize("bent", [False, True])
def test_alpha_channels_count_in_all_masks_of_a_set_if_one_has_transparent_pixels(farm, bent):
    """Of an opaque cut-out the alpha channel counts too; a mask without one goes by its colours."""
    if bent:
        (farm / "sparse/0/cameras.txt").write_text("1 OPENCV 40 30 36 36 20 15 -0.001 0 0 0\n")
    for number, kept in enumerate(sides()):
        put(farm / f"masks/view_00{number}.png", cut_out(kept) if number else left_black())
    scene, notes = scene_of(farm)
    shares = [view_mask(view).float().mean().item() for view in scene.train]
    assert shares == pytest.approx([0.75, 1.0, 0.5, 7 / 12], abs=0.06 if bent else 1e-6)
    assert [view.mask.alpha for view in scene.train] == [False, not bent, not bent, not bent]
    assert notes == [
        "what is black in their masks is ignored in 1 of 4 photographs",
        "what is transparent in their masks is ignored in 3 of 4 photographs: these masks have an alpha channel, "
        f"{farm / 'masks/view_002.png'} has transparent pixels, and colours do not count in any of them",
    ]
    only = build_scene(Data(farm, test_every=0), read_capture(Data(farm), reader_of(Data(farm))), only={"view_001.png"})
    assert view_mask(only.train[0]).float().mean() == pytest.approx(1.0, abs=0.06 * bent)


def test_alpha_channels_without_transparent_pixels_say_nothing(farm):
    for number in range(4):
        put(farm / f"masks/view_00{number}.png", np.dstack([left_black()] * 3 + [np.full((30, 40), 255, np.uint8)]))
    scene, notes = scene_of(farm)
    assert [view_mask(view).float().mean().item() for view in scene.train] == [0.75] * 4
    assert not any("alpha" in note for note in notes)


def test_few_masks_are_decoded_to_decide(farm, monkeypatch):
    """Those without an alpha channel never, those with one up to the first that has transparent pixels."""
    decoded = []
    plain = masks.open_picture
    monkeypatch.setattr(masks, "open_picture", lambda path, use: decoded.append(path.name) or plain(path, use))
    monkeypatch.setattr(masks, "READER_THREADS", 1)
    for number, kept in enumerate(sides()):
        put(farm / f"masks/view_00{number}.png", cut_out(kept) if number else left_black())
    found = read(Data(farm, test_every=0))
    assert decoded == ["view_001.png", "view_002.png"]
    read(Data(farm, test_every=0))
    assert decoded == ["view_001.png", "view_002.png"], "a command that reads its data set again does not decode again"
    assert found.train[3].mask.alpha


def test_an_undistorted_mask_is_made_again_when_its_alpha_channel_counts(farm):
    (farm / "sparse/0/cameras.txt").write_text("1 OPENCV 40 30 36 36 20 15 -0.001 0 0 0\n")
    for number in range(4):
        put(farm / f"masks/view_00{number}.png", cut_out(np.ones((30, 40), bool), 255 * (number != 1)))
    before = scene_of(farm)[0].train[1]
    assert not view_mask(before).any()
    put(farm / "masks/view_003.png", cut_out(sides()[2], 255))
    after = scene_of(farm)[0].train[1]
    assert view_mask(after).float().mean() > 0.9
    (change,) = changed(fingerprint(scene_with(before)), fingerprint(scene_with(after)))
    assert change.what == "the mask of view_001.png has changed, come or gone"


def scene_with(view):
    return Scene("one", (view,), (), SparsePoints(torch.zeros(1, 3), torch.zeros(1, 3, dtype=torch.uint8)), None)


def test_a_fingerprint_knows_whether_alpha_or_colours_count(farm):
    put(farm / "masks/view_001.png", cut_out(sides()[2]))
    view = scene_of(farm)[0].train[1]
    now, other = (
        fingerprint(scene_with(replace(view, mask=replace(view.mask, alpha=alpha)))) for alpha in (True, False)
    )
    assert not changed(now, now)
    assert [change.name for change in changed(now, other)] == ["view_001.png"]
    stamp = replace(now.photographs["view_001.png"].beside["mask"], meaning="")
    older = replace(now, photographs={"view_001.png": replace(now.photographs["view_001.png"], beside={"mask": stamp})})
    assert not changed(older, now), "older runs did not keep it"


def test_masks_that_keep_nothing_are_told_once_when_all_have_been_read(farm):
    for number in range(4):
        put(farm / f"masks/view_00{number}.png", np.full((30, 40), 255 * (number in (1, 2)), np.uint8))
    scene, notes = scene_of(farm)
    assert not any("nothing" in note for note in notes)
    with collect_notes() as kept:
        for _ in range(2):
            found = mask_cache(scene.train, 0)
            for at in (3, 3, 0, 2, 1):
                found[at]
    assert kept.texts == [
        "2 masks keep nothing of the photograph, 'view_000.png', 'view_003.png'; correct or delete them"
    ]
