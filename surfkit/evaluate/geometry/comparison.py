"""A reconstruction against the truth: sampled, aligned, cropped, thinned and compared, several times over."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from surfkit.core.check import BadInput
from surfkit.core.events import Progress, Warned, emit
from surfkit.evaluate.geometry.repetition import LEAST, Draw, Measurement, Side, cloud_side, mesh_side, refuse_few
from surfkit.evaluate.geometry.scores import spacing, tree
from surfkit.evaluate.geometry.surface import Surface
from surfkit.evaluate.geometry.transform import read_transform, scale_of
from surfkit.evaluate.geometry.volume import Enough, said, visible_crop
from surfkit.scene.crop import Axis, Crop, read_crop
from surfkit.scene.scene import Frame, View

AUTO_TAU = 1.5
"""Of the mean distance between neighbours in the truth (CityGaussianV2)."""
OFF, FAR_OFF = 2.0, 10.0
"""Thresholds by which half of both clouds miss each other where frames or units may differ, and where they must."""
RESIZED = 0.02
"""Change of size by ICP above which it is told."""
SHORTEST, FURTHEST = 1e-7, 1e4
"""Lengths that can be meant, as shares of the diagonal of the truth."""
MOST_DRAWS = 1000
"""Repetitions: the error bars are known long before."""

Align = Literal["similarity", "rigid", "none"]
WAYS: tuple[Align, ...] = ("none", "rigid", "similarity")


@dataclass(frozen=True)
class Comparison:
    """How a reconstruction is compared with the truth."""

    transform: Path | None = None
    """File with the 4 x 4 matrix that takes the reconstruction's frame to the truth's: four rows of text as in Tanks
    and Temples (SCENE_trans.txt), or JSON. ICP starts from it; the identity if left out."""

    crop: str = "auto"
    """Volume to compare in: a JSON file of Tanks and Temples, `auto` for where enough training views really see the
    truth, or `none`."""

    tau: float | None = None
    """Distance below which a point counts as right, in units of the truth; 1.5 times the mean distance between
    neighbouring points of a cloud if left out. A mesh as truth needs it."""

    voxel: float | None = None
    """Thin a cloud of truth to one point for each voxel of this edge first. Left out, clouds are taken as they are, and
    those of more than 4 million points thinned to that."""

    samples: int | None = None
    """Points drawn from a mesh. Left out, as many as it has vertices and faces, and for a coarse one enough to lie no
    further apart than 0.7 times tau."""

    draws: int = 3
    """Times that the whole measurement is repeated with other random points, for the error bars."""

    align: Align = "similarity"
    """What ICP may change for the figures that count: place and size, place, or nothing. All three are written."""

    visible: float = 0.05
    """Share of the training views that must see a point for it to lie in the volume of `--crop auto`."""

    radius: float | None = None
    """Of the alpha shape around the visible ground, in units of the truth; 2 % of the diagonal if left out."""

    up: Axis | None = None
    """Axis of the truth's frame that stands on the ground. Left out, z for the crop volume and the plan; for the
    classes, z of a georeferenced frame, else the direction in which the cameras are held level."""

    classes: bool = True
    """Also tell precision, recall and F1 apart: roofs, facades, ground; places that 0-1, 2, 3-5, 6 or more training
    views see; near edges of the depth and away from them; near borders of blocks (--seams)."""

    far: float | None = None
    """Distances above this do not count in the chamfer distance of DTU; 20 times --tau if left out."""

    seed: int = 0
    """Of all random draws."""

    def __post_init__(self) -> None:
        for name in ("tau", "voxel", "radius", "far"):
            value = getattr(self, name)
            if value is not None and not 0 < value < float("inf"):
                raise BadInput(f"--{name} {value:g}: it is a length, so it must be above 0")
        if self.seed < 0:
            raise BadInput(f"--seed {self.seed}: give 0 or more")
        if not 1 <= self.draws <= MOST_DRAWS:
            raise BadInput(f"--draws {self.draws}: give 1 to {MOST_DRAWS}")
        if self.samples is not None and self.samples < LEAST:
            raise BadInput(f"--samples {self.samples}: give {LEAST} or more points")
        if not 0 < self.visible <= 1:
            raise BadInput(f"--visible {self.visible:g}: it is a share of the views, above 0 and at most 1")


@dataclass(frozen=True)
class Outcome:
    """All that was measured.

    Attributes:
        draws: With the alignment that counts, one for each repetition.
        others: By way of aligning, from the first repetition; the one that counts too. None where too few points are
            left to compare.
        tau: Threshold.
        matrix: (4, 4) that alignment began with.
        crop: Volume, or None for all of space.
        seen: Points of the truth that enough views see; None where the crop volume was given.
        voxel: By which the truth was thinned first, or None.
        sides: The reconstruction and the truth, which the points were drawn from.
    """

    draws: tuple[Draw, ...]
    others: dict[str, Draw | None]
    tau: float
    matrix: np.ndarray
    crop: Crop | None
    seen: int | None
    voxel: float | None
    sides: tuple[Side, Side]


def compare(
    reconstruction: Surface,
    truth: Surface,
    settings: Comparison,
    views: Sequence[View] = (),
    frame: Frame | None = None,
) -> Outcome:
    """Measure a reconstruction.

    Args:
        reconstruction: In the input frame of its photographs.
        truth: In any frame that `settings.transform` leads to.
        settings: How.
        views: Training views, for `--crop auto`.
        frame: Of the views.

    Raises:
        BadInput: The two do not lie in one frame, too few points, no volume to compare in.
    """
    matrix = np.eye(4) if settings.transform is None else read_transform(settings.transform)
    refuse_sizes(settings, truth)
    theirs, tau = truth_side(truth, settings)
    ours = sided(reconstruction, None, settings.samples, tau / scale_of(matrix))
    first = theirs.points(np.random.default_rng(settings.seed))
    refuse_few(first, truth.path)
    crop, seen = volume(first, settings, views, frame, (matrix, tau))
    draws: list[Draw] = []
    others: dict[str, Draw | None] = {}
    for number in range(settings.draws):
        measure = Measurement(ours, theirs, crop, tau, np.random.default_rng([settings.seed, number]))
        if number == 0:
            measure.refuse_strangers(matrix)
        found = {way: measure.draw(matrix, way) for way in ((settings.align,) if number else WAYS)}
        others = others or found
        draws.append(usable(found[settings.align], tau, quiet=number > 0))
        emit(Progress("measuring", number + 1, settings.draws))
    if settings.align == "similarity":
        warn_of_size(draws[0].alignment.scale / scale_of(matrix))
    return Outcome(tuple(draws), others, tau, matrix, crop, seen, theirs.voxel, (ours, theirs))


def refuse_sizes(settings: Comparison, truth: Surface) -> None:
    """BadInput for lengths that have nothing to do with the size of the truth."""
    ends = [(block.min(0), block.max(0)) for block in truth.blocks() if len(block)]
    if not ends:
        return  # which is told later
    low, high = np.min([end[0] for end in ends], axis=0), np.max([end[1] for end in ends], axis=0)
    span = float(np.linalg.norm(high - low))
    for name in ("tau", "voxel", "radius", "far"):
        value = getattr(settings, name)
        if value is not None and not SHORTEST * span <= value <= FURTHEST * span and span > 0:
            raise BadInput(
                f"--{name} {value:g}: {truth.path} spans {span:.3g}, so it must lie between {SHORTEST * span:.3g} and "
                f"{FURTHEST * span:.3g}"
            )


def truth_side(truth: Surface, settings: Comparison) -> tuple[Side, float]:
    """What the truth is drawn from, and tau."""
    if truth.faces is not None:
        if settings.tau is None:
            raise BadInput(f"{truth.path}: a mesh has no spacing of points to take the threshold from; give --tau")
        return sided(truth, None, settings.samples, settings.tau), settings.tau
    found = cloud_side(truth, settings.voxel)
    if settings.tau is not None:
        return found, settings.tau
    refuse_few(found.cloud, truth.path)
    tau = AUTO_TAU * spacing(tree(found.cloud), found.cloud[:: max(1, len(found.cloud) // 1_000_000)])
    if not tau > 0:
        raise BadInput(f"{truth.path}: all its points lie twice in one place, which gives no threshold; give --tau")
    return found, tau


def sided(surface: Surface, voxel: float | None, samples: int | None, tau: float) -> Side:
    """What points are drawn from, whichever the file holds."""
    return cloud_side(surface, voxel) if surface.faces is None else mesh_side(surface, samples, tau)


def volume(
    truth: np.ndarray, settings: Comparison, views: Sequence[View], frame: Frame | None, start: tuple[np.ndarray, float]
) -> tuple[Crop | None, int | None]:
    """The crop volume, and how many points of the truth enough views see if it came from that.

    Args:
        truth: (n, 3) points.
        settings: How it is chosen.
        views: Training views, perhaps none.
        frame: Of the views.
        start: Matrix from the frame of the views to that of the truth, and tau.
    """
    matrix, tau = start
    if settings.crop == "none":
        return None, None
    if settings.crop != "auto":
        return read_crop(Path(settings.crop)), None
    if not views or frame is None:
        raise BadInput(
            "--crop auto needs the photographs: name a run folder, give --views with a run folder or a data set, or "
            "give --crop a file of Tanks and Temples, or --crop none"
        )
    wanted = Enough(settings.visible, settings.up or "z", settings.radius, tau)
    return visible_crop(truth, views, frame, matrix, wanted)


def usable(draw: Draw | None, tau: float, quiet: bool) -> Draw:
    """The repetition, or BadInput if alignment left too little, or the two nowhere near each other."""
    if draw is None:
        raise BadInput(
            f"after alignment fewer than {LEAST} points are left in the crop volume, thinned to half of tau "
            f"({tau:.3g}): if frames or units differ, give --transform, else lower --tau or widen --crop"
        )
    apart = min(float(np.median(draw.distances.to_truth)), float(np.median(draw.distances.to_reconstruction)))
    residual = draw.alignment.residual
    left = "no pair is close enough to align by" if residual is None else f"the ICP residual is {residual:.3g}"
    text = (
        f"after alignment half of all points are more than {apart:.3g} apart, {apart / tau:.1f} times tau ({tau:.3g}), "
        f"{left}, and {draw.alignment.matched:.0%} of the points have a partner; the reconstruction spans "
        f"{said(draw.reconstruction)} then, and the truth {said(draw.truth)}"
    )
    if apart > FAR_OFF * tau:
        raise BadInput(f"the truth is in another frame or unit: {text}; give --transform, or a larger --tau")
    if apart > OFF * tau and not quiet:
        emit(Warned(f"the reconstruction is rough, or the truth is in another frame or unit (--transform): {text}"))
    return draw


def warn_of_size(change: float) -> None:
    """Say if alignment had to change the size by much."""
    if abs(change - 1) > RESIZED:
        emit(
            Warned(
                f"ICP changed the size of the reconstruction by {change - 1:+.1%}: check the unit of the truth, and "
                "compare the figures with --align rigid"
            )
        )
