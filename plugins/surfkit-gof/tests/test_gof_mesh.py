"""The mesher on balls whose surface is known, its treatment of places that no view sees, and its contract."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from surfkit_gof.mesher import OpacityField

from surfkit.mesh.opacity_surface import in_view
from surfkit.plugin import BadInput
from surfkit.testing import check, check_mesher
from surfkit.testing.inputs import BALL_RADIUS, mesh_input


def volume(mesh) -> float:
    a, b, c = (mesh.vertices[mesh.faces[:, k]].astype(np.float64) for k in range(3))
    return float(np.einsum("ni,ni->n", a, np.cross(b, c)).sum() / 6)


def is_closed(faces) -> bool:
    directed = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    there = {tuple(edge) for edge in directed}
    return len(there) == len(directed) and all((b, a) in there for a, b in there)


def above_half(given):
    """The same ball, seen only from cameras in the upper half space, near the pole."""
    views = [view for view in given.views if float(view.camera.centre[2]) > 1.5]
    assert 2 <= len(views) < len(given.views)
    return replace(given, views=tuple(views))


def test_a_ball_of_ellipsoids_becomes_a_closed_ball():
    mesh = OpacityField(longest=0).mesh(mesh_input("gaussian", count=600, views=12))
    assert is_closed(mesh.faces)
    radius = np.linalg.norm(mesh.vertices, axis=1)
    assert np.abs(radius - BALL_RADIUS).max() < 0.03 and np.abs(radius - BALL_RADIUS).mean() < 0.006
    assert volume(mesh) == pytest.approx(4 / 3 * np.pi * BALL_RADIUS**3, rel=0.06)
    assert mesh.facts == {"points": 9 * 600, "unseen_points": 0}


def test_it_keeps_to_the_contract():
    check(OpacityField(bisections=3))
    check_mesher(OpacityField(bisections=3), mesh_input("gaussian", count=600, views=8))


def test_a_higher_level_lies_deeper():
    given = mesh_input("gaussian", count=600, views=8)
    outer, inner = (volume(OpacityField(level=level, longest=0).mesh(given)) for level in (0.2, 0.9))
    assert 0 < inner < outer


def test_unseen_places_are_unknown_or_inside():
    given = above_half(mesh_input("gaussian", count=500, views=14))
    draw = torch.Generator().manual_seed(0)
    dust = given.splats.first(200)  # faint splats in the open, in view and out of view
    dust = replace(dust, means=2.4 * torch.rand(200, 3, generator=draw) - 1.2, opacities=torch.full((200,), 0.06))
    given = replace(given, splats=given.splats.and_then(dust))
    views = len(given.views)
    unknown, shell = (OpacityField(min_views=views, unseen=u, longest=0).mesh(given) for u in ("unknown", "inside"))
    assert unknown.facts["unseen_points"] == shell.facts["unseen_points"] > 100

    def in_the_open(mesh) -> int:
        """Vertices away from the ball, and so high that it hides nothing there."""
        return int(((mesh.vertices[:, 2] > 0.2) & (np.linalg.norm(mesh.vertices, axis=1) > BALL_RADIUS + 0.05)).sum())

    assert in_the_open(unknown) == 0
    assert in_the_open(shell) > 50, "its shell runs along the border of what is seen"


def test_splats_out_of_view_give_no_points():
    given = mesh_input("gaussian", count=300, views=6)
    far = replace(given.splats, means=given.splats.means + 100)
    both = replace(given, splats=given.splats.and_then(far))
    assert len(in_view(both).splats) == 300
    with pytest.raises(BadInput, match="300 splats .* 6 views"):
        OpacityField().mesh(replace(given, splats=far))


@pytest.mark.parametrize(
    ("wrong", "told"),
    [({"level": 1.0}, "level is 1.0"), ({"reach": 0.0}, "reach is 0.0"), ({"min_views": 0}, "min-views 0")],
)
def test_settings_that_cannot_be_are_refused(wrong, told):
    with pytest.raises(BadInput, match=told):
        OpacityField(**wrong)


def test_all_is_drawn_from_the_generator():
    given = mesh_input("gaussian", count=600, views=6)
    one, two = (
        OpacityField(bisections=2).mesh(replace(given, generator=torch.Generator().manual_seed(3))) for _ in range(2)
    )
    assert np.array_equal(one.vertices, two.vertices) and np.array_equal(one.faces, two.faces)
