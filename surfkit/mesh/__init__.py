"""From splats to triangles."""

from collections.abc import Mapping

from surfkit.core.hooks import hookimpl
from surfkit.core.registry import Component
from surfkit.mesh.geometric_consistency import GeometricConsistency
from surfkit.mesh.poisson import Poisson
from surfkit.mesh.stereo import Stereo
from surfkit.mesh.tetra import Tetra
from surfkit.mesh.tsdf import TSDF
from surfkit.mesh.visibility import Visibility


@hookimpl
def surfkit_components() -> Mapping[str, type[Component]]:
    """Names of what this folder offers."""
    return {
        "tsdf": TSDF,
        "tetra": Tetra,
        "poisson": Poisson,
        "stereo": Stereo,
        "visibility": Visibility,
        "agreement": GeometricConsistency,
    }
