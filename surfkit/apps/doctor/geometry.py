"""Whether cameras and sparse points make sense together."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np

from surfkit.apps.doctor.coverage_gaps import holes
from surfkit.apps.doctor.finding import Finding, from_errors
from surfkit.core.check import BadInput, few
from surfkit.io.datasets.raw_dataset import RawImage
from surfkit.io.datasets.undistort import check_camera, is_panorama
from surfkit.scene.scene import Frame

SAMPLED_POINTS = 4_000
"""Sparse points, evenly drawn, that stand for all of them."""
COMPARED_POINTS, CANDIDATE_POINTS = 1_000, 200_000
"""Sparse points at which the colours of photographs are compared, and out of which they are chosen."""
SHARED_POINTS = 20_000
"""Sparse points that tell which photographs show the same places."""
MAX_RAY_OVERSHOOT = 0.3
"""Share of the image by which a ray may miss it before its distortion: polynomials fold far rays back in."""
FAR_CAMERA = 25.0
"""A camera so many times farther out than the median one is no part of the scene."""
FEW_POINTS, FEW_IN_VIEW, FEW_VIEWS = 1_000, 10, 3
BATCH_POINTS = 65_536
"""Points between two checks whether a photograph has enough of them in view."""
MAX_THIN_SHARE = 0.2
"""Share of the points that may be seen by fewer than FEW_VIEWS photographs; the rim of a survey is."""
MAX_NEAR_SHARE = 0.01
"""Share of what is in view that may lie before the near plane."""
VISIBLE_SPACING_SHARE = 1e-5
"""Spacing of 32-bit numbers at the scene's coordinates, as a share of its extent, that can be seen in a result."""


@dataclass(frozen=True)
class Geometry:
    """Cameras and points of a data set, measured.

    Attributes:
        extent: Of the scene, input units; None if there is none.
        sample: (S, 3) float64 sparse points, input frame.
        views: (S,) how many training photographs have each of them in view; what hides it is not known.
        depth: Median depth of the points in view, input units; None if none is.
        sound: Names of the training photographs whose cameras can be used.
        findings: What is wrong.
    """

    extent: float | None
    sample: np.ndarray
    views: np.ndarray
    depth: float | None
    sound: frozenset[str]
    findings: tuple[Finding, ...]


@np.errstate(all="ignore")
def survey(shots: Sequence[RawImage], train: Sequence[RawImage], xyz: np.ndarray, near: float) -> Geometry:
    """Measure cameras and points; numbers may be as large as they come.

    Args:
        shots: All that have a pose.
        train: Those to train on.
        xyz: (P, 3) float64 sparse points, input frame.
        near: Nothing nearer is drawn, as a share of the extent.
    """
    findings = [*_cameras(shots)]
    sound = [shot for shot in train if not _camera_fault(shot)]
    usable = frozenset(shot.name for shot in sound)
    sample = xyz[np.random.default_rng(0).permutation(len(xyz))[:SAMPLED_POINTS]]
    if not sound:
        return Geometry(None, sample, np.zeros(len(sample), int), None, usable, tuple(findings))
    extent = None
    try:
        extent = 1 / Frame.around(np.stack([shot.pose for shot in sound]), xyz).scale
    except BadInput as error:
        findings += from_errors("one-place", [error])
    findings += [*_poses(sound), *_numbers(sound, xyz, extent)]
    if not len(xyz):
        return Geometry(extent, sample, np.zeros(0, int), None, usable, tuple(findings))
    views, counts, depths = _in_view(sound, sample)
    findings += _points(sound, xyz, views, counts)
    findings += _nearness(depths, extent, near)
    findings += holes(xyz, np.stack([centre(shot) for shot in sound]))
    depth = float(np.median(depths)) if len(depths) else None
    return Geometry(extent, sample, views, depth, usable, tuple(findings))


def centre(shot: RawImage) -> np.ndarray:
    """(3,) position of a camera, input frame."""
    return -shot.pose[:3, :3].T @ shot.pose[:3, 3]


def places(shot: RawImage, xyz: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Where a photograph shows points, if nothing hides them.

    Args:
        shot: The photograph, with a camera that can be used.
        xyz: (S, 3) float64, input frame.

    Returns:
        (S, 2) shares of the width and height, NaN where a point is not in view; (S,) camera z, input units, or the
        distance for a panorama.
    """
    rays = xyz @ shot.pose[:3, :3].T + shot.pose[:3, 3]
    depth, camera = rays[:, 2], shot.camera
    size = np.array([camera.width, camera.height])
    found = np.full((len(xyz), 2), np.nan)
    if is_panorama(camera):  # all around it
        depth = np.linalg.norm(rays, axis=1)
        good = np.isfinite(depth) & (depth > 0)
        found[good] = np.asarray(camera.img_from_cam(rays[good]), np.float64).reshape(-1, 2) / size
        return found, depth
    with np.errstate(all="ignore"):
        flat = rays[:, :2] / depth[:, None]
        focal = np.array([camera.focal_length_x, camera.focal_length_y])
        straight = (flat * focal + [camera.principal_point_x, camera.principal_point_y]) / size
        plausible = (depth > 0) & np.isfinite(flat).all(1)
        if "FISHEYE" not in camera.model.name:
            plausible &= (np.abs(straight - 0.5) <= 0.5 + MAX_RAY_OVERSHOOT).all(1)
        if plausible.any():
            pixels = np.asarray(camera.img_from_cam(rays[plausible] / depth[plausible, None]), np.float64)
            found[plausible] = pixels.reshape(-1, 2) / size
        found[~((found >= 0) & (found <= 1)).all(1)] = np.nan
    return found, depth


def points_in_common(shots: Sequence[RawImage], xyz: np.ndarray) -> np.ndarray:
    """(S, 3) float64 sparse points that two of some photographs and more have in view, if nothing hides them.

    They are drawn from what these photographs show: of a large scene, that is a small part.

    Args:
        shots: Photographs, with cameras that can be used.
        xyz: (P, 3) float64 sparse points, input frame.
    """
    draw = np.random.default_rng(0)
    some = xyz[draw.permutation(len(xyz))[:CANDIDATE_POINTS]]
    counts = np.zeros(len(some), int)
    for shot in shots:
        counts += np.isfinite(places(shot, some)[0]).all(1)
    return some[np.flatnonzero(counts > 1)[:COMPARED_POINTS]]


def points_in_view(xyz: np.ndarray) -> tuple[int, Callable[[RawImage], np.ndarray]]:
    """How many of (P, 3) sparse points are looked for, drawn at random, and which of these, (K,), a photograph has in
    view, if nothing hides them."""
    some = xyz[np.random.default_rng(1).permutation(len(xyz))[:SHARED_POINTS]]
    return len(some), lambda shot: np.flatnonzero(np.isfinite(places(shot, some)[0]).all(1))


def seen_by(shot: RawImage, xyz: np.ndarray) -> Callable[[], np.ndarray]:
    """Gives the places of points in a photograph when they are needed."""
    return lambda: places(shot, xyz)[0]


def _in_view(shots: Sequence[RawImage], xyz: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(S,) how many photographs have each point in view; (V,) how many points each of these has; depths of all of them,
    input units, or of an even part."""

    def look(shot: RawImage) -> tuple[np.ndarray, np.ndarray]:
        where, depth = places(shot, xyz)
        inside = np.isfinite(where[:, 0])
        return inside, np.sort(depth[inside])[::10]

    views, counts, depths = np.zeros(len(xyz), int), [], []
    with ThreadPoolExecutor(4) as pool:
        for inside, some in pool.map(look, shots):
            views += inside
            counts.append(inside.sum())
            depths.append(some)
    return views, np.array(counts), np.concatenate(depths)


def _has_few(shot: RawImage, xyz: np.ndarray) -> bool:
    """Whether a photograph has few of all points in view; no more are looked at than tell it."""
    count = 0
    for start in range(0, len(xyz), BATCH_POINTS):
        count += int(np.isfinite(places(shot, xyz[start : start + BATCH_POINTS])[0][:, 0]).sum())
        if count >= FEW_IN_VIEW:
            return False
    return True


def _camera_fault(shot: RawImage) -> str | None:
    try:
        check_camera(shot.camera, shot.name)
    except BadInput as error:
        return str(error)
    return None


def _cameras(shots: Sequence[RawImage]) -> list[Finding]:
    """What is wrong with the lenses; one line for each camera."""
    first = {id(shot.camera): shot for shot in reversed(shots)}
    faults = {key: text for key, shot in first.items() if (text := _camera_fault(shot))}
    names = {key: tuple(shot.name for shot in shots if id(shot.camera) == key) for key in faults}
    return [
        Finding("error", "camera", f"{text} ({len(names[key])} photographs); correct or delete it", names[key])
        for key, text in faults.items()
    ]


def _poses(shots: Sequence[RawImage]) -> list[Finding]:
    """Cameras far from all others, and such as stand in one place."""
    centres = np.stack([centre(shot) for shot in shots])
    distance = np.linalg.norm(centres - np.median(centres, 0), axis=1)
    usual = np.median(distance)
    found = []
    far = [shots[at].name for at in np.argsort(-distance).tolist() if usual > 0 and distance[at] > FAR_CAMERA * usual]
    if far:
        times = distance.max() / usual
        text = (
            f"{few(far)}: {times:,.0f} times as far out as the median camera; they stretch the scene's extent, "
            "by which learning rates, near plane and densification are scaled: delete them from the model"
        )
        found.append(Finding("warning", "far-cameras", text, tuple(far)))
    poses = np.stack([shot.pose for shot in shots]).reshape(len(shots), -1)
    _, at, back, count = np.unique(poses, axis=0, return_index=True, return_inverse=True, return_counts=True)
    same = [shots[i].name for i in np.flatnonzero(count[back.reshape(-1)] > 1).tolist()]
    if same:
        text = f"{len(same)} photographs have exactly the pose of another, {few(same)}: filled in, or copies"
        found.append(Finding("warning", "equal-poses", f"{text}; delete them from the model", tuple(same)))
    return found


def _numbers(shots: Sequence[RawImage], xyz: np.ndarray, extent: float | None) -> list[Finding]:
    """Coordinates that 32 bits hold badly."""
    if extent is None:
        return []
    most = np.float32(np.abs(np.median(np.stack([centre(shot) for shot in shots]), 0)).max())
    spacing = float(np.spacing(most))
    if spacing <= VISIBLE_SPACING_SHARE * extent:
        return []
    text = (
        f"coordinates of up to {most:,.0f} in a scene of {extent:,.3g} units, of which 32 bits hold {spacing:.2g} "
        "at best: point_cloud.ply leaves out an offset, which its header and run.json name"
    )
    return [Finding("note", "large-coordinates", text)]


def _points(shots: Sequence[RawImage], xyz: np.ndarray, views: np.ndarray, counts: np.ndarray) -> list[Finding]:
    """Points that no photograph shows, and photographs without points; by those of a sample first, see `_in_view`."""
    found = []
    unseen, thin = float((views == 0).mean()), float(((views > 0) & (views < FEW_VIEWS)).mean())
    if unseen > 0.5:
        text = (
            f"{unseen:.0%} of the sparse points are in view of no training photograph: cameras and points are probably "
            "not in one frame, or the axes are of another convention; look at both in a viewer"
        )
        found.append(Finding("error" if unseen == 1 else "warning", "points-out-of-view", text))
    elif thin + unseen > MAX_THIN_SHARE:
        text = (
            f"{thin + unseen:.0%} of the sparse points are in view of fewer than {FEW_VIEWS} training photographs, so "
            "the surface there will be poor; add photographs, or hold out fewer (--test-every)"
        )
        found.append(Finding("warning", "thin-coverage", text))
    if len(xyz) < FEW_POINTS:
        text = (
            f"only {len(xyz)} sparse points to start from; a model has thousands: match more features, or triangulate"
        )
        found.append(Finding("warning", "few-points", text))
    doubtful = [shot for shot, count in zip(shots, counts, strict=True) if count * len(xyz) < FEW_IN_VIEW * len(views)]
    bare = []
    if doubtful and unseen < 1:  # of thousands of photographs, some show nothing of a sample
        mixed = np.random.default_rng(0).permutation(xyz)
        with ThreadPoolExecutor(4) as pool:
            few_there = pool.map(lambda shot: _has_few(shot, mixed), doubtful)
            bare = [shot.name for shot, has_few in zip(doubtful, few_there, strict=True) if has_few]
    if bare:
        text = (
            f"{len(bare)} photographs have fewer than {FEW_IN_VIEW} sparse points in view, {few(bare)}: their surface "
            "starts from nothing; check their poses, or delete them from the model"
        )
        found.append(Finding("warning", "cameras-without-points", text, tuple(bare)))
    return found


def _nearness(depths: np.ndarray, extent: float | None, near: float) -> list[Finding]:
    """Surfaces that the near plane would cut away, and scenes seen from one place."""
    if extent is None or not len(depths):
        return []
    cut, typical = float((depths < near * extent).mean()), float(np.median(depths))
    if cut > MAX_NEAR_SHARE:
        text = (
            f"{cut:.0%} of what is in view lies nearer to the camera than the near plane of {near * extent:.3g} units, "
            f"and would not be drawn; use --pretrain.near {max(1e-6, np.quantile(depths, 0.001) / extent / 2):.1g}"
        )
        return [Finding("warning", "near-plane", text)]
    if typical > 100 * extent:
        text = (
            f"what is in view is {typical / extent:,.0f} times as far away as the cameras are apart: they stand in one "
            "place, and depth cannot be told; add photographs from other places"
        )
        return [Finding("warning", "no-parallax", text)]
    return []
