"""One splat for a group of them: the mean and the covariance of the mixture, and its opacity times area."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace

import numpy as np
import torch

from surfkit.compress.levels.merge_cost import MergeCost, summed
from surfkit.core.check import BadInput
from surfkit.core.registry import name_of
from surfkit.primitives.base import Primitive
from surfkit.primitives.init import SH_C0
from surfkit.primitives.model import SplatModel
from surfkit.primitives.points import Columns
from surfkit.raster.api import ALPHA_MAX, PRIMITIVE_KINDS, Splats
from surfkit.scene.rotations import numpy_quaternions, numpy_rotations
from surfkit.scene.scene import SparsePoints

SHAPE = ("means", "quats", "scales", "opacities")
"""Columns that are merged as a shape; all others become weighted means."""
MIN_MERGED_SCALE = 1e-7
"""Smallest scale of what is merged, local units: a row of discs has no width."""


def refuse_unmergeable(primitive: Primitive, lod: str) -> None:
    """BadInput if the splats of a primitive are not what its columns means, quats, scales and opacities say; `lod` is
    the name of the part that is to merge them."""
    columns = primitive.columns()
    shapes = {"means": ((3,),), "quats": ((4,),), "scales": ((2,), (3,)), "opacities": ((),)}
    lacking = [
        name
        for name, allowed in shapes.items()
        if name not in columns or columns[name].shared or tuple(columns[name].shape) not in allowed
    ]
    complaint = f"lod:{lod} cannot merge splats of primitive {name_of(primitive)}"
    remedy = "choose lod:prune, which only drops some"
    if lacking:
        raise BadInput(
            f"{complaint}: it needs columns means (3,), quats (4,), scales (2,) or (3,) and opacities (), and "
            f"{lacking[0]} is not so; {remedy}"
        )
    places = torch.tensor([[0.0, 0, 0], [0.1, 0, 0], [0, 0.2, 0], [0, 0, 0.4]])
    params = primitive.init(
        SparsePoints(places, torch.full((4, 3), 128, dtype=torch.uint8)), torch.Generator().manual_seed(0)
    )
    splats = primitive.activate(params, 0)
    if splats.kind not in PRIMITIVE_KINDS:
        raise BadInput(f"{complaint}: they are {splats.kind}s, and not {' or '.join(PRIMITIVE_KINDS)}s; {remedy}")
    for name in SHAPE:
        value, drawn = columns[name].activation.value(params[name]), getattr(splats, name)
        drawn = drawn[:, : value.shape[1]] if value.dim() > 1 else drawn
        if value.shape != drawn.shape or not torch.allclose(value, drawn, rtol=1e-4, atol=1e-7):
            raise BadInput(f"{complaint}: its column {name} is not what is drawn; {remedy}")


@dataclass(frozen=True)
class Shapes:
    """N splats as Gaussians, float64.

    Attributes:
        means: (N, 3).
        turns: (N, 3, 3) rotations from the axes of each splat to the world.
        scales: (N, 3) standard deviations along the axes; the third of a disc is 0.
        opacities: (N,).
    """

    means: np.ndarray
    turns: np.ndarray
    scales: np.ndarray
    opacities: np.ndarray

    @classmethod
    def of(cls, splats: Splats) -> Shapes:
        """Those of activated splats."""
        scales = splats.scales.detach().double().cpu().numpy()
        return cls(
            splats.means.detach().double().cpu().numpy(),
            numpy_rotations(splats.quats.detach().double().cpu().numpy()),
            np.pad(scales, ((0, 0), (0, 3 - scales.shape[1]))),
            splats.opacities.detach().double().cpu().numpy(),
        )

    @property
    def covariances(self) -> np.ndarray:
        """(N, 3, 3)."""
        axes = self.turns * self.scales[:, None, :]
        return np.einsum("nij,nkj->nik", axes, axes)

    @property
    def areas(self) -> np.ndarray:
        """(N,) about what they cover, in units of the sight of a disc from above: that of an ellipsoid is like it."""
        x, y, z = self.scales.T
        return x * y + y * z + z * x

    @property
    def normals(self) -> np.ndarray:
        """(N, 3) the thinnest axis, as long as the splat is flat."""
        thin = np.argsort(self.scales, axis=1)
        ordered = np.take_along_axis(self.scales, thin, axis=1)
        axis = np.take_along_axis(self.turns, thin[:, None, :1], axis=2)[..., 0]
        return axis * (1 - ordered[:, :1] / np.maximum(ordered[:, 1:2], MIN_MERGED_SCALE))

    def merged(self, labels: np.ndarray, weights: np.ndarray, flat: bool) -> Shapes:
        """One for each group, with the axes from the longest to the shortest.

        The mean and the covariance of the mixture are kept, and the sum of opacity times area. Where that would need
        an opacity above ALPHA_MAX, splats overlapped: half of the excess, as a factor, goes into the area, and half is
        taken as hidden. (On a model of 32,000 surfels, half of them left: 39.6 dB against the full model; 33.3 dB with
        all of it in the area, 36.6 dB with none.)

        Args:
            labels: (N,) groups.
            weights: (N,) of each splat in the mixture.
            flat: Whether discs are wanted: the third axis is dropped.
        """
        total = summed(weights, labels)
        means = summed(self.means * weights[:, None], labels) / total[:, None]
        off = self.means - means[labels]
        spread = self.covariances + off[:, :, None] * off[:, None, :]
        values, axes = np.linalg.eigh(summed(spread * weights[:, None, None], labels) / total[:, None, None])
        axes = axes[:, :, ::-1].copy()
        axes[np.linalg.det(axes) < 0, :, 2] *= -1
        scales = np.sqrt(np.maximum(values[:, ::-1], MIN_MERGED_SCALE**2))
        if flat:
            scales[:, 2] = 0
        made = Shapes(means, axes, scales, np.ones(len(means)))
        opacities = summed(self.opacities * self.areas, labels) / made.areas
        excess = np.maximum(opacities / ALPHA_MAX, 1.0)
        return replace(made, scales=scales * excess[:, None] ** 0.25, opacities=np.minimum(opacities, ALPHA_MAX))


def merged_model(model: SplatModel, labels: np.ndarray, weights: np.ndarray) -> SplatModel:
    """The model with one point for each group of its points.

    Args:
        model: Of a primitive that `refuse_unmergeable` takes.
        labels: (N,) groups 0..G-1.
        weights: (N,) of the points, above 0; colours and what else a point has become weighted means.
    """
    columns, shared = model.primitive.columns(), model.primitive.shared()
    flat = columns["scales"].shape == (2,)
    made = Shapes.of(model.splats).merged(labels, weights, flat)
    shape = {
        "means": made.means,
        "quats": numpy_quaternions(made.turns),
        "scales": made.scales[:, : columns["scales"].shape[0]],
        "opacities": made.opacities,
    }
    total = summed(weights, labels)
    params: Columns = {}
    for name, raw in model.params.items():
        if name in shared:
            params[name] = raw.clone()
            continue
        if name in shape:
            value = shape[name]
        else:
            each = columns[name].activation.value(raw.detach()).double().cpu().numpy().reshape(len(raw), -1)
            value = summed(each * weights[:, None], labels) / total[:, None]
        activated = torch.from_numpy(np.ascontiguousarray(value)).view(len(total), *raw.shape[1:])
        with one_thread():
            params[name] = columns[name].activation.inverse(activated).to(raw)
    return replace(model, params=params)


@contextmanager
def one_thread() -> Iterator[None]:
    """Within, torch computes in one thread: it rounds the last elements of each thread's share in another way."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


def alike(splats: Splats, weights: np.ndarray) -> MergeCost:
    """What tells which splats are alike; `weights`: (N,) of them."""
    shapes = Shapes.of(splats)
    colors = 0.5 + SH_C0 * splats.sh0[:, 0].detach().double().cpu().numpy()
    return MergeCost(shapes.means, weights, colors, shapes.normals)
