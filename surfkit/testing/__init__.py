"""Checks that the parts of a plugin keep their contract, and small scenes to try them on."""

from surfkit.testing.checks import (
    check_component,
    check_loss,
    check_mesher,
    check_partition,
    check_policy,
    check_refine,
)
from surfkit.testing.data_sets import check_depth_layout, check_split
from surfkit.testing.method import check_method
from surfkit.testing.primitive import check_primitive

__all__ = [
    "check_component",
    "check_depth_layout",
    "check_loss",
    "check_mesher",
    "check_method",
    "check_partition",
    "check_policy",
    "check_primitive",
    "check_refine",
    "check_split",
]
