"""Where rays are looked at: evenly through the box, then again where the field puts the surface, and beyond the box."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from surfkit_neus.weights import section_alphas, weights_of

FIRST_SHARPNESS = 64.0
"""s of the first round of importance sampling; it doubles from round to round (Wang et al. 2021, section 3.3)."""
EVERYWHERE = 1e-5
"""Added to the weight of every section: rays that meet nothing are sampled evenly."""


def even_samples(near: Tensor, far: Tensor, count: int, draw: torch.Generator | None) -> Tensor:
    """(R, count) distances from near to far, sorted; moved together by up to half a gap on each ray, if `draw`."""
    share = torch.linspace(0, 1, count, device=near.device)[None]
    if draw is not None:
        move = torch.rand(len(near), 1, generator=draw).to(near) - 0.5
        share = (share + move / max(1, count - 1)).clamp(0, 1)
    return near[:, None] + (far - near)[:, None] * share


def importance_samples(t: Tensor, weights: Tensor, count: int) -> Tensor:
    """(R, count) distances at even quantiles of the sections between (R, N) distances, by weights (R, N - 1)."""
    weights = weights + EVERYWHERE
    ends = torch.nn.functional.pad((weights / weights.sum(1, keepdim=True)).cumsum(1), (1, 0))
    wanted = ((torch.arange(count, device=t.device) + 0.5) / count).to(t).expand(len(t), count).contiguous()
    at = torch.searchsorted(ends, wanted, right=True).clamp(1, t.shape[1] - 1)
    low, high = ends.gather(1, at - 1), ends.gather(1, at)
    share = ((wanted - low) / (high - low).clamp_min(1e-12)).clamp(0, 1)
    return torch.lerp(t.gather(1, at - 1), t.gather(1, at), share)


@torch.no_grad()
def surface_samples(t: Tensor, distances: Callable[[Tensor], Tensor], count: int, rounds: int) -> Tensor:
    """(R, N + count) sorted distances: those given, and `count` where weights are high, in rounds of rising sharpness.

    Args:
        t: (R, N) sorted.
        distances: (R, M) signed distances of the field at (R, M) distances along the rays.
        count: New ones on each ray.
        rounds: Among which they are shared out.
    """
    if not count:
        return t
    sdf = distances(t)
    for at in range(rounds):
        share = count * (at + 1) // rounds - count * at // rounds
        weights = weights_of(section_alphas(sdf[:, :-1], sdf[:, 1:], FIRST_SHARPNESS * 2**at))[0]
        fresh = importance_samples(t, weights, share)
        t, order = torch.cat([t, fresh], 1).sort(1)
        if at < rounds - 1:
            sdf = torch.cat([sdf, distances(fresh)], 1).gather(1, order)
    return t


def beyond_samples(start: Tensor, count: int, draw: torch.Generator | None) -> Tensor:
    """(R, count + 1) sorted distances from `start` outwards, even in the inverse of the distance; moved if `draw`."""
    place = torch.arange(count + 1, device=start.device).to(start).expand(len(start), count + 1)
    if draw is not None:
        move = torch.rand(len(start), 1, generator=draw).to(start) - 0.5
        place = torch.cat([place[:, :1], place[:, 1:] + move], 1)
    return start[:, None] * (count + 1) / (count + 1 - place)
