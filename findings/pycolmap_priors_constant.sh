#!/usr/bin/env bash
# Bundle adjustment with priors of positions moves frames and points that are held constant, and does not say so.
#
# pycolmap 4.2.1. Of ten frames five are held with `set_constant_rig_from_world_pose`, as of a block that is adjusted already,
# and one point with `add_constant_point`; the other five have positions of GNSS, all 3 m too far east. The adjuster of
# `create_pose_prior_bundle_adjuster` first aligns the whole model to the priors: all frames held, and the point, are 3 m
# further east afterwards, although the configuration still lists them as constant. The solution is called usable, nothing
# is logged. The same configuration in `create_default_bundle_adjuster` leaves them where they were.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet pycolmap==4.2.1 numpy==2.4.6
"$folder/venv/bin/python" - <<'PYTHON'
import numpy as np
import pycolmap

EAST = np.array([3.0, 0.0, 0.0])


def moved(with_priors):
    """How far the frames held and the point held move, in metres, as vectors."""
    pycolmap.set_random_seed(0)
    wanted = pycolmap.SyntheticDatasetOptions(num_rigs=1, num_frames_per_rig=10, num_points3D=100)
    model = pycolmap.synthesize_dataset(wanted)
    images = sorted(model.images.values(), key=lambda image: image.image_id)
    held, others, point = images[:5], images[5:], min(model.points3D)
    config = pycolmap.BundleAdjustmentConfig()
    for image in images:
        config.add_image(image.image_id)
    for image in held:
        config.set_constant_rig_from_world_pose(image.frame_id)
    config.add_constant_point(point)
    places = [image.projection_center() for image in held] + [model.points3D[point].xyz.copy()]
    priors = []
    for image in others:
        prior = pycolmap.PosePrior()
        prior.corr_data_id, prior.position = image.data_id, image.projection_center() + EAST
        prior.position_covariance = 9 * np.eye(3)
        prior.coordinate_system = pycolmap.PosePriorCoordinateSystem.CARTESIAN
        priors.append(prior)
    options, trust = pycolmap.BundleAdjustmentOptions(print_summary=False), pycolmap.PosePriorBundleAdjustmentOptions()
    trust.alignment_ransac.random_seed = 1
    if with_priors:
        adjuster = pycolmap.create_pose_prior_bundle_adjuster(options, trust, config, priors, model)
    else:
        adjuster = pycolmap.create_default_bundle_adjuster(options, config, model)
    assert adjuster.solve().is_solution_usable()
    assert all(config.has_constant_rig_from_world_pose(image.frame_id) for image in held)
    after = [model.images[image.image_id].projection_center() for image in held] + [model.points3D[point].xyz]
    return np.array(after) - np.array(places)


plain, aligned = moved(False), moved(True)
print("pycolmap", pycolmap.__version__)
print("without priors, five frames and a point that are held move by", np.abs(plain).max(), "m")
print("with priors of the other frames, by", aligned.round(6).tolist())
assert np.abs(plain).max() == 0
assert np.abs(aligned - EAST).max() < 1e-6, "the behaviour has changed"
PYTHON
