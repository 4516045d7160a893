"""What no rasterizer draws is refused with one line that says where and what."""

from dataclasses import replace

import pytest
import torch

from surfkit.core.check import BadInput
from surfkit.raster.reference import Reference
from surfkit.raster.validate import validate

from .scenes import NEAR, PRIMITIVE_KINDS, make

NAN, INF = float("nan"), float("inf")


def spoilt(kind: str, name: str, row: int, value: float):
    """A scene with one row of one tensor set to a value."""
    shown, view = make("plain", kind, 1)
    tensor = getattr(shown, name).clone()
    tensor[row] = value
    return replace(shown, **{name: tensor}), view


@pytest.mark.parametrize("kind", PRIMITIVE_KINDS)
@pytest.mark.parametrize(
    ("name", "value", "words"),
    [
        ("scales", NAN, "not finite"),
        ("scales", -0.1, "not positive"),
        ("scales", 0.0, "not positive"),
        ("quats", 0.0, "zero, which is no rotation"),
        ("quats", NAN, "not finite"),
        ("means", INF, "not finite"),
        ("opacities", NAN, "not finite"),
        ("sh0", INF, "not finite"),
        ("sh_rest", INF, "not finite"),
    ],
)
def test_bad_values_are_named_with_their_row(kind, name, value, words):
    shown, view = spoilt(kind, name, 7, value)
    with pytest.raises(BadInput, match=f"splats.{name}: 1 of 70 .*{words}.*row 7"):
        validate(shown)
    with pytest.raises(BadInput, match=f"splats.{name}"):
        Reference().render(shown, view, NEAR)


@pytest.mark.parametrize(
    ("name", "shape", "wanted"),
    [
        ("means", (70, 2), r"\(70, 3\)"),
        ("quats", (70, 3), r"\(70, 4\)"),
        ("quats", (69, 4), r"\(70, 4\)"),
        ("scales", (70, 3), r"\(70, 2\)"),
        ("opacities", (70, 1), r"\(70,\)"),
        ("sh0", (70, 3), r"\(70, 1, 3\)"),
        ("sh_rest", (70, 4, 3), r"\(70, 0, 3, 8 or 15, 3\)"),
        ("sh_rest", (70, 3), r"\(70, 0, 3, 8 or 15, 3\)"),
    ],
)
def test_wrong_shapes_are_named(name, shape, wanted):
    shown, _ = make("plain", "surfel")
    with pytest.raises(BadInput, match=rf"splats\.{name}: shape .*{wanted}"):
        validate(replace(shown, **{name: torch.ones(shape)}), values=False)


def test_scales_fit_the_kind():
    shown, _ = make("plain", "gaussian")
    validate(shown)
    with pytest.raises(BadInput, match=r"splats\.scales: shape \(70, 2\); .*\(70, 3\)"):
        validate(replace(shown, scales=shown.scales[:, :2]))


@pytest.mark.parametrize(
    ("kind", "change", "words"),
    [
        (
            "gaussian",
            {"geometry": "disc"},
            "splats.geometry: 'disc' .*'gaussian'; .*axis, plane, ray",
        ),
        ("surfel", {"geometry": "ray"}, "surfels only axis"),
        ("gaussian", {"geometry": "ray", "antialias": True}, "splats.antialias: gaussians of geometry 'ray'"),
    ],
)
def test_a_geometry_that_a_kind_does_not_have_is_refused(kind, change, words):
    with pytest.raises(BadInput, match=words):
        validate(replace(make("plain", kind)[0], **change))
