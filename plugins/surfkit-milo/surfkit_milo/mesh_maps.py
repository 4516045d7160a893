"""Depth and normals of the mesh in a view, differentiable in its vertices, without a rasterizer of triangles on a GPU.

Which triangle a pixel hits is found by a z-buffer and has no gradient. The depth and the normal of the plane of that
triangle, at the pixel, are functions of its three corners: within a triangle their gradient is exact. At the silhouette
of the mesh there is none.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from surfkit.plugin import Camera, draw_faces
from surfkit_milo.pivots import Boxes, vertices

GRAZING = 0.05
"""Cosine between ray and normal, below which a pixel says nothing: the slope of its depth has no bound."""


@dataclass(frozen=True)
class MeshMaps:
    """What K pixels of a view show of a mesh.

    Attributes:
        pixels: (K,) int64, in rows.
        depth: (K,) camera z.
        normal: (K, 3) unit vectors in the frame of the camera, towards it.
    """

    pixels: Tensor
    depth: Tensor
    normal: Tensor


def draw_mesh(boxes: Boxes, ends: np.ndarray, camera: Camera) -> MeshMaps:
    """The surface in a view, with the graph to the boxes.

    Triangles that reach behind the camera, and pixels that see theirs at a grazing angle, are left out.

    Args:
        boxes: In float64.
        ends: (F, 3, 2) pivots, as `crossings` gives them.
        camera: Of the view.
    """
    device = boxes.centres.device
    edges = torch.from_numpy(np.ascontiguousarray(ends)).to(device)
    with torch.no_grad():
        drawn = camera.project(vertices(boxes, edges.view(-1, 2))).cpu().numpy()
    faces = np.arange(len(drawn)).reshape(-1, 3)
    face = torch.from_numpy(draw_faces(drawn, faces, camera.width, camera.height)[1]).flatten().to(device)
    pixels = (face >= 0).nonzero()[:, 0]
    shown, which = torch.unique(face[pixels].long(), return_inverse=True)
    pose = camera.world_to_camera.to(device)
    corners = vertices(boxes, edges[shown].view(-1, 2)) @ pose[:3, :3].T + pose[:3, 3]
    a, b, c = corners.view(-1, 3, 3).unbind(1)
    rays = camera.rays(torch.float64, device).flatten(1).T[pixels]
    return on_planes(a, torch.linalg.cross(b - a, c - a), which, pixels, rays)


def on_planes(point: Tensor, across: Tensor, which: Tensor, pixels: Tensor, rays: Tensor) -> MeshMaps:
    """Where rays meet planes.

    Args:
        point: (U, 3) on each plane, in the frame of the camera.
        across: (U, 3) along its normal, of any length.
        which: (K,) plane of each ray.
        pixels: (K,) of the rays.
        rays: (K, 3), with z = 1.
    """
    length = across.detach().norm(dim=1, keepdim=True)
    normal = torch.nn.functional.normalize(across / length.clamp_min(1e-300), dim=1)
    normal, height = normal[which], (normal * point).sum(1)[which]
    slope = (normal * rays).sum(1)
    clear = slope.detach().abs() > GRAZING * rays.norm(dim=1)
    normal, height, slope, pixels = normal[clear], height[clear], slope[clear], pixels[clear]
    return MeshMaps(pixels, height / slope, -normal * slope.detach().sign()[:, None])
