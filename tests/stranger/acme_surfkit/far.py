"""A pruner."""

from dataclasses import dataclass

from surfkit.plugin import BadInput, Edit, Prune


@dataclass(frozen=True)
class Far(Prune):
    """Drop points that are far from the cameras, every so many steps."""

    radius: float = 1.0
    """Largest distance to the mean centre of the cameras, as a share of the scene extent."""

    every: int = 2
    """Steps between edits."""

    def __post_init__(self):
        if self.radius <= 0 or self.every < 1:
            raise BadInput(f"far.radius {self.radius:g}, every {self.every}: give more than 0, and 1 or more")

    def edit(self, points, step):
        """Drop them."""
        if step.index % self.every:
            return None
        return Edit(drop=step.splats.means.norm(dim=1) > self.radius)
