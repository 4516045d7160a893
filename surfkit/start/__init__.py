"""Initial points of the optimisation, by registered name."""

from surfkit.core.hooks import hookimpl
from surfkit.start.pointmap_start import PointmapStart
from surfkit.start.simple_starts import RandomStart, SparseStart
from surfkit.start.splat_start import SplatStart
from surfkit.start.stereo_start import StereoStart


@hookimpl
def surfkit_components():
    simple = {"sparse": SparseStart, "random": RandomStart}
    return simple | {"stereo": StereoStart, "splats": SplatStart, "pointmap": PointmapStart}
