"""What differs from photograph to photograph though the scene does not."""

from collections.abc import Mapping

from surfkit.appearance.camera_response import CameraResponse
from surfkit.appearance.exposure import Exposure
from surfkit.core.hooks import hookimpl
from surfkit.core.registry import Component


@hookimpl
def surfkit_components() -> Mapping[str, type[Component]]:
    """Appearance models, by name."""
    return {"camera-response": CameraResponse, "exposure": Exposure}
