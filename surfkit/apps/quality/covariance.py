"""Standard deviations and correlations of camera calibrations, from the normal matrix of a bundle adjustment.

Triggs, McLauchlan, Hartley and Fitzgibbon, "Bundle Adjustment - A Modern Synthesis" (2000): tie points, then poses are
eliminated by Schur complements. The datum (position, rotation and scale of the block) is fixed at one photograph and a
coordinate of another one; calibrations do not depend on it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy import sparse
from scipy.linalg import LinAlgError, cho_factor, cho_solve

from surfkit.apps.quality.sparse_model import SparseModel, projected, with_params

MAX_PHOTOS, MAX_OBSERVATIONS = 300, 300_000
"""Of a block whose normal matrix is formed: about 20 seconds and 1 GB."""
DATUM = 7
"""Unknowns of a block that no tie point determines: position, rotation, scale."""
MIN_PIVOT = 1e-13
"""Least square of a pivot of a normal matrix with 1 on its diagonal, below which it is singular."""
STEP = 1e-6
"""Of differences of projections, as a share of depths and parameters."""
MIN_CONDITION = 1e-12
"""Least ratio of the eigenvalues of a point's normal matrix: its rays meet at an angle."""


@dataclass(frozen=True)
class CalibrationPrecision:
    """How exact a calibration is.

    Attributes:
        estimated: K indices of the parameters that an adjustment estimates: not the principal point.
        covariance: (K, K) of these, pixels and the units of the parameters.
        sigma: Standard deviation of unit weight, pixels: of one coordinate of an observation.
        photos: That the normal matrix was formed from.
        observations: The same.
        is_whole: Whether that is all of the model.
    """

    estimated: tuple[int, ...]
    covariance: np.ndarray
    sigma: float
    photos: int
    observations: int
    is_whole: bool

    @property
    def deviations(self) -> np.ndarray:
        """(K,) standard deviations."""
        return np.sqrt(np.diagonal(self.covariance))

    @property
    def correlations(self) -> np.ndarray:
        """(K, K) in [-1, 1]."""
        return self.covariance / np.outer(self.deviations, self.deviations)


def calibration_precision(model: SparseModel, number: int) -> CalibrationPrecision | None:
    """That of one camera; None where the tie points do not determine its calibration.

    Of a model of more than `MAX_PHOTOS` or `MAX_OBSERVATIONS`, the photographs of the camera that are nearest to their
    middle are taken, then one of so many tie points. The standard deviations of the whole are smaller.
    """
    own = np.flatnonzero(model.camera_of == number)
    chosen = np.arange(len(model.names))
    if len(chosen) > MAX_PHOTOS:
        centres = model.centres
        far = np.linalg.norm(centres[own] - np.median(centres[own], axis=0), axis=1)
        chosen = np.sort(own[np.argsort(far, kind="stable")[:MAX_PHOTOS]])
    part = model.part(chosen)
    if (every := -(-len(part.xy) // MAX_OBSERVATIONS)) > 1:
        part = model.part(chosen, every)
    sigma, found = unit_weight(model), cofactors(part)
    if sigma is None or found is None or number not in found:
        return None
    is_whole = len(chosen) == len(model.names) and every == 1
    covariance = sigma**2 * found[number]
    return CalibrationPrecision(estimated(part.cameras[number]), covariance, sigma, len(chosen), len(part.xy), is_whole)


def estimated(camera: object) -> tuple[int, ...]:
    """Indices of the parameters of a pycolmap.Camera that COLMAP adjusts by default: focal length and distortion."""
    return (*camera.focal_length_idxs(), *camera.extra_params_idxs())  # type: ignore[attr-defined]


def unit_weight(model: SparseModel) -> float | None:
    """Standard deviation of one coordinate of an observation after the adjustment of a whole model, pixels; None where
    there are no more observations than unknowns."""
    degrees = 2 * len(model.xy) - _unknowns(model)[1] - 3 * len(model.xyz) + DATUM
    return float(np.sqrt(np.nansum(model.residuals**2) / degrees)) if degrees > 0 else None


def cofactors(model: SparseModel) -> dict[int, np.ndarray] | None:
    """(K, K) covariance of the calibration of each camera for observations with a standard deviation of one pixel; None
    where the normal matrix has a defect beside that of the datum."""
    model = _usable(model)
    photos, (lenses, unknowns) = len(model.names), _unknowns(model)
    if photos < 2 or 2 * len(model.xy) < unknowns + 3 * len(model.xyz) - DATUM:
        return None
    normal = _reduced(model, lenses, unknowns)
    scale = 1 / np.sqrt(np.diagonal(normal).clip(np.finfo(float).tiny))
    normal = normal * np.outer(scale, scale)
    kept = np.setdiff1d(np.arange(6 * photos), _datum(model))
    inner = np.arange(6 * photos, unknowns)
    try:
        across = normal[np.ix_(kept, inner)]
        poses = cho_factor(normal[np.ix_(kept, kept)], lower=True)
        left = cho_factor(normal[np.ix_(inner, inner)] - across.T @ cho_solve(poses, across), lower=True)
    except LinAlgError:
        return None
    if min(np.diagonal(factor).min() for factor, _ in (poses, left)) ** 2 < MIN_PIVOT:
        return None
    whole = cho_solve(left, np.eye(len(inner))) * np.outer(scale[inner], scale[inner])
    first = 6 * photos
    return {number: whole[np.ix_(at - first, at - first)] for number, at in lenses.items()}


def _unknowns(model: SparseModel) -> tuple[dict[int, np.ndarray], int]:
    """Where the calibration of each camera lies among the unknowns, poses first, and how many these are."""
    lenses, count = {}, 6 * len(model.names)
    for number, camera in model.cameras.items():
        lenses[number] = count + np.arange(len(estimated(camera)))
        count += len(lenses[number])
    return lenses, count


def _usable(model: SparseModel) -> SparseModel:
    """The model in units of its spread, without tie points whose rays are parallel, and photographs that see none."""
    centre = np.median(model.xyz, axis=0) if len(model.xyz) else np.zeros(3)
    size = float(np.median(np.linalg.norm(model.xyz - centre, axis=1))) or 1.0 if len(model.xyz) else 1.0
    poses = model.poses.copy()
    poses[:, :, 3] = (poses[:, :, 3] + poses[:, :, :3] @ centre) / size
    moved = replace(model, poses=poses, xyz=(model.xyz - centre) / size)
    weights = np.linalg.eigvalsh(_points(moved, _jacobians(moved)[0]))
    good = np.flatnonzero(weights[:, 0] > MIN_CONDITION * weights[:, 2])
    kept = np.isin(moved.point, good) & np.isfinite(moved.residuals).all(1)
    seen = replace(moved, photo=moved.photo[kept], point=moved.point[kept], xy=moved.xy[kept])
    return seen.part(np.unique(seen.photo))


def _jacobians(model: SparseModel) -> tuple[np.ndarray, np.ndarray, dict[int, np.ndarray]]:
    """Derivatives of projections: (O, 2, 3) by the tie point, (O, 2, 6) by the pose (a turn and a shift in the axes of
    the camera), and by the calibration of each camera, (O', 2, K) of its observations."""
    local, by_local, by_lens = model.in_cameras, np.zeros((len(model.xy), 2, 3)), {}
    for number, camera in model.cameras.items():
        mine = model.camera_of[model.photo] == number
        xyz = local[mine]
        step = STEP * np.abs(xyz[:, 2:])
        columns = [projected(camera, xyz + step * axis) - projected(camera, xyz - step * axis) for axis in np.eye(3)]
        by_local[mine] = np.stack(columns, -1) / (2 * step[..., None])
        params, columns = np.asarray(camera.params, np.float64), []
        for at in estimated(camera):
            change = np.zeros(len(params))
            change[at] = STEP * max(1.0, abs(params[at]))
            ends = [projected(with_params(camera, params + sign * change), xyz) for sign in (1, -1)]
            columns.append((ends[0] - ends[1]) / (2 * change[at]))
        by_lens[number] = np.stack(columns, -1)
    x, y, z = local.T
    nought = np.zeros(len(local))
    turn = np.stack([nought, z, -y, -z, nought, x, y, -x, nought], -1).reshape(-1, 3, 3)
    by_pose = np.concatenate([by_local @ turn, by_local], -1)
    return by_local @ model.poses[model.photo][:, :, :3], by_pose, by_lens


def _points(model: SparseModel, by_point: np.ndarray) -> np.ndarray:
    """(N, 3, 3) normal matrix of each tie point alone."""
    found = np.zeros((len(model.xyz), 3, 3))
    np.add.at(found, model.point, np.nan_to_num(by_point.transpose(0, 2, 1) @ by_point))
    return found


def _reduced(model: SparseModel, lenses: dict[int, np.ndarray], unknowns: int) -> np.ndarray:
    """(D, D) normal matrix of poses and calibrations, tie points eliminated."""
    by_point, by_pose, by_lens = _jacobians(model)
    inverse = np.linalg.inv(_points(model, by_point))
    rows, columns, values = [], [], []
    observed = np.arange(2 * len(model.xy)).reshape(-1, 2, 1)

    def add(at: np.ndarray, where: np.ndarray, block: np.ndarray) -> None:
        rows.append(np.broadcast_to(at, block.shape).ravel())
        columns.append(np.broadcast_to(where, block.shape).ravel())
        values.append(block.ravel())

    add(observed, (6 * model.photo[:, None] + np.arange(6))[:, None, :], by_pose)
    for number, block in by_lens.items():
        add(observed[model.camera_of[model.photo] == number], lenses[number], block)
    joined = (np.concatenate(values), (np.concatenate(rows), np.concatenate(columns)))
    outer = sparse.csr_matrix(joined, (2 * len(model.xy), unknowns))
    where = np.broadcast_to((3 * model.point[:, None] + np.arange(3))[:, None, :], by_point.shape)
    across = np.broadcast_to(observed, by_point.shape)
    inner = sparse.csr_matrix(
        (by_point.ravel(), (across.ravel(), where.ravel())), (2 * len(model.xy), 3 * len(inverse))
    )
    mixed = (outer.T @ inner).tocsr()
    blocks = sparse.bsr_matrix((inverse, np.arange(len(inverse)), np.arange(len(inverse) + 1)))
    return np.asarray((outer.T @ outer - mixed @ blocks.tocsr() @ mixed.T).todense())


def _datum(model: SparseModel) -> np.ndarray:
    """The seven unknowns that are fixed: a photograph, and the coordinate in which scale moves another one most."""
    centres = model.centres
    first = int(np.linalg.norm(centres - np.median(centres, axis=0), axis=1).argmin())
    moves = np.abs(np.einsum("pij,pj->pi", model.poses[:, :, :3], centres - centres[first]))
    other, axis = np.unravel_index(moves.argmax(), moves.shape)
    return np.array([*range(6 * first, 6 * first + 6), 6 * other + 3 + axis])
