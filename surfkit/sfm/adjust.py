"""Bundle adjustment of a placed reconstruction in which each camera is drawn to its position on the map as strongly as
that is exact, against the bending of long strips."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Any

import numpy as np

from surfkit.core.codec import read_json, write_json
from surfkit.core.files import replacing_folder
from surfkit.sfm.engine import load_engine, run
from surfkit.sfm.georeference import Placement, centres_of
from surfkit.sfm.mapping import read_model
from surfkit.sfm.photographs import Photo
from surfkit.sfm.settings import Settings

RECIPE = "1"
"""Changes when the same model would be adjusted otherwise."""
LEAST_SIGMA_M = 0.01
"""No position is trusted more."""
WORSE = 1.1
"""An adjustment that makes the mean reprojection error larger than this many times is not kept."""


def adjust_once(
    model: Any, placement: Placement, photos: dict[str, Photo], settings: Settings, folder: Path
) -> Any | None:
    """What `adjust` gives, from the folder where an earlier call has kept it for the same model and positions."""
    where = [list(camera.params) for camera in model.cameras.values()], model.num_points3D(), centres_of(model)
    accuracies = [photos[name].exif.accuracy_m for name in placement.names]
    facts = repr((where, placement.names, placement.onto.tolist(), placement.fit.inside.tolist(), accuracies))
    key = hashlib.sha256(f"{RECIPE} {settings.seed} {placement.fit.sigma.tolist()} {facts}".encode()).hexdigest()[:24]
    record = folder / "adjusted.json"
    if record.is_file() and read_json(record, dict[str, Any]).get("key") == key:
        return read_model(folder) if (folder / "images.bin").is_file() else None
    found = adjust(model, placement, photos, settings)
    with replacing_folder(folder) as made:
        if found is not None:
            found.write_binary(made)
        write_json(made / record.name, {"key": key})
    return found


def adjust(model: Any, placement: Placement, photos: dict[str, Photo], settings: Settings) -> Any | None:
    """A reconstruction adjusted to positions; None where it does not converge, or fits the photographs worse.

    Args:
        model: pycolmap.Reconstruction, on the map already; it is not changed.
        placement: The positions, and which of them agree.
        photos: By name; those that state an accuracy are trusted by it, others by the residuals of all.
        settings: For the seed.
    """
    engine = load_engine()
    new = engine.Reconstruction(model)
    numbers = {image.name: image for image in new.images.values()}
    config, priors = engine.BundleAdjustmentConfig(), []
    for number in new.reg_image_ids():
        config.add_image(number)
    metres = placement.chart.metres
    for name, xyz, inside in zip(placement.names, placement.onto, placement.fit.inside, strict=True):
        if not inside:
            continue
        image = numbers[name]
        stated = photos[name].exif.accuracy_m
        sigma = np.maximum(placement.fit.sigma if stated is None else np.array(stated) / metres, LEAST_SIGMA_M / metres)
        prior = engine.PosePrior()
        prior.corr_data_id = image.data_id
        prior.position = xyz
        prior.position_covariance = np.diag(sigma**2)
        prior.coordinate_system = engine.PosePriorCoordinateSystem.CARTESIAN
        priors.append(prior)
    options, trust = engine.BundleAdjustmentOptions(), engine.PosePriorBundleAdjustmentOptions()
    options.print_summary = False
    trust.alignment_ransac.random_seed = settings.seed

    def solve(_: Any) -> Any:
        return engine.create_pose_prior_bundle_adjuster(options, trust, config, priors, new).solve()

    summary = run("adjusting cameras", solve)
    before, after = model.compute_mean_reprojection_error(), _error(new)
    return new if summary.is_solution_usable() and after <= WORSE * before else None


def _error(model: Any) -> float:
    model.update_point_3d_errors()
    return float(model.compute_mean_reprojection_error())
