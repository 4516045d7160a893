"""Geometry-aware density control (GSDF, Yu et al. 2024): splats grow where the surface is, and fade away from it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import torch
from surfkit_octree.growth import OPACITY, VIEWS
from torch import Tensor

from surfkit.plugin import Densify, Edit, Points, Step


def nearness(sdf: Tensor, sigma: float) -> Tensor:
    """mu(s) = exp(-s^2 / (2 sigma^2)), from 0 to 1, of signed distances, any shape; 0 where they are inf."""
    return torch.exp(-sdf.square() / (2 * sigma**2))


@dataclass(frozen=True)
class NearSurface(Densify):
    """Another densifier that sees gradients and opacities as the surface would have them:

        gradient + grow mu(s)           where it adds points
        opacity - prune (1 - mu(s))     where it drops faint ones

    with s the signed distance at a splat. Where points are anchors, each Gaussian has its own s for the first, and each
    anchor for the second; their opacities are means over views of the sum over their Gaussians.

    Attributes:
        inner: The other densifier.
        distances: (P,) signed distances of (P, 3) local positions.
        sigma: Of mu, in the unit of the distances.
        grow, prune: Weights.
        after: The last step in which it sees them as they are, as the surface is not there yet.
    """

    inner: Densify
    distances: Callable[[Tensor], Tensor]
    sigma: float
    grow: float
    prune: float
    after: int

    def edits(self, steps: int) -> Sequence[int] | None:
        """See `Densify.edits`."""
        return self.inner.edits(steps)

    @property
    def needs_absolute(self) -> bool:
        """See `Densify.needs_absolute`."""
        return self.inner.needs_absolute

    @property
    def most_points(self) -> int | None:
        """See `Densify.most_points`."""
        return self.inner.most_points

    def limited(self, points: int) -> NearSurface:
        """See `Densify.limited`."""
        return replace(self, inner=self.inner.limited(points))

    def watch(self, points: Points, step: Step) -> None:
        """See `Policy.watch`; the inner one watches higher gradients near the surface."""
        self.inner.watch(points, step if step.index <= self.after else self._raised(step))

    def edit(self, points: Points, step: Step) -> Edit | None:
        """See `Policy.edit`; the inner one sees lower opacities far from the surface."""
        due = self.inner.edits(step.steps)
        if step.index <= self.after or (due is not None and step.index not in due):
            return self.inner.edit(points, step)
        lost = self.prune * (1 - nearness(self.distances(step.splats.means), self.sigma))
        if OPACITY in points.stats:
            opacity = points.stats[OPACITY] - lost * points.stats[VIEWS]
            return self.inner.edit(replace(points, stats=points.stats | {OPACITY: opacity}), step)
        splats = replace(step.splats, opacities=step.splats.opacities - lost)
        return self.inner.edit(points, replace(step, splats=splats))

    def _raised(self, step: Step) -> Step:
        """The step with gradients as they are near the surface; of splats that are not seen they stay 0."""

        def more(means: Tensor, seen: Tensor) -> Tensor:
            found = torch.zeros_like(means[:, 0])
            found[seen] = self.grow * nearness(self.distances(means[seen]), self.sigma)
            return found

        if (made := step.derived) is not None and made.grad_norm is not None:
            raised = made.grad_norm + more(made.splats.means, made.seen)
            return replace(step, derived=replace(made, grad_norm=raised))
        if (view := step.in_view) is not None:
            means = step.splats.means if view.rows is None else step.splats.means[view.rows]
            return replace(step, in_view=replace(view, grad_norm=view.grad_norm + more(means, view.seen)))
        return replace(step, grad_norm=step.grad_norm + more(step.splats.means, step.seen))
