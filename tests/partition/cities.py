"""A flat city of discs under a grid of cameras."""

from surfkit.partition.base import Ground
from surfkit.testing.inputs import above as below
from surfkit.testing.inputs import coarse_model as city

__all__ = ["FLAT", "below", "city"]

FLAT = Ground((1.0, 0.0, 0.0), (0.0, 1.0, 0.0))
