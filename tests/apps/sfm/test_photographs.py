"""What is found out about each photograph before any is compared."""

import os
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image, ImageFilter

from surfkit.apps.sfm import inspect_photos as photographs
from surfkit.apps.sfm.inspect_photos import Photo, blurred_below, lens_groups, look
from surfkit.core.check import BadInput
from surfkit.runs.run_notes import collect_notes

from .pictures import arc, picture, save


@pytest.fixture
def folder(tmp_path):
    first, second = (picture(pose) for pose in arc(2))
    save(tmp_path / "a.jpg", first)
    save(tmp_path / "deep er/b.JPG", second)
    Image.fromarray(second).filter(ImageFilter.GaussianBlur(6)).save(tmp_path / "c.png")
    (tmp_path / "d.jpg").write_bytes((tmp_path / "a.jpg").read_bytes())
    Image.new("RGB", (240, 180), (2, 2, 2)).save(tmp_path / "e.jpg")
    Image.new("RGB", (240, 180), (90, 90, 90)).save(tmp_path / "f.png")
    (tmp_path / "g.jpg").write_bytes((tmp_path / "a.jpg").read_bytes()[:3000])
    save(tmp_path / ".thumbs/a.jpg", first)
    (tmp_path / "h.dng").write_bytes(b"raw")
    (tmp_path / "notes.txt").write_text("x")
    return tmp_path


def test_what_each_photograph_is(folder, capsys):
    with collect_notes():
        found = {photo.name: photo for photo in look(folder)}
    assert "1 files cannot be read: 'h.dng'" in capsys.readouterr().err
    assert list(found) == ["a.jpg", "c.png", "d.jpg", "deep er/b.JPG", "e.jpg", "f.png", "g.jpg"]
    wrong = {name: photo.problem for name, photo in found.items() if not photo.usable}
    assert wrong.pop("g.jpg") and wrong == {"d.jpg": "a copy of a.jpg", "e.jpg": "black", "f.png": "of one colour"}
    least = blurred_below(list(found.values()))
    assert [name for name, photo in found.items() if photo.usable and photo.sharpness < least] == ["c.png"]
    assert found["a.jpg"].size == (240, 180)


def test_what_is_known_is_not_looked_at_again(folder, monkeypatch):
    before = look(folder)
    save(folder / "a.jpg", picture(arc(3)[2]))
    os.utime(folder / "a.jpg", ns=(1, 1))
    seen, plain = [], photographs._look
    monkeypatch.setattr(photographs, "_look", lambda path, photo: seen.append(photo.name) or plain(path, photo))
    after = {photo.name: photo for photo in look(folder, before)}
    assert seen == ["a.jpg"]
    assert after["d.jpg"].usable, "it was a copy of what is another photograph now"
    assert after["c.png"] == before[1]


def test_what_an_earlier_edition_found_is_looked_at_again(folder):
    (first, *_) = look(folder)
    old = replace(first, edition=first.edition - 1, exif=photographs.Exif(camera="of before"))
    assert look(folder, [replace(old, edition=first.edition)])[0].exif.camera == "of before"
    assert look(folder, [old])[0] == first


def test_lenses_are_shared_by_camera_size_and_focal_length():
    def photo(camera=None, size=(40, 30), focal=None, serial=None):
        return Photo("x", (0, 0), size=size, exif=photographs.Exif(camera, serial=serial, focal_px=focal))

    given = [
        photo(),
        photo(size=(30, 40)),
        photo("A", focal=50.1),
        photo("A", focal=49.9),
        photo("A", focal=70.0),
        photo(),
        photo("A", focal=50.0, serial="17"),  # another of the same kind: two drones, or a rig
        photo("A", focal=50.0, serial="18"),
    ]
    assert lens_groups(given) == [0, 1, 2, 2, 3, 0, 4, 5]


def test_folders_behind_links_are_looked_into_once(folder, tmp_path_factory):
    flight = tmp_path_factory.mktemp("flight")
    save(flight / "x.jpg", picture(arc(4)[3]))
    save(folder / "@eaDir/a.jpg/SYNOPHOTO_THUMB_XL.jpg", picture(arc(5)[4]))
    (folder / "second").symlink_to(flight)
    (folder / "deep again").symlink_to(folder / "deep er")  # before the folder itself, by name
    (flight / "back").symlink_to(folder)
    (folder / "gone.jpg").symlink_to(flight / "no.jpg")
    found = {photo.name: photo for photo in look(folder)}
    assert len(found) == 9 and found["second/x.jpg"].usable and "deep er/b.JPG" in found
    assert "leads nowhere" in found["gone.jpg"].problem


def test_a_name_that_is_no_text_is_left_out(folder):
    os.rename(os.path.join(os.fsencode(folder), b"a.jpg"), os.path.join(os.fsencode(folder), b"a\xfc.jpg"))
    found = {photo.name: photo for photo in look(folder)}
    assert "not UTF-8" in found["a\udcfc.jpg"].problem and found["d.jpg"].usable


def test_folders_without_photographs(tmp_path):
    with pytest.raises(BadInput, match="no such folder"):
        look(tmp_path / "x")
    (tmp_path / "a.txt").write_text("")
    with pytest.raises(BadInput, match="no photographs"):
        look(tmp_path)
    with pytest.raises(BadInput, match="a file"):
        look(tmp_path / "a.txt")


def test_twelve_bits_are_stretched_for_the_whole_folder(tmp_path):
    """Nearly black as they are stored; one exposure for all, and what another photograph changes is looked at again."""
    for name, pose in zip("ab", arc(2), strict=True):
        grey = picture(pose)[..., 1]
        Image.fromarray(grey.astype(np.uint16) * 4).save(tmp_path / f"{name}.tif")
    with collect_notes() as notes:
        before = look(tmp_path)
    assert all(photo.usable for photo in before) and any("1,023 is taken for white" in text for text in notes.texts)
    assert before[0].light == pytest.approx(picture(arc(2)[0])[..., 1].mean(), abs=2)
    Image.fromarray(picture(arc(3)[2])[..., 1].astype(np.uint16) * 16).save(tmp_path / "c.tif")
    after = look(tmp_path, before)
    assert after[0].light == pytest.approx(before[0].light / 4, abs=1) and after[0].digest != before[0].digest
    assert look(tmp_path, after) == after


@pytest.mark.parametrize("kind", ["equirectangular", "cylindrical"])
def test_panoramas_are_told_and_left_out(folder, kind):
    """The packet is as Google's specification of GPano has it; a photograph of a lens may have one, too."""
    for name, said in (("a.jpg", kind), ("b.jpg", "perspective")):
        packet = f'<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:Description GPano:ProjectionType="{said}"/></x:xmpmeta>'
        Image.fromarray(picture(arc(8)[ord(name[0]) - 92])).save(folder / name, xmp=packet.encode())
    with collect_notes() as notes:
        found = {photo.name: photo for photo in look(folder)}
    assert found["a.jpg"].problem == f"a panorama ({kind})" and found["b.jpg"].usable
    assert any("1 of 8 photographs are panoramas by their XMP, 'a.jpg'" in text for text in notes.texts)
