"""Pictures of a mesh that are written beside it."""

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import torch
from mesh.shapes import look_at

from surfkit.mesh.base import Mesh
from surfkit.raster.api import Maps
from surfkit.runs import make_mesh
from surfkit.scene.scene import Frame


def test_above_is_above_for_a_wall_too(tmp_path, monkeypatch):
    """Photographs from the ground show a facade: it faces them, and up is where their tops point."""
    cameras = [look_at((x, -3.0, 0.2), at=(0.3 * x, 0.0, 0.2)) for x in (-2.0, -1.0, 0.0, 1.0, 2.0)]
    x, z = np.meshgrid(np.linspace(-2, 2, 9), np.linspace(0, 1, 5))
    vertices = np.stack([x, 0 * x, z], 2).reshape(-1, 3).astype(np.float32)
    at = np.arange(45).reshape(5, 9)
    a, b, c, d = (part.ravel() for part in (at[:-1, :-1], at[:-1, 1:], at[1:, 1:], at[1:, :-1]))
    wall = Mesh(vertices, np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)]).astype(np.int32))
    seen = []
    monkeypatch.setattr(make_mesh, "from_above", lambda mesh, up, *rest: seen.append(up) or torch.zeros(3, 4, 4))
    (tmp_path / "mesh_pictures").mkdir()
    run = SimpleNamespace(mesh_pictures=Path(tmp_path / "mesh_pictures"))
    views = [SimpleNamespace(camera=camera) for camera in cameras]
    subject = SimpleNamespace(
        views=views,
        frame=Frame(np.zeros(3), 1.0),
        draw=lambda view: Maps(color=torch.zeros(3, view.camera.height, view.camera.width)),
    )
    make_mesh.write_pictures(run, wall, subject)
    np.testing.assert_allclose(seen, [[0, 0, 1]], atol=1e-6)
