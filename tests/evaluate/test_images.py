"""Image metrics on images whose answer is known."""

import json
import math

import pytest
import torch

from surfkit.core.check import BadInput
from surfkit.evaluate.images import measure_images as measure
from surfkit.evaluate.images.measure_images import evaluate_views, frames_per_second
from surfkit.raster.api import Maps
from surfkit.raster.psnr import psnr
from surfkit.testing.synthetic import Flight, photograph

SYNTHETIC = photograph(Flight(views=5, width=32, height=24, points=20))
VIEWS = (*SYNTHETIC.scene.train, *SYNTHETIC.scene.held_out)
PHOTOS = [(SYNTHETIC.exact[view.name].color * 255).round().to(torch.uint8) for view in VIEWS]


def drawn(view):
    return Maps(color=SYNTHETIC.exact[view.name].color.float() + 0.1)


def test_psnr_of_a_known_error():
    photo = torch.full((3, 4, 5), 0.5)
    assert psnr(photo + 0.1, photo) == pytest.approx(20, abs=1e-4)
    assert psnr(photo + 7, photo) == pytest.approx(-20 * math.log10(0.5), abs=1e-4)  # clamped to 1
    assert psnr(photo, photo) == pytest.approx(100)


def test_every_view_and_the_means():
    shown = []
    result = evaluate_views(VIEWS, PHOTOS, drawn, show=lambda view, photo, maps: shown.append((view.name, photo.dtype)))
    images = result["images"]
    assert list(images["per_image"]) == [view.name for view in VIEWS] == [name for name, _ in shown]
    for view, photo in zip(VIEWS, PHOTOS, strict=True):
        expected = psnr(drawn(view).color, photo / 255)
        assert images["per_image"][view.name]["psnr"] == pytest.approx(expected, abs=1e-4)
        assert 0.2 < images["per_image"][view.name]["ssim"] < 1
    assert images["psnr"] == pytest.approx(sum(v["psnr"] for v in images["per_image"].values()) / 5)
    assert 19 < images["psnr"] < 21 and result["fps"] > 0
    json.dumps(result, allow_nan=False)


def test_a_photograph_or_mask_that_cannot_be_read_is_passed_over(monkeypatch):
    class Files(list):
        def __getitem__(self, at):
            if at == self.damaged:
                raise BadInput(f"{at}: not a whole picture")
            return super().__getitem__(at)

    skipped = []
    monkeypatch.setattr(measure, "emit", skipped.append)
    photos, masks = Files(PHOTOS), Files([torch.ones(24, 32, dtype=torch.bool)] * 5)
    photos.damaged, masks.damaged = 1, 3
    images = evaluate_views(VIEWS, photos, drawn, masks=masks)["images"]
    assert list(images["per_image"]) == [VIEWS[at].name for at in (0, 2, 4)]
    assert [(event.name, event.reason) for event in skipped] == [
        (VIEWS[at].name, f"{at}: not a whole picture") for at in (1, 3)
    ]


def test_the_right_photograph_scores_highest():
    aligned = evaluate_views(VIEWS, PHOTOS, drawn)["images"]
    shifted = evaluate_views(VIEWS, PHOTOS[1:] + PHOTOS[:1], drawn)["images"]
    assert aligned["psnr"] > shifted["psnr"] + 1 and aligned["ssim"] > shifted["ssim"] + 0.1


def test_perfect_renders():
    exact = evaluate_views(VIEWS, PHOTOS, lambda view: Maps(color=PHOTOS[VIEWS.index(view)] / 255))["images"]
    assert exact["psnr"] == pytest.approx(100) and exact["ssim"] == pytest.approx(1, abs=1e-5)


def test_without_views_there_are_no_numbers():
    names = ("psnr", "ssim", "psnr_aligned", "ssim_aligned")
    assert evaluate_views([], [], drawn) == {"images": {**dict.fromkeys(names), "per_image": {}}, "fps": None}


def test_speed_counts_after_the_warmup():
    calls = []
    assert frames_per_second(VIEWS, lambda view: calls.append(view.name) or drawn(view), warmup=2, most=3) > 0
    assert len(calls) == 2 + 3 and len(set(calls[2:])) == 3
