"""Pictures of a mesh without a GPU: a z-buffer, and light from above the left shoulder.

Our own and not Open3D's ray casting: `surfkit train` draws these pictures, also where Open3D is not installed or does
not load (it needs libusb-1.0).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from surfkit.mesh.base import Mesh
from surfkit.raster.native import kernels, module
from surfkit.scene.camera import Camera

BACKGROUND = 1.0
LIGHT_DIRECTION = np.array([-0.4, -0.5, -0.77])
"""Towards the light, in the camera's frame: from above the left shoulder."""
SAMPLED_ELEMENTS = 500_000
"""Triangles and vertices, about, that tell how a mesh lies and how far it reaches; of larger ones, every n-th."""
OPEN_GROUND_SHARE = 0.1
"""Share of the area of a mesh that faces one way, on the whole, from which it is open ground."""


def draw_faces(vertices: np.ndarray, faces: np.ndarray, width: int, height: int) -> tuple[np.ndarray, np.ndarray]:
    """Depth and number of the nearest triangle of each pixel: (H, W) float32, inf for none, and (H, W) int32, -1.

    Args:
        vertices: (V, 3) x and y in pixels, and depth; a triangle with a corner at depth 0 or less is not drawn.
        faces: (F, 3).
        width: Pixels.
        height: Pixels.
    """
    depth = np.full((height, width), np.inf, np.float32)
    face = np.full((height, width), -1, np.int32)
    vertices, faces = np.ascontiguousarray(vertices, np.float32), np.ascontiguousarray(faces, np.int32)
    if module() is not None:
        kernels().draw_faces(vertices, faces, depth, face, torch.get_num_threads())
    else:
        draw_in_numpy(vertices, faces, depth, face)
    return depth, face


def draw_in_numpy(vertices: np.ndarray, faces: np.ndarray, depth: np.ndarray, face: np.ndarray) -> None:
    """The same by numpy, triangles of similar size at once."""
    height, width = depth.shape
    with np.errstate(invalid="ignore"):
        corners = vertices[faces].astype(np.float64)  # (F, 3, 3)
        low = np.nan_to_num(np.ceil(corners[:, :, :2].min(1) - 0.5).clip(0, [width, height]))
        high = (np.floor(corners[:, :, :2].max(1) - 0.5) + 1).clip(0, [width, height])
        size = (high - low).max(1)
        drawn = (corners[:, :, 2] > 0).all(1) & ((high - low).min(1) > 0)
    side, low = 1, low.astype(np.int64)
    while side < 2 * max(width, height):
        rows = np.flatnonzero(drawn & (size <= side) & (size > side // 2))
        step = max(1, 2**22 // side**2)
        for at in range(0, len(rows), step):
            some = rows[at : at + step]
            _draw_similar(corners[some], low[some], some, side, (depth, face))
        side *= 2


def _draw_similar(
    corners: np.ndarray, low: np.ndarray, numbers: np.ndarray, side: int, into: tuple[np.ndarray, np.ndarray]
) -> None:
    depth, face = into
    height, width = depth.shape
    rows, columns = np.indices((side, side)).reshape(2, 1, -1) + low[:, [1, 0]].T[:, :, None]
    x, y, inverse = (
        corners[:, :, 0].T[:, :, None],
        corners[:, :, 1].T[:, :, None],
        1 / corners[:, :, 2].T[:, :, None],
    )
    px, py = columns + 0.5, rows + 0.5
    with np.errstate(divide="ignore", invalid="ignore"):
        area = (x[1] - x[0]) * (y[2] - y[0]) - (x[2] - x[0]) * (y[1] - y[0])
        b = ((px - x[0]) * (y[2] - y[0]) - (x[2] - x[0]) * (py - y[0])) / area
        c = ((x[1] - x[0]) * (py - y[0]) - (px - x[0]) * (y[1] - y[0])) / area
        at = 1 / (inverse[0] + b * (inverse[1] - inverse[0]) + c * (inverse[2] - inverse[0]))
        hit = (b >= 0) & (c >= 0) & (b + c <= 1) & (rows < height) & (columns < width)
    places, found = (rows * width + columns)[hit], at[hit].astype(np.float32)
    owners = np.broadcast_to(numbers[:, None], hit.shape)[hit]
    order = np.lexsort((owners, found, places))  # the nearest of each pixel comes first, of equal ones the first face
    places, found, owners = places[order], found[order], owners[order]
    first = np.flatnonzero(np.diff(places, prepend=-1))
    places, found, owners = places[first], found[first], owners[first]
    old, number = depth.reshape(-1), face.reshape(-1)
    nearer = (found < old[places]) | ((found == old[places]) & (owners < number[places]))
    old[places[nearer]], number[places[nearer]] = found[nearer], owners[nearer]


def shaded(mesh: Mesh, camera: Camera) -> Tensor:
    """(3, H, W) in [0, 1]: the mesh as a photograph's camera sees it, in grey."""
    pose = camera.world_to_camera.numpy()
    local = mesh.vertices.astype(np.float64) @ pose[:3, :3].T + pose[:3, 3]
    z = np.where(local[:, 2] > 0, local[:, 2], np.nan)
    places = np.stack([local[:, 0] / z * camera.fx + camera.cx, local[:, 1] / z * camera.fy + camera.cy, z], 1)
    return _lit(mesh, local, (places, camera.width, camera.height))


def from_above(mesh: Mesh, up: np.ndarray, longest: int, colors: np.ndarray | None = None) -> Tensor:
    """(3, H, W) in [0, 1]: the mesh, seen against the direction `up`, without perspective.

    Args:
        mesh: Any.
        up: (3,) unit vector.
        longest: Side of the picture, pixels.
        colors: (V, 3) uint8 of the vertices; the mesh is grey, and blue from behind, where there are none.
    """
    across = np.cross(up, [0.0, 1.0, 0.0] if abs(up[1]) < 0.9 else [1.0, 0.0, 0.0])
    across /= np.linalg.norm(across)
    turn = np.stack([-across, np.cross(-up, -across), -up])  # x to the right, y down, z away from the eye
    local = mesh.vertices.astype(np.float64) @ turn.T
    low, high = np.percentile(local[:: 1 + len(local) // SAMPLED_ELEMENTS, :2], [0.5, 99.5], axis=0)
    low, high = low - 0.02 * (high - low), high + 0.02 * (high - low)
    scale = longest / max((high - low).max(), 1e-12)
    width, height = (max(1, round(float(side))) for side in (high - low) * scale)
    deep = local[:, 2] - local[:, 2].min() + 1e3 * max(np.ptp(local[:, 2]), 1e-12)  # nearly parallel rays
    places = np.concatenate([(local[:, :2] - low) * scale, deep[:, None]], axis=1)
    far = local + [0, 0, 1e6 * (1 + np.abs(local).max())]  # from an eye far away
    return _lit(mesh, far, (places, width, height), colors)


def _lit(mesh: Mesh, local: np.ndarray, drawn: tuple[np.ndarray, int, int], colors: np.ndarray | None = None) -> Tensor:
    """The picture of a mesh from its vertices in the camera's frame, and where they lie on the picture."""
    places, width, height = drawn
    _, face = draw_faces(places, mesh.faces, width, height)
    there = face >= 0
    a, b, c = (local[mesh.faces[face[there], i]] for i in range(3))
    normals = np.cross(b - a, c - a)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True).clip(1e-30)
    light = normals @ (LIGHT_DIRECTION / np.linalg.norm(LIGHT_DIRECTION))
    # What is seen from behind is blue: the mesh is open or turned inside out there.
    behind = (normals * (a + b + c)).sum(1) > 0
    grey = 0.25 + 0.7 * np.abs(light)
    image = np.full((height, width, 3), BACKGROUND)
    if colors is None:
        image[there] = np.where(behind[:, None], grey[:, None] * [0.55, 0.7, 1.0], grey[:, None])
    else:
        image[there] = grey[:, None] * colors[mesh.faces[face[there]]].mean(1) / 255
    return torch.from_numpy(image).float().permute(2, 0, 1)


def up_of(mesh: Mesh, cameras: Sequence[Camera]) -> np.ndarray:
    """(3,) the direction that is up: where open ground faces on the whole; for closed bodies, that of photographs."""
    some = mesh.faces[:: 1 + len(mesh.faces) // SAMPLED_ELEMENTS]
    a, b, c = (mesh.vertices[some[:, i]].astype(np.float64) for i in range(3))
    areas = np.cross(b - a, c - a)
    whole, sizes = areas.sum(0), np.linalg.norm(areas, axis=1).sum()
    if np.linalg.norm(whole) > OPEN_GROUND_SHARE * sizes:
        return whole / np.linalg.norm(whole)
    poses = np.stack([camera.world_to_camera.numpy() for camera in cameras])
    heads = -poses[:, 1, :3].mean(0)
    return heads / max(np.linalg.norm(heads), 1e-12) if np.linalg.norm(heads) > 1e-3 else np.array([0.0, 0.0, 1.0])
