"""From anchors to the Gaussians or surfels of one view: three small networks that all anchors share (Scaffold-GS)."""

from __future__ import annotations

import math
from collections.abc import Mapping

import torch
from torch import Tensor

from surfkit.plugin import Column, Columns, LearningRate, Splats
from surfkit.primitives.columns import sigmoid

SH_C0 = 0.28209479177387814
"""Value of the constant spherical harmonic."""
SIGHT = 4
"""Inputs of a network beside the feature: view direction and distance."""
SMALLEST = 1e-7
"""No scale below this, local units."""
PER_OFFSET = {"opacity": 1, "shape": 7, "color": 3}
"""Outputs of each network for one Gaussian."""
RATES = {
    "opacity": LearningRate(2e-3, 2e-5),
    "shape": LearningRate(4e-3),
    "color": LearningRate(8e-3, 5e-5),
}


def network_columns(feature: int, hidden: int, offsets: int) -> dict[str, Column]:
    """The weights of the networks: a hidden layer with ReLU each.

    Args:
        feature: Numbers of an anchor's feature.
        hidden: Width of the hidden layers.
        offsets: Gaussians of an anchor.
    """
    found: dict[str, Column] = {}
    for name, each in PER_OFFSET.items():
        shapes = {
            "in": (feature + SIGHT, hidden),
            "in_bias": (hidden,),
            "out": (hidden, each * offsets),
            "out_bias": (each * offsets,),
        }
        found |= {f"{name}_{part}": Column(shape, RATES[name], shared=True) for part, shape in shapes.items()}
    return found


def fresh_networks(columns: Mapping[str, Column], generator: torch.Generator) -> Columns:
    """Weights drawn evenly within 1 / sqrt(inputs) of 0, as is usual for linear layers."""
    found = {}
    for name in PER_OFFSET:
        for layer in ("in", "out"):
            inputs, outputs = columns[f"{name}_{layer}"].of_point
            for part, shape in ((layer, (inputs, outputs)), (f"{layer}_bias", (outputs,))):
                drawn = torch.rand(shape, generator=generator)
                found[f"{name}_{part}"] = (2 * drawn - 1) / math.sqrt(inputs)
    return found


def decode(kind: str, anchors: Splats, rows: Tensor, centre: Tensor) -> tuple[Splats, Tensor]:
    """The splats that some anchors stand for, seen from a place, with the graph to the anchors and the networks.

    Position: anchor + offset * scale. The opacity is what is above 0 of a tanh, the colour and the factor of the second
    three scales are sigmoids (Scaffold-GS, section 3.2).

    Args:
        kind: "gaussian" or "surfel".
        anchors: As `Anchors.activate` gives them, k offsets each.
        rows: (V,) int64, the anchors to decode.
        centre: (3,) of the camera.

    Returns:
        V k splats, those of an anchor in a row in the order of its offsets; and (V k,) int64 their anchors.
    """
    means, offsets, sizes = anchors.means[rows], anchors.extra["offsets"][rows], anchors.extra["sizes"][rows]
    sight = means - centre.to(means)
    distance = sight.norm(dim=-1, keepdim=True).clamp_min(1e-9)
    seen = torch.cat([anchors.extra["feature"][rows], sight / distance, distance], 1)
    count = offsets.shape[1]
    opacity, shape, color = (
        network(name, anchors.shared, seen).reshape(len(rows) * count, each) for name, each in PER_OFFSET.items()
    )
    opacity = opacity[:, 0].tanh().clamp_min(0) * anchors.opacities[rows].repeat_interleave(count)
    scales = (sizes[:, 3:].repeat_interleave(count, 0) * sigmoid(shape[:, :3])).clamp_min(SMALLEST)
    made = Splats(
        kind,
        (means[:, None] + offsets * sizes[:, None, :3]).reshape(-1, 3),
        torch.nn.functional.normalize(shape[:, 3:], dim=-1),
        scales[:, :2] if kind == "surfel" else scales,
        opacity,
        ((sigmoid(color) - 0.5) / SH_C0)[:, None],
    )
    return made, rows.repeat_interleave(count)


def network(name: str, weights: Mapping[str, Tensor], inputs: Tensor) -> Tensor:
    """(V, outputs) of (V, inputs), before the last activation."""
    hidden = torch.relu(inputs @ weights[f"{name}_in"] + weights[f"{name}_in_bias"])
    return hidden @ weights[f"{name}_out"] + weights[f"{name}_out_bias"]
