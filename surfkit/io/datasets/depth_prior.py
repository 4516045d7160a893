"""Estimated depth of the training photographs, in the units of the scene, for the depth loss."""

from __future__ import annotations

import shlex
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import interpolate

from surfkit.core.check import BadInput
from surfkit.core.events import Warned, emit
from surfkit.io.datasets.data import Data
from surfkit.io.datasets.depth_files import DepthFile, normal_path, read_record
from surfkit.io.datasets.depth_layout import DepthQuery, find_maps
from surfkit.io.datasets.depth_layouts import EstimatedDepths
from surfkit.io.datasets.depth_lens import fits_both, judge, lens_in, refuse_unlike
from surfkit.io.datasets.depth_map_index import located
from surfkit.io.datasets.depth_sampling import distorted, nearest, resized, straightened, straightened_nearest
from surfkit.io.datasets.depth_units import Unit, far_warning, in_other_units, points_in, unit_of
from surfkit.io.datasets.panoramas import has_panoramas, points_remedy
from surfkit.io.datasets.read import model_folder, observations
from surfkit.scene.align import MAX_ERROR_PX, SCALE_BAND, align, rank_correlation, sample
from surfkit.scene.cache import Cache
from surfkit.scene.observations import Observations
from surfkit.scene.scene import Lens, Scene, View
from surfkit.scene.vectors import unit

MIN_TRUSTED_CONFIDENCE = 0.5
"""Pixels of a higher confidence count as trusted."""
MIN_TRUSTED_SHARE = 0.02
"""Below this share of trusted pixels, something is wrong with the input of the maps."""
LISTED_PHOTOS = 10
"""Photographs that a warning names."""
SWITCHED_OFF = "everything that learns from them is switched off, such as the losses depth and normal-prior"
"""Consequence of missing depth priors."""
CONTRARY_ORDER = 0.5
"""A map is taken for one of depth if its rank correlation with the sparse points is below minus this."""
MIN_ORDER = 0.3
"""Median rank correlation of the maps below which they may be of other photographs."""
MIN_KNOWN_CONFIDENCE = 0.1
"""Least confidence of a pixel of which a depth prior knows something."""


@dataclass(frozen=True)
class DepthPrior:
    """The depth prior of a photograph.

    Attributes:
        inverse: (H, W) float32 inverse camera z, 1/local units; 0 where there is none.
        confidence: (H, W) float32 in [0, 1]; 0 where there is none.
        typical: Inverse depth that is typical of the data set, 1/local units.
        normal: (3, H, W) float32 unit normals of the surface in the camera's axes, towards the camera; 0 where there is
            none. None where the data set has no normals.
        coarseness: Side of a pixel of the map that it was read from, pixels of the photograph; at least 1.
    """

    inverse: Tensor
    confidence: Tensor
    typical: float
    normal: Tensor | None = None
    coarseness: float = 1.0


Priors = Cache["DepthPrior | None"]


@dataclass(frozen=True)
class DepthAlignment:
    """How the depth maps of a data set become inverse depths, whichever of its photographs are trained on.

    Attributes:
        typical: See `DepthPrior`.
        fits: Scale and offset of the map of each training photograph that has one which can be used, by name.
        straight: Whether maps whose shape does not tell are of undistorted photographs.
    """

    typical: float
    fits: dict[str, tuple[float, float]]
    straight: bool = False


@dataclass(frozen=True)
class ScaleOffsetFit:
    """A map, and the scale and offset that turn its values into inverse depths in 1/local units.

    `trusted` is the share of its pixels with high confidence, 1 where that is not known; `unit` is what tells its unit,
    if it has one. `straight` is as for `DepthAlignment`, `lens` what distorts it, if anything does, and `either`
    whether its shape does not tell. `order` is the rank correlation with the sparse points that it is fitted to.
    """

    file: DepthFile
    scale: float
    offset: float
    trusted: float = 1.0
    unit: Unit | None = None
    straight: bool = False
    lens: Lens | None = None
    either: bool = False
    order: float | None = None


def prior_cache(
    views: Sequence[View],
    fits: Sequence[ScaleOffsetFit | None],
    typical: float,
    budget_bytes: int | None = None,
    normals: bool = False,
) -> Priors:
    """The priors of training views by position, as `fits` says how to read them; with normals if there are any."""

    def read(at: int) -> DepthPrior | None:
        fit = fits[at]
        return None if fit is None else _read(views[at], fit, typical, normals)

    each = prior_bytes(normals)
    sizes = [each * v.camera.width * v.camera.height if f else 0 for v, f in zip(views, fits, strict=True)]
    return Cache(read, sizes, budget_bytes, opened=_unpacked)


def prior_bytes(normals: bool) -> int:
    """Bytes per pixel of a prior in a cache: float32 for depth and confidence, int8 for normals."""
    return 8 + 3 * normals


def _unpacked(prior: DepthPrior | None) -> DepthPrior | None:
    """A prior whose normals are unit vectors again."""
    if prior is None or prior.normal is None:
        return prior
    return replace(prior, normal=unit(prior.normal.to(torch.float32)))


def _read(view: View, fit: ScaleOffsetFit, typical: float, normals: bool) -> DepthPrior:
    size = (view.camera.height, view.camera.width)
    try:
        inverse = torch.from_numpy(fit.file.read()) * fit.scale + fit.offset
        confidence = fit.file.read_confidence()
        normal = fit.file.read_normal() if normals else None
    except BadInput as error:
        raise BadInput(f"{fit.file.path}: {error}") from error
    inverse, coarseness = inverse.nan_to_num(0, 0, 0).clamp_min(0), max(1.0, size[1] / inverse.shape[1])
    beside = [None if part is None else torch.from_numpy(np.array(part)) for part in (confidence, normal)]
    trust, facing = (None if part is None else part.reshape(-1, *inverse.shape) for part in beside)
    if (lens := lens_in(view, fit.file, inverse.shape, fit.straight)) is not None:
        trust, facing = (None if part is None else straightened_nearest(part, lens) for part in (trust, facing))
        inverse = straightened(inverse, lens)
    facing = None if facing is None else nearest(facing, size)
    inverse = resized(inverse, size)
    there = (inverse > 0).to(torch.float32)
    if trust is None:
        return DepthPrior(inverse, there, typical, facing, coarseness)
    grown = interpolate(trust[None], size, mode="nearest-exact")[0, 0]
    return DepthPrior(inverse, grown * there, typical, facing, coarseness)


def prior_files(data: Data, scene: Scene) -> dict[str, DepthFile]:
    """The depth map of each training photograph that has one, by name: of the data set, or made for it."""
    names = [view.name for view in scene.train]
    if data.priors is not None:
        return find_maps(DepthQuery(folder := located(data.priors), names, folder), EstimatedDepths())
    query = DepthQuery(data.path, names, model_folder(data), scene.frame.metres)
    return find_maps(query, data.depth_layout)


def read_priors(
    data: Data,
    scene: Scene,
    budget_bytes: int | None = None,
    known: DepthAlignment | None = None,
    normals: bool = False,
) -> Priors | None:
    """The depth priors of a data set; None where there are none.

    Args:
        data: The data set.
        scene: That `read` gave for it, or some of its photographs.
        budget_bytes: Memory to keep them in; None keeps all.
        known: How they are aligned, where the scene has only some of the photographs; see `alignment` for None.
        normals: Whether to read their normals too, where there are any.
    """
    known = known or alignment(data, scene, normals)
    if not any(view.name in known.fits for view in scene.train):
        return None
    maps = prior_files(data, scene)
    lost = [view.name for view in scene.train if view.name in known.fits and view.name not in maps]
    if lost:
        again = "put it back" if data.priors is None else "give the surfkit train command again, which makes it again"
        raise BadInput(f"{data.priors or data.path}: the depth map of {lost[0]} is gone; {again}")
    fits = [
        ScaleOffsetFit(maps[v.name], *known.fits[v.name], straight=known.straight) if v.name in known.fits else None
        for v in scene.train
    ]
    return prior_cache(scene.train, fits, known.typical, budget_bytes, normals)


def alignment(
    data: Data, scene: Scene, normals: bool = False, band: tuple[float, float] = SCALE_BAND
) -> DepthAlignment:
    """How the depth maps of a data set fit its sparse points, and a warning where there are none.

    Photographs without a map, or with one that cannot be used, are listed in one warning; where `normals` are wanted
    too, another one says that there are none. A map whose scale is outside `band`, lowest and highest multiple of the
    median over all maps, cannot be used.
    """
    maps = prior_files(data, scene)
    if not maps:
        names = [view.name for view in scene.train]
        lost = has_panoramas(names) and observations(data, scene).is_empty  # then there is nothing to compare them by
        remedy = points_remedy(data.path, names) if lost else prepare_command(data)
        remedy = f"; {remedy}" if data.priors is None else ""
        emit(Warned(f"{data.path} has no depth priors, so {SWITCHED_OFF}{remedy}"))
        return DepthAlignment(0.0, {})
    tracks = observations(data, scene)
    verdict = judge(data, scene, maps, tracks)
    straight = verdict.straight
    with ThreadPoolExecutor(4) as pool:
        answers = list(pool.map(lambda view: _fit(view, maps.get(view.name), tracks, scene, straight), scene.train))
    fits = [answer if isinstance(answer, ScaleOffsetFit) else None for answer in answers]
    reasons = {v.name: a for v, a in zip(scene.train, answers, strict=True) if isinstance(a, str)}
    unfit = dict.fromkeys(_outliers(fits, band), "its scale is far from that of the other images")
    for at, reason in (unfit | in_other_units([None if fit is None else fit.unit for fit in fits])).items():
        reasons[scene.train[at].name] = reason
        fits[at] = None
    if not any(fits):
        emit(Warned(f"no depth prior of {data.path} can be used, so {SWITCHED_OFF}: {list_reasons(reasons)}"))
        return DepthAlignment(0.0, {})
    if reasons:
        emit(Warned(f"{len(reasons)} of {len(fits)} photographs train without a depth prior: {list_reasons(reasons)}"))
    _warn_of_leaks(data, scene)
    used = [fit for fit in fits if fit is not None]
    if text := verdict.line(sum(fit.lens is not None for fit in used), sum(fit.either for fit in used)):
        emit(Warned(text))
    if text := far_warning([fit.unit for fit in used], scene):
        emit(Warned(text))
    if text := order_warning([fit.order for fit in used if fit.order is not None]):
        emit(Warned(text))
    if text := trust_warning(float(np.mean([fit.trusted for fit in used]))):
        emit(Warned(text))
    found = {v.name: (fit.scale, fit.offset) for v, fit in zip(scene.train, fits, strict=True) if fit is not None}
    if normals and (text := normals_warning(data, [maps[name] for name in found])):
        emit(Warned(text))
    return DepthAlignment(typical_inverse_depth(scene.train, tracks, scene), found, straight)


def trust_warning(share: float) -> str | None:
    """A warning about depth maps with a low share of trusted pixels; None where it is high enough."""
    if share >= MIN_TRUSTED_SHARE:
        return None
    causes = "are mirrored, are all the same, show no texture, or belong to other cameras"
    return f"only {share:.1%} of the pixels of the depth maps are trusted; see whether the photographs {causes}"


def order_warning(orders: Sequence[float]) -> str | None:
    """A warning where maps hardly have the order of the sparse points, from the rank correlation of each."""
    if not orders or (median := float(np.median(orders))) >= MIN_ORDER:
        return None
    found = f"the depth maps hardly follow the sparse points: rank correlation {median:.2f}, median of {len(orders)}"
    return f"{found}; see whether they belong to these photographs"


def typical_inverse_depth(views: Sequence[View], observations: Observations, scene: Scene) -> float:
    """The median over views of the median inverse depth of their sparse points, 1/local units."""
    medians = [np.median(c) for view in views for c in [observations.of(view, MAX_ERROR_PX)[1]] if len(c)]
    if medians:
        return float(np.median(medians))
    xyz = scene.cloud.xyz.to(torch.float64)  # a model without tracks: every point that is before a camera
    some = views[:: max(1, len(views) // 100)]
    depths = torch.cat([xyz @ view.camera.world_to_camera[2, :3] + view.camera.world_to_camera[2, 3] for view in some])
    return float((1 / depths[depths > 0]).median())


def list_reasons(reasons: Mapping[str, str]) -> str:
    """Names by reason, in one line; of many, the first."""
    groups: dict[str, list[str]] = {}
    for name, reason in reasons.items():
        groups.setdefault(reason, []).append(name)
    return "; ".join(f"{reason}: {_listed(names)}" for reason, names in groups.items())


def _listed(names: Sequence[str]) -> str:
    more = len(names) - LISTED_PHOTOS
    return ", ".join(names) if more <= 1 else f"{', '.join(names[:LISTED_PHOTOS])} and {more:,} others"


def _fit(
    view: View, file: DepthFile | None, observations: Observations, scene: Scene, straight: bool
) -> ScaleOffsetFit | str:
    """How the map of a view becomes inverse depth, or why it cannot."""
    if file is None:
        return "no map"
    try:
        values = file.read()
        confidence, normal = file.read_confidence(), file.read_normal()
        lens, either = lens_in(view, file, values.shape, straight), fits_both(view, file, values.shape)
        refuse_unlike(values, view, lens)
        _check_beside(values, {"confidence": confidence, "normals": normal})
        trusted = 1.0 if confidence is None else float((confidence > MIN_TRUSTED_CONFIDENCE).mean())
        at, inverse, tracked = points_in(view, observations, scene, guess=file.aligned)
        at = at if lens is None else distorted(at, lens)
        if not file.aligned:
            scale, offset = align(found := sample(values, at), inverse)
            order = rank_correlation(found, inverse)
            if order < -CONTRARY_ORDER:
                return "nearer points have lower values in it, as in a map of depth; give maps of inverse depth"
            return ScaleOffsetFit(file, scale, offset, trusted, None, straight, lens, either, order)
        unit = unit_of(values / scene.frame.scale, at, inverse, tracked)
        return ScaleOffsetFit(file, 1 / scene.frame.scale, 0.0, trusted, unit, straight, lens, either)
    except BadInput as error:
        return str(error).removeprefix(f"{file.path}: ")


def _check_beside(values: np.ndarray, beside: Mapping[str, np.ndarray | None]) -> None:
    height, width = values.shape
    for what, array in beside.items():
        if array is not None and array.shape[-2:] != values.shape:
            size = f"{array.shape[-1]} x {array.shape[-2]} px"
            raise BadInput(f"it has {width} x {height} px, and its {what} {size}")


def _outliers(fits: Sequence[ScaleOffsetFit | None], band: tuple[float, float]) -> list[int]:
    """Positions of the images whose alignment failed; maps that came in input units share one scale."""
    scales = {at: fit.scale for at, fit in enumerate(fits) if fit is not None and not fit.file.aligned}
    if not scales:
        return []
    usual = float(np.median(list(scales.values())))
    low, high = (usual * multiple for multiple in band)
    return [at for at, scale in scales.items() if not low <= scale <= high]


def _warn_of_leaks(data: Data, scene: Scene) -> None:
    """Maps made from several photographs must not have seen those that are kept to measure with."""
    used = read_record(data.path).get("matched") if data.priors is None else None  # a run matches what it trains on
    seen = [view.name for view in scene.held_out if isinstance(used, list) and view.name in used]
    if seen:
        text = (
            f"the depth priors were made with {len(seen)} of the {len(scene.held_out)} photographs held out, "
            f"{seen[0]} for one, so the quality will look better than it is; "
            f"{prepare_command(data)} --again, with the same split"
        )
        emit(Warned(text))


def normals_warning(data: Data, files: Sequence[DepthFile]) -> str | None:
    """A warning about maps without normals, for a loss that needs them; None where all have normals.

    Not every estimator gives normals, and a loss that is always 0 is noticed nowhere else.
    """
    without = sum(not normal_path(file.path).exists() for file in files)
    if not without:
        return None
    remedy = f"make others with `surfkit prepare depth {shlex.quote(str(data.path))} --again`"
    remedy = remedy if data.priors is None else "depth:patch-match makes some that have"
    what = f"{without} of {len(files)} depth priors have no normals"
    return f"{what}, and the loss normal-prior learns nothing from those; {remedy}"


def prepare_command(data: Data) -> str:
    """Which command makes depth priors, with normals."""
    return f"make them with `surfkit prepare depth {shlex.quote(str(data.path))}`"
