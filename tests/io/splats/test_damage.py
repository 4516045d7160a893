"""Hundreds of damaged files of every format: one line each, and nothing allocated that the file cannot hold.

`bench/fuzz.py --targets splats-sog ...` makes thousands, through the command line.
"""

import gzip
import os
import shutil
import struct
import sys
import tracemalloc
import warnings
import zipfile
import zlib
from pathlib import Path

import pytest
import zstandard
from needs import needs

from surfkit.core.check import BadInput
from surfkit.io.splats.compressed_ply import CompressedPLY
from surfkit.io.splats.sog import SOG
from surfkit.io.splats.splat import Splat
from surfkit.io.splats.splat_files import format_for, read_splat_file
from surfkit.io.splats.spz import SPZ

from .models import table

hypothesis = needs("hypothesis")
BENCH = Path(__file__).parents[3] / "bench"
NAMES = ("compressed-ply", "gltf", "gltf-spz", "ply", "sog", "splat", "spz", "spz-4", "surfkit")
CASES = int(os.environ.get("SURFKIT_FUZZ_CASES", "300"))
MOST = 64 << 20
"""Bytes that reading a damaged file of some tens of kilobytes may take."""


@pytest.fixture(scope="module")
def fuzzing():
    sys.path.insert(0, str(BENCH))
    try:
        from fuzzing import damage, splats

        yield damage, splats
    finally:
        sys.path.remove(str(BENCH))


@pytest.mark.parametrize("name", NAMES)
def test_damage_is_one_line(fuzzing, name, tmp_path):
    damage, splats = fuzzing
    assert set(NAMES) == set(splats.FORMATS)
    whole = splats.write_model(tmp_path / "whole", name)
    form, here, refused = format_for(whole), tmp_path / "here", []
    assert len(form.read(whole)) == 600

    @hypothesis.settings(
        max_examples=CASES,
        deadline=None,
        database=None,
        derandomize=True,
        phases=[hypothesis.Phase.generate],
        suppress_health_check=list(hypothesis.HealthCheck),
    )
    @hypothesis.given(damage.damages([whole.name]))
    def check(listed):
        shutil.rmtree(here, ignore_errors=True)
        shutil.copytree(whole.parent, here)
        for one in listed:
            damage.apply(one, here)
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            tracemalloc.start()
            try:
                form.read(here / whole.name).refuse_unsound(str(here / whole.name))
            except BadInput as error:
                refused.append(str(error))
                assert "\n" not in str(error) and str(here / whole.name) in str(error)
            finally:
                most = tracemalloc.get_traced_memory()[1]
                tracemalloc.stop()
        assert most < MOST, f"took {most >> 20} MiB"

    check()
    assert len(refused) > CASES / 10 and len(set(refused)) > 5


@pytest.mark.parametrize("form", [CompressedPLY(), SOG(), SPZ(), SPZ(version=4)], ids=repr)
def test_cut_off_at_every_place(tmp_path, form):
    """A copy that stopped anywhere is refused."""
    path = tmp_path / f"a{form.suffix}"
    form.write(path, table(count=3, degree=1))
    whole = path.read_bytes()
    for size in {*range(0, len(whole), 13), *range(len(whole) - 9, len(whole))}:
        path.write_bytes(whole[:size])
        with pytest.raises(BadInput):
            form.read(path)


def peak(act):
    """Bytes that a call took at most, and what it said."""
    tracemalloc.start()
    try:
        with pytest.raises(BadInput) as caught:
            act()
        return tracemalloc.get_traced_memory()[1], str(caught.value)
    finally:
        tracemalloc.stop()


def test_absurd_counts_take_no_memory(tmp_path):
    billion = struct.pack("<4sIIBBBB", b"NGSP", 3, 2**31, 3, 12, 0, 0)
    (tmp_path / "a.spz").write_bytes(gzip.compress(billion))
    most, said = peak(lambda: SPZ().read(tmp_path / "a.spz"))
    assert most < 1 << 20 and "bytes cannot hold" in said
    squeezed = zstandard.ZstdCompressor().compress(bytes(1 << 20))
    head = struct.pack("<4sIIBBBBI12x", b"NGSP", 4, 2**30, 0, 12, 0, 5, 32)
    rows = b"".join(struct.pack("<QQ", len(squeezed), width * 2**30) for width in (9, 1, 3, 3, 4))
    (tmp_path / "a.spz").write_bytes(head + rows + squeezed * 5)
    most, said = peak(lambda: SPZ().read(tmp_path / "a.spz"))
    assert most < 1 << 20 and "bytes cannot hold" in said
    head = "ply\nformat binary_little_endian 1.0\nelement chunk 1000000000000\nproperty float min_x\nend_header\n"
    (tmp_path / "a.ply").write_text(head)
    most, said = peak(lambda: CompressedPLY().read(tmp_path / "a.ply"))
    assert most < 1 << 20 and "cut off after 0 of 1000000000000 rows of chunk" in said
    (tmp_path / "a.splat").write_bytes(bytes(33))
    _, said = peak(lambda: Splat().read(tmp_path / "a.splat"))
    assert "33 bytes are no .splat file" in said


def test_bombs_take_no_memory(tmp_path):
    """Streams that would become a thousand times as large and more."""
    head = struct.pack("<4sIIBBBB", b"NGSP", 3, 10, 0, 12, 0, 0)
    stream = zlib.compressobj(9, zlib.DEFLATED, 31)
    bomb = stream.compress(head) + b"".join(stream.compress(bytes(1 << 20)) for _ in range(200)) + stream.flush()
    (tmp_path / "a.spz").write_bytes(bomb)
    most, said = peak(lambda: SPZ().read(tmp_path / "a.spz"))
    assert most < 4 << 20 and "cut off or damaged" in said
    frame = zstandard.ZstdCompressor().compress(bytes(100 << 20))  # says so itself
    head = struct.pack("<4sIIBBBBI12x", b"NGSP", 4, 10, 0, 12, 0, 5, 32)
    rows = b"".join(struct.pack("<QQ", len(frame), width * 10) for width in (9, 1, 3, 3, 4))
    (tmp_path / "a.spz").write_bytes(head + rows + frame * 5)
    most, said = peak(lambda: SPZ().read(tmp_path / "a.spz"))
    assert most < 4 << 20 and "104,857,600 bytes in place of 90" in said
    with zipfile.ZipFile(tmp_path / "a.sog", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("meta.json", b" " * (200 << 20))
    most, said = peak(lambda: SOG().read(tmp_path / "a.sog"))
    assert most < 4 << 20 and "bytes cannot hold 209,715,200" in said


def test_images_of_absurd_sizes_take_no_memory(tmp_path, fuzzing):
    _, splats = fuzzing
    SOG().write(tmp_path / "a.sog", table(count=9, degree=0))

    def claim(content, damage):
        return content[:21] + struct.pack("<I", struct.unpack_from("<I", content, 21)[0] | 0xFFFFFFF) + content[25:]

    class Somewhere:
        what, at = 0, 0.0

    splats.inside_zip(claim)(tmp_path / "a.sog", Somewhere)
    most, said = peak(lambda: SOG().read(tmp_path / "a.sog"))
    assert most < 16 << 20 and "bytes cannot hold 1,073,741,824" in said


def test_archives_of_absurd_sizes_take_no_memory(tmp_path):
    """Both sizes of a file in the central directory are those of a gigabyte."""
    SOG().write(tmp_path / "a.sog", table(count=9, degree=0))
    content = bytearray((tmp_path / "a.sog").read_bytes())
    struct.pack_into("<II", content, content.rindex(b"PK\x01\x02") + 20, 1 << 30, 1 << 30)
    (tmp_path / "a.sog").write_bytes(content)
    most, said = peak(lambda: SOG().read(tmp_path / "a.sog"))
    assert most < 4 << 20 and "meta.json would be larger than the file" in said


def test_names_in_meta_json_stay_in_the_archive(tmp_path):
    SOG().write(tmp_path / "a.sog", table(count=9, degree=0))
    zipfile.ZipFile(tmp_path / "a.sog").extractall(tmp_path / "there")
    meta = tmp_path / "there" / "meta.json"
    for name in ("../quats.webp", "/etc/passwd", "..", "", "a\\\\b", "quats.webp\\u0000"):
        text = meta.read_text()
        meta.write_text(text.replace('"quats.webp"', f'"{name}"'))
        with pytest.raises(BadInput, match="quats.files .*name .*at 0"):
            read_splat_file(meta)
        meta.write_text(text)
