"""How well `surfkit prepare photos` finds cameras that are known: share, residuals, georeference and time.

    python bench/photographs.py examples/boruszyn --noise 3 --far 500

The photographs of a data set with a COLMAP model are copied without it. With --noise each copy gets a position in EXIF,
that of its camera on a made-up place on Earth plus Gaussian noise; --far moves that of one photograph.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import shutil
import tempfile
import time
from pathlib import Path

import numpy as np

from surfkit.apps.sfm.base import FeatureExtractor, FeatureMatcher
from surfkit.apps.sfm.settings import Settings
from surfkit.apps.sfm.sfm_pipeline import SfmPreparation
from surfkit.apps.sfm.similarity import umeyama
from surfkit.core.registry import find
from surfkit.io.datasets.data import Data
from surfkit.io.datasets.read import read
from surfkit.runs.run_notes import collect_notes
from surfkit.scene.earth import from_utm
from surfkit.testing.write_exif import write_exif

PLACE = np.array([512_000.0, 5_800_000.0, 100.0])
"""In zone 33 of UTM, from where the coordinates of the model are counted."""


def centres(folder: Path) -> dict[str, np.ndarray]:
    """Camera centres of a data set in its own coordinates, by name."""
    scene = read(Data(folder))
    poses = {view.name: scene.frame.input_pose(view.camera.world_to_camera) for view in (*scene.train, *scene.held_out)}
    return {name: -pose[:3, :3].T @ pose[:3, 3] for name, pose in poses.items()}


def write_positions(folder: Path, truth: dict[str, np.ndarray], noise: float, far: float, seed: int) -> None:
    """Positions in the EXIF of the copies."""
    rng = np.random.default_rng(seed)
    for at, (name, centre) in enumerate(sorted(truth.items())):
        east, north, up = centre + rng.normal(0, noise, 3) + (far * (at == len(truth) // 2), 0, 0)
        latitude, longitude = from_utm(np.array([east]), np.array([north]), 33, False)
        write_exif(folder / name, (float(latitude[0]), float(longitude[0]), float(up)))


def main() -> None:
    """Measure, and print JSON."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("data", type=Path)
    parser.add_argument("--noise", type=float, help="metres, each axis; no positions without it")
    parser.add_argument("--far", type=float, default=0.0, help="metres by which one position is wrong")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--pairs", default="auto")
    parser.add_argument("--mapper", default="incremental")
    parser.add_argument("--longest", type=int, default=1600)
    parser.add_argument("--max-features", type=int, default=8192)
    parser.add_argument("--features", default="sift", help="name of a part, with its default settings")
    parser.add_argument("--matcher", default="pycolmap", help="likewise")
    parser.add_argument("--work", type=Path, help="folder to keep, which later calls go on from")
    given = parser.parse_args()
    known = {name: centre + PLACE for name, centre in centres(given.data).items()}
    with contextlib.ExitStack() as stack:
        work = given.work or Path(stack.enter_context(tempfile.TemporaryDirectory()))
        photos = work / "photos"
        if not photos.exists():
            photos.mkdir(parents=True)
            for name in known:
                shutil.copyfile(given.data / "images" / name, photos / name)
            if given.noise is not None:
                write_positions(photos, known, given.noise, given.far, given.seed)
        began, cpu = time.perf_counter(), time.process_time()
        settings = Settings(
            longest=given.longest,
            max_features=given.max_features,
            features=find(FeatureExtractor, given.features)(),
            matcher=find(FeatureMatcher, given.matcher)(),
            pairs=given.pairs,
            mapper=given.mapper,
        )
        with collect_notes():
            report = SfmPreparation(photos, work / "scene", settings).run()
        spent = time.perf_counter() - began, time.process_time() - cpu
        found = centres(work / "scene")
    names = sorted(found)
    truth, ours = np.stack([known[name] for name in names]), np.stack([found[name] for name in names])
    best = umeyama(ours, truth, np.ones(len(names)))
    aligned = np.linalg.norm(best.points(ours) - truth, axis=1)
    said = {
        "registered": f"{report['registered']} of {report['photographs']}",
        "reprojection_error_px": report["models"][0]["reprojection_error_px"],
        "residual_after_similarity_m": {"rms": float(np.sqrt((aligned**2).mean())), "most": float(aligned.max())},
        "seconds": spent[0],
        "cpu_seconds": spent[1],
        "by_stage": report["seconds"],
    }
    if given.noise is not None:
        away = ours - truth
        place = report["models"][0].get("georeference", {})
        said["georeference_m"] = {
            "mean_error": float(np.linalg.norm(away.mean(0))),
            "mean_error_enu": away.mean(0).tolist(),
            "rms": float(np.sqrt((away**2).sum(1).mean())),
            "left_out": place.get("left_out"),
            "expected_mean_error": given.noise * np.sqrt(3 / len(names)),
        }
    print(json.dumps(said, indent=2))


if __name__ == "__main__":
    main()
