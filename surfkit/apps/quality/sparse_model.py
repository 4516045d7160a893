"""A sparse model as arrays: cameras, poses, tie points and where photographs see them."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np


@dataclass(frozen=True)
class SparseModel:
    """Cameras and tie points.

    Attributes:
        cameras: pycolmap.Camera by number.
        names: P photographs, in the order of their names.
        camera_of: (P,) number of the camera of each.
        poses: (P, 3, 4) float64 from the world to the camera.
        xyz: (N, 3) float64 tie points, world.
        photo: (O,) index of the photograph of each observation.
        point: (O,) index of its tie point.
        xy: (O, 2) float64 where it is seen, pixels.
    """

    cameras: Mapping[int, Any]
    names: tuple[str, ...]
    camera_of: np.ndarray
    poses: np.ndarray
    xyz: np.ndarray
    photo: np.ndarray
    point: np.ndarray
    xy: np.ndarray

    @classmethod
    def of(cls, model: Any) -> SparseModel:
        """That of a pycolmap.Reconstruction."""
        images = sorted((model.image(number) for number in model.reg_image_ids()), key=lambda image: image.name)
        index = {number: at for at, number in enumerate(sorted(model.point3D_ids()))}
        photo, point, xy = [], [], []
        for at, image in enumerate(images):
            seen = image.get_observation_points2D()
            photo.append(np.full(len(seen), at))
            point.append(np.array([index[spot.point3D_id] for spot in seen], np.int64))
            xy.append(np.array([spot.xy for spot in seen], np.float64).reshape(-1, 2))
        return cls(
            {number: model.cameras[number] for number in sorted({image.camera_id for image in images})},
            tuple(image.name for image in images),
            np.array([image.camera_id for image in images], np.int64),
            np.array([image.cam_from_world().matrix() for image in images], np.float64).reshape(-1, 3, 4),
            np.array([model.points3D[number].xyz for number in index], np.float64).reshape(-1, 3),
            np.concatenate([*photo, np.zeros(0, np.int64)]),
            np.concatenate([*point, np.zeros(0, np.int64)]),
            np.concatenate([*xy, np.zeros((0, 2))]),
        )

    @property
    def centres(self) -> np.ndarray:
        """(P, 3) projection centres, world."""
        return -np.einsum("pji,pj->pi", self.poses[:, :, :3], self.poses[:, :, 3])

    @cached_property
    def in_cameras(self) -> np.ndarray:
        """(O, 3) the tie point of each observation in the axes of its camera."""
        pose = self.poses[self.photo]
        return np.einsum("oij,oj->oi", pose[:, :, :3], self.xyz[self.point]) + pose[:, :, 3]

    @cached_property
    def residuals(self) -> np.ndarray:
        """(O, 2) observed less projected, pixels."""
        left = np.zeros_like(self.xy)
        for number, camera in self.cameras.items():
            mine = self.camera_of[self.photo] == number
            left[mine] = self.xy[mine] - projected(camera, self.in_cameras[mine])
        return left

    @cached_property
    def errors(self) -> np.ndarray:
        """(O,) reprojection errors: lengths of the residuals, pixels."""
        return np.linalg.norm(self.residuals, axis=1)

    @cached_property
    def track_lengths(self) -> np.ndarray:
        """(N,) in how many photographs each tie point is seen."""
        return np.bincount(self.point, minlength=len(self.xyz))

    def part(self, photos: np.ndarray, every: int = 1) -> SparseModel:
        """The model of some photographs, and of every so many of the tie points that two of them see.

        Args:
            photos: (Q,) indices, ascending.
            every: Take one of so many tie points.
        """
        among = np.isin(self.photo, photos)
        seen = np.bincount(self.point[among], minlength=len(self.xyz))
        points = np.flatnonzero(seen >= 2)[::every]
        kept = among & np.isin(self.point, points)
        return replace(
            self,
            cameras={number: self.cameras[number] for number in sorted(set(self.camera_of[photos].tolist()))},
            names=tuple(self.names[at] for at in photos),
            camera_of=self.camera_of[photos],
            poses=self.poses[photos],
            xyz=self.xyz[points],
            photo=np.searchsorted(photos, self.photo[kept]),
            point=np.searchsorted(points, self.point[kept]),
            xy=self.xy[kept],
        )


def projected(camera: Any, xyz: np.ndarray) -> np.ndarray:
    """(N, 2) pixels of (N, 3) points in the axes of a pycolmap.Camera; NaN where it has none."""
    return np.asarray(camera.img_from_cam(np.ascontiguousarray(xyz)), np.float64).reshape(-1, 2)


def with_params(camera: Any, params: np.ndarray) -> Any:
    """A pycolmap.Camera with other (K,) parameters."""
    other = copy.deepcopy(camera)
    other.params = params
    return other
