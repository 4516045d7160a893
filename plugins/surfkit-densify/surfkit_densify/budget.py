"""Points are added to a number that is known beforehand, where a score of many terms is high (Mallick et al. 2024)."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from surfkit.plugin import ADC, BadInput, ComparedView, Densify, Edit, Points, Step, ssim_map

FIRST_STAT, SCORE_STAT = "budget/first", "budget/score"
WEIGHTS = {"gradient": 25.0, "opacity": 100.0, "radius": 10.0, "volume": 25.0, "blend": 50.0}
"""Of the terms of the score. The published one has four more: depth 5, and of each pixel that a point is in, the
distance to its centre 50, the loss 10 and the count 0.1."""
OF_L1, OF_EDGES = 50.0, 50.0
"""Weights of the error of a pixel and of the edges of the photograph there in the term "blend"."""
VIEW_WEIGHT = 50.0
"""Of what a view adds to the score, times its loss; it is the same for all, so draws do not change with it."""


@dataclass(frozen=True)
class Budget(Densify):
    """Densify up to a number of points along a curve that is steep first and flat at the end; of the points that ADC
    would densify, those are drawn at random that score high (Taming 3DGS)."""

    budget: int = 1_000_000
    """Points after the last edit, if ADC names enough to densify."""

    views: int = 10
    """Views that the score is of: those of the last so many steps before an edit."""

    adc: ADC = ADC()
    """Schedule, removal, filters and resets of opacities, and the tests that name the points to clone and to split."""

    def __post_init__(self) -> None:
        for name in ("budget", "views"):
            if getattr(self, name) < 1:
                raise BadInput(f"densify.{name} is {getattr(self, name)}; it must be 1 or more")

    @property
    def needs_pixels(self) -> bool:
        """See `Densify.needs_pixels`."""
        return True

    @property
    def needs_absolute(self) -> bool:
        """See `Densify.needs_absolute`."""
        return self.adc.needs_absolute

    def edits(self, steps: int) -> range:
        """See `Densify.edits`."""
        return self.adc.edits(steps)

    @property
    def most_points(self) -> int:
        """See `Densify.most_points`."""
        return min(self.budget, self.adc.most_points or self.budget)

    def limited(self, points: int) -> Budget:
        """See `Densify.limited`; the curve ends at the limit."""
        return replace(self, budget=min(self.budget, points))

    def watch(self, points: Points, step: Step) -> None:
        """Keep the statistics of ADC, the number of points at first, and the score of the views before an edit."""
        self.adc.watch(points, step)
        first = points.stat(FIRST_STAT)
        if step.index == 1:
            first.fill_(len(points))
        ahead = -step.index % self.adc.every  # steps to the next edit
        if ahead >= self.views or not self.adc.is_due(step.index + ahead):
            return
        score = points.stat(SCORE_STAT)
        if ahead == min(self.views, self.adc.every) - 1:
            score.zero_()
        if step.view is None:
            raise BadInput("densify: a step without `view`; whoever makes steps for densify:budget must give it")
        step.shown.add(score, score_of(step, step.view))

    def edit(self, points: Points, step: Step) -> Edit | None:
        """As ADC, but with as many clones and splits, in proportion, as bring the points to the curve."""
        edit = self.adc.edit(points, step)
        if edit is None or not self.adc.is_due(step.index):
            return edit
        assert edit.clone is not None and edit.split is not None and edit.drop is not None, "ADC gives all three"
        events, score = self.edits(step.steps), points.stat(SCORE_STAT)
        at_first = int(points.stat(FIRST_STAT).max())  # 0 for points that came later
        target = self.target(at_first, events.index(step.index) + 1, len(events))
        clone, split = edit.clone & ~edit.drop, edit.split & ~edit.drop
        named = int(clone.sum()) + int(split.sum())
        room = min(max(0, target - int((~edit.drop).sum())), named)
        clones = round(room * int(clone.sum()) / max(named, 1))
        draw = torch.Generator().manual_seed(step.seed)
        hot = drawn(score, clone, clones, draw) | drawn(score, split, room - clones, draw)
        return self.adc.edit_of(points, step, hot)

    def target(self, at_first: int, event: int, events: int) -> int:
        """Points after edit 1 to `events`: N(x) = N0 + k x + a x^2, with k = 2 (B - N0) / n and a = -(B - N0) / n^2.

        So N(0) = N0 and N(n) = B, where the curve is flat. Where there are more than B at first, B.
        """
        more, share = self.most_points - at_first, event / events
        return min(self.most_points, at_first + round(more * (2 * share - share**2)))


def score_of(step: Step, view: ComparedView) -> Tensor:
    """(R,) what one view adds to the score of the points of `step.shown`: its loss times the sum of the terms, each
    divided by its median over the points where it is above 0. Points that the view does not show get 0."""
    shown, splats = step.shown, step.splats
    rows = slice(None) if shown.rows is None else shown.rows
    difference = (view.color - view.photo).abs().mean(0)
    edges = torch.hypot(*torch.gradient(view.photo.mean(0)))
    terms = {
        "gradient": shown.grad_norm,
        "opacity": splats.opacities[rows],
        "radius": shown.radii,
        "volume": splats.scales[rows].prod(-1),
        "blend": view.blended(OF_L1 * difference + OF_EDGES * edges),
    }
    loss = 0.8 * difference.mean() + 0.2 * (1 - ssim_map(view.color, view.photo).mean())
    total = sum(weight * relative(terms[name] * shown.seen) for name, weight in WEIGHTS.items())
    return VIEW_WEIGHT * loss * total


def relative(values: Tensor) -> Tensor:
    """(R,) values of 0 or more, divided by the median of those above 0."""
    above = values[values > 0]
    return values / above.median() if len(above) else values


def drawn(weights: Tensor, among: Tensor, count: int, draw: torch.Generator) -> Tensor:
    """(N,) bool, `count` rows of a (N,) mask, drawn without replacement in proportion to (N,) weights.

    They are those of the largest log(u) / weight with u uniform in (0, 1), which comes to the same as multinomial draws
    one after the other (Efraimidis and Spirakis 2006). Rows of weight 0 come last.
    """
    rows = among.nonzero()[:, 0]
    u = torch.rand(len(weights), generator=draw, dtype=torch.float64).to(weights.device)[rows]
    keys = u.clamp_min(1e-300).log() / weights[rows].double()
    return torch.zeros_like(among).index_fill(0, rows[keys.topk(count).indices], True)
