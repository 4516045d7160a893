"""What the values of a data set's photographs mean is decided for all of them alike, told, and used everywhere."""

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from surfkit.core.check import BadInput
from surfkit.core.codec import dump, load
from surfkit.io.datasets import extract
from surfkit.io.datasets import pixel_interpretation as pixels
from surfkit.io.datasets.data import Data
from surfkit.io.datasets.masks import read_mask, view_mask
from surfkit.io.datasets.pixel_interpretation import decide
from surfkit.io.datasets.read import read
from surfkit.runs.run_notes import collect_notes
from surfkit.scene.decoded_photos import DecodedPhotoCache
from surfkit.scene.photos import photo_cache, view_photo
from surfkit.scene.pixels import DEFAULT_PIXELS, Pixels
from surfkit.scene.scene import Mask
from surfkit.testing.synthetic import Flight, photograph, write_colmap
from tests.scene.test_pixels import geotiff, opencv


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    folder = tmp_path_factory.mktemp("made") / "farm"
    write_colmap(folder, photograph(Flight(views=4, width=40, height=30, points=60)))
    return folder


@pytest.fixture
def farm(made, tmp_path):
    return Path(shutil.copytree(made, tmp_path / "farm"))


def photos_of(farm):
    return sorted((farm / "images").iterdir())


def rewrite(farm, change):
    """Write each photograph anew, as `change` makes it of its number and its pixels."""
    for number, path in enumerate(photos_of(farm)):
        Image.fromarray(change(number, np.asarray(Image.open(path).convert("RGB")))).save(path)


def scene_of(farm, **settings):
    with collect_notes() as kept:
        return read(Data(farm, test_every=0, **settings)), kept.texts


def left_clear(number, rgb):
    alpha = np.full(rgb.shape[:2], 255, np.uint8)
    alpha[:, :10] = 0
    return np.dstack([rgb, alpha])


def distort(farm):
    """A lens of strong distortion."""
    path = farm / "sparse/0/cameras.txt"
    words = path.read_text().split()
    focal, x, y = words[-4], words[-2], words[-1]
    path.write_text(f"1 SIMPLE_RADIAL 40 30 {focal} {x} {y} -0.2\n")


def test_exposures_stay_comparable(farm):
    """The darker half of the photographs holds 10 bits, the brighter one 12: white is that of 12 for all."""
    true = [np.asarray(Image.open(path).convert("L")) for path in photos_of(farm)]
    rewrite(farm, lambda number, rgb: np.asarray(true[number]).astype(np.uint16) * (16 if number % 2 else 4))
    scene, notes = scene_of(farm)
    assert [view.pixels for view in scene.train] == [Pixels(4095)] * 4
    (line,) = [line for line in notes if "bits" in line]
    assert "4 photographs of 16 bits" in line and "12 bits: 4,095 is taken for white" in line
    for number, view in enumerate(scene.train):
        wanted = true[number] * (1.0 if number % 2 else 0.25)
        assert np.abs(view_photo(view)[0].numpy() - wanted).max() <= 1.5
    cached = photo_cache(scene.train, 0, DecodedPhotoCache(farm))
    assert torch.equal(cached[1], view_photo(scene.train[1]))


def test_a_part_of_the_photographs_is_read_as_all_are(farm):
    from surfkit.io.datasets.read import build_scene, read_capture, reader_of

    rewrite(farm, lambda number, rgb: rgb[..., 1].astype(np.uint16) * (16 if number == 3 else 1))
    data = Data(farm, test_every=0)
    names = [path.name for path in photos_of(farm)]
    part = build_scene(data, read_capture(data, reader_of(data)), only={names[0]})
    assert [view.pixels for view in part.train] == [Pixels(4095)]


def test_sixteen_bits_and_eight_bits_stay_as_they_were(farm):
    rewrite(farm, lambda number, rgb: rgb[..., 1].astype(np.uint16) * (257 if number == 3 else 16))
    scene, notes = scene_of(farm)
    assert [view.pixels for view in scene.train] == [DEFAULT_PIXELS] * 4 and not [
        line for line in notes if "bits" in line
    ]


def test_a_tag_goes_before_values(tmp_path):
    values = np.full((4, 6), 900, np.uint16)
    for name, tags in {"a.tif": {50717: 2000}, "b.tif": {281: 4095}, "c.tif": {}}.items():
        Image.fromarray(values).save(tmp_path / name, tiffinfo=tags)
    found = decide({name: tmp_path / name for name in ("a.tif", "b.tif", "c.tif")})
    assert found.pixels == {"a.tif": Pixels(2000), "b.tif": Pixels(4095), "c.tif": Pixels(4095)}
    assert len(found.lines) == 2 and "2,000 by a tag in 1 photograph" in found.lines[1]
    assert decide({"c.tif": tmp_path / "c.tif"}).pixels == {"c.tif": Pixels(1023)}


def test_an_infrared_band_is_no_opacity(tmp_path):
    values = np.random.default_rng(0).integers(1, 250, (30, 40, 4)).astype(np.uint8)
    geotiff(tmp_path / "named.tif", values, photometric="RGB", alpha="NO")
    opencv(tmp_path / "unnamed.tif", values)
    geotiff(tmp_path / "called-alpha.tif", values, photometric="RGB", alpha="YES")
    cut = values.copy()
    cut[..., 3] = 255
    cut[:10, :, 3] = 0
    opencv(tmp_path / "cut.tif", cut)
    files = {path.name: path for path in tmp_path.iterdir()}
    found = decide(files)
    modes = {name: way.alpha for name, way in found.pixels.items()}
    wanted = {"named.tif": "blend", "unnamed.tif": "ignore", "called-alpha.tif": "ignore", "cut.tif": "blend"}
    assert modes == wanted
    text = "\n".join(found.lines)
    assert "'named.tif', are no opacity by their tag" in text and "1 of 4 photographs have transparent" in text
    assert "2 photographs" in text and "no opacity by its values" in text
    forced = decide(files, "blend")
    assert {name: way.alpha for name, way in forced.pixels.items()} == dict.fromkeys(files, "blend")


@pytest.mark.parametrize("bent", [False, True])
@pytest.mark.parametrize("alpha", [None, "blend", "mask", "ignore"])
def test_what_becomes_of_transparent_pixels(farm, alpha, bent):
    before = [view_photo(view) for view in scene_of(farm)[0].train]
    rewrite(farm, left_clear)
    if bent:
        distort(farm)
    scene, notes = scene_of(farm, alpha=alpha)
    view = scene.train[0]
    got, mask = view_photo(view), view_mask(view)
    left = got[:, 8:-8, 1:6]
    told = [line for line in notes if "transparent" in line]
    assert len(told) == (alpha in (None, "mask"))
    if alpha is None:
        assert "4 of 4 photographs have transparent pixels" in told[0] and "25.0%" in told[0]
    if alpha in (None, "blend"):
        assert (left == 0).all()
    if alpha == "ignore":
        assert bent or torch.equal(got, before[0])
        assert left.float().mean() > 20
    if alpha == "mask":
        kept = mask.float().mean(0)
        assert (kept[:6] == 0).all() and kept[14:-3].mean() > 0.9
        if not bent:
            assert torch.equal(got[:, mask], before[0][:, mask]) and mask.float().mean() == 0.75
        assert view.mask == Mask(view.path, alpha=True) or bent
    else:
        assert mask is None or bent


def test_colours_of_transparent_pixels_do_not_come_in_when_undistorted(farm):
    def change(number, rgb):
        made = left_clear(number, np.full_like(rgb, 200))
        made[:, :10, :3] = (0, 255, 0)
        return made

    rewrite(farm, change)
    distort(farm)
    scene, _ = scene_of(farm, alpha="mask")
    kept = view_photo(scene.train[0])[:, view_mask(scene.train[0])]
    assert kept.shape[1] > 500 and (kept.int() - 200).abs().max() <= 1


def test_mask_files_go_before_an_opacity(farm):
    rewrite(farm, left_clear)
    mask = np.zeros((30, 40), np.uint8)
    mask[:, 20:] = 255
    name = photos_of(farm)[0].stem
    (farm / "masks").mkdir()
    Image.fromarray(mask).save(farm / f"masks/{name}.png")
    scene, notes = scene_of(farm, alpha="mask")
    assert any("1 photographs have a mask and an opacity" in line for line in notes)
    assert view_mask(scene.train[0]).float().mean() == 0.5 and view_mask(scene.train[1]).float().mean() == 0.75


def test_white_and_alpha_are_one_choice(farm):
    with pytest.raises(BadInput, match="--white .*--alpha mask"):
        Data(farm, white=True, alpha="mask")
    rewrite(farm, left_clear)
    scene, notes = scene_of(farm, white=True)
    assert (view_photo(scene.train[0])[:, :, :9] == 255).all() and not any("transparent" in line for line in notes)
    assert any("--alpha mask: no photograph has an opacity" in line for line in decide({}, "mask").lines)


def test_workers_read_the_same_pixels(farm, tmp_path):
    rewrite(farm, left_clear)
    scene, _ = scene_of(farm, alpha="mask")
    views = tuple(replace(view, pixels=Pixels(4095, "mask")) for view in scene.train)
    extract.save(tmp_path / "a.npz", extract.of(replace(scene, train=views), [view.name for view in views], None))
    again = extract.load(tmp_path / "a.npz").scene.train
    assert [view.pixels for view in again] == [Pixels(4095, "mask")] * 4
    assert torch.equal(view_mask(again[0]), view_mask(scene.train[0]))


def test_of_many_photographs_some_are_looked_at(tmp_path, monkeypatch):
    monkeypatch.setattr(pixels, "MAX_EXAMINED_PHOTOS", 3)
    for number in range(8):
        Image.fromarray(left_clear(0, np.full((4, 40, 3), 9, np.uint8))).save(tmp_path / f"{number}.png")
    (line,) = decide({path.name: path for path in sorted(tmp_path.iterdir())}).lines
    assert line.startswith("3 of 3 photographs that were looked at, of 8")


def test_a_mask_goes_by_what_is_opaque_or_by_its_colours(tmp_path):
    alpha = np.full((30, 40), 255, np.uint8)
    alpha[:10] = 0
    wanted = torch.from_numpy(alpha > 0)
    black, white = np.zeros((30, 40, 3), np.uint8), np.full((30, 40, 3), 255, np.uint8)
    for name, colour in {"black": black, "white": white}.items():
        Image.fromarray(np.dstack([colour, alpha])).save(tmp_path / f"{name}.png")
        Image.fromarray(np.dstack([colour[..., 0], alpha]), "LA").save(tmp_path / f"{name}-LA.png")
        for path in (tmp_path / f"{name}.png", tmp_path / f"{name}-LA.png"):
            assert torch.equal(read_mask(path, (40, 30), alpha=True), wanted)
            assert torch.equal(read_mask(path, (40, 30)), torch.full((30, 40), name == "white"))


def test_options_that_a_command_lacks_are_not_named(tmp_path):
    Image.fromarray(left_clear(0, np.full((4, 40, 3), 9, np.uint8))).save(tmp_path / "a.png")
    files = {"a.png": tmp_path / "a.png"}
    assert "--alpha mask" in decide(files).lines[0] and "--white" in decide(files).lines[0]
    assert "--white" not in decide(files, options=("--alpha",)).lines[0]
    assert decide(files, options=()).lines[0].endswith("empty space")


def test_the_choice_is_kept_and_runs_of_before_have_none():
    known = dump(Data(Path("a"), alpha="mask"))
    assert load(Data, known).alpha == "mask"
    del known["alpha"]
    assert load(Data, known).alpha is None
