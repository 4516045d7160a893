"""Small data sets of every layout, to be damaged: each function fills `data` in the folder of a case."""

from __future__ import annotations

import json
import math
import shutil
from pathlib import Path
from typing import Any

import numpy as np


def truth() -> Any:
    """A scene of six photographs."""
    from surfkit.testing.synthetic import Flight, photograph

    return photograph(Flight(views=6, width=24, height=18, points=60, test_every=3))


def colmap(here: Path, binary: bool = False) -> Any:
    """A sparse model with tracks."""
    from surfkit.testing.synthetic import write_colmap

    made = truth()
    write_colmap(here / "data", made, binary=binary, tracks=True)
    return made


def lenses(here: Path) -> None:
    """A distorted camera and masks."""
    from PIL import Image

    made = colmap(here)
    path = here / "data" / "sparse" / "0" / "cameras.txt"
    words = path.read_text().split()
    path.write_text(" ".join([words[0], "OPENCV", *words[2:], "-0.05", "0.01", "0.001", "0"]) + "\n")
    for view in made.scene.train:
        mask = np.full((18, 24), 255, np.uint8)
        mask[4:9, 5:12] = 0
        (here / "data" / "masks").mkdir(exist_ok=True)
        Image.fromarray(mask).save(here / "data" / "masks" / view.name)


def photographs(here: Path) -> tuple[Any, Path]:
    """The scene and its folder, without a model of COLMAP."""
    made, data = colmap(here), here / "data"
    shutil.rmtree(data / "sparse")
    return made, data


def inverse(made: Any, name: str) -> np.ndarray:
    """(H, W) inverse depth, input units."""
    depth = made.exact[name].depth.numpy() / made.scene.frame.scale
    return np.where(depth > 0, 1 / np.maximum(depth, 1e-9), 0)


def arrays(here: Path) -> None:
    """Depth priors of surfkit and CityGaussianV2."""
    from surfkit.io.datasets.depth_files import write_map, write_record

    made = colmap(here)
    for view in made.scene.train:
        values = inverse(made, view.name)
        write_map(here / "data", view.name, values * 3 + 0.1, np.ones_like(values))
    write_record(here / "data", {"aligned": False, "matched": [view.name for view in made.scene.held_out]})


def pictures(here: Path) -> None:
    """Depth priors of hierarchical 3DGS."""
    from PIL import Image

    made, params = colmap(here), {}
    (here / "data" / "depths").mkdir()
    for view in made.scene.train:
        values = inverse(made, view.name)
        scale = float(values.max())
        params[Path(view.name).stem] = {"scale": scale * 1.01, "offset": 0.0}
        stored = np.where(values > 0, values / (scale * 1.01) * 65536, 0)
        Image.fromarray(stored.astype(np.uint16)).save(here / "data" / "depths" / view.name)
    (here / "data" / "sparse" / "0" / "depth_params.json").write_text(json.dumps(params))


def frames(made: Any, views: Any, prefix: str) -> list[dict[str, Any]]:
    """The list of a transforms file."""
    flip = np.diag([1.0, -1.0, -1.0, 1.0])
    poses = [np.linalg.inv(made.scene.frame.input_pose(view.camera.world_to_camera)) @ flip for view in views]
    return [
        {"file_path": f"{prefix}{v.name}", "transform_matrix": p.tolist()} for v, p in zip(views, poses, strict=True)
    ]


def angle(made: Any) -> float:
    """Across the pictures, as Blender has it."""
    return 2 * math.atan(12 / made.scene.train[0].camera.fx)


def parts(made: Any) -> dict[str, Any]:
    """Views by the name of their part."""
    return {"train": made.scene.train, "test": made.scene.held_out}


def sparse(made: Any, path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Write the sparse points, in the input frame; positions and colours."""
    from surfkit.io.splats.ply import write_points

    xyz, rgb = made.scene.frame.to_input(made.scene.cloud.xyz.numpy()), made.scene.cloud.rgb.numpy()
    write_points(path, xyz, rgb)
    return xyz, rgb


def nerfstudio(here: Path, text: bool = False) -> None:
    """A transforms.json, depth maps and points."""
    from PIL import Image

    made, data = photographs(here)
    views = [*made.scene.train, *made.scene.held_out]
    lens = views[0].camera
    listed = frames(made, views, "./images/")
    (data / "depth").mkdir()
    for frame, view in zip(listed, views, strict=True):
        depth = made.exact[view.name].depth.numpy() / made.scene.frame.scale
        Image.fromarray((depth * 1000).astype(np.uint16)).save(data / "depth" / view.name)
        frame["depth_file_path"] = f"depth/{view.name}"
    names = {"w": lens.width, "h": lens.height, "fl_x": lens.fx, "fl_y": lens.fy, "cx": lens.cx, "cy": lens.cy}
    held = [f"./images/{view.name}" for view in made.scene.held_out]
    contents = {**names, "camera_model": "OPENCV", "ply_file_path": "p.ply", "frames": listed, "test_filenames": held}
    (data / "transforms.json").write_text(json.dumps(contents))
    xyz, rgb = sparse(made, data / "p.ply")
    if text:
        head = [f"property float {axis}" for axis in "xyz"] + [f"property uchar {c}" for c in ("red", "green", "blue")]
        rows = [" ".join(map(str, [*a, *b])) for a, b in zip(xyz.tolist(), rgb.tolist(), strict=True)]
        lines = ["ply", "format ascii 1.0", f"element vertex {len(xyz)}", *head, "end_header", *rows, ""]
        (data / "p.ply").write_text("\n".join(lines))


def blender(here: Path) -> None:
    """One file for each part."""
    made, data = photographs(here)
    for part, views in parts(made).items():
        contents = {"camera_angle_x": angle(made), "frames": frames(made, views, "./images/")}
        (data / f"transforms_{part}.json").write_text(json.dumps(contents))
    sparse(made, data / "points3d.ply")


def matrixcity(here: Path) -> None:
    """One folder for each part."""
    made, data = photographs(here)
    for part, views in parts(made).items():
        listed = frames(made, views, "")
        for at, (frame, view) in enumerate(zip(listed, views, strict=True)):
            del frame["file_path"]
            frame |= {"frame_index": at, "rot_mat": frame.pop("transform_matrix")}
            (data / part / "block_A").mkdir(parents=True, exist_ok=True)
            shutil.move(data / "images" / view.name, data / part / "block_A" / f"{at:04}.png")
        text = json.dumps({"camera_angle_x": angle(made), "frames": listed})
        (data / part / "block_A" / "transforms.json").write_text(text)
    sparse(made, data / "points3d.ply")


def odm(here: Path) -> None:
    """A project of OpenDroneMap."""
    from scipy.spatial.transform import Rotation

    made, data = photographs(here)
    lens = made.scene.train[0].camera
    camera = {
        "projection_type": "brown", "width": 24, "height": 18, "focal_x": lens.fx / 24, "focal_y": lens.fy / 24,
        "c_x": (lens.cx - 12) / 24, "c_y": (lens.cy - 9) / 24, "k1": 0.0, "k2": 0.0, "p1": 0.0, "p2": 0.0, "k3": 0.0,
    }  # fmt: skip
    shots = {}
    for view in [*made.scene.train, *made.scene.held_out]:
        pose = made.scene.frame.input_pose(view.camera.world_to_camera)
        turn = Rotation.from_matrix(pose[:3, :3]).as_rotvec().tolist()
        shots[view.name] = {"rotation": turn, "translation": pose[:3, 3].tolist(), "camera": "c"}
    xyz = made.scene.frame.to_input(made.scene.cloud.xyz.numpy()).tolist()
    rows = zip(xyz, made.scene.cloud.rgb.tolist(), strict=True)
    points = {str(at): {"coordinates": a, "color": b} for at, (a, b) in enumerate(rows)}
    (data / "opensfm").mkdir()
    model = [{"cameras": {"c": camera}, "shots": shots, "points": points}]
    (data / "opensfm" / "reconstruction.json").write_text(json.dumps(model))
    lines = ["OPENSFM_TRACKS_VERSION_v2"]
    for view in [*made.scene.train, *made.scene.held_out]:
        pose = made.scene.frame.input_pose(view.camera.world_to_camera)
        x, y, z = (np.array(xyz) @ pose[:3, :3].T + pose[:3, 3]).T
        for at, (u, v) in enumerate(zip((lens.fx * x / z).tolist(), (lens.fy * y / z).tolist(), strict=True)):
            place = ((u + lens.cx - 12) / 24, (v + lens.cy - 9) / 24)
            lines.append("\t".join([view.name, str(at), "0", *map(repr, place), "0.001", "1", "2", "3", "-1", "-1"]))
    (data / "opensfm" / "tracks.csv").write_text("\n".join(lines) + "\n")
