"""Splats that are much larger than what the photographs resolve: they paint places that few of them see."""

from __future__ import annotations

from dataclasses import replace

from surfkit.core.check import BadInput
from surfkit.mesh.base import MeshInput
from surfkit.mesh.fusion_image import Which
from surfkit.mesh.fusion_lengths import look


def without_oversized(subject: MeshInput, largest_px: float, which: Which) -> MeshInput:
    """What is to be meshed, without splats of a standard deviation above so many pixels at the median depth.

    Few views fix where such a splat lies, as at the rim of a survey; and it hides the smaller ones behind it.

    Raises:
        BadInput: None would be left, or what is drawn are no splats.
    """
    if subject.draw_of is None:
        raise BadInput("mesh.largest_px leaves out splats, and what is drawn here is not made of splats; give 0")
    _, pixel, _ = look(subject, which)
    kept = subject.splats.scales.amax(1) <= largest_px * pixel
    if kept.all():
        return subject
    if not kept.any():
        raise BadInput(
            f"mesh.largest_px {largest_px:g}: all {len(kept)} splats are larger; give more, or 0 for no limit"
        )
    splats = subject.splats.take(kept)
    return replace(subject, splats=splats, draw=subject.draw_of(splats))
