"""Loose parts in front of a wall: those that views see through go, those that they see stay, however small."""

from dataclasses import replace

import numpy as np
import torch

from surfkit.mesh.base import Mesh
from surfkit.mesh.clean import clusters
from surfkit.mesh.floaters import drop_floaters
from surfkit.mesh.geometric_consistency import GeometricConsistency
from surfkit.mesh.lattice import FusionImage
from surfkit.mesh.tsdf import TSDF

from .shapes import look_at, maps_of, seen, subject

CAMERAS = [look_at((0.25 * at, 0.1, 2.0), (0.25 * at, 0.1001, 0.0)) for at in range(5)]


def wall_and_mast(points):
    """The ground z = 0, and a loose ball of radius 0.08 above it."""
    return np.minimum(points[..., 2], np.linalg.norm(points - [0.5, 0.1, 0.7], axis=-1) - 0.08)


def patch(x, y, z, side=0.1):
    return np.array([[x, y, z], [x + side, y, z], [x + side, y + side, z], [x, y + side, z]], np.float32)


def test_parts_in_the_open_go_and_parts_that_are_seen_stay():
    vertices = np.concatenate([patch(-1, -1, 0, 3.0), patch(0.4, -0.3, 1.0), patch(0.46, 0.06, 0.78, 0.08)])
    faces = np.concatenate([np.array([[0, 1, 2], [0, 2, 3]], np.int32) + 4 * n for n in range(3)])
    pictures = []
    for camera in CAMERAS:
        depth = seen(camera, wall_and_mast)[0].astype(np.float32)
        pictures.append(FusionImage(depth, np.where(depth > 0, 32 << 24, 0).astype(np.uint32), camera))
    kept, dropped = drop_floaters(Mesh(vertices, faces), iter(pictures), 0.06, 1.0)
    assert dropped == 1 and set(np.unique(kept.faces // 4)) == {0, 2}
    blind = [replace(p, shade=p.shade & 0xFFFFFF) for p in pictures]
    assert drop_floaters(Mesh(vertices, faces), iter(blind), 0.06, 1.0)[1] == 0, "pixels without weight are ignored"
    assert drop_floaters(Mesh(vertices, faces), iter(pictures), 0.06, 1000.0)[1] == 1, "nobody sees it"


def test_a_mesh_without_what_one_view_alone_sees():
    """One view has a false blob in the air; without carving it is meshed, and found out by the others."""
    maps = {f"{at}": maps_of(camera, wall_and_mast) for at, camera in enumerate(CAMERAS)}
    wrong = maps["1"].median.clone()
    wrong[44:60, 20:36] = 1.0
    maps["1"] = replace(maps["1"], median=wrong)
    given = replace(subject(CAMERAS, wall_and_mast), draw=lambda view: maps[view.name])
    mesher = TSDF(voxel=0.3, truncation=1.2, depth_limit=50.0, least_views=0.5, carve=False)

    def blob(mesh):
        return (np.abs(mesh.vertices[mesh.faces].mean(1)[:, 2] - 1.0) < 0.1).sum()

    def ball(mesh):
        return (np.abs(mesh.vertices[mesh.faces].mean(1)[:, 2] - 0.75) < 0.08).sum()

    plain, judged = mesher.mesh(given), replace(mesher, floaters=1.0).mesh(given)
    assert judged.facts["floaters"] >= 1 and "floaters" not in plain.facts
    assert blob(plain) > 20 and blob(judged) == 0 and ball(plain) == ball(judged) > 5
    assert len(clusters(judged)[1]) < len(clusters(plain)[1])
    trusted = replace(mesher, floaters=1.0, trust=GeometricConsistency(alone=1.0)).mesh(given)
    assert blob(trusted) == 0 and ball(trusted) > 5
    assert torch.equal(maps["1"].median, wrong)
