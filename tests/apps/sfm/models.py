"""Reconstructions as pycolmap has them, of known poses, in a frame of their own."""

from types import SimpleNamespace

import numpy as np

from surfkit.io.datasets.raw_dataset import load_pycolmap


def reconstruction(poses, points, turn, scale, move, camera=None):
    """Cameras (by name, (4, 4) world_to_camera) and (P, 3) points after new = scale * turn @ old + move."""
    engine, found = load_pycolmap(), {}
    for at, (name, pose) in enumerate(poses.items()):
        turned = pose[:3, :3] @ turn.T
        centre = scale * turn @ (-pose[:3, :3].T @ pose[:3, 3]) + move
        rigid = engine.Rigid3d(engine.Rotation3d(turned), -turned @ centre)
        found[at] = SimpleNamespace(
            name=name, camera=camera, cam_from_world=lambda rigid=rigid: rigid, projection_center=lambda c=centre: c
        )
    cloud = {at: SimpleNamespace(xyz=scale * turn @ xyz + move) for at, xyz in enumerate(points)}
    return SimpleNamespace(reg_image_ids=lambda: list(found), image=found.get, points3D=cloud)


def down(centres):
    """Poses (4, 4) world_to_camera that look straight down from (V, 3) centres, every other one turned by a quarter."""
    north = np.diag([1.0, -1.0, -1.0])
    turns = [north, np.array([[0.0, 1.0, 0], [-1, 0, 0], [0, 0, 1]]) @ north]
    poses = []
    for at, centre in enumerate(centres):
        turn = turns[at % 2]
        poses.append(np.vstack([np.column_stack([turn, -turn @ centre]), [0, 0, 0, 1]]))
    return poses
