"""The doctor says of the values of photographs what training says, and looks at them as training does."""

import shutil
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from surfkit.apps.doctor.examine import examine
from surfkit.cli.recipes import recipes
from surfkit.io.datasets.data import Data
from surfkit.io.datasets.read import read
from surfkit.runs.run_notes import collect_notes
from surfkit.scene import large_photos as large
from surfkit.testing.synthetic import Flight, photograph, write_colmap


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    folder = tmp_path_factory.mktemp("made") / "farm"
    write_colmap(folder, photograph(Flight(kind="grid", views=6, width=64, height=48, points=300)))
    return folder


@pytest.fixture
def farm(made, tmp_path):
    return Path(shutil.copytree(made, tmp_path / "farm"))


def rewrite(farm, change):
    for path in sorted((farm / "images").iterdir()):
        Image.fromarray(change(np.asarray(Image.open(path).convert("RGB")))).save(path)


def clear(rgb):
    alpha = np.full(rgb.shape[:2], 255, np.uint8)
    alpha[:12] = 0
    return np.dstack([rgb, alpha])


def diagnosed(farm, quick=False, **settings):
    return examine(Data(farm, test_every=0, **settings), recipes()["2dgs"], quick).diagnosis


@pytest.mark.parametrize(
    "change, settings, words",
    [
        (lambda rgb: rgb[..., 1].astype(np.uint16) * 16, {}, "4,095 is taken for white"),
        (clear, {}, "6 of 6 photographs have transparent pixels"),
        (clear, {"alpha": "mask"}, "what is transparent is ignored in 6 of 6"),
    ],
)
def test_what_training_says(farm, change, settings, words):
    rewrite(farm, change)
    with collect_notes() as notes:
        read(Data(farm, test_every=0, **settings))
    (line,) = [text for text in notes.texts if words in text]
    found = diagnosed(farm, **settings)
    assert line in [finding.text for finding in found.findings] and found.sound
    assert not [finding for finding in found.findings if finding.what in ("blank-photographs", "inverted-masks")]
    assert ("ignore what is transparent in 6 photographs" in found.will) == ("alpha" in settings)
    assert line not in [finding.text for finding in diagnosed(farm, quick=True, **settings).findings]


def test_dark_twelve_bits_are_not_blank(farm):
    rewrite(farm, lambda rgb: (rgb[..., 1] // 4 + 100).astype(np.uint16))
    assert not [finding for finding in diagnosed(farm).findings if finding.what == "blank-photographs"]


def test_masks_with_an_alpha_channel_are_told(farm):
    alpha = np.full((48, 64), 255, np.uint8)
    alpha[:24] = 0
    (farm / "masks").mkdir()
    for path in (farm / "images").iterdir():
        Image.fromarray(np.dstack([np.zeros((48, 64, 3), np.uint8), alpha])).save(farm / "masks" / path.name)
    found = diagnosed(farm)
    said = "what is transparent in their masks is ignored in 6 of 6 photographs: these masks have an alpha channel"
    assert [text for text in (each.text for each in found.findings) if text.startswith(said)]
    assert any("transparent in the masks of 6" in text for text in found.will)
    assert not [finding for finding in found.findings if finding.what == "inverted-masks"]


def test_photographs_that_are_too_large_are_told_before_training(farm, monkeypatch):
    monkeypatch.setattr(large, "MAX_UNCHECKED_PIXELS", 1000)
    monkeypatch.setattr(large, "free_bytes", lambda: 10_000)
    for quick in (False, True):
        found = diagnosed(farm, quick)
        assert not found.sound and any("SURFKIT_MAX_MEGAPIXELS" in finding.text for finding in found.findings)
