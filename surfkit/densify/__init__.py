"""What adds and removes points while a scene is optimised."""

from collections.abc import Mapping

from surfkit.core.hooks import hookimpl
from surfkit.core.registry import Component
from surfkit.densify.adc import ADC
from surfkit.densify.filters import CountCap, Elongation
from surfkit.densify.matched import MatchedADC
from surfkit.densify.point_cap import PointCap
from surfkit.densify.prune import PruneByImportance, PruneByOpacity
from surfkit.densify.signal import AbsGradient, LossGradient
from surfkit.densify.trim import Trim


@hookimpl
def surfkit_components() -> Mapping[str, type[Component]]:
    """Policies, filters and signals, by name."""
    return {
        "adc": ADC,
        "matched-adc": MatchedADC,
        "limited": PointCap,
        "elongation": Elongation,
        "count-cap": CountCap,
        "loss-gradient": LossGradient,
        "abs-gradient": AbsGradient,
        "trim": Trim,
        "importance": PruneByImportance,
        "opacity": PruneByOpacity,
    }
