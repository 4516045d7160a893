"""Optimisation of a model; called as a function, `surfkit.train(...)`, it is `surfkit.api.train`."""

import sys

import surfkit

sys.modules[__name__].__class__ = surfkit.TrainFolder
