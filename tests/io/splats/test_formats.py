"""Every format there and back, within the bounds that its bits give."""

import math
import os
import re
import shutil
import zipfile
from dataclasses import replace

import numpy as np
import pytest
import torch

from surfkit.core.check import BadInput
from surfkit.core.registry import components
from surfkit.io.splats.base import Format
from surfkit.io.splats.compressed_ply import CompressedPLY
from surfkit.io.splats.ply import PLY, read_splats, write_splats
from surfkit.io.splats.sog import SOG
from surfkit.io.splats.splat import Splat
from surfkit.io.splats.splat_files import format_for, format_of, read_splat_file
from surfkit.io.splats.splat_table import THINNESS
from surfkit.io.splats.spz import SPZ
from surfkit.runs.run_notes import collect_notes
from surfkit.scene.scene import Frame

from .models import differences, same, table, turned

FORMS = [PLY(), CompressedPLY(), Splat(), SOG(), SPZ(), SPZ(version=2), SPZ(version=4), SPZ(axes="same")]
UTM = torch.tensor([512_345.0, 5_678_901.0, 123.0], dtype=torch.float64)


def there_and_back(form, splats, folder, frame=None):
    path = folder / f"model{form.suffix}"
    form.write(path, splats, frame)
    assert [p.name for p in folder.iterdir()] == [path.name], "nothing beside it"
    return form.read(path)


def bounds(form, splats):
    """What each column may differ by, from the number of bits alone."""
    means, scales = splats.means.numpy(), splats.log_scales.numpy()
    color = np.ptp(splats.sh0.numpy())
    if isinstance(form, PLY):
        return dict.fromkeys(("means", "log_scales", "opacity_logits", "sh0", "sh_rest"), 0) | {"quats": 1e-6}
    if isinstance(form, CompressedPLY):  # 10 bits of what a chunk spans, which is less than all of it
        shares = {"means": np.ptp(means) / 1023 / 2, "log_scales": np.ptp(scales) / 1023 / 2, "sh0": color / 255 / 2}
        return shares | {"opacity_logits": 0.5 / 255, "sh_rest": 1 / 64, "quats": 4 * 2**0.5 / 1023}
    if isinstance(form, Splat):
        return {"means": 0, "log_scales": 1e-6, "opacity_logits": 0.5 / 255, "quats": 4 / 128}
    if isinstance(form, SPZ):
        rotation = 0.2 if form.version == 2 else 4 / 511
        return {
            "means": 2e-3,
            "log_scales": 1 / 32,
            "opacity_logits": 0.5 / 255,
            "sh_rest": 1 / 16 + 1 / 128,
            "quats": rotation,
        }
    bent = np.sign(means) * np.log1p(np.abs(means))
    positions = np.ptp(bent, axis=0).max() / 65_535 / 2 * (1 + np.abs(means).max()) * 1.01
    return {
        "means": positions,
        "log_scales": np.ptp(scales) / 60,
        "sh0": color / 64,
        "opacity_logits": 0.5 / 255,
        "quats": 4 * 2**0.5 / 255,
    }


@pytest.mark.parametrize("degree", range(4))
@pytest.mark.parametrize("kind", ["gaussian", "surfel"])
@pytest.mark.parametrize("form", FORMS, ids=repr)
def test_there_and_back(tmp_path, form, kind, degree):
    splats = table(kind, degree=degree)
    found = there_and_back(form, splats, tmp_path)
    assert found.kind == kind and found.sh_degree == (0 if isinstance(form, Splat) else degree)
    if isinstance(form, (Splat, SPZ)):  # colours beyond those that can be seen are clipped
        reach = 0.5 / 0.28209479 if isinstance(form, Splat) else 0.5 / 0.15
        clipped = replace(splats, sh0=splats.sh0.clamp(-reach, reach))
        assert differences(clipped, replace(found, sh_rest=splats.sh_rest))["sh0"] <= reach / 255 + 1e-6
    if isinstance(form, Splat):
        splats = replace(splats, sh_rest=splats.sh_rest[:, :0])
    for name, bound in bounds(form, splats).items():
        assert differences(splats, found)[name] <= bound + 1e-6, name


@pytest.mark.parametrize("form", FORMS, ids=repr)
@pytest.mark.parametrize("count", [0, 1, 2, 257])
def test_few_splats(tmp_path, form, count):
    for kind in ("gaussian", "surfel"):
        splats = table(kind, count, 1)
        found = there_and_back(form, splats, tmp_path)
        assert len(found) == count
        if count:
            assert found.kind == kind and differences(splats, replace(found, sh_rest=splats.sh_rest))["means"] < 0.1


@pytest.mark.parametrize("form", FORMS, ids=repr)
@pytest.mark.parametrize("column", ["means", "quats", "log_scales", "opacity_logits", "sh0", "sh_rest"])
def test_nan_and_inf_are_refused(tmp_path, form, column):
    for value in (math.nan, math.inf, -math.inf):
        splats = table(count=9, degree=1)
        getattr(splats, column)[4, ...] = value
        with pytest.raises(BadInput, match=rf"{column} of splat 4 of 9 .*1e\+18"):
            form.write(tmp_path / f"a{form.suffix}", splats)
        assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("form", FORMS, ids=repr)
def test_survey_coordinates(tmp_path, form):
    """They come back whole where the format has a place for the offset, and without it elsewhere."""
    near = table(count=300, degree=0)
    frame = Frame(UTM.numpy(), 1.0, metres=1.0, crs="EPSG:32632", shift=(512_000.0, 5_679_000.0, 0.0))
    found = there_and_back(form, replace(near, means=near.means.double() + UTM), tmp_path, frame)
    offset = torch.zeros(3) if isinstance(form, (SPZ, Splat)) else torch.tensor(frame.shift)
    moved = replace(near, means=near.means.double() + UTM - torch.tensor(frame.shift, dtype=torch.float64))
    assert differences(moved, replace(found, means=found.means - offset))["means"] < 0.35  # 16 bits at 400 units
    if not isinstance(form, SOG):
        assert differences(moved, replace(found, means=found.means - offset))["means"] < 0.1


@pytest.mark.parametrize("form", [PLY(), Splat(), SOG(), SPZ(fractional_bits=9), CompressedPLY()], ids=repr)
def test_what_was_read_is_written_as_the_same_values(tmp_path, form):
    """All but rotations, and what the bounds of chunks and codebooks move, are on the steps of the format already."""
    once = there_and_back(form, table(count=500), tmp_path)
    twice = there_and_back(form, once, tmp_path)
    found = differences(once, twice)
    steps = {"means": 2e-3, "log_scales": 1e-3} if isinstance(form, CompressedPLY) else {}
    for name in ("means", "log_scales", "opacity_logits", "sh0", "sh_rest"):
        assert found[name] <= steps.get(name, 0) + 1e-5, name


def test_thin_ellipsoids_are_surfels_only_if_all_are(tmp_path):
    splats = table("surfel", count=50, degree=0)
    thick = replace(splats, kind="gaussian", log_scales=splats.ellipsoid_log_scales().clone())
    for form in (Splat(), SPZ(), PLY()):
        found = there_and_back(form, thick, tmp_path)
        assert found.kind == "surfel", "each third scale is a thousandth of the smaller one"
        thicker = thick.log_scales.clone()
        thicker[7, 2] += 0.5
        assert there_and_back(form, replace(thick, log_scales=thicker), tmp_path).kind == "gaussian"
        (tmp_path / f"model{form.suffix}").unlink()


def test_the_third_scale_is_thin_in_every_format(tmp_path):
    """As a program that knows ellipsoids alone reads it."""
    splats = table("surfel", count=40, degree=0)
    expected = splats.log_scales.amin(1) + math.log(THINNESS)
    assert torch.equal(splats.ellipsoid_log_scales()[:, 2], expected)
    Splat().write(tmp_path / "a.splat", splats)
    rows = np.frombuffer((tmp_path / "a.splat").read_bytes(), np.float32).reshape(-1, 8)
    np.testing.assert_allclose(np.sort(np.log(rows[:, 5])), np.sort(expected), rtol=1e-5)


def test_half_a_turn_is_one_of_the_whole_scene(tmp_path):
    """The stored splats are those of a scene that is turned by 180 degrees about x."""
    splats = table(count=60, degree=3)
    SPZ(axes="rub", sh1_bits=8, sh_rest_bits=8).write(tmp_path / "a.spz", splats)
    stored = SPZ(axes="same").read(tmp_path / "a.spz")
    turn = torch.diag(torch.tensor([1.0, -1, -1], dtype=torch.float64))
    back = replace(stored, means=(stored.means.double() @ turn).float())
    assert differences(splats, replace(back, quats=splats.quats, sh_rest=splats.sh_rest))["means"] < 2e-3
    stored = stored.take(torch.cdist(splats.means, back.means).argmin(1))

    def shape(axes, scales):
        return axes @ torch.diag_embed((2 * scales.double()).exp()) @ axes.transpose(1, 2)

    expected = turn @ shape(turned(splats.quats), stored.log_scales) @ turn
    found = shape(turned(stored.quats), stored.log_scales)
    assert float(((found - expected).norm(dim=(1, 2)) / expected.norm(dim=(1, 2))).max()) < 0.05

    way = torch.nn.functional.normalize(torch.randn(60, 3, generator=torch.Generator().manual_seed(1)), dim=1).double()
    seen, turned_way = (harmonics(way) * splats.sh_rest).sum(1), way @ turn
    assert float((seen - (harmonics(turned_way) * stored.sh_rest).sum(1)).abs().max()) < 0.15


def harmonics(way):
    """(N, 15, 1) values of degrees 1 to 3, up to factors, with the signs and the order of 3DGS."""
    x, y, z = way.unbind(1)
    first = [-y, z, -x, x * y, -y * z, 2 * z * z - x * x - y * y, -x * z, x * x - y * y]
    third = [-y * (3 * x * x - y * y), x * y * z, -y * (4 * z * z - x * x - y * y)]
    third += [z * (2 * z * z - 3 * x * x - 3 * y * y), -x * (4 * z * z - x * x - y * y)]
    third += [z * (x * x - y * y), -x * (x * x - 3 * y * y)]
    return torch.stack(first + third, 1)[:, :, None]


def test_spz_of_large_scenes(tmp_path):
    far = table(count=50, degree=0, means=3e5 * torch.rand(50, 3))
    with collect_notes() as notes:
        there_and_back(SPZ(), far, tmp_path)
    assert "positions are 0.0625 apart" in notes.texts[0] and "x the median scale" in notes.texts[0]
    with pytest.raises(BadInput, match="24 bits with 8 .*; at most 4"):
        SPZ(fractional_bits=8).write(tmp_path / "b.spz", far)
    beyond = replace(far, means=far.means * 1e3)
    with pytest.raises(BadInput, match="towards 0, or .*another format"):
        SPZ().write(tmp_path / "b.spz", beyond)


def test_formats_are_known_by_what_they_hold(tmp_path):
    splats = table(count=20, degree=1)
    for name, cls in components(Format).items():
        if not cls.suffix or cls.read is Format.read:
            continue
        path = tmp_path / f"{name}{cls.suffix}"
        cls().write(path, splats)
        assert type(format_of(path)) is type(format_for(path)) is cls
        assert len(read_splat_file(path)) == 20
        if cls is not Splat:  # which has nothing but its name
            for ending in (".dat", ".splat"):
                path = path.rename(tmp_path / f"{name}{ending}")
                assert type(format_of(path)) is cls
    with pytest.raises(BadInput, match=r"suffix; known: .*sog \(\.sog\)"):
        format_for(tmp_path / "a.xyz")
    with pytest.raises(BadInput, match="no file of splats"):
        format_of(tmp_path)


def test_infinities_of_other_programs(tmp_path):
    """Some write the logits of opacities 0 and 1, and scales of 0, as infinite values."""
    splats = table(count=5, degree=0)
    splats.opacity_logits[1], splats.opacity_logits[2], splats.log_scales[3, 2] = math.inf, -math.inf, -math.inf
    write_splats(tmp_path / "a.ply", splats)
    found = PLY().read(tmp_path / "a.ply")
    assert found.opacity_logits[1].sigmoid() == 1 and found.opacity_logits[2].sigmoid() < 1e-7
    assert found.log_scales[3, 2] == pytest.approx(float(splats.log_scales[3, :2].min()) + math.log(THINNESS))


def test_sog_outside_of_an_archive(tmp_path):
    folder = unpacked_sog(tmp_path)
    assert same(read_splat_file(folder / "meta.json"), read_splat_file(tmp_path / "a.sog"))
    (folder / "inner").mkdir()
    (folder / "quats.webp").rename(folder / "inner" / "kept.webp")
    (folder / "quats.webp").symlink_to("inner/kept.webp")
    (tmp_path / "link").symlink_to(folder)
    for where in (folder, tmp_path / "link"):
        assert same(read_splat_file(where / "meta.json"), read_splat_file(tmp_path / "a.sog"))


def unpacked_sog(folder):
    SOG().write(folder / "a.sog", table(count=30, degree=1))
    zipfile.ZipFile(folder / "a.sog").extractall(folder / "there")
    return folder / "there"


@pytest.mark.parametrize("name", ["meta.json", "means_l.webp", "shN_labels.webp"])
def test_members_of_an_unpacked_sog_are_regular_files_of_the_folder_and_bounded(tmp_path, name):
    folder = unpacked_sog(tmp_path)
    member, kept = folder / name, tmp_path / "kept"
    member.rename(kept)

    def refused(text):
        with pytest.raises(BadInput, match=text) as error:
            SOG().read(folder / "meta.json")
        assert str(error.value).count("\n") == 0
        member.unlink()

    os.mkfifo(member)
    refused(f"{name} is no regular file")
    member.symlink_to(kept)
    refused(f"{name} is a link out of the folder")
    member.symlink_to("/dev/zero")
    refused(f"{name} is a link out of the folder")
    member.symlink_to(name)
    refused("cannot be read|damaged: Symlink loop")  # by the version of Python
    shutil.copy(kept, member)
    os.truncate(member, 1 << 40)  # a hole, which takes no place on disk
    refused(f"{name} has 1,099,511,627,776 bytes, more than it can be of use")


def test_a_pipe_is_no_file_of_splats(tmp_path):
    for name in ("meta.json", "a.ply"):
        os.mkfifo(tmp_path / name)
        with pytest.raises(BadInput, match="neither a file nor a folder"):
            read_splat_file(tmp_path / name)


def test_versions_of_before_colours_had_bounds(tmp_path):
    """Older compressed PLY files have bounds of positions and scales only."""
    CompressedPLY().write(tmp_path / "a.compressed.ply", table(count=3, degree=0))
    raw = (tmp_path / "a.compressed.ply").read_bytes()
    head, body = raw.split(b"end_header\n", 1)
    lines = [line for line in head.split(b"\n") if not re.search(rb" (min|max)_[rgb]$", line)]
    (tmp_path / "a.compressed.ply").write_bytes(b"\n".join(lines) + b"end_header\n" + body[:48] + body[72:])
    words = np.frombuffer(body[72:], np.uint32).reshape(3, 4)[:, 3]
    found = CompressedPLY().read(tmp_path / "a.compressed.ply")
    np.testing.assert_allclose(found.sh0[:, 0] * 0.28209479 + 0.5, (words >> 24) / 255, atol=1e-6)


def test_read_splats_is_as_exact_as_before(tmp_path):
    splats = table(count=30)
    PLY().write(tmp_path / "a.ply", splats)
    assert same(read_splats(tmp_path / "a.ply"), splats)


def test_the_median_scale_of_an_even_number_is_between_two():
    few = table(count=1, log_scales=torch.tensor([[0.0, 2.0, -9.0]]))
    assert few.median_scale() == pytest.approx(math.exp(1.0))
