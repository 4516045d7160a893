"""Comparison of a reconstruction with ground truth: sample, align, crop, thin and compare, several times."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np

from surfkit.core.check import BadInput
from surfkit.core.events import Progress, Warned, emit
from surfkit.evaluate.geometry.compared_area import compared_area
from surfkit.evaluate.geometry.presets import PRESETS, PresetName
from surfkit.evaluate.geometry.registration import ICP_ROUNDS
from surfkit.evaluate.geometry.repetition import (
    MIN_COMPARED_POINTS,
    Box,
    ComparedSurface,
    Measurement,
    RepetitionResult,
    cloud_side,
    mesh_side,
    refuse_few,
    warn_if_rounded,
    warn_if_sparse,
)
from surfkit.evaluate.geometry.scores import shares, spacing, tree
from surfkit.evaluate.geometry.surface_file import SurfaceFile
from surfkit.evaluate.geometry.transform import read_transform, scale_of, seen_from
from surfkit.evaluate.geometry.volume import CropSettings, extent_text, heightened, outside_shares, visible_crop
from surfkit.io.area import Area, require_area
from surfkit.scene.crop import Axis, Crop, read_crop
from surfkit.scene.scene import Frame, View

AUTO_TAU = 1.5
"""Of the mean distance between neighbours in the truth (CityGaussianV2)."""
SUSPECT_MISS_TAUS, CERTAIN_MISS_TAUS = 2.0, 10.0
"""Thresholds by which half of both clouds miss each other where frames or units may differ, and where they must."""
MIN_VIEW_SHARE, SUFFICIENT_VIEWS = 0.05, 5
"""Of the training views, that must see a point of the truth by default; and the number that is enough in any case: how
many photographs show a place depends on their overlap, not on the size of the survey."""
MAX_SCALE_CHANGE = 0.02
"""Change of scale by ICP above which a warning is printed."""
MAX_F1_LOSS = 0.002
"""Of F1 by alignment, above which a warning is printed; less is chance."""
MIN_LENGTH_SHARE, MAX_LENGTH_SHARE = 1e-7, 1e4
"""Lengths that can be meant, as shares of the diagonal of the truth."""
MAX_DRAWS = 1000
"""Repetitions: the error bars are known long before."""

Align = Literal["similarity", "rigid", "none"]
ALIGNMENTS: tuple[Align, ...] = ("none", "rigid", "similarity")


@dataclass(frozen=True)
class Comparison:
    """How a reconstruction is compared with ground truth."""

    preset: PresetName | None = None
    """Settings of the paper of CityGaussianV2 for a scene of its data sets: --voxel of 0.35 m, and the number of views
    for --visible; --tau follows from the truth. Options that are given take precedence. The photographs must be all of
    the scene, and the length of their unit must be known."""

    transform: Path | None = None
    """File with the 4 x 4 matrix from the reconstruction's frame to the frame of the ground truth: four rows of text as
    in Tanks and Temples (SCENE_trans.txt), or JSON. ICP starts from it. Default: the identity."""

    crop: str = "auto"
    """Volume in which the two are compared: a JSON file in the format of Tanks and Temples, `auto` for the volume of
    the ground truth that enough training views see (--visible), or `none`."""

    area: Path | None = None
    """Compare only what lies within the polygons of this file in plan: GeoJSON, GPKG or SHP, in any coordinate
    reference system. With --crop, what lies in both counts."""

    tau: float | None = None
    """Distance threshold: a nearer point counts as correct. In units of the ground truth. Default: 1.5 times the mean
    distance between neighbouring points of the ground truth cloud; required when the ground truth is a mesh."""

    voxel: float | None = None
    """Voxel size: first reduce a ground truth cloud to one point per voxel. Default: only clouds of more than 4 million
    points are reduced, to about 4 million."""

    samples: int | None = None
    """Number of points sampled on a mesh. Default: the number of its vertices and faces, and for a coarse mesh enough
    that neighbours are at most 0.7 times tau apart."""

    draws: int = 3
    """Number of repetitions of the whole measurement with other random points, for standard deviations."""

    align: Align = "similarity"
    """What ICP may change for the reported values: rotation, translation and scale (similarity), rotation and
    translation (rigid), or nothing (none). metrics.json has the values of all three."""

    visible: float | None = None
    """Training views that must see a point for it to be in the volume of `--crop auto`: a share of all up to 1, or a
    number from 2 on. Default: a share of 0.05, at most 5 of them."""

    radius: float | None = None
    """Radius of the alpha shape around the visible ground, in units of the ground truth. Default: 2 % of the
    diagonal."""

    up: Axis | None = None
    """Vertical axis of the frame of the ground truth. Default: z for the crop volume and the plan; for the classes, z
    of a georeferenced frame, otherwise the vertical direction that the cameras suggest."""

    classes: bool = True
    """Also compute precision, recall and F1 for classes of points: roofs, facades, ground; seen by 0, 1, 2, 3-5, 6 or
    more training views; near depth edges and away from them; near block borders (--seams)."""

    far: float | None = None
    """Largest distance that counts in the chamfer distance of DTU. Default: 20 times --tau."""

    seed: int = 0
    """Random seed."""

    def __post_init__(self) -> None:
        for name in ("tau", "voxel", "radius", "far"):
            value = getattr(self, name)
            if value is not None and not 0 < value < float("inf"):
                raise BadInput(f"--{name} {value:g}: it is a length, so it must be more than 0")
        if self.seed < 0:
            raise BadInput(f"--seed {self.seed}: give 0 or more")
        if not 1 <= self.draws <= MAX_DRAWS:
            raise BadInput(f"--draws {self.draws}: give 1 to {MAX_DRAWS}")
        if self.samples is not None and self.samples < MIN_COMPARED_POINTS:
            raise BadInput(f"--samples {self.samples}: give {MIN_COMPARED_POINTS} or more points")
        if self.visible is not None and not (0 < self.visible <= 1 or (self.visible > 1 and self.visible % 1 == 0)):
            raise BadInput(
                f"--visible {self.visible:g}: give a share of the views, more than 0 and at most 1, or a number of them"
            )
        if self.area is not None:
            require_area()
        if self.preset is not None and self.preset not in PRESETS:
            raise BadInput(f"--preset {self.preset}: choose one of {', '.join(PRESETS)}")

    def for_scene(self, frame: Frame | None, matrix: np.ndarray) -> Comparison:
        """The same with what the preset says of settings that are not given, and without a preset.

        Args:
            frame: Of the photographs, which knows the length of their unit; None where there are none.
            matrix: (4, 4) from that frame to the frame of the truth.

        Raises:
            BadInput: The preset has a length in metres, and nobody knows how long a unit is.
        """
        if self.preset is None:
            return self
        preset, voxel = PRESETS[self.preset], self.voxel
        if voxel is None:
            if frame is None or frame.metres is None:
                raise BadInput(
                    f"--preset {self.preset}: the truth is thinned to voxels of {preset.voxel_m:g} m, and nobody says "
                    "how long its unit is: train with --metres-per-unit, or give --voxel in units of the truth"
                )
            voxel = preset.voxel_m * scale_of(matrix) / frame.metres
        return replace(self, preset=None, voxel=voxel, visible=self.visible or preset.visible)


@dataclass(frozen=True)
class ComparisonResult:
    """All that was measured.

    Attributes:
        draws: With the alignment that counts, one for each repetition.
        others: By way of aligning, from the first repetition; the one that counts too. None where too few points are
            left to compare.
        tau: Threshold.
        matrix: (4, 4) that alignment began with.
        crop: Volume, or None for all of space.
        seen: Number of points of the ground truth that enough views see; None where the crop volume was given.
        voxel: By which the truth was thinned first, or None.
        sides: The reconstruction and the truth, which the points were drawn from.
        outside: Shares of the reconstruction above, below and beside the volume; None without one.
        area: What counts of the volume, frame of the truth; None for all of it.
    """

    draws: tuple[RepetitionResult, ...]
    others: dict[str, RepetitionResult | None]
    tau: float
    matrix: np.ndarray
    crop: Crop | None
    seen: int | None
    voxel: float | None
    sides: tuple[ComparedSurface, ComparedSurface]
    outside: dict[str, float] | None = None
    area: Area | None = None


def compare(
    reconstruction: SurfaceFile,
    truth: SurfaceFile,
    settings: Comparison,
    views: Sequence[View] = (),
    frame: Frame | None = None,
) -> ComparisonResult:
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
    settings = settings.for_scene(frame, matrix)
    refuse_sizes(settings, truth)
    theirs, tau = truth_side(truth, settings)
    first = theirs.points(np.random.default_rng(settings.seed))
    refuse_few(first, truth.path)
    area, area_box = None, None
    if settings.area is not None:
        sides = reconstruction, truth
        area, area_box = compared_area(settings.area, sides, settings.up, views, frame, matrix)
        first = first[area.inside(first)]
        refuse_few(first, truth.path, f" within --area {settings.area}")
    crop, seen = volume(first, settings, views, frame, (matrix, tau))
    if crop is not None and settings.crop == "auto":
        crop = heightened(crop, reconstruction, matrix, tau, area)
    box = around(crop, area_box, tau)
    own_box, own_tau = box and seen_from(np.linalg.inv(matrix), box), tau / scale_of(matrix)
    ours = make_side(reconstruction, None, settings.samples, own_tau, own_box)
    if theirs.sparse is not None:
        theirs = make_side(truth, None, settings.samples, tau, box)
    for side, surface, length in ((ours, reconstruction, own_tau), (theirs, truth, tau)):
        warn_if_sparse(side, length)
        warn_if_rounded(surface, length)
    draws: list[RepetitionResult] = []
    others: dict[str, RepetitionResult | None] = {}
    done, total = 0, len(ALIGNMENTS) + settings.draws - 1
    emit(Progress("measuring", done, total))
    for number in range(settings.draws):
        measure = Measurement(ours, theirs, crop, tau, np.random.default_rng([settings.seed, number]), area)
        if number == 0:
            measure.refuse_other_frame(matrix)
        found: dict[str, RepetitionResult | None] = {}
        for way in (settings.align,) if number else ALIGNMENTS:
            found[way] = measure.draw(matrix, way)
            done += 1
            emit(Progress("measuring", done, total))
        others = others or found
        draws.append(usable(found[settings.align], tau, quiet=number > 0))
    warn_of_loss(draws[0], others["none"], settings.align, tau)
    if settings.align == "similarity":
        warn_of_size(draws[0].alignment.scale / scale_of(matrix))
    outside = None if crop is None else outside_shares(reconstruction, draws[0].alignment.matrix, crop, area)
    return ComparisonResult(tuple(draws), others, tau, matrix, crop, seen, theirs.voxel, (ours, theirs), outside, area)


def refuse_sizes(settings: Comparison, truth: SurfaceFile) -> None:
    """BadInput for lengths that have nothing to do with the size of the truth."""
    ends = [(block.min(0), block.max(0)) for block in truth.blocks() if len(block)]
    if not ends:
        return  # an error later reports it
    low, high = np.min([end[0] for end in ends], axis=0), np.max([end[1] for end in ends], axis=0)
    span = float(np.linalg.norm(high - low))
    for name in ("tau", "voxel", "radius", "far"):
        value = getattr(settings, name)
        if value is not None and not MIN_LENGTH_SHARE * span <= value <= MAX_LENGTH_SHARE * span and span > 0:
            raise BadInput(
                f"--{name} {value:g}: {truth.path} spans {span:.3g}, so it must lie between "
                f"{MIN_LENGTH_SHARE * span:.3g} and "
                f"{MAX_LENGTH_SHARE * span:.3g}"
            )


def truth_side(truth: SurfaceFile, settings: Comparison) -> tuple[ComparedSurface, float]:
    """What the truth is drawn from, and tau."""
    if truth.faces is not None:
        if settings.tau is None:
            raise BadInput(
                f"{truth.path}: a mesh or a raster has no spacing of points to take the threshold from; give --tau"
            )
        return make_side(truth, None, settings.samples, settings.tau), settings.tau
    found = cloud_side(truth, settings.voxel)
    if settings.tau is not None:
        return found, settings.tau
    cloud = found.cloud
    assert cloud is not None, "what is no mesh is read as a cloud"
    refuse_few(cloud, truth.path)
    tau = AUTO_TAU * spacing(tree(cloud), cloud[:: max(1, len(cloud) // 1_000_000)])
    if not tau > 0:
        raise BadInput(
            f"{truth.path}: the distance between its neighbouring points is 0, which gives no threshold; give --tau"
        )
    return found, tau


def make_side(
    surface: SurfaceFile, voxel: float | None, samples: int | None, tau: float, box: Box | None = None
) -> ComparedSurface:
    """What points are drawn from, whichever the file holds; see `mesh_side`."""
    return cloud_side(surface, voxel) if surface.faces is None else mesh_side(surface, samples, tau, box)


def around(crop: Crop | None, area: Box | None, tau: float) -> Box | None:
    """The box about a crop volume, and that of an area, with room for what alignment brings into it; None without."""
    room = ICP_ROUNDS[0][1] * tau
    if crop is None:
        return None if area is None else (area[0] - room, area[1] + room)
    low, high = crop.ends
    if area is not None:
        low, high = np.maximum(low, area[0]), np.minimum(high, area[1])
    return low - room, high + room


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
    wanted = CropSettings(settings.visible or usual_visible(len(views)), settings.up or "z", settings.radius, tau)
    return visible_crop(truth, views, frame, matrix, wanted)


def usual_visible(views: int) -> float:
    """Which views must see a point, as `CropSettings` has it, where nothing is said."""
    return MIN_VIEW_SHARE if MIN_VIEW_SHARE * views <= SUFFICIENT_VIEWS else SUFFICIENT_VIEWS


def usable(draw: RepetitionResult | None, tau: float, quiet: bool) -> RepetitionResult:
    """The repetition, or BadInput if alignment left too little, or the two nowhere near each other."""
    if draw is None:
        raise BadInput(
            f"after alignment fewer than {MIN_COMPARED_POINTS} points are left in the crop volume, thinned to half "
            f"of tau "
            f"({tau:.3g}): if frames or units differ, give --transform, else lower --tau or widen --crop"
        )
    apart = min(float(np.median(draw.distances.to_truth)), float(np.median(draw.distances.to_reconstruction)))
    residual = draw.alignment.residual
    left = "no pair is close enough to align by" if residual is None else f"the ICP residual is {residual:.3g}"
    text = (
        f"after alignment half of all points are more than {apart:.3g} apart, {apart / tau:.1f} times tau ({tau:.3g}), "
        f"{left}, and {draw.alignment.matched:.0%} of the points have a partner; the reconstruction spans "
        f"{extent_text(draw.reconstruction)} then, and the truth {extent_text(draw.truth)}"
    )
    if apart > CERTAIN_MISS_TAUS * tau:
        raise BadInput(f"the truth is in another frame or unit: {text}; give --transform, or a larger --tau")
    if apart > SUSPECT_MISS_TAUS * tau and not quiet:
        emit(Warned(f"the reconstruction is rough, or the truth is in another frame or unit (--transform): {text}"))
    return draw


def warn_of_loss(draw: RepetitionResult, unaligned: RepetitionResult | None, way: str, tau: float) -> None:
    """Warn if the two fit less well after alignment than before."""
    if unaligned is None:
        return
    before, after = (shares(each.distances, tau)[2] for each in (unaligned, draw))
    if after < before - MAX_F1_LOSS:
        emit(
            Warned(
                f"--align {way} lowers F1 from {before:.3f} to {after:.3f}: if both are in one frame, take --align none"
            )
        )


def warn_of_size(change: float) -> None:
    """Warn if alignment had to change the scale much."""
    if abs(change - 1) > MAX_SCALE_CHANGE:
        emit(
            Warned(
                f"ICP changed the size of the reconstruction by {change - 1:+.1%}: check the unit of the truth, and "
                "compare the figures with --align rigid"
            )
        )
