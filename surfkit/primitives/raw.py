"""Splats of a file as raw parameters of a primitive, whatever their kind and degree."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from surfkit.core.check import BadInput
from surfkit.io.splats.splat_table import SplatTable
from surfkit.primitives.columns import EXP, RATES, SIGMOID, Column
from surfkit.primitives.init import SH_C0
from surfkit.primitives.points import Columns
from surfkit.scene.scene import SparsePoints

TURNS = ((0.5, 0.5, 0.5, 0.5), (0.5, -0.5, -0.5, -0.5))
"""Quaternions wxyz that make the first, and the second, of three axes the third: turns of 120 degrees."""


def raw_columns(what: str, columns: Mapping[str, Column], table: SplatTable) -> Columns:
    """The standard raw columns (`columns.standard_columns`) of N splats in the local frame, float32.

    Values of the table are taken as they are where the activation is that of files, and go through its inverse where it
    is another. Where the primitive has two scales and the table three, the thinnest axis is left out and becomes the
    normal; where it has three and the table two, the third is the smaller of the two times THINNESS. Spherical
    harmonics are cut, or get zeros.

    Args:
        what: Whose columns they are, for the message.
        columns: What the primitive declares.
        table: The splats.

    Raises:
        BadInput: A standard column is not declared, or has another shape.
    """
    for name, shapes in {"scales": ((2,), (3,)), "quats": ((4,),), "opacities": ((),), "sh0": ((1, 3),)}.items():
        if name not in columns or columns[name].shape not in shapes:
            raise BadInput(
                f"{what} cannot begin at the splats of a file, as it has no column {name!r} of "
                f"{' or '.join(map(str, shapes))} values; it needs a `from_table` of its own, or choose another"
            )
    axes, rest = columns["scales"].of_point[0], columns["sh_rest"].of_point[0] if "sh_rest" in columns else 0
    log_scales, quats = with_axes(table, axes)
    sh_rest = torch.nn.functional.pad(table.sh_rest[:, :rest], (0, 0, 0, max(0, rest - table.sh_rest.shape[1])))
    scales, opacities = columns["scales"].activation, columns["opacities"].activation
    logits = table.opacity_logits
    found = {
        "means": table.means,
        "scales": log_scales if scales is EXP else scales.inverse(log_scales.double().exp()),
        "quats": quats,
        "opacities": logits if opacities is SIGMOID else opacities.inverse(logits.double().sigmoid()),
        "sh0": table.sh0[:, None],
        "sh_rest": sh_rest,
    }
    return {name: found[name].float().contiguous().clone() for name in RATES if name in columns}


def with_axes(table: SplatTable, axes: int) -> tuple[Tensor, Tensor]:
    """(N, axes) logarithms of scales and (N, 4) rotations of splats that shall have 2 or 3 axes."""
    log_scales, quats = table.log_scales, table.quats
    if axes == 3:
        return table.ellipsoid_log_scales(), quats
    if log_scales.shape[1] == 2:
        return log_scales, quats
    order = torch.tensor([[1, 2], [2, 0], [0, 1]])  # the axes left, so that the others stay right-handed
    thinnest = log_scales[:, [2, 0, 1]].argmin(1)  # the third where several are equally thin
    thinnest = torch.tensor([2, 0, 1])[thinnest]
    turned = quats.clone()
    for axis, turn in enumerate(TURNS):
        rows = thinnest == axis
        turned[rows] = product(quats[rows], quats.new_tensor(turn))
    return log_scales.gather(1, order[thinnest]), turned


def product(first: Tensor, second: Tensor) -> Tensor:
    """(N, 4) products of quaternions wxyz (N, 4) with one (4,): the turn `second`, then `first`."""
    w, axis, v = first[:, :1], first[:, 1:], second[1:]
    scalar = second[0] * w - axis @ v[:, None]
    return torch.cat([scalar, w * v + second[0] * axis + torch.linalg.cross(axis, v.expand_as(axis))], 1)


def cloud_of(table: SplatTable) -> SparsePoints:
    """Points at the splats, with what a cloud knows of each: colour from everywhere, opacity and mean size."""
    rgb = (255 * (0.5 + SH_C0 * table.sh0)).round().clamp(0, 255).to(torch.uint8)
    opacity = table.opacity_logits.float().sigmoid().clamp(1e-6, 1 - 1e-6)
    size = table.log_scales.float().topk(2, 1).values.mean(1).exp()
    return SparsePoints(table.means.float(), rgb, opacity=opacity, size=size)
