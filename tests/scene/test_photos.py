"""Photographs of every kind become RGB of the right size, and damaged ones are named."""

from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from surfkit.core.check import BadInput
from surfkit.io.datasets.raw_dataset import load_pycolmap
from surfkit.scene import photos
from surfkit.scene.camera import Camera
from surfkit.scene.decoded_photos import DecodedPhotoCache
from surfkit.scene.photos import is_turned, photo_cache, photo_size, read_photo
from surfkit.scene.scene import View


def stripes(width=8, height=6):
    return np.random.default_rng(0).integers(0, 256, (height, width, 3), np.uint8)


def view(path, width=8, height=6):
    return View(path.name, Camera(torch.eye(4, dtype=torch.float64), 9, 9, 4, 3, width, height), path)


def save(path, pixels, mode=None, **options):
    image = Image.fromarray(pixels)
    (image.convert(mode) if mode else image).save(path, **options)
    return path


def test_pixels_are_those_of_the_file(tmp_path):
    pixels = stripes()
    got = read_photo(save(tmp_path / "a.png", pixels), (8, 6))
    assert got.dtype == torch.uint8 and got.is_contiguous()
    np.testing.assert_array_equal(got.permute(1, 2, 0).numpy(), pixels)


def test_reduction_averages_and_does_not_alias(tmp_path):
    fine = np.zeros((120, 160, 3), np.uint8)
    fine[:, ::2] = 200  # one pixel stripes, which a plain pick would keep
    got = read_photo(save(tmp_path / "a.png", fine), (20, 15)).float()
    assert got.shape == (3, 15, 20)
    assert (got - 100).abs().max() <= 3


def test_reduction_keeps_the_place_of_things(tmp_path):
    ramp = np.broadcast_to(np.arange(240, dtype=np.uint8)[None, :, None], (60, 240, 3)).copy()
    got = read_photo(save(tmp_path / "a.png", ramp), (80, 20)).float()
    centres = (torch.arange(80) + 0.5) * 3 - 0.5
    assert (got[:, :, 2:-2] - centres[2:-2]).abs().max() <= 1


@pytest.mark.parametrize("mode", ["L", "1", "P", "CMYK", "LA"])
def test_other_modes_become_rgb(tmp_path, mode):
    grey = np.full((6, 8, 3), 255, np.uint8)
    grey[:, :4] = 0
    path = save(tmp_path / ("a.tif" if mode == "CMYK" else "a.png"), grey, mode)
    np.testing.assert_array_equal(read_photo(path, (8, 6)).permute(1, 2, 0).numpy(), grey)


def test_sixteen_bits_are_scaled_and_not_clipped(tmp_path):
    values = np.array([[0, 200, 32896, 65535]], np.uint16)
    assert read_photo(save(tmp_path / "a.png", values), (4, 1))[1].tolist() == [[0, 1, 128, 255]]


def test_alpha_lies_over_black(tmp_path):
    pixels = np.full((2, 2, 4), 200, np.uint8)
    pixels[0, :, 3] = [0, 255]
    pixels[1, :, 3] = 128
    got = read_photo(save(tmp_path / "a.png", pixels), (2, 2))[0].tolist()
    assert got == [[0, 200], [100, 100]]


@pytest.mark.parametrize("turn", range(1, 9))
@pytest.mark.parametrize("end", ["png", "tif"])
def test_the_rotation_in_exif_is_not_applied(tmp_path, end, turn):
    """Neither by us nor by Pillow, which turns TIFF files when it reads them; COLMAP does not."""
    exif = Image.Exif()
    exif[0x0112] = turn
    pixels = np.arange(144, dtype=np.uint8).reshape(6, 8, 3)
    path = save(tmp_path / f"a.{end}", pixels, exif=exif)
    assert photo_size(path) == (8, 6) and is_turned(path) == (turn > 1)
    assert np.array_equal(read_photo(path, (8, 6)).permute(1, 2, 0), pixels)
    assert np.array_equal(load_pycolmap().Bitmap.read(str(path), True).to_array(), pixels)


def test_by_position_in_the_size_of_the_camera(tmp_path):
    paths = [save(tmp_path / f"{i}.png", np.full((6, 8, 3), i * 10, np.uint8)) for i in range(5)]
    photos = photo_cache([view(path, 4, 3) for path in paths], threads=2)
    assert len(photos) == 5
    for i in (3, 0, 4, 3, -1):
        assert photos[i].shape == (3, 3, 4) and (photos[i] == i % 5 * 10).all()
    assert photos[2] is photos[2]


def test_a_damaged_photograph_is_named(tmp_path):
    whole = save(tmp_path / "whole.jpg", stripes(64, 48))
    cut = tmp_path / "cut.jpg"
    cut.write_bytes(whole.read_bytes()[:700])
    photos = photo_cache([view(whole, 64, 48), view(cut, 64, 48)])
    assert photos[0].shape == (3, 48, 64)
    with pytest.raises(BadInput, match="cut.jpg: .*truncated") as error:
        photos[1]
    assert "\n" not in str(error.value)
    (tmp_path / "page.jpg").write_text("<html>")
    with pytest.raises(BadInput, match="page.jpg: not a whole picture"):
        photo_size(tmp_path / "page.jpg")
    with pytest.raises(BadInput, match="no such photograph"):
        photo_size(Path(tmp_path / "none.jpg"))


def test_sixteen_bits_of_colour_and_alpha(tmp_path):
    """PNG of 16 bits a channel, which Pillow cannot write."""
    import struct
    import zlib

    def chunk(kind, body):
        return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))

    for kind, channels in {2: 3, 6: 4}.items():
        values = np.array([[[1000, 30000, 65535, 65535][:channels], [0, 257, 514, 0][:channels]]], ">u2")
        rows = b"".join(b"\0" + row.tobytes() for row in values)
        head = chunk(b"IHDR", struct.pack(">IIBBBBB", 2, 1, 16, kind, 0, 0, 0))
        body = chunk(b"IDAT", zlib.compress(rows)) + chunk(b"IEND", b"")
        (tmp_path / "a.png").write_bytes(b"\x89PNG\r\n\x1a\n" + head + body)
        got = read_photo(tmp_path / "a.png", (2, 1))[:, 0].T.tolist()
        assert np.abs(np.array(got[0]) - [1000 / 257, 30000 / 257, 255]).max() <= 1
        assert got[1] == ([0, 1, 2] if kind == 2 else [0, 0, 0])
        if kind == 6:
            assert read_photo(tmp_path / "a.png", (2, 1), white=True)[:, 0, 1].tolist() == [255, 255, 255]


def test_memory_stays_within_the_budget(tmp_path):
    """160 photographs of 2 MB each, of which ten fit, in training order."""
    import psutil

    for i in range(40):
        save(tmp_path / f"{i}.jpg", np.full((800, 900, 3), i, np.uint8))
    views = [view(tmp_path / f"{i % 40}.jpg", 900, 800) for i in range(160)]
    process, budget = psutil.Process(), 22_000_000
    before, most = process.memory_info().rss, 0
    cache = photo_cache(views, budget, threads=2)
    order = torch.randperm(160, generator=torch.Generator().manual_seed(0)).tolist()
    cache.expect(order)
    for at in order:
        assert abs(int(cache[at][0, 0, 0]) - at % 40) <= 1
        assert cache.bytes <= budget
        most = max(most, process.memory_info().rss)
    assert most - before < budget + 80_000_000, "all of them are 346 MB; the rest is for decoding, and the allocator's"


def test_copies_on_disk_are_the_same_pixels_and_made_once(tmp_path, monkeypatch):
    paths = [save(tmp_path / f"{name}.png", stripes(40, 30)) for name in "ab"]
    views = [view(path) for path in paths]
    wanted = [read_photo(path, (8, 6)) for path in paths]
    for _ in range(2):
        cache = photo_cache(views, 0, DecodedPhotoCache(tmp_path))
        assert all(torch.equal(cache[at], wanted[at]) for at in (0, 1, 0))
    made = sorted((tmp_path / "resized").iterdir())
    assert [path.name[:2] for path in made] == ["a-", "b-"]
    with monkeypatch.context() as patch:
        patch.setattr(photos, "read_photo", None)  # decoding again would fail
        assert torch.equal(photo_cache(views, 0, DecodedPhotoCache(tmp_path))[1], wanted[1])
    made[0].write_bytes(made[0].read_bytes()[:-5])  # damaged: made again
    assert torch.equal(photo_cache(views, 0, DecodedPhotoCache(tmp_path))[0], wanted[0])
    save(paths[1], 255 - stripes(40, 30))  # another photograph of that name
    assert torch.equal(photo_cache(views, 0, DecodedPhotoCache(tmp_path))[1], read_photo(paths[1], (8, 6)))
    assert len(list((tmp_path / "resized").iterdir())) == 3
    paths[0].unlink()
    with pytest.raises(BadInput, match="a.png: no such photograph"):
        photo_cache(views, 0, DecodedPhotoCache(tmp_path))[0]


def test_large_photographs_are_decoded_one_after_the_other(tmp_path, monkeypatch):
    monkeypatch.setattr(photos.DECODE_GATE, "most", 3 * 40 * 30)
    inside, most = [0], [0]
    original = photos.to_rgb

    def counted(*args):
        inside[0] += 1
        most[0] = max(most[0], inside[0])
        try:
            return original(*args)
        finally:
            inside[0] -= 1

    monkeypatch.setattr(photos, "to_rgb", counted)
    views = [view(save(tmp_path / f"{at}.png", stripes(40, 30))) for at in range(20)]
    cache = photo_cache(views, threads=4)
    assert len({tuple(cache[at].shape) for at in range(20)}) == 1 and most[0] == 1
