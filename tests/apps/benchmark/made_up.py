"""Tiny folders in the layouts of the benchmarks, and protocols with tiny steps for them."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
from PIL import Image
from scipy.io import savemat

from surfkit.apps.benchmark.protocol import BenchmarkScene, Contender, Protocol
from surfkit.apps.benchmark.protocols import colmap
from surfkit.apps.benchmark.truths import Needed, SurfaceTruth
from surfkit.evaluate.geometry.comparison import Comparison
from surfkit.io.datasets.data import ReadSettings
from surfkit.testing.synthetic import Flight, Synthetic, photograph, write_colmap
from tests.evaluate.test_trajectory import write_log

VIEWS = 9


def truth_points(truth: Synthetic) -> np.ndarray:
    """(n, 3) input frame: what all the views see, from their exact depths."""
    found = []
    for view in (*truth.scene.train, *truth.scene.held_out):
        camera, depth = view.camera, truth.exact[view.name].depth.numpy()
        y, x = np.nonzero(depth > 0)
        rays = np.stack([(x + 0.5 - camera.cx) / camera.fx, (y + 0.5 - camera.cy) / camera.fy, np.ones(len(x))], 1)
        pose = np.linalg.inv(truth.scene.frame.input_pose(view.camera.world_to_camera))
        local = rays * depth[y, x, None] / truth.scene.frame.scale
        found.append(local @ pose[:3, :3].T + pose[:3, 3])
    return np.concatenate(found)


def write_cloud(path: Path, points: np.ndarray) -> None:
    """A cloud as PLY in text."""
    path.parent.mkdir(parents=True, exist_ok=True)
    head = f"ply\nformat ascii 1.0\nelement vertex {len(points)}\n" + "".join(f"property float {c}\n" for c in "xyz")
    path.write_text(head + "end_header\n" + "".join(f"{x:.6f} {y:.6f} {z:.6f}\n" for x, y, z in points))


def flown(**settings) -> Synthetic:
    """The photographs of all layouts."""
    return photograph(Flight(**{"views": VIEWS, "width": 48, "height": 36, "points": 300, "test_every": 4} | settings))


def city(root: Path) -> None:
    """Two scenes as in GauU-Scene: COLMAP folders, and scans beside them."""
    for seed, name in enumerate(("A", "B")):
        truth = flown(seed=seed)
        write_colmap(root / name, truth)
        write_cloud(root / f"ground_truth/{name}.ply", truth_points(truth))


def city_protocol(**changes) -> Protocol:
    """Of `city`, with a few steps."""
    scenes = tuple(
        BenchmarkScene(
            name.lower(),
            name,
            ReadSettings(layout="colmap", test_every=4, metres_per_unit=1.0),
            colmap(name, "photographs", (VIEWS, VIEWS), 48),
            SurfaceTruth(
                Needed(f"ground_truth/{name}.ply", "laser scan", "scan", points=(100, None)),
                Comparison(align="none", crop="none", classes=False, draws=1),
                tau=2.0,
            ),
            (6, 6),
        )
        for name in ("A", "B")
    )
    made = Protocol(
        name="tiny",
        version=1,
        about="Two made-up scenes",
        scenes=scenes,
        contenders=(
            Contender("2dgs", "2dgs", published={"a": {"f1": 0.5, "psnr": 20.0}, "mean": {"f1": 0.25}}),
            Contender("surface", {"a": "2dgs", "b": "flat3dgs"}, by_default=False),
        ),
        columns=("psnr", "precision", "recall", "f1", "seconds", "peak_memory_bytes"),
        sources={
            "photographs": "the page of photographs, https://example.org/photographs",
            "scan": "the page of scans",
        },
        rules=("One rule.",),
        published_in="A paper, 2024",
        steps=6,
    )
    return replace(made, **changes)


def tanks(root: Path, scene: str = "Barn") -> Synthetic:
    """A scene of Tanks and Temples: the scan is 3 times as large as the cameras of the benchmark, which are twice as
    large as those of the model, and shifted."""
    truth = flown(test_every=0)
    write_colmap(root / scene, truth)
    frame, views = truth.scene.frame, truth.scene.train
    centres = frame.to_input(np.array([view.camera.centre.tolist() for view in views]))
    write_log(root / scene / f"{scene}_COLMAP_SfM.log", centres * 2 + [1, 2, 3])
    matrix = np.diag([3.0, 3, 3, 1])
    (root / scene / f"{scene}_trans.txt").write_text("\n".join(" ".join(map(str, row)) for row in matrix))
    points = (truth_points(truth) * 2 + [1, 2, 3]) * 3
    write_cloud(root / scene / f"{scene}.ply", points)
    low, high = points.min(0) - 1, points.max(0) + 1
    corners = [[low[0], low[1], 0], [high[0], low[1], 0], [high[0], high[1], 0], [low[0], high[1], 0]]
    crop = {"class_name": "SelectionPolygonVolume", "orthogonal_axis": "Z", "bounding_polygon": corners}
    crop |= {"axis_min": low[2], "axis_max": high[2], "version_major": 1, "version_minor": 0}
    (root / scene / f"{scene}.json").write_text(json.dumps(crop))
    return truth


def dtu(root: Path, number: int = 24) -> Synthetic:
    """A scan of DTU: millimetres are 10 times the units of the model, and shifted; the silhouettes are everything."""
    truth = flown(test_every=0)
    folder, official = root / f"scan{number}", root / "SampleSet/MVS Data/ObsMask"
    write_colmap(folder, truth)
    (folder / "mask").mkdir()
    for at in range(VIEWS):
        Image.new("L", (48, 36), 255).save(folder / f"mask/{at:03d}.png")
    scale = np.diag([10.0, 10, 10, 1])
    scale[:3, 3] = 5, 0, -5
    np.savez(folder / "cameras.npz", scale_mat_0=scale)
    points = truth_points(truth) * 10 + [5, 0, -5]
    write_cloud(root / f"Points/stl/stl{number:03d}_total.ply", points)
    official.mkdir(parents=True)
    low = points.min(0) - 20
    size = np.ceil((np.ptp(points, axis=0) + 40) / 10).astype(int) + 1
    box = np.stack([low, points.max(0) + 20])
    savemat(official / f"ObsMask{number}_10.mat", {"ObsMask": np.ones(size, np.uint8), "BB": box, "Res": 10.0})
    savemat(official / f"Plane{number}.mat", {"P": np.array([0.0, 0, 0, 1]).reshape(4, 1)})
    return truth


def shrunk(protocol: Protocol, *names: str) -> Protocol:
    """One of the five with the counts of a made-up folder, so that its own layout is read."""

    def small(needed: Needed) -> Needed:
        pictures = needed.pictures and (1, None)
        return replace(needed, pictures=pictures, longest=None, points=needed.points and (10, None), faces=None)

    def truth(files):
        return replace(files, file=small(files.file)) if isinstance(files, SurfaceTruth) else files

    scenes = tuple(
        replace(scene, needed=tuple(map(small, scene.needed)), truth=truth(scene.truth), training=None)
        for scene in protocol.scenes
        if scene.name in names
    )
    return replace(protocol, scenes=scenes)


def copy(source: Path, target: Path) -> Path:
    """A folder that a test may change."""
    shutil.copytree(source, target)
    return target
