"""What adds and removes points while a scene is optimised."""

from collections.abc import Mapping

from surfkit.core.registry import Component, hookimpl
from surfkit.densify.adc import ADC
from surfkit.densify.filters import Elongation
from surfkit.densify.signal import LossGradient


@hookimpl
def surfkit_components() -> Mapping[str, type[Component]]:
    """Policies, filters and signals, by name."""
    return {"adc": ADC, "elongation": Elongation, "loss-gradient": LossGradient}
