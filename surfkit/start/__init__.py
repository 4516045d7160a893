"""Initial points of the optimisation, by registered name."""

from surfkit.core.hooks import hookimpl
from surfkit.start.plain import RandomStart, SparseStart
from surfkit.start.splats import SplatStart
from surfkit.start.stereo import StereoStart


@hookimpl
def surfkit_components():
    return {"sparse": SparseStart, "stereo": StereoStart, "random": RandomStart, "splats": SplatStart}
