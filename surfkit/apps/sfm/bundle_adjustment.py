"""Bundle adjustment of a reconstruction with all that is known of its cameras, each as strongly as that is exact: the
focal length of EXIF, and on the map the positions, against the bending of long strips."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from surfkit.apps.sfm.engine import load_engine, run
from surfkit.apps.sfm.focal import add_marks, known_focals
from surfkit.apps.sfm.georeference import Placement, centres_of
from surfkit.apps.sfm.inspect_photos import Photo
from surfkit.apps.sfm.mapping import read_model
from surfkit.apps.sfm.settings import Settings
from surfkit.core.codec import read_json, write_json
from surfkit.core.files import replacing_folder

CACHE_VERSION = "2"
"""Changes when the same model would be adjusted otherwise."""
MAX_ERROR_RATIO = 1.1
"""An adjustment that makes the mean reprojection error larger than this many times is not kept."""


def adjust_once(
    model: Any, placement: Placement | None, photos: Mapping[str, Photo], settings: Settings, folder: Path
) -> Any | None:
    """What `adjust` gives, from the folder where an earlier call has kept it for the same model, EXIF and positions."""
    where = [list(camera.params) for camera in model.cameras.values()], model.num_points3D(), centres_of(model)
    facts = [CACHE_VERSION, settings.seed, where, sorted(known_focals(model, photos, placement is not None).items())]
    if placement is not None:
        fit = placement.fit
        facts += [placement.names, placement.onto.tolist(), fit.inside.tolist(), placement.sigma.tolist()]
    key = hashlib.sha256(repr(facts).encode()).hexdigest()[:24]
    record = folder / "adjusted.json"
    if record.is_file() and read_json(record, dict[str, Any]).get("key") == key:
        return read_model(folder) if (folder / "images.bin").is_file() else None
    found = adjust(model, placement, photos, settings)
    with replacing_folder(folder) as made:
        if found is not None:
            found.write_binary(made)
        write_json(made / record.name, {"key": key})
    return found


def adjust(
    model: Any,
    placement: Placement | None,
    photos: Mapping[str, Photo],
    settings: Settings,
    max_error_ratio: float = MAX_ERROR_RATIO,
) -> Any | None:
    """A reconstruction adjusted to EXIF and positions; None where it does not converge, or fits the photographs worse.

    Args:
        model: pycolmap.Reconstruction, on the map already if there are positions; it is not changed.
        placement: The positions, and which of them agree; None without.
        photos: By name.
        settings: For the seed.
        max_error_ratio: How many times larger the mean reprojection error may become.
    """
    engine = load_engine()
    new = engine.Reconstruction(model)
    config = engine.BundleAdjustmentConfig()
    for number in new.reg_image_ids():
        config.add_image(number)
    priors = _priors(engine, new, placement) if placement is not None else []
    add_marks(new, config, known_focals(model, photos, placement is not None))
    options, trust = engine.BundleAdjustmentOptions(), engine.PosePriorBundleAdjustmentOptions()
    options.print_summary = False
    options.ceres.solver_options.num_threads = 1  # several add up in another order each time, and come to other bits
    trust.alignment_ransac.random_seed = settings.seed

    def solve(_: Any) -> Any:
        if not priors:
            return engine.create_default_bundle_adjuster(options, config, new).solve()
        return engine.create_pose_prior_bundle_adjuster(options, trust, config, priors, new).solve()

    summary = run("adjusting cameras", solve)
    found = taken_over(engine, model, new)
    before, after = mean_error(engine.Reconstruction(model)), mean_error(found)
    return found if summary.is_solution_usable() and after <= max_error_ratio * before else None


def _priors(engine: Any, model: Any, placement: Placement) -> list[Any]:
    """The positions that agree, as pycolmap takes them."""
    numbers, priors = {image.name: image for image in model.images.values()}, []
    rows = zip(placement.names, placement.onto, placement.sigma, placement.fit.inside, strict=True)
    for name, xyz, sigma, inside in rows:
        if inside:
            prior = engine.PosePrior()
            prior.corr_data_id = numbers[name].data_id
            prior.position = xyz
            prior.position_covariance = np.diag(sigma**2)
            prior.coordinate_system = engine.PosePriorCoordinateSystem.CARTESIAN
            priors.append(prior)
    return priors


def taken_over(engine: Any, model: Any, adjusted: Any) -> Any:
    """The model with the cameras, poses and points of an adjusted one, which may have more."""
    new = engine.Reconstruction(model)
    for number, camera in new.cameras.items():
        camera.params = adjusted.cameras[number].params
    for number in {image.frame_id for image in new.images.values() if image.has_pose}:
        new.frames[number].rig_from_world = adjusted.frames[number].rig_from_world
    for number, point in new.points3D.items():
        point.xyz = adjusted.points3D[number].xyz
    return new


def mean_error(model: Any) -> float:
    model.update_point_3d_errors()
    return float(model.compute_mean_reprojection_error())
