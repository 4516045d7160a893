"""`surfkit prepare`: what photographs or a data set may need before training."""

from surfkit.apps.prepare_depth import Depth
from surfkit.apps.prepare_photos import Photos
from surfkit.apps.prepare_points import Points

COMMAND = {"photos": Photos, "points": Points, "depth": Depth}
