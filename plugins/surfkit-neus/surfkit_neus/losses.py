"""What the field is optimised for. Each loss is a mean, so that its weight does not depend on the number of rays."""

from __future__ import annotations

import torch
from torch import Tensor


def color_loss(drawn: Tensor, photo: Tensor, weight: Tensor) -> Tensor:
    """Mean absolute difference of (R, 3) colours over the rays with a weight (R,) above 0; 0 where there are none."""
    return ((drawn - photo).abs().mean(1) * weight).sum() / weight.sum().clamp_min(1e-6)


def eikonal_loss(gradient: Tensor, inside: Tensor) -> Tensor:
    """Mean of (|gradient| - 1)^2 over the (P, 3) gradients that count, (P,) bool."""
    length = (gradient.square().sum(1) + 1e-12).sqrt()  # the root of 0 has no derivative
    return ((length - 1).square() * inside).sum() / inside.sum().clamp_min(1)


def curvature_loss(laplacian: Tensor, inside: Tensor) -> Tensor:
    """Mean of |laplacian| over the (P,) that count, (P,) bool (Li et al. 2023, eq. 5)."""
    return (laplacian.abs() * inside).sum() / inside.sum().clamp_min(1)


def points_loss(sdf: Tensor) -> Tensor:
    """Mean |distance| at points that lie on the surface (Geo-NeuS, Fu et al. 2022, eq. 9), (K,)."""
    return sdf.abs().mean()


def depth_loss(drawn: Tensor, prior: Tensor, confidence: Tensor) -> Tensor:
    """Mean relative difference of (R,) depths to those of a prior, by its confidence (R,); 0 where there is none."""
    there = confidence * (prior > 0)
    apart = (drawn - prior).abs() / prior.clamp_min(1e-6)
    return (apart * there).sum() / there.sum().clamp_min(1e-6) if bool((there > 0).any()) else torch.zeros(())
