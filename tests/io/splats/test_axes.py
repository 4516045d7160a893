"""Axes of files of splats: a marked splat and an oblique ellipsoid come out where the letters of the axes say."""

import gzip
import struct
from dataclasses import replace

import numpy as np
import pytest
import torch
import zstandard

from surfkit.core.check import BadInput
from surfkit.io.splats.file_axes import AXES_NAMES, turn_between
from surfkit.io.splats.gltf import GLTF
from surfkit.io.splats.rotate_splats import basis
from surfkit.io.splats.splat_files import from_axes, read_splat_file
from surfkit.io.splats.spz import SPZ
from surfkit.runs.run_notes import collect_notes
from surfkit.testing.format_checks import splat_table

from .models import differences, turned
from .test_gltf import foreign, glb

POINTS_AT = {"r": (0, 1), "l": (0, -1), "d": (1, 1), "u": (1, -1), "f": (2, 1), "b": (2, -1)}
"""By letter, which coordinate of right-down-forward it is, and its sign."""
NUMBERS = {"ldb": 1, "rub": 4, "rdf": 6, "luf": 7, "ruf": 8, "lfd": 9, "rfu": 12, "lbd": 13, "rbu": 16}
"""Of CoordinateSystem in splat-types.h of nianticlabs/spz."""


def expected(xyz, axes):
    """What xyz along some axes is along right, down and forward."""
    found = np.zeros_like(np.asarray(xyz, float))
    for column, letter in enumerate(axes):
        place, sign = POINTS_AT[letter]
        found[..., place] = sign * np.asarray(xyz)[..., column]
    return found


def spz_of(version, records=b"", flags=2, degree=0, at=(1.0, 2.0, 3.0)):
    """The bytes of a file with one splat, by the README of nianticlabs/spz."""
    streams = [b"".join(int(value * 4096).to_bytes(3, "little", signed=True) for value in at)]
    streams += [bytes([200]), bytes([128] * 3), bytes([112] * 3), struct.pack("<I", 3 << 30)]
    streams += [bytes(range(60, 60 + 3 * ((degree + 1) ** 2 - 1)))] if degree else []
    head = struct.pack("<4sIIBBBB", b"NGSP", version, 1, degree, 12, flags, 0)
    if version < 4:
        return gzip.compress(head + b"".join(streams) + records)
    packed = [zstandard.compress(stream) for stream in streams]
    table = b"".join(struct.pack("<QQ", len(small), len(large)) for small, large in zip(packed, streams, strict=True))
    head = head[:15] + struct.pack("<BI12x", len(streams), 32 + len(records))
    return head + records + table + b"".join(packed)


def record(number, kind=0xADBE0003):
    return struct.pack("<III", kind, 4, number)


def test_names_have_the_numbers_of_spz():
    assert {name: AXES_NAMES.index(name) + 1 for name in NUMBERS} == NUMBERS and len(AXES_NAMES) == 16


@pytest.mark.parametrize("version", [3, 4])
@pytest.mark.parametrize("name", AXES_NAMES)
def test_a_record_of_axes_is_gone_by(tmp_path, name, version):
    other = struct.pack("<II12x", 0xADBE0002, 12)
    (tmp_path / "a.spz").write_bytes(spz_of(version, other + record(AXES_NAMES.index(name) + 1)))
    with collect_notes() as notes:
        table = read_splat_file(tmp_path / "a.spz")
    np.testing.assert_allclose(table.means[0], expected([1, 2, 3], name))
    assert (table.axes.name, table.axes.is_told, notes.texts) == (name, True, [])


@pytest.mark.parametrize(("records", "flags"), [(b"", 0), (record(6), 0), (record(0), 2), (record(6, 0xADBE0001), 2)])
def test_axes_that_are_not_named_are_told(tmp_path, records, flags):
    (tmp_path / "a.spz").write_bytes(spz_of(4, records, flags))
    with collect_notes() as notes:
        means = read_splat_file(tmp_path / "a.spz").means
        as_they_are = read_splat_file(tmp_path / "a.spz", "rdf").means
    assert means.tolist() == [[1, -2, -3]] and as_they_are.tolist() == [[1, 2, 3]]
    (note,) = notes.texts
    assert "rub (right-up-back) is assumed; --axes rdf" in note


def test_records_that_are_damaged_are_refused(tmp_path):
    for records, text in (
        (record(17), "number 17; 1 to 16"),
        (record(6)[:-1], "the record of its axes is cut off"),
        (struct.pack("<IIQ", 0xADBE0003, 8, 6), "the record of its axes is cut off"),
    ):
        (tmp_path / "a.spz").write_bytes(spz_of(4, records))
        with pytest.raises(BadInput, match=text):
            SPZ().read(tmp_path / "a.spz")


def test_degree_4_is_cut_and_told(tmp_path):
    (tmp_path / "a.spz").write_bytes(spz_of(4, record(6), degree=4))
    with collect_notes() as notes:
        table = read_splat_file(tmp_path / "a.spz")
    assert notes.texts == [f"{tmp_path / 'a.spz'}: spherical harmonics of degree 4 are cut to 3"]
    np.testing.assert_allclose(table.sh_rest[0].ravel(), (np.arange(60, 105) - 128) / 128)


def test_the_same_axes_are_named_in_version_4(tmp_path):
    splats = splat_table(count=50)
    SPZ(version=4, axes="same").write(tmp_path / "a.spz", splats)
    with collect_notes() as notes:
        assert differences(splats, read_splat_file(tmp_path / "a.spz"))["means"] < 2e-3
    assert notes.texts == []


@pytest.mark.parametrize("name", ["rub", "luf", "rfu", "ruf", "lbd"])
def test_splats_look_the_same_along_other_axes(name):
    """Positions, covariances and colours, the mirrored axes included, by matrices from the letters alone."""
    splats = splat_table(count=40, degree=3)
    splats = replace(splats, **{name: getattr(splats, name).double() for name in ("means", "quats", "log_scales")})
    matrix = np.stack([expected(axis, name) for axis in np.eye(3)], 1)
    np.testing.assert_array_equal(turn_between(name), matrix)
    found = from_axes(splats, name)
    np.testing.assert_array_equal(found.means, expected(splats.means.numpy(), name))

    def shapes(table):
        axes = turned(table.quats)
        return (axes @ torch.diag_embed((2 * table.log_scales).exp()) @ axes.transpose(1, 2)).numpy()

    np.testing.assert_allclose(shapes(found), matrix @ shapes(splats) @ matrix.T, rtol=1e-5, atol=1e-9)
    way = np.random.default_rng(0).normal(size=(30, 3))
    way /= np.linalg.norm(way, axis=1, keepdims=True)
    seen, before = (
        np.einsum("pk,nkc->npc", basis(towards, 3)[:, 1:], table.sh_rest.double())
        for towards, table in ((way @ matrix.T, found), (way, splats))
    )
    np.testing.assert_allclose(seen, before, atol=1e-6)


@pytest.mark.parametrize(("generator", "is_told"), [("splat-transform 3.7.0", True), ("Some program", False)])
def test_a_glb_of_another_program_is_turned_from_the_axes_of_gltf(tmp_path, generator, is_told):
    document, data = foreign(splat_table(count=20))
    document["asset"]["generator"] = generator
    with collect_notes() as notes:
        table = read_splat_file(glb(tmp_path / "a.glb", document, data))
    np.testing.assert_allclose(table.means, 2 * splat_table(count=20).means * torch.tensor([-1, -1, 1]), rtol=1e-6)
    assert ("luf (left-up-forward) is assumed" in " ".join(notes.texts)) is not is_told


def test_a_glb_of_surfkit_stays_and_takes_other_axes_where_they_are_given(tmp_path):
    splats = splat_table(count=20)
    GLTF().write(tmp_path / "a.glb", splats)
    assert torch.equal(read_splat_file(tmp_path / "a.glb").means, splats.means)
    assert torch.equal(read_splat_file(tmp_path / "a.glb", "rub").means, splats.means * torch.tensor([1, -1, -1]))
