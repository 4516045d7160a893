"""From a scene to a reconstruction."""

from collections.abc import Mapping

from surfkit.core.registry import Component, hookimpl
from surfkit.method.imported import SplatImport
from surfkit.method.splats import SplatOptimisation
from surfkit.method.stereo import StereoFusion


@hookimpl
def surfkit_components() -> Mapping[str, type[Component]]:
    """Names of what this folder offers."""
    return {"splats": SplatOptimisation, "stereo": StereoFusion, "import": SplatImport}
