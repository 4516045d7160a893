"""From signed distances along a ray to the weights of its samples (Wang et al. 2021, NeuS)."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import logsigmoid, relu


def section_alphas(front: Tensor, back: Tensor, sharpness: Tensor | float) -> Tensor:
    """Opacity of sections of a ray, max((Phi_s(f_i) - Phi_s(f_i+1)) / Phi_s(f_i), 0) (eq. 13).

    Phi_s(f) = 1 / (1 + exp(-s f)). Computed as 1 - exp(log Phi_s(f_i+1) - log Phi_s(f_i)), which needs no small number
    in the denominator deep below the surface.

    Args:
        front, back: Signed distances where the section begins and ends, any shape.
        sharpness: s, 1 / length.
    """
    return -torch.expm1((logsigmoid(sharpness * back) - logsigmoid(sharpness * front)).clamp_max(0))


def section_ends(middle: Tensor, slope: Tensor, length: Tensor, anneal: float) -> tuple[Tensor, Tensor]:
    """Signed distances at both ends of sections, from that in their middle and the slope along the ray.

    Slopes above 0, where the ray leaves the surface, count as 0. Early in training, `anneal` below 1 makes all slopes
    fall, so that a wrong surface can be seen from behind and moved: it weighs relu(-slope) against half of relu(1 -
    slope).

    Args:
        middle: Signed distances.
        slope: Their derivative along the ray.
        length: Of the sections.
        anneal: From 0 at the first step to 1.
    """
    fall = anneal * relu(-slope) + (1 - anneal) * relu(0.5 - 0.5 * slope)
    half = 0.5 * fall * length
    return middle + half, middle - half


def weights_of(alphas: Tensor) -> tuple[Tensor, Tensor]:
    """(R, N) weights alpha_i T_i of the samples of R rays, T_i the product of 1 - alpha before; (R,) T behind all."""
    through = torch.nn.functional.pad((1 - alphas).cumprod(1), (1, 0), value=1.0)
    return alphas * through[:, :-1], through[:, -1]
