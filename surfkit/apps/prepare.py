"""`surfkit prepare`: what photographs or a data set may need before training."""

from surfkit.apps.prepare_depth import PrepareDepthCommand
from surfkit.apps.prepare_photos import PreparePhotosCommand
from surfkit.apps.prepare_points import PreparePointsCommand

COMMAND = {"photos": PreparePhotosCommand, "points": PreparePointsCommand, "depth": PrepareDepthCommand}
