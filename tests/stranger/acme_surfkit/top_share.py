"""A densifier that knows no limit on the number of points: it has no `cap`, and takes no filters."""

from dataclasses import dataclass

from surfkit.plugin import Densify, Edit

GRAD = "acme/grad"


@dataclass(frozen=True)
class TopShare(Densify):
    """Clone the points with the highest mean gradient since the last edit."""

    share: float = 0.1
    """Of the points, that is cloned at each edit."""

    every: int = 2
    """Steps between edits."""

    def watch(self, points, step):
        """Sum the gradients."""
        points.stat(GRAD).add_(step.grad_norm)

    def edit(self, points, step):
        """Clone, every so often."""
        count = int(self.share * len(points))
        if step.index % self.every or not count:
            return None
        gradients = points.stat(GRAD)
        return Edit(clone=gradients >= gradients.topk(count).values[-1])
