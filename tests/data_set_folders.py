"""One small scene in the folders of several programs."""

import json
import math
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from needs import needs
from PIL import Image
from scipy.spatial.transform import Rotation

from surfkit.io.splats.ply import write_points
from surfkit.testing.synthetic import Flight, look, photograph, write_colmap

FLIGHT = Flight(views=6, width=40, height=30, points=60, test_every=3)
GL = np.diag([1.0, -1.0, -1.0, 1.0])


def views_of(truth):
    return sorted([*truth.scene.train, *truth.scene.held_out], key=lambda view: view.name)


def pixels_of(truth, name):
    return (truth.exact[name].color.permute(1, 2, 0).numpy() * 255).round().astype(np.uint8)


def save(path, pixels):
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(pixels).save(path)


def to_world(truth, view):
    """OpenGL camera_to_world, as a list."""
    return (np.linalg.inv(truth.scene.frame.input_pose(view.camera.world_to_camera)) @ GL).tolist()


def lens(truth):
    c = views_of(truth)[0].camera
    return {"w": c.width, "h": c.height, "fl_x": c.fx, "fl_y": c.fy, "cx": c.cx, "cy": c.cy}


def sparse(truth):
    cloud = truth.scene.cloud
    return truth.scene.frame.to_input(cloud.xyz.numpy()), cloud.rgb.numpy()


def nerfstudio(folder, truth, change=None):
    frames = []
    for view in views_of(truth):
        save(folder / "images" / view.name, pixels_of(truth, view.name))
        frames.append({"file_path": f"./images/{view.name}", "transform_matrix": to_world(truth, view)})
    write_points(folder / "sparse_pc.ply", *sparse(truth))
    contents = {**lens(truth), "camera_model": "OPENCV", "ply_file_path": "sparse_pc.ply", "frames": frames}
    if change:
        change(contents)
    (folder / "transforms.json").write_text(json.dumps(contents))
    return folder


def odm(folder, truth, kind="brown", **coefficients):
    c = views_of(truth)[0].camera
    normal = {"c_x": (c.cx - 20) / 40, "c_y": (c.cy - 15) / 40, "focal_x": c.fx / 40, "focal_y": c.fy / 40}
    camera = {"projection_type": kind, "width": 40, "height": 30, **normal, **coefficients}
    shots = {}
    for view in views_of(truth):
        save(folder / "images" / view.name, pixels_of(truth, view.name))
        pose = truth.scene.frame.input_pose(view.camera.world_to_camera)
        turn = Rotation.from_matrix(pose[:3, :3]).as_rotvec().tolist()
        shots[view.name] = {"rotation": turn, "translation": pose[:3, 3].tolist(), "camera": "v2 made"}
    xyz, rgb = sparse(truth)
    pairs = enumerate(zip(xyz.tolist(), rgb.tolist(), strict=True))
    points = {str(i): {"coordinates": place, "color": color} for i, (place, color) in pairs}
    small = {"cameras": {}, "shots": {"a.png": {}}, "points": {}}
    model = {"cameras": {"v2 made": camera}, "shots": shots, "points": points}
    (folder / "opensfm").mkdir(exist_ok=True)
    (folder / "opensfm/reconstruction.json").write_text(json.dumps([small, model]))
    return folder


def squarely(truth, view):
    """Pixels, and depths in metres, of a view with square pixels and its principal point in the middle."""
    camera = replace(view.camera, fy=view.camera.fx, cx=20.0, cy=15.0)
    rays = camera.rays(torch.float64).flatten(1).T.numpy()
    depth, color = look(FLIGHT, truth.scene.frame.input_pose(camera.world_to_camera), rays)
    return (color.reshape(30, 40, 3) * 255).round().astype(np.uint8), depth.reshape(30, 40)


def write_exr(path, depth):
    OpenEXR = needs("OpenEXR", "an .exr file")

    path.parent.mkdir(parents=True, exist_ok=True)
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    OpenEXR.File(header, {"RGB": np.stack([depth] * 3, -1)}).write(str(path))


DEPTHS = {
    "aerial": ("city_depth_float32/aerial/{part}/{block}_depth/{number:04d}.exr", np.float32),
    "street": ("city_depth/street/{part}/{block}_depth/{block}_depth/{number:04d}.exr", np.float16),
    "beside": ("city/beside/{part}/{block}/depth/{number:04d}.exr", np.float32),
}


def city(folder, truth, kind):
    """small_city as MatrixCity hands it out: metres and shrunken rotations, archives unpacked in three ways."""
    needs("OpenEXR", "an .exr file")
    pattern, dtype = DEPTHS[kind]
    root, held = folder / "city" / kind, {view.name for view in truth.scene.held_out}
    inside = {"aerial": "", "street": "{block}/", "beside": "rgb/"}[kind]
    for part, block in (("train", "block_1"), ("test", "block_1_test")):
        frames = []
        for number, view in enumerate(v for v in views_of(truth) if (v.name in held) == (part == "test")):
            pixels, depth = squarely(truth, view)
            save(root / part / block / inside.format(block=block) / f"{number:04d}.png", pixels)
            matrix = np.linalg.inv(truth.scene.frame.input_pose(view.camera.world_to_camera)) @ GL
            matrix[:3, :3] /= 100
            matrix[3, 3] /= 100
            frames.append({"frame_index": number, "rot_mat": matrix.tolist()})
            centimetres = depth * 100
            centimetres[:5, :7] = 65504
            write_exr(folder / pattern.format(part=part, block=block, number=number), centimetres.astype(dtype))
        angle = 2 * math.atan(20 / views_of(truth)[0].camera.fx)
        text = json.dumps({"camera_angle_x": angle, "frames": frames})
        (root / part / block / "transforms.json").write_text(text)
    return root


def renumbered(model):
    """Numbers of the images of a COLMAP model in the reverse order of their names."""
    lines = (model / "images.txt").read_text().splitlines()
    count = len(lines) // 2
    for at in range(0, len(lines), 2):
        words = lines[at].split()
        lines[at] = " ".join([str(count + 1 - int(words[0])), *words[1:]])
    (model / "images.txt").write_text("\n".join(lines) + "\n")


def with_tests_apart(folder, truth):
    """Two COLMAP folders in the same coordinates, one to train with and one to test on."""
    train, test = folder / "train/block_all", folder / "test/block_all_test"
    write_colmap(train, truth, tracks=True)
    shutil.copytree(train, test)
    held = {view.name for view in truth.scene.held_out}
    for folder, drop in ((train, held), (test, {f"view_{i:03d}.png" for i in range(6)} - held)):
        model = folder / "sparse/0"
        lines = (model / "images.txt").read_text().splitlines()
        kept = [i for i in range(0, len(lines), 2) if lines[i].split()[-1] not in drop]
        (model / "images.txt").write_text("".join(f"{lines[i]}\n\n" for i in kept))
        points = [line.split()[:8] for line in (model / "points3D.txt").read_text().splitlines()]
        (model / "points3D.txt").write_text("".join(" ".join(words) + "\n" for words in points))
    return train, test


def blender(folder, truth):
    """Renders with an angle of view, and a corner that is transparent."""
    angle = 2 * math.atan(20 / views_of(truth)[0].camera.fx)
    held = {view.name for view in truth.scene.held_out}
    for part, chosen in {"train": False, "test": True}.items():
        frames = []
        for view in views_of(truth):
            if (view.name in held) == chosen:
                pixels = np.concatenate([squarely(truth, view)[0], np.full((30, 40, 1), 255, np.uint8)], 2)
                pixels[:5, :5, 3] = 0
                save(folder / part / view.name, pixels)
                stem = Path(view.name).stem
                frames.append({"file_path": f"./{part}/{stem}", "transform_matrix": to_world(truth, view)})
        contents = {"camera_angle_x": angle, "frames": frames}
        (folder / f"transforms_{part}.json").write_text(json.dumps(contents))
    return folder


def surveyed(folder, move):
    """A COLMAP folder whose coordinates are those of a survey."""
    write_colmap(folder, photograph(FLIGHT))
    model = folder / "sparse/0"
    lines = (model / "points3D.txt").read_text().splitlines()
    words = [line.split() for line in lines]
    rows = [[w[0], *(repr(float(v) + float(m)) for v, m in zip(w[1:4], move, strict=True)), *w[4:]] for w in words]
    (model / "points3D.txt").write_text("".join(" ".join(row) + "\n" for row in rows))
    lines = (model / "images.txt").read_text().splitlines()
    for at in range(0, len(lines), 2):
        words = lines[at].split()
        w, x, y, z, *t = (float(value) for value in words[1:8])
        t = np.array(t) - Rotation.from_quat([x, y, z, w]).as_matrix() @ move
        lines[at] = " ".join([*words[:5], *(repr(float(value)) for value in t), *words[8:]])
    (model / "images.txt").write_text("\n".join(lines) + "\n")
    return folder
