"""Chamfer distance of the DTU benchmark: Jensen et al., Large Scale Multi-view Stereopsis Evaluation, CVPR 2014;
Aanæs et al., IJCV 120, 2016.

Accuracy is the mean distance from the reconstruction to the structured light scan, completeness the mean distance from
the scan to the reconstruction, both in millimetres. Distances above 20 mm do not count. Of the reconstruction, only
points in the observability mask count, the space that the scanner saw; of the scan, only points above the plane of the
table. The papers measure clouds of points. For meshes these rules were added, as is usual since neural surfaces:

- faces outside the silhouettes of the object are dropped first, as the scan has nothing there;
- the mesh becomes points with a spacing of 0.2 mm, the same that the benchmark thins clouds to.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from surfkit.core.check import BadInput
from surfkit.evaluate.geometry.sampling import face_areas, sample_surface
from surfkit.evaluate.geometry.scores import Distances, between, chamfer
from surfkit.evaluate.geometry.surface_file import SurfaceFile
from surfkit.evaluate.geometry.transform import apply
from surfkit.scene.scene import Frame, View

SPACING_MM = 0.2
"""Least distance between two points of the reconstruction."""
FAR_MM = 20.0
"""Distances above this do not count."""
MARGIN_PX = 24
"""Radius of the disc by which silhouettes are widened before they cut the mesh."""
SAMPLES_PER_CELL = 2
"""Points that are drawn for each square of the spacing, before they are thinned to it."""


@dataclass(frozen=True)
class Observability:
    """Where the scanner saw: the observability mask of a scan (`ObsMask24_10.mat`).

    Attributes:
        seen: (X, Y, Z) bool, cells of space.
        low: (3,) centre of the first cell, mm.
        cell: Edge, mm.
    """

    seen: np.ndarray
    low: np.ndarray
    cell: float

    def inside(self, points: np.ndarray) -> np.ndarray:
        """(n,) bool: which of the (n, 3) points, mm, lie in a cell that was seen."""
        at = np.rint((points - self.low) / self.cell)
        result = ((at >= 0) & (at < self.seen.shape)).all(1)
        x, y, z = at[result].astype(np.int64).T
        result[result] = self.seen[x, y, z]
        return result


def read_observability(path: Path) -> Observability:
    """The mask in a MATLAB file of the benchmark: ObsMask (X, Y, Z), BB (2, 3) its corners, Res the edge of a cell.

    Raises:
        BadInput: Not such a file.
    """
    found = _matlab(path, {"ObsMask": None, "BB": (2, 3), "Res": None})
    seen, cell = found["ObsMask"], found["Res"].reshape(-1)
    if seen.ndim != 3 or cell.size != 1 or not cell[0] > 0 or not np.isfinite(found["BB"]).all():
        raise BadInput(f"{path}: no observability mask: ObsMask must be a volume, BB two corners and Res one length")
    return Observability(seen != 0, found["BB"][0].astype(np.float64), float(cell[0]))


def read_plane(path: Path) -> np.ndarray:
    """(4,) plane of the table in a MATLAB file (`Plane24.mat`): P . (x, y, z, 1) is more than 0 above it.

    Raises:
        BadInput: Not such a file.
    """
    plane = _matlab(path, {"P": None})["P"].astype(np.float64).reshape(-1)
    if plane.size != 4 or not np.isfinite(plane).all():
        raise BadInput(f"{path}: no plane: P must be four numbers")
    return plane


def read_scale(path: Path) -> np.ndarray:
    """(4, 4) from the normalised frame of the cameras to millimetres: `scale_mat_0` of a `cameras.npz`.

    Raises:
        BadInput: Not such a file.
    """
    try:
        with np.load(path, allow_pickle=False) as file:
            matrix = np.asarray(file["scale_mat_0"], np.float64)
    except Exception as error:  # of a damaged file, zipfile and numpy raise whatever comes
        raise BadInput(f"{path}: no scale_mat_0 can be read from it; copy the file again") from error
    if matrix.shape != (4, 4) or not np.isfinite(matrix).all() or not np.linalg.det(matrix) > 0:
        raise BadInput(f"{path}: scale_mat_0 must be a matrix of 4 x 4 numbers that does not mirror")
    return matrix


def _matlab(path: Path, wanted: dict[str, tuple[int, ...] | None]) -> dict[str, np.ndarray]:
    """Arrays of a MATLAB file by name, of given shapes where they have one."""
    from scipy.io import loadmat

    try:
        found = {name: np.asarray(array) for name, array in loadmat(path, variable_names=list(wanted)).items()}
    except Exception as error:  # of a damaged file, scipy raises whatever comes
        raise BadInput(f"{path}: cannot be read as a MATLAB file: {' '.join(str(error).split())}") from error
    for name, shape in wanted.items():
        if name not in found or found[name].dtype.kind not in "buif" or shape not in (None, found[name].shape):
            size = "" if shape is None else f" of {' x '.join(map(str, shape))} numbers"
            raise BadInput(f"{path}: no {name}{size} in it; copy the file of the benchmark again")
    return {name: found[name] for name in wanted}


def in_silhouettes(xyz: np.ndarray, views: Sequence[View], frame: Frame, masks: Sequence[np.ndarray]) -> np.ndarray:
    """(n,) bool: which points no view shows outside the widened silhouette. A view that a point lies outside of, or
    behind, says nothing of it.

    Args:
        xyz: (n, 3) input frame.
        views: Of any size.
        frame: Of the views.
        masks: (h, w) bool, the silhouette in each view, of any size.
    """
    from scipy.ndimage import distance_transform_edt

    kept = np.ones(len(xyz), bool)
    for view, mask in zip(views, masks, strict=True):
        camera, (height, width) = view.camera, mask.shape
        pose = frame.input_pose(camera.world_to_camera)
        rows = np.flatnonzero(kept)
        rays = apply(pose, xyz[rows])
        with np.errstate(divide="ignore", invalid="ignore"):
            x = (camera.fx * rays[:, 0] / rays[:, 2] + camera.cx) * (width / camera.width)
            y = (camera.fy * rays[:, 1] / rays[:, 2] + camera.cy) * (height / camera.height)
            shown = (rays[:, 2] > 0) & (x >= 0) & (x < width) & (y >= 0) & (y < height)
        widened = distance_transform_edt(~mask) <= MARGIN_PX if mask.any() else mask
        kept[rows[shown]] = widened[y[shown].astype(np.int64), x[shown].astype(np.int64)]
    return kept


def cut(mesh: SurfaceFile, kept: np.ndarray) -> SurfaceFile:
    """The faces of a mesh all of whose corners are kept; `kept` is (V,) bool.

    Raises:
        BadInput: None is left.
    """
    faces = mesh.triangles[kept[mesh.triangles].all(1)]
    if not len(faces):
        raise BadInput(f"{mesh.path}: no face lies within the silhouettes of the object in all views")
    return SurfaceFile(mesh.path, mesh.rows, faces, mesh.offset)


def thinned(points: np.ndarray, spacing: float, draw: np.random.Generator) -> np.ndarray:
    """(m, 3) of (n, 3) points: in a random order, each is kept unless one that is kept lies within the spacing.

    Rounds of all points at once give the same as one after the other: a point is decided once all those are that come
    before it and are near.
    """
    from scipy.spatial import cKDTree

    points = points[draw.permutation(len(points))]
    pairs = cKDTree(points).query_pairs(spacing, output_type="ndarray")
    pairs.sort(axis=1)
    kept, open_ = np.zeros(len(points), bool), np.ones(len(points), bool)
    while open_.any():
        waits = np.zeros(len(points), bool)
        waits[pairs[:, 1]] = True
        chosen = open_ & ~waits
        kept |= chosen
        open_ &= ~chosen
        open_[pairs[chosen[pairs[:, 0]], 1]] = False
        pairs = pairs[open_[pairs].all(1)]
    return points[kept]


def sampled(mesh: SurfaceFile, draw: np.random.Generator, spacing: float = SPACING_MM) -> np.ndarray:
    """(n, 3) points on a mesh in millimetres, none nearer to another than the spacing."""
    count = max(1, int(np.ceil(SAMPLES_PER_CELL * face_areas(mesh).sum() / spacing**2)))
    return thinned(sample_surface(mesh, count, draw), spacing, draw)


def dtu_distances(
    points: np.ndarray, scan: np.ndarray, observability: Observability, plane: np.ndarray
) -> tuple[dict[str, float | None], Distances]:
    """Accuracy, completeness and their mean ("overall"), mm, and the distances of all that counts.

    Args:
        points: (n, 3) of the reconstruction, mm.
        scan: (m, 3) of the structured light scan, mm.
        observability: Of the scan.
        plane: (4,) of the table.

    Raises:
        BadInput: Nothing of one of the two counts.
    """
    seen, above = observability.inside(points), scan @ plane[:3] + plane[3] > 0
    if not seen.any() or not above.any():
        raise BadInput(
            f"{seen.sum()} of {len(points)} points of the reconstruction lie in the observability mask, and "
            f"{above.sum()} of {len(scan)} of the scan above the plane: they are not in one frame"
        )
    both = between(points, scan)
    counted = Distances(both.to_truth[seen], both.to_reconstruction[above])
    return chamfer(counted, FAR_MM), counted
