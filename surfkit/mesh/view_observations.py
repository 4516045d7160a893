"""What the views see of a surface, on disk: depth of splats and of stereo, their weights, normals and colours."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from surfkit.core.check import BadInput
from surfkit.core.events import Progress, emit
from surfkit.mesh.base import MeshInput
from surfkit.mesh.fusion import TILES_PATTERN
from surfkit.mesh.fusion_image import Which, depth_of
from surfkit.mesh.overlap import Depths
from surfkit.mesh.trust import Trust
from surfkit.raster.native import kernels
from surfkit.scene.camera import Camera

SIGHT_PIXEL_BYTES = 18
"""Bytes per pixel of a view on disk."""


@dataclass(frozen=True)
class ViewObservation:
    """What a view sees.

    Attributes:
        camera: Of the view.
        depth: (L, H, W) float32 camera z of each of its depth maps, local units; 0 for none.
        weight: (L, H, W) float32 how far each depth is trusted; 0 does not count.
        normal: (3, H, W) float32 of the surface, camera axes, of any length.
        color: (3, H, W) uint8.
    """

    camera: Camera
    depth: np.ndarray
    weight: np.ndarray
    normal: np.ndarray
    color: np.ndarray

    @property
    def native(self) -> tuple[Any, ...]:
        """As the compiled part takes it."""
        camera = self.camera
        lens = [camera.fx, camera.fy, camera.cx, camera.cy]
        return self.depth, self.weight, self.normal, self.color, lens, camera.world_to_camera.flatten().tolist()


class ViewObservations(Sequence[ViewObservation]):
    """The sights of all views, in a folder."""

    def __init__(self, folder: Path, cameras: Sequence[Camera]) -> None:
        self.folder, self.cameras = folder, tuple(cameras)

    def __len__(self) -> int:
        return len(self.cameras)

    def __getitem__(self, at: int) -> ViewObservation:  # type: ignore[override]
        depth, weight, normal, color = (np.load(self.folder / f"{at}-{name}.npy") for name in SIGHT_MAPS)
        return ViewObservation(self.cameras[at], depth, weight.astype(np.float32), normal.astype(np.float32), color)

    def depths(self) -> Depths:
        """The first depth map of each view."""

        def read(at: int) -> torch.Tensor:
            return torch.from_numpy(np.load(self.folder / f"{at}-depth.npy", mmap_mode="r")[0].copy())

        return Depths(self.cameras, read)

    def write(self, at: int, **arrays: np.ndarray) -> None:
        """Write some of the arrays of a view, by their names in `ViewObservation`."""
        for name, values in arrays.items():
            np.save(self.folder / f"{at}-{name}.npy", values)


SIGHT_MAPS = "depth", "weight", "normal", "color"


@dataclass(frozen=True)
class ObservationSettings:
    """How views look at splats.

    Attributes:
        which: Depth of a pixel that is drawn.
        limit: Depth from which nothing counts, local units.
        trust: Of what is drawn.
        doubted: Least weight of what is drawn where `trust` has some by the view alone, and none by others.
        stereo: Weight of the depth of a prior at full confidence.
        confident: Least confidence of a prior that counts.
    """

    which: Which
    limit: float
    trust: Trust
    doubted: float
    stereo: float
    confident: float


@contextmanager
def seen(subject: MeshInput, how: ObservationSettings) -> Iterator[ViewObservations]:
    """What all views see, each drawn once, and compared with the others.

    Raises:
        BadInput: The disk has no room for it.
    """
    views = subject.views
    needed = SIGHT_PIXEL_BYTES * sum(view.camera.width * view.camera.height for view in views)
    with tempfile.TemporaryDirectory(dir=subject.scratch, prefix=TILES_PATTERN.rstrip("*")) as name:
        folder = Path(name)
        if (free := shutil.disk_usage(folder).free) < 1.05 * needed:
            raise BadInput(
                f"{folder.parent}: {needed / 1e9:.1f} GB of disk are needed for the depth of all views and "
                f"{free / 1e9:.1f} GB are free; make room"
            )
        sights = ViewObservations(folder, [view.camera for view in views])
        for at in range(len(views)):
            sights.write(at, **_drawn(subject, at, how))
            emit(Progress("drawing views", at + 1, len(views)))
        depths = sights.depths()
        for at in range(len(views)):
            weight = np.load(folder / f"{at}-weight.npy")
            among = how.trust.among(at, depths).numpy()
            weight[0] *= np.maximum(among, how.doubted)  # 0 stays 0: what the view itself does not trust
            sights.write(at, weight=weight)
            emit(Progress("comparing views", at + 1, len(views)))
        yield sights


def _drawn(subject: MeshInput, at: int, how: ObservationSettings) -> dict[str, np.ndarray]:
    view = subject.views[at]
    maps, keep = subject.draw(view), subject.keep(at)
    depth = depth_of(maps, how.which)
    depth = torch.where(depth <= how.limit, depth, 0.0)
    if keep is not None:
        depth = torch.where(keep, depth, 0.0)
    prior = None if subject.priors is None else subject.priors[at]
    own = how.trust.within(maps, depth, prior if how.trust.needs_prior else None)
    layers, weights = [torch.where(own > 0, depth, 0.0)], [own]
    if prior is not None and how.stereo:
        known = (prior.inverse > 1 / how.limit) & (prior.confidence >= how.confident)
        if keep is not None:
            known &= keep
        layers.append(torch.where(known, 1 / prior.inverse.clamp_min(1e-20), 0.0))
        weights.append(torch.where(known, how.stereo * prior.confidence, 0.0))
    normal = torch.zeros(3, *depth.shape) if maps.normal is None else maps.normal
    length = normal.norm(dim=0).clamp_min(1e-6)
    return {
        "depth": torch.stack(layers).float().numpy(),
        "weight": torch.stack(weights).half().numpy(),
        "normal": (127 * normal / length).round().to(torch.int8).numpy(),
        "color": (255 * maps.need("color").clamp(0, 1)).round().to(torch.uint8).numpy(),
    }


Each = Callable[[ViewObservation], None]


def for_all(sights: ViewObservations, what: str, each: Each, places: np.ndarray | None = None) -> None:
    """Call `each` with every sight, or those that may see some of (N, 3) places, and report progress."""
    looking: Sequence[int] = range(len(sights))
    if places is not None:
        ends = (places.min(0), places.max(0)) if len(places) else None
        looking = [at for at in looking if ends and may_see(sights.cameras[at], *ends)]
    for done, at in enumerate(looking, 1):
        each(sights[at])
        emit(Progress(what, done, len(looking)))


def may_see(camera: Camera, low: np.ndarray, high: np.ndarray) -> bool:
    """Whether a camera may see some of a box with corners (3,)."""
    lens = [camera.fx, camera.fy, camera.cx, camera.cy]
    pose = camera.world_to_camera.flatten().tolist()
    return kernels().may_see([*low.tolist(), *high.tolist()], camera.width, camera.height, lens, pose)


def boxes_of(places: np.ndarray) -> np.ndarray:
    """(K, 6) float32 lowest and highest corner of each `PIECE` of (N, 3) float32 places: what a view does not see of
    these is passed over."""
    firsts = np.arange(0, len(places), kernels().PIECE)
    return np.concatenate([np.minimum.reduceat(places, firsts), np.maximum.reduceat(places, firsts)], 1)
