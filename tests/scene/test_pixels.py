"""Values of photographs become colours by what their file is: bits that are used, opacity, bands beyond the colours."""

import io

import numpy as np
import pytest
from PIL import Image

from surfkit.core.check import BadInput
from surfkit.scene import jpeg, photos
from surfkit.scene import large_photos as large
from surfkit.scene.photos import open_picture, read_draft, read_photo, refuse_large
from surfkit.scene.pixels import Pixels, is_opacity, kind_of, largest_of, opacity_of, white_level_of
from tests.needs import needs

SIZE = (50, 40)


def twelve_bits(bands=3, seed=0):
    return np.random.default_rng(seed).integers(0, 4096, (SIZE[1], SIZE[0], bands)).astype(np.uint16)


def geotiff(path, values, **profile):
    """As GDAL writes it."""
    height, width, bands = values.shape
    with needs("rasterio").open(
        path, "w", driver="GTiff", height=height, width=width, count=bands, dtype=values.dtype, **profile
    ) as f:
        f.write(np.moveaxis(values, 2, 0))
    return path


def opencv(path, values):
    """As OpenCV writes it, which knows 16 bits of colour in PNG and TIFF."""
    order = [2, 1, 0, 3][: values.shape[2]]
    assert needs("cv2").imwrite(str(path), values[..., order])
    return path


WIDE = {
    "png": lambda folder, values: opencv(folder / "a.png", values),
    "tif": lambda folder, values: opencv(folder / "a.tif", values),
    "raw": lambda folder, values: geotiff(folder / "b.tif", values, photometric="RGB"),
    "tiles": lambda folder, values: geotiff(
        folder / "c.tif", values, photometric="RGB", tiled=True, blockxsize=16, blockysize=16, compress="deflate"
    ),
    "big-endian": lambda folder, values: geotiff(folder / "d.tif", values, photometric="RGB", ENDIANNESS="BIG"),
    "predictor": lambda folder, values: geotiff(
        folder / "e.tif", values, photometric="RGB", compress="lzw", predictor=2
    ),
}


@pytest.mark.parametrize("kind", WIDE)
def test_twelve_bits_of_colour_are_read_whole(tmp_path, kind):
    values = twelve_bits()
    path = WIDE[kind](tmp_path, values)
    got = read_photo(path, SIZE, pixels=Pixels(4095)).permute(1, 2, 0).numpy()
    assert np.abs(got - values * (255 / 4095)).max() <= 0.501
    assert read_photo(path, SIZE).max() <= 16, "as the file is 16 bits, and nothing says that white is 4,095"
    assert open_picture(path, kind_of).wide
    assert white_level_of(open_picture(path, largest_of)) == 4095
    assert np.abs(read_draft(path, 10, Pixels(4095)).mean() - got.mean()) < 2


def test_values_above_white_are_white(tmp_path):
    values = np.array([[[0, 4095, 5000], [65535, 2048, 1]]], np.uint16)
    got = read_photo(opencv(tmp_path / "a.png", values), (2, 1), pixels=Pixels(4095))
    assert got[:, 0].T.tolist() == [[0, 255, 255], [255, 128, 0]]
    grey = tmp_path / "g.tif"
    Image.fromarray(values[..., 0]).save(grey)
    assert read_photo(grey, (2, 1), pixels=Pixels(4095))[0].tolist() == [[0, 255]]


@pytest.mark.parametrize("largest, level", [(0, 255), (255, 255), (900, 1023), (3998, 4095), (16383, 16383)])
def test_white_is_the_largest_value_of_the_bits_in_use(largest, level):
    assert white_level_of(largest) == level


@pytest.mark.parametrize("largest", [16384, 40000, 65535])
def test_of_sixteen_bits_all_are_in_use(largest):
    assert white_level_of(largest) == 0


def test_tags_name_white(tmp_path):
    values = twelve_bits(1)
    packed = geotiff(tmp_path / "packed.tif", values, NBITS=12)
    assert open_picture(packed, kind_of).white_level == 4095
    assert np.abs(read_photo(packed, SIZE, pixels=Pixels(4095))[0].numpy() - values[..., 0] * (255 / 4095)).max() < 0.51
    for tag, field in ((50717, "white_level"), (281, "largest")):
        path = tmp_path / f"{tag}.tif"
        Image.fromarray(values[..., 0]).save(path, tiffinfo={tag: 4000})
        assert getattr(open_picture(path, kind_of), field) == 4000
        assert getattr(open_picture(path, kind_of), {"white_level": "largest", "largest": "white_level"}[field]) == 0


def coloured(bands=4):
    values = np.random.default_rng(1).integers(1, 250, (SIZE[1], SIZE[0], bands)).astype(np.uint8)
    return values


def test_a_band_is_an_opacity_by_its_values():
    assert not is_opacity(coloured()[..., 3]) and not is_opacity(np.zeros((4, 4), np.uint8))
    cut = np.full((40, 50), 255, np.uint8)
    cut[:20, :20], cut[:, 20:22] = 0, 100
    assert is_opacity(cut)


@pytest.mark.parametrize("alpha", ["NO", "YES", "NON-PREMULTIPLIED"])
@pytest.mark.parametrize("kind", ["uint8", "uint16"])
def test_a_fourth_band_is_as_doubtful_as_its_tag(tmp_path, alpha, kind):
    """GDAL calls the fourth band an opacity where it is asked to, or by default, whatever is in it."""
    values = coloured().astype(kind) * (1 if kind == "uint8" else 257)
    found = open_picture(geotiff(tmp_path / "a.tif", values, photometric="RGB", alpha=alpha), kind_of)
    if alpha == "NO":
        assert not found.opacity and found.dropped == 1
    else:
        assert found.doubtful and found.dropped == 0
        band = open_picture(tmp_path / "a.tif", opacity_of)
        assert np.array_equal(band, coloured()[..., 3]) and not is_opacity(band)
    got = read_photo(tmp_path / "a.tif", SIZE, pixels=Pixels(alpha="ignore"))
    assert np.array_equal(got.permute(1, 2, 0), coloured()[..., :3])


def test_masked_pixels_do_not_spread_their_colour(tmp_path):
    """Where a photograph is reduced, colours below what is transparent count for nothing."""
    values = np.full((40, 60, 4), 200, np.uint8)
    values[..., 3] = 255
    values[:, 25:] = (0, 255, 0, 0)
    Image.fromarray(values).save(tmp_path / "a.png")
    kept = read_photo(tmp_path / "a.png", (6, 4), pixels=Pixels(alpha="mask"))[:, :, :3]
    assert (kept.int() - 200).abs().max() <= 1
    ignored = read_photo(tmp_path / "a.png", (60, 40), pixels=Pixels(alpha="ignore"))
    assert np.array_equal(ignored.permute(1, 2, 0), values[..., :3])
    assert read_draft(tmp_path / "a.png", 6, Pixels(alpha="mask")).shape == (4, 6, 3)


KINDS = {
    "LA": lambda image: image.convert("LA"),
    "palette": lambda image: image.convert("RGB").quantize(8),
    "premultiplied": lambda image: image,
}


@pytest.mark.parametrize("kind", KINDS)
def test_every_way_to_be_transparent_lies_over_black_or_white(tmp_path, kind):
    values = np.zeros((4, 6, 4), np.uint8)
    values[:, :3] = (80, 80, 80, 255)
    made, path = KINDS[kind](Image.fromarray(values)), tmp_path / "a.png"
    if kind == "palette":
        made.save(path, transparency=int(np.asarray(made)[0, 5]))
    elif kind == "premultiplied":
        path = geotiff(tmp_path / "a.tif", values, photometric="RGB", alpha="PREMULTIPLIED")
    else:
        made.save(path)
    for white in (False, True):
        got = read_photo(path, (6, 4), white)
        assert (got[:, :, :3] == 80).all() and (got[:, :, 3:] == (255 if white else 0)).all()


@pytest.fixture
def heard(monkeypatch, warned):
    """Warnings, of which the first about JPEG files is told."""
    monkeypatch.setattr(jpeg, "_told", [False])
    return warned


def picture(width=200, height=152):
    """Smooth, with grain: what a photograph compresses to."""
    x, y = np.meshgrid(np.arange(width), np.arange(height))
    plain = np.stack([x, y, x + y], 2) * 0.6 + np.random.default_rng(0).normal(0, 8, (height, width, 3))
    return Image.fromarray(plain.clip(0, 255).astype(np.uint8))


@pytest.mark.parametrize(
    "options", [{}, {"progressive": True}, {"restart_marker_rows": 1}, {"subsampling": 0}], ids=str
)
@pytest.mark.parametrize("lost", [1, 2])
def test_a_jpeg_without_its_end_is_read(tmp_path, heard, options, lost):
    whole = tmp_path / "whole.jpg"
    picture().save(whole, quality=90, **options)
    for name in ("a.jpg", "b.jpg"):
        (tmp_path / name).write_bytes(whole.read_bytes()[:-lost])
        assert np.array_equal(read_photo(tmp_path / name, (200, 152)), read_photo(whole, (200, 152)))
    assert np.array_equal(read_draft(tmp_path / "a.jpg", 50), read_draft(whole, 50))
    assert len(heard) == 1 and "EOI" in heard[0]


@pytest.mark.parametrize("options", [{}, {"progressive": True}, {"subsampling": 0}], ids=str)
@pytest.mark.parametrize("lost", [8, 40, 0.1, 0.5])
def test_a_jpeg_that_lacks_pixels_is_damaged(tmp_path, heard, options, lost):
    file = io.BytesIO()
    picture().save(file, "JPEG", quality=90, **options)
    data = file.getvalue()
    path = tmp_path / "cut.jpg"
    path.write_bytes(data[: -(lost if lost >= 1 else int(len(data) * lost))])
    with pytest.raises(BadInput, match="cut.jpg: not a whole picture"):
        read_photo(path, (200, 152))
    assert not heard


def bomb(path, width, height):
    """A PNG that claims a size."""
    Image.new("1", (1, 1)).save(path)
    data = bytearray(path.read_bytes())
    import struct
    import zlib

    data[16:24] = struct.pack(">II", width, height)
    data[29:33] = struct.pack(">I", zlib.crc32(bytes(data[12:29])))
    path.write_bytes(data)
    return path


def test_what_the_memory_does_not_hold_is_refused(tmp_path, monkeypatch):
    path = bomb(tmp_path / "a.png", 20_000, 10_000)
    monkeypatch.setattr(large, "free_bytes", lambda: 10**9)
    for read in (lambda: read_photo(path, (40, 30)), lambda: refuse_large(path, (20_000, 10_000), (40, 30))):
        with pytest.raises(BadInput, match="a.png: 20,000 x 10,000 px .*SURFKIT_MAX_MEGAPIXELS=200"):
            read()
    assert photos.photo_size(path) == (20_000, 10_000), "its header can be read"
    assert Image.MAX_IMAGE_PIXELS is not None, "for other programs in this process"
    monkeypatch.setattr(large, "free_bytes", lambda: 10**13)
    refuse_large(path, (20_000, 10_000), (40, 30))
    with pytest.raises(BadInput, match="not a whole picture"):  # nothing more is in it
        open_picture(path, lambda image: image.getexif())


def test_large_photographs_are_read(tmp_path, monkeypatch):
    """What is large, and Pillow's own limit, are set low: the same happens to 150 megapixels, and takes longer."""
    monkeypatch.setattr(large, "MAX_UNCHECKED_PIXELS", 1000)
    monkeypatch.setattr(Image, "MAX_IMAGE_PIXELS", 500)
    for end in ("png", "jpg", "tif"):
        picture(640, 480).save(tmp_path / f"a.{end}")
        got = read_photo(tmp_path / f"a.{end}", (64, 48)).float()
        true = np.asarray(picture(640, 480).resize((64, 48), Image.Resampling.BOX), float)
        assert np.abs(got.permute(1, 2, 0).numpy() - true).mean() < 3
    sizes = []
    open_picture(tmp_path / "a.jpg", lambda image: sizes.append(image.size), (64, 48))
    assert sizes == [(160, 120)], "a large JPEG is never held at its full size"
    need = large.DECODED_PIXEL_BYTES * 640 * 480 + large.RESULT_PIXEL_BYTES * 64 * 48
    monkeypatch.setattr(large, "free_bytes", lambda: int(need / large.DECODE_MEMORY_SHARE) - 1)
    read_photo(tmp_path / "a.jpg", (64, 48))
    with pytest.raises(BadInput, match="a.png: 640 x 480 px"):
        read_photo(tmp_path / "a.png", (64, 48))
    monkeypatch.setattr(large, "free_bytes", lambda: int(need / large.DECODE_MEMORY_SHARE) + 1)
    read_photo(tmp_path / "a.png", (64, 48))


def test_the_user_sets_the_limit(tmp_path, monkeypatch):
    picture(640, 480).save(tmp_path / "a.png")
    monkeypatch.setattr(large, "free_bytes", lambda: 0)
    monkeypatch.setattr(large, "MAX_UNCHECKED_PIXELS", 1000)
    monkeypatch.setenv(large.MEGAPIXELS_VARIABLE, "0.4")
    read_photo(tmp_path / "a.png", (64, 48))
    monkeypatch.setenv(large.MEGAPIXELS_VARIABLE, "0.3")
    with pytest.raises(BadInput, match="SURFKIT_MAX_MEGAPIXELS=0.3"):
        read_photo(tmp_path / "a.png", (64, 48))
    for wrong in ("much", "-1", "nan", "inf"):
        monkeypatch.setenv(large.MEGAPIXELS_VARIABLE, wrong)
        with pytest.raises(BadInput, match=f"SURFKIT_MAX_MEGAPIXELS={wrong}: "):
            read_photo(tmp_path / "a.png", (64, 48))
