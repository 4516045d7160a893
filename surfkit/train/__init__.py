"""Optimisation of a model; called as a function, `surfkit.train(...)`, it is `surfkit.api.train`."""

import sys
from collections.abc import Mapping

import surfkit
from surfkit.core.hooks import hookimpl
from surfkit.core.registry import Component
from surfkit.train.adam import Adam, AdamInView
from surfkit.train.adam_batch import AdamBatch

sys.modules[__name__].__class__ = surfkit.TrainFolder


@hookimpl
def surfkit_components() -> Mapping[str, type[Component]]:
    """Optimizers, by name."""
    return {"adam": Adam, "adam-in-view": AdamInView, "adam-batch": AdamBatch}
