"""Cameras and points from verified matches: incremental (Schoenberger and Frahm, CVPR 2016) or global (GLOMAP, ECCV
2024), both by pycolmap. Photographs in groups that share no matches become several models, the largest first."""

from __future__ import annotations

from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np

from surfkit.apps.sfm.engine import load_engine, run
from surfkit.apps.sfm.settings import Settings
from surfkit.core.check import BadInput
from surfkit.core.events import Progress, emit
from surfkit.core.files import replacing_folder
from surfkit.io.datasets.colmap_files import refuse_cut_off

MIN_MODEL_PHOTOS = 3
"""Photographs of a model; fewer determine no surface."""
MODEL_ROUNDING = 2.0**-26
"""To which models are rounded, whose cameras spread by some 10 units: less than 1e-3 px. Threads add up in another
order each time, which changes the last bits, by 1e-14; rounded, nearly all come to the same bits."""


def map_photographs(database: Path, folder: Path, count: int, settings: Settings) -> list[Path]:
    """Place the cameras of a database; the folders of the models, that of most photographs first.

    Args:
        database: With verified matches.
        folder: For the models; what is in it is replaced when all went well.
        count: Photographs in the database.
        settings: How.
    """
    engine = load_engine()
    with replacing_folder(folder) as made:
        scratch = made / "scratch"
        scratch.mkdir()
        place = _incremental if settings.mapper == "incremental" else _global
        models = place(engine, database, scratch, count, settings)
        order = sorted(models.values(), key=lambda model: (-model.num_reg_images(), -model.num_points3D()))
        kept = [model for model in order if model.num_reg_images() >= MIN_MODEL_PHOTOS and model.num_points3D()]
        for number, model in enumerate(kept):
            (made / str(number)).mkdir()
            for image in model.images.values():
                image.name = unquote(image.name)
            round_off(engine, model)
            model.write_binary(made / str(number))
        for path in sorted(scratch.rglob("*"), reverse=True):
            path.rmdir() if path.is_dir() else path.unlink()
        scratch.rmdir()
    return [folder / str(number) for number in range(len(kept))]


def round_off(engine: Any, model: Any) -> None:
    """Round cameras, poses and points of a pycolmap.Reconstruction to multiples of `MODEL_ROUNDING`."""

    def rounded(values: Any) -> np.ndarray:
        return np.round(np.asarray(values, np.float64) / MODEL_ROUNDING) * MODEL_ROUNDING

    for camera in model.cameras.values():
        camera.params = rounded(camera.params)
    for number in model.reg_frame_ids():
        frame = model.frames[number]
        pose = frame.rig_from_world
        turn = engine.Rotation3d(rounded(pose.rotation.quat))
        frame.rig_from_world = engine.Rigid3d(turn, rounded(pose.translation))
    for point in model.points3D.values():
        point.xyz = rounded(point.xyz)
    model.update_point_3d_errors()


def read_model(folder: Path) -> Any:
    """The pycolmap reconstruction in a folder of `prepare/`."""
    refuse_cut_off(folder)
    try:
        return load_engine().Reconstruction(folder)
    except (RuntimeError, ValueError) as error:
        raise BadInput(f"{folder}: damaged: {' '.join(str(error).split())}; delete it and try again") from error


def _incremental(engine: Any, database: Path, folder: Path, count: int, settings: Settings) -> dict[int, Any]:
    options = engine.IncrementalPipelineOptions()
    options.min_model_size = MIN_MODEL_PHOTOS
    options.random_seed = settings.seed
    options.extract_colors = False  # photographs are read once, when they are undistorted
    placed = 0

    def one_more(by: int = 1) -> None:
        nonlocal placed
        placed = min(placed + by, count)
        emit(Progress("placing cameras", placed, count))

    models = run(
        "placing cameras",
        lambda token: engine.incremental_mapping(
            database, folder, folder, options, "", lambda: one_more(2), one_more, token
        ),
    )
    if placed < count:
        emit(Progress("placing cameras", count, count))
    return models


def _global(engine: Any, database: Path, folder: Path, count: int, settings: Settings) -> dict[int, Any]:
    options = engine.GlobalPipelineOptions()
    options.min_model_size = MIN_MODEL_PHOTOS
    options.random_seed = settings.seed
    emit(Progress("placing cameras", 0, count))
    models = run("placing cameras", lambda token: engine.global_mapping(database, folder, folder, options))
    emit(Progress("placing cameras", count, count))
    return models
