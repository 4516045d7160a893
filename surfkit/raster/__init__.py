"""Pictures of splats, and the way back to their gradients."""

from collections.abc import Mapping

from surfkit.core.hooks import hookimpl
from surfkit.core.registry import Component


@hookimpl
def surfkit_components() -> Mapping[str, type[Component]]:
    """Rasterizers, by name."""
    from surfkit.raster.cuda.gpu import CudaRasterizer
    from surfkit.raster.native_rasterizer import NativeRasterizer
    from surfkit.raster.reference import Reference

    return {"native": NativeRasterizer, "reference": Reference, "nvidia": CudaRasterizer}
