"""Depth maps of meshes against rays, also of triangles that reach behind the camera."""

import numpy as np
import torch
from needs import needs

from surfkit.mesh.depths import mesh_depth
from surfkit.scene.camera import Camera

from .shapes import look_at, seen, sphere

trimesh = needs("trimesh")


def test_depth_of_a_ball():
    camera = look_at((1.2, -1.0, 0.8))
    ball = trimesh.creation.icosphere(5, radius=0.5)
    depth, (truth, _) = mesh_depth(np.asarray(ball.vertices), ball.faces, camera), seen(camera, sphere)
    both = (depth > 0) & (truth > 0)
    assert ((depth > 0) != (truth > 0)).mean() < 0.01 and np.abs(depth - truth)[both].max() < 0.02


def test_a_ground_of_two_triangles_under_a_camera_that_stands_on_it():
    """Every triangle reaches behind the camera; the depth below the horizon is that of the plane."""
    corners = np.array([[-50, 0, -50], [50, 0, -40], [45, 0, 60], [-55, 0, 50]], float) + [0, 1.5, 0]  # y is down
    camera = Camera(torch.eye(4, dtype=torch.float64), 60.0, 60.0, 48.0, 36.0, 96, 72)
    rows = np.arange(72) + 0.5
    for faces in ([[0, 1, 2], [0, 2, 3]], [[0, 1, 3], [1, 2, 3]], [[2, 1, 0], [3, 2, 0]]):
        depth = mesh_depth(corners, np.array(faces), camera)
        expected = 1.5 * 60 / (rows - 36)
        below = (rows > 36) & (expected < 30)
        assert below.sum() > 25 and not depth[rows < 36].any()
        assert np.allclose(depth[below], np.where(below, expected, 0)[below][:, None], rtol=1e-4)


def test_what_lies_behind_is_not_drawn():
    corners = np.array([[-1, -1, -2], [1, -1, -2], [0, 1, -2]], float)
    camera = Camera(torch.eye(4, dtype=torch.float64), 60.0, 60.0, 48.0, 36.0, 96, 72)
    assert not mesh_depth(corners, np.array([[0, 1, 2]]), camera).any()


def test_a_wall_close_to_the_camera_hides_what_is_far():
    """Its triangles reach behind the camera, and far away there is more of the scene: nothing near is cut off."""
    wall = np.array([[-4, -4, 0.3], [4, -4, 0.2], [4, 4, 0.25], [-4, 4, -0.4]], float)
    hills = np.array([[-2000, -2000, 1000], [2000, -2000, 1000], [0, 3000, 1000]], float)
    camera = Camera(torch.eye(4, dtype=torch.float64), 60.0, 60.0, 48.0, 36.0, 96, 72)
    faces = np.array([[0, 1, 2], [0, 2, 3], [4, 5, 6]])
    depth = mesh_depth(np.concatenate([wall, hills]), faces, camera)
    x, y = (np.arange(96) + 0.5 - 48) / 60, ((np.arange(72) + 0.5 - 36) / 60)[:, None]
    exact = np.zeros((72, 96))
    for a, b, c in wall[faces[:2]]:
        normal = np.cross(b - a, c - a)
        z = normal @ a / (normal[0] * x + normal[1] * y + normal[2])
        places = np.stack([x * z, y * z, z], -1)
        sides = [np.cross(q - p, places - p) @ normal for p, q in ((a, b), (b, c), (c, a))]
        exact = np.where((z > 0) & np.all([side >= 0 for side in sides], axis=0), z, exact)
    assert (exact > 0).mean() > 0.8
    assert np.allclose(depth[exact > 0], exact[exact > 0], rtol=1e-3)
