"""Trained models in fewer bytes."""

from surfkit.core.hooks import hookimpl


@hookimpl
def surfkit_components():
    """Names of what this folder offers."""
    from surfkit.compress.colors import Codes, PrincipalComponents
    from surfkit.compress.format import SurfkitFile
    from surfkit.compress.lossless import Float16, Lossless
    from surfkit.compress.packed import Packed
    from surfkit.compress.scalars import Floats, LogSteps, MortonPositions, SmallestThree, UniformLevels
    from surfkit.compress.vectree import Vectree

    encodings = {
        "cells": MortonPositions, "codes": Codes, "floats": Floats, "levels": UniformLevels, "log-steps": LogSteps,
        "principal-components": PrincipalComponents, "smallest-three": SmallestThree,
    }  # fmt: skip
    compressors = {"float16": Float16, "lossless": Lossless, "packed": Packed, "vectree": Vectree}
    return encodings | compressors | {"surfkit": SurfkitFile}
