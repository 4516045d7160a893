"""`surfkit prepare`: what photographs or a data set may need before training."""

from surfkit.cli.prepare_depth import Depth
from surfkit.cli.prepare_photos import Photos
from surfkit.cli.prepare_points import Points

COMMAND = {"photos": Photos, "points": Points, "depth": Depth}
