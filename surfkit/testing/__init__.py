"""Checks that the parts of a plugin keep their contract, and small scenes to try them on.

`check(part)` is all that the tests of a plugin need: it looks at what every component must keep to, and at the contract
of the part's kind. A part that breaks it raises AssertionError with a sentence that says what is wrong.
"""

from surfkit.testing.component_checks import check, check_component
from surfkit.testing.compressor_checks import check_compressor, check_encoding
from surfkit.testing.data_sets import check_depth_layout, check_split
from surfkit.testing.executors import check_executor
from surfkit.testing.feature_checks import check_feature_extractor, check_feature_matcher
from surfkit.testing.format_checks import check_format
from surfkit.testing.image_part_checks import (
    check_appearance,
    check_depth_estimator,
    check_fill,
    check_loss,
    check_regularizer,
    check_transients,
)
from surfkit.testing.levels import check_levels_of_detail
from surfkit.testing.method_checks import check_method
from surfkit.testing.optimizer_checks import check_optimizer
from surfkit.testing.policy_checks import (
    check_densify,
    check_filter,
    check_policy,
    check_prune,
    check_signal,
)
from surfkit.testing.primitive import check_primitive
from surfkit.testing.raster import check_rasterizer
from surfkit.testing.scenes import check_assign, check_partition, check_reader, check_refine, check_start
from surfkit.testing.surfaces import check_mesher, check_trust

__all__ = [
    "check",
    "check_appearance",
    "check_assign",
    "check_component",
    "check_compressor",
    "check_densify",
    "check_depth_estimator",
    "check_depth_layout",
    "check_encoding",
    "check_executor",
    "check_feature_extractor",
    "check_feature_matcher",
    "check_fill",
    "check_filter",
    "check_format",
    "check_levels_of_detail",
    "check_loss",
    "check_mesher",
    "check_method",
    "check_optimizer",
    "check_partition",
    "check_policy",
    "check_primitive",
    "check_prune",
    "check_rasterizer",
    "check_reader",
    "check_refine",
    "check_regularizer",
    "check_signal",
    "check_split",
    "check_start",
    "check_transients",
    "check_trust",
]
