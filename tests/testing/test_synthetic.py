"""The analytic scene: its maps agree with its surfaces, with each other and with its points."""

import numpy as np
import pytest
import torch

from surfkit.scene.photos import read_photo
from surfkit.testing.synthetic import SURFACES, Flight, photograph, write_colmap


@pytest.fixture(scope="module", params=["orbit", "grid"])
def made(request):
    return photograph(Flight(kind=request.param, views=4, width=32, height=24, points=200))


def lifted(made, view):
    """(H, W, 3) positions in metres of the pixels, from the exact depth."""
    eye = (view.camera.rays(torch.float64) * made.exact[view.name].depth).flatten(1)
    pose = view.camera.world_to_camera
    local = pose[:3, :3].T @ (eye - pose[:3, 3:])
    return made.scene.frame.to_input(local.T.numpy()).reshape(view.camera.height, view.camera.width, 3)


def views(made):
    return [*made.scene.train, *made.scene.held_out]


def test_depth_ends_on_a_surface(made):
    for view in views(made):
        points = lifted(made, view).reshape(-1, 3)
        assert np.min([surface.distance(points) for surface in SURFACES], axis=0).max() < 1e-9
        assert (points[:, 2] > -1e-9).all()


def test_all_surfaces_are_seen(made):
    points = np.concatenate([lifted(made, view).reshape(-1, 3) for view in views(made)])
    nearest = np.argmin([surface.distance(points) for surface in SURFACES], axis=0)
    assert (np.bincount(nearest, minlength=3) > 50).all()


def test_nothing_lies_in_front_of_what_is_seen(made):
    """Points along the way to a pixel are outside of the box and the sphere."""
    _, box, sphere = SURFACES
    for view in views(made):
        centre = made.scene.frame.to_input(view.camera.centre.numpy())
        for share in np.linspace(0.3, 0.999, 40):
            points = (centre + share * (lifted(made, view) - centre)).reshape(-1, 3)
            assert (points[:, 2] > 0).all()
            assert not ((points > box.low) & (points < box.high)).all(1).any()
            assert (np.linalg.norm(points - sphere.centre, axis=1) > sphere.radius).all()


def test_normals_are_those_of_the_depth(made):
    """Of neighbouring points; exact on the flat surfaces, so the median agrees."""
    for view in views(made):
        normal = made.exact[view.name].normal
        torch.testing.assert_close(normal.norm(dim=0), torch.ones_like(normal[0]))
        assert ((view.camera.rays(torch.float64) * normal).sum(0) < 0).all()
        points = lifted(made, view)
        across = np.cross(points[1:, :-1] - points[:-1, :-1], points[:-1, 1:] - points[:-1, :-1])
        across /= np.linalg.norm(across, axis=-1, keepdims=True)
        world = np.einsum("ij,ihw->hwj", view.camera.world_to_camera[:3, :3].numpy(), normal.numpy())[:-1, :-1]
        assert np.median((across * world).sum(-1)) > 1 - 1e-9


def test_points_lie_on_the_surface_and_have_its_colour(made):
    cloud, frame = made.scene.cloud, made.scene.frame
    points = frame.to_input(cloud.xyz.numpy())
    assert len(points) == 200 and cloud.rgb.dtype == torch.uint8
    assert np.min([surface.distance(points) for surface in SURFACES], axis=0).max() < 1e-5


def test_colours_agree_between_views():
    """What is seen from two places has one colour: project the pixels of one view into another."""
    made = photograph(Flight(views=12, width=64, height=48))
    one, other = made.scene.train[0], made.scene.train[1]
    points = made.scene.frame.to_local(lifted(made, one).reshape(-1, 3))
    pose = other.camera.world_to_camera.numpy()
    eye = points @ pose[:3, :3].T + pose[:3, 3]
    x = np.floor(eye[:, 0] / eye[:, 2] * other.camera.fx + other.camera.cx).astype(int)
    y = np.floor(eye[:, 1] / eye[:, 2] * other.camera.fy + other.camera.cy).astype(int)
    inside = (x >= 0) & (x < 64) & (y >= 0) & (y < 48)
    exact = made.exact[other.name]
    seen = np.abs(exact.depth.numpy()[y[inside], x[inside]] - eye[inside, 2]) < 0.01
    assert seen.mean() > 0.5
    a = made.exact[one.name].color.flatten(1).numpy()[:, inside][:, seen]
    b = exact.color.numpy()[:, y[inside], x[inside]][:, seen]
    assert np.abs(a - b).mean() < 0.03 < np.abs(a - b[:, ::-1]).mean()


def test_the_seed_decides_everything():
    flight = Flight(kind="grid", views=3, width=16, height=12, points=20)
    one, again = photograph(flight), photograph(flight)
    other = photograph(Flight(kind="grid", views=3, width=16, height=12, points=20, seed=1))
    assert torch.equal(one.scene.cloud.xyz, again.scene.cloud.xyz)
    for name, exact in one.exact.items():
        assert torch.equal(exact.color, again.exact[name].color) and 0 <= exact.color.min() <= exact.color.max() <= 1
        assert not torch.equal(exact.color, other.exact[name].color)


def test_the_files_hold_the_exact_colours(made, tmp_path):
    write_colmap(tmp_path, made)
    name = made.scene.held_out[0].name
    pixels = read_photo(tmp_path / "images" / name, (32, 24)).double() / 255
    assert (pixels - made.exact[name].color).abs().max() <= 0.5 / 255 + 1e-9
