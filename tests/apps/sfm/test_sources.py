"""Masks for photographs without cameras, and photographs of telephones."""

import json
import shutil
import sys

import numpy as np
import pytest
import torch
from needs import needs
from PIL import Image

from surfkit.apps.sfm.feature_cache import feature_file, find_features, read_features
from surfkit.apps.sfm.inspect_photos import look
from surfkit.apps.sfm.settings import Settings
from surfkit.apps.sfm.sources import look_at_all
from surfkit.cli import main
from surfkit.core.check import BadInput
from surfkit.io.datasets.data import Data
from surfkit.io.datasets.masks import read_mask
from surfkit.io.datasets.read import read
from surfkit.runs.run_notes import collect_notes
from surfkit.scene.photos import photo_size, read_photo

from .pictures import HEIGHT, WIDTH, arc, picture, save

CPU = torch.device("cpu")
QUICK = ("--max-features", "800")
HIDDEN = (slice(40, 130), slice(60, 150))
"""Rows and columns that masks hide."""


@pytest.fixture
def folder(tmp_path):
    """Five photographs, and masks of four of them, by three ways to name them."""
    for at, pose in enumerate(arc(5)):
        save(tmp_path / "p/flight" / f"{at}.jpg", picture(pose))
    seen = np.full((HEIGHT, WIDTH), 255, np.uint8)
    seen[HIDDEN] = 0
    for name in ("flight/0.jpg.png", "flight/1.png", "2_mask.png", "flight/3.jpg.png"):
        (tmp_path / "m" / name).parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(seen).save(tmp_path / "m" / name)
    return tmp_path


def sources_of(folder, **settings):
    return look_at_all(
        folder / "p", folder / "work", folder / "photographs.json", Settings(max_features=800, **settings)
    )


def test_no_feature_is_taken_where_a_mask_is_black(folder):
    settings = Settings(max_features=800, masks=folder / "m")
    sources, photos = sources_of(folder, masks=folder / "m")
    assert [bool(photo.mask) for photo in photos] == [True, True, True, True, False]
    counts = find_features(photos, sources, folder / "f", settings, CPU)
    whole, plain = sources_of(folder)
    before = find_features(plain, whole, folder / "f", Settings(max_features=800), CPU)
    for photo, unmasked in zip(photos, plain, strict=True):
        spots = read_features(feature_file(folder / "f", photo, settings)).keypoints[:, :2]
        inside = (spots >= (60, 40)).all(1) & (spots < (150, 130)).all(1)
        assert inside.any() == (not photo.mask) and len(spots) == counts[photo.name] > 50
        assert (counts[photo.name] < before[photo.name]) == bool(photo.mask)
        assert not unmasked.mask


def test_masks_beside_photographs_are_told(folder):
    shutil.copy(folder / "m/2_mask.png", folder / "p/flight/2_MASK.PNG")
    shutil.copy(folder / "p/flight/4.jpg", folder / "p/flight/9_mask.jpg")
    with collect_notes() as notes:
        sources_of(folder)
    told = [text for text in notes.texts if "called as masks" in text]
    assert len(told) == 1 and told[0].startswith("1 files") and "flight/2_MASK.PNG" in told[0]


def test_a_set_of_cut_outs_is_read_alike_and_masks_that_keep_nothing_are_told(folder):
    alpha = np.full((HEIGHT, WIDTH), 255, np.uint8)
    alpha[HIDDEN] = 0
    for name, opacity in {"flight/0.jpg": alpha, "flight/1": np.full_like(alpha, 255), "2_mask": alpha * 0}.items():
        Image.fromarray(np.dstack([np.zeros((HEIGHT, WIDTH, 3), np.uint8), opacity])).save(folder / f"m/{name}.png")
    settings = Settings(max_features=800, masks=folder / "m")
    sources, photos = sources_of(folder, masks=folder / "m")
    shares = [sources.read_mask(photo.name, (WIDTH, HEIGHT)).mean() for photo in photos[:4]]
    hidden = 90 * 90 / (WIDTH * HEIGHT)
    assert shares == pytest.approx([1 - hidden, 1, 0, 1 - hidden]), "the last one by its colours"
    with collect_notes() as notes:
        counts = find_features(photos, sources, folder / "f", settings, CPU)
    assert counts["flight/1.jpg"] > counts["flight/0.jpg"] > 50 and counts["flight/2.jpg"] == 0
    told = "no features are where the masks of 1 photographs keep something, 'flight/2.jpg'; correct or delete masks"
    assert notes.texts == [f"{told} that keep nothing"]


def test_masks_go_with_the_scene_undistorted_as_its_photographs(folder, capsys):
    words = ["prepare", "photos", str(folder / "p"), "--out", str(folder / "s"), *QUICK]
    assert main([*words, "--masks", str(folder / "m")]) == 0
    assert "ignored in 4 of 5 photographs" in capsys.readouterr().err
    scene = read(Data(folder / "s"))
    views = {view.name: view for view in (*scene.train, *scene.held_out)}
    assert len(views) == 5 and {name for name, view in views.items() if view.mask is None} == {"flight/4.jpg"}
    camera = json.loads((folder / "s/report.json").read_text())["models"][0]["cameras"][0]
    focal, bend = camera["params"][0], camera["params"][3]
    for name, view in views.items():
        if view.mask is None:
            continue
        size = photo_size(view.path)
        kept = read_mask(view.mask.path, size).numpy()
        x, y = np.meshgrid(np.arange(size[0]) + 0.5, np.arange(size[1]) + 0.5)
        rays = np.stack([x - view.camera.cx, y - view.camera.cy], -1) / view.camera.fx
        spots = focal * rays * (1 + bend * (rays**2).sum(-1, keepdims=True)) + (WIDTH / 2, HEIGHT / 2)
        truth = ~((spots >= (60, 40)) & (spots < (150, 130))).all(-1)
        assert (kept != truth).mean() < 0.01 and 0.6 < kept.mean() < 0.9, name
    before = {path: path.stat().st_mtime_ns for path in (folder / "s/masks").rglob("*.png")}
    assert len(before) == 4 and main([*words, "--masks", str(folder / "m")]) == 0
    assert {path: path.stat().st_mtime_ns for path in before} == before, "what is there is not made again"
    Image.new("L", (8, 8)).save(folder / "s/masks/own.png")
    assert main(words) == 0
    assert [path.name for path in (folder / "s/masks").rglob("*.png")] == ["own.png"], "ours go, those of the user stay"


def test_what_is_transparent_is_masked_where_alpha_says_so(folder):
    alpha = np.full((HEIGHT, WIDTH), 255, np.uint8)
    alpha[HIDDEN] = 0
    for path in sorted((folder / "p/flight").iterdir())[:3]:
        rgb = np.asarray(Image.open(path))
        Image.fromarray(np.dstack([rgb, alpha])).save(path.with_suffix(".png"))
        path.unlink()
    settings = Settings(max_features=800, alpha="mask")
    sources, photos = sources_of(folder, alpha="mask")
    assert [bool(photo.mask) for photo in photos] == [True, True, True, False, False]
    counts = find_features(photos[:1], sources, folder / "f", settings, CPU)
    spots = read_features(feature_file(folder / "f", photos[0], settings)).keypoints[:, :2]
    assert counts[photos[0].name] > 50 and not ((spots >= (60, 40)).all(1) & (spots < (150, 130)).all(1)).any()
    with collect_notes() as notes:
        _, plain = sources_of(folder)
    assert not any(photo.mask for photo in plain) and plain[0].digest != photos[0].digest
    assert any("3 of 5 photographs have transparent pixels" in text for text in notes.texts)
    _, both = sources_of(folder, alpha="mask", masks=folder / "m")
    assert [bool(photo.mask) for photo in both] == [True, True, True, True, False]
    command = ["prepare", "photos", str(folder / "p"), "--out", str(folder / "s"), *QUICK, "--alpha", "mask"]
    assert main(command) == 0
    scene = read(Data(folder / "s", test_every=0))
    assert len([view for view in scene.train if view.mask is not None]) == 3
    assert 0.6 < read_mask(scene.train[0].mask.path, (WIDTH, HEIGHT)).float().mean() < 0.9


def test_masks_of_the_user_in_the_scene_are_not_replaced(folder, capsys):
    words = ["prepare", "photos", str(folder / "p"), "--out", str(folder / "s"), *QUICK]
    assert main(words) == 0
    mine = folder / "s/masks/flight/0.jpg.png"
    mine.parent.mkdir(parents=True)
    Image.new("L", (8, 8)).save(mine)
    assert main([*words, "--masks", str(folder / "m")]) == 2
    assert "0.jpg.png is there" in capsys.readouterr().err
    assert photo_size(mine) == (8, 8)


def test_masks_that_do_not_fit_are_told(folder):
    Image.new("L", (WIDTH, HEIGHT), 255).save(folder / "m/nobody.png")
    with collect_notes() as notes:
        sources_of(folder, masks=folder / "m")
    assert any(text.startswith(f"--masks {folder / 'm'}: 1 ") and "'nobody.png'" in text for text in notes.texts)
    Image.new("L", (WIDTH, HEIGHT // 2), 255).save(folder / "m/flight/1.png")
    with pytest.raises(BadInput, match=r"1\.png: 240 x 90 px"):
        sources_of(folder, masks=folder / "m")
    (folder / "empty").mkdir()
    with pytest.raises(BadInput, match="empty: .*NAME.jpg.png"):
        sources_of(folder, masks=folder / "empty")
    with pytest.raises(BadInput, match="no such folder of masks"):
        sources_of(folder, masks=folder / "nowhere")


def test_masks_among_the_photographs_are_no_photographs(folder):
    shutil.copytree(folder / "m", folder / "p/masks")
    _, photos = sources_of(folder, masks=folder / "p/masks")
    assert len(photos) == 5 and sum(bool(photo.mask) for photo in photos) == 4
    with collect_notes() as notes:
        _, photos = sources_of(folder)
    assert len(photos) == 9, "as nobody said so"
    assert any("4 files in folders called masks are taken for photographs" in text for text in notes.texts)


def test_photographs_of_telephones(tmp_path, monkeypatch, capsys):
    heif = needs("pillow_heif")
    heif.register_heif_opener()
    pixels = picture(arc(1)[0])
    save(tmp_path / "a.jpg", pixels)
    tags = Image.Exif()
    tags[0x0110], tags[0x0112] = "telephone", 6
    Image.fromarray(picture(arc(2)[1])).save(tmp_path / "b.HEIC", quality=95, exif=tags.tobytes())
    found = {photo.name: photo for photo in look(tmp_path)}
    turned = found["b.HEIC"]
    assert turned.usable and turned.exif.camera == "telephone"
    assert (turned.size, turned.exif.orientation) == ((HEIGHT, WIDTH), 1), "libheif has turned it already"
    shown = read_photo(tmp_path / "b.HEIC", turned.size).permute(1, 2, 0).numpy().astype(float)
    assert np.abs(np.rot90(shown) - picture(arc(2)[1])).mean() < 6


def test_without_pillow_heif_one_line_names_the_extra(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "pillow_heif", None)
    (tmp_path / "b.HEIC").write_bytes(b"x")
    (tmp_path / "c.heic").write_bytes(b"x")
    said = r"2 HEIC .*pillow_heif, .*pip install 'surfkit\[heic\]'"
    with pytest.raises(BadInput, match=said):
        look(tmp_path)
    save(tmp_path / "a.jpg", picture(arc(1)[0]))
    with collect_notes() as notes:
        assert [photo.name for photo in look(tmp_path)] == ["a.jpg"]
    assert len(notes.texts) == 1 and "pip install 'surfkit[heic]'; they are left out" in notes.texts[0]
