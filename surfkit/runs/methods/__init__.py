"""From a scene to a reconstruction."""

from collections.abc import Mapping

from surfkit.core.hooks import hookimpl
from surfkit.core.registry import Component
from surfkit.runs.methods.imported import SplatImport
from surfkit.runs.methods.splat_optimisation import SplatOptimisation
from surfkit.runs.methods.stereo_fusion import StereoFusion


@hookimpl
def surfkit_components() -> Mapping[str, type[Component]]:
    """Names of what this folder offers."""
    return {"splats": SplatOptimisation, "stereo": StereoFusion, "import": SplatImport}
