"""Trained models in fewer bytes."""

from surfkit.core.registry import hookimpl


@hookimpl
def surfkit_components():
    """Names of what this folder offers."""
    from surfkit.compress.colors import Codes, PrincipalComponents
    from surfkit.compress.packed import Packed
    from surfkit.compress.plain import Float16, Lossless
    from surfkit.compress.scalars import Cells, Floats, Levels, LogSteps, SmallestThree

    encodings = {
        "cells": Cells, "codes": Codes, "floats": Floats, "levels": Levels, "log-steps": LogSteps,
        "principal-components": PrincipalComponents, "smallest-three": SmallestThree,
    }  # fmt: skip
    return encodings | {"float16": Float16, "lossless": Lossless, "packed": Packed}
