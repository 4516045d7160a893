"""Pictures of files in web viewers of others, from the camera of a held-out photograph, beside surfkit's own."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import torch
from check import Row, failed
from PIL import Image
from programs import HERE, Missing, find_chromium, is_as_in_ply, node, three

from surfkit.raster.psnr import psnr

TIMES = 3
"""Pixels of a picture for one of the photograph, on each side."""
ALIKE_DB = 30.0
"""A viewer must draw a file at least this much like the PLY file of the same model (PSNR)."""
LIKE_OURS_DB = 20.0
"""And like surfkit at least this much: viewers draw surfels as thin ellipsoids, and filter and clamp in other ways."""
HALF_TURN = np.diag([1.0, -1.0, -1.0, 1.0])
"""From the axes of PLY files to those of SPZ files, right-up-back."""

VIEWERS = {
    "playcanvas": r"\.(ply|sog|glb|stream)$|\.v4\.(same\.)?spz$",
    "spark": r"\.(ply|sog|splat)$|\.v[23]\.spz$",
    "cesium": r"\.tiles$",
}
"""Names of the files that each viewer draws. PlayCanvas reads version 4 of SPZ only, Spark 2.2 versions up to 3, and
CesiumJS 1.145 only 3D Tiles with SPZ inside."""


INDEX_FILES = {".tiles": "tileset.json", ".stream": "lod-meta.json"}
"""What viewers open of a folder."""


def suits(viewer: str, path: Path) -> bool:
    """Whether a viewer is to draw a file."""
    return bool(re.search(VIEWERS[viewer], path.name)) and not path.name.endswith(".spz.glb")


def world_of(path: Path) -> np.ndarray:
    """(4, 4) from the coordinates of the PLY file to those in which a viewer sees a file."""
    if path.suffix == ".glb":
        return np.array(three(path)[1]["matrix"]).reshape(4, 4).T
    if path.is_dir() and (path / "tileset.json").is_file():
        root = json.loads((path / "tileset.json").read_text())["root"]
        return np.array(root.get("transform", np.eye(4).ravel())).reshape(4, 4).T
    return HALF_TURN if path.suffix == ".spz" and not is_as_in_ply(path) else np.eye(4)


def camera_of(row: dict, world: np.ndarray) -> dict:
    """The camera of cameras.json as viewers take it, OpenGL axes."""
    matrix = np.eye(4)
    matrix[:3, :3] = np.array(row["rotation"]) @ np.diag([1.0, -1.0, -1.0])
    matrix[:3, 3] = row["position"]
    fov = float(np.degrees(2 * np.arctan(row["height"] / 2 / row["fy"])))
    return {"matrix": (world @ matrix).T.ravel().tolist(), "fov": fov, "near": 0.5, "far": 5000.0}


def drawn(folder: Path, run: Path) -> list[Row]:
    """A row for each file and viewer: PSNR to the same viewer's picture of the PLY file, and to surfkit's picture."""
    cameras = json.loads((run / "cameras.json").read_text())
    row = next(c for c in cameras if c["held_out"] and (run / "pictures" / f"{c['img_name']}.png").is_file())
    wanted = _panel(run / "pictures" / f"{row['img_name']}.png", row["width"])
    size = {"width": TIMES * row["width"], "height": TIMES * row["height"]}
    shots = []
    for viewer in VIEWERS:
        for path in sorted(folder.glob("model.*"), key=lambda p: (p.name != "model.ply", p.name)):
            if suits(viewer, path):
                name = f"{path.name}/{INDEX_FILES[path.suffix]}" if path.is_dir() else path.name
                camera = camera_of(row, world_of(path))
                shots.append(
                    {"viewer": viewer, "file": name, "camera": camera, "out": str(folder / f"{viewer}.{path.name}.png")}
                    | size
                )
    plan = folder / "shots.json"
    try:
        plan.write_text(json.dumps({"chromium": find_chromium(), "folder": str(folder.resolve()), "shots": shots}))
        answers = json.loads(node(HERE / "view.mjs", plan, timeout=3600))
    except (Missing, ValueError, OSError) as error:
        return [failed(folder, "Chromium", error)]
    return [_judged(shot, answer, wanted, folder) for shot, answer in zip(shots, answers, strict=True)]


def _panel(path: Path, width: int) -> np.ndarray:
    """surfkit's picture: the second of those side by side."""
    whole = Image.open(path).convert("RGB")
    return np.asarray(whole.crop((width, 0, 2 * width, whole.height)), np.float64)


def _judged(shot: dict, answer: dict, wanted: np.ndarray, folder: Path) -> Row:
    name = shot["file"].partition("/")[0]
    if "error" in answer or answer.get("faults"):
        return failed(Path(name), shot["viewer"], ValueError(answer.get("error") or "; ".join(answer["faults"])))
    picture = Image.open(shot["out"]).convert("RGB")
    small = np.asarray(picture.resize(wanted.shape[1::-1], Image.BOX), np.float64)
    ours = psnr_of(small, wanted)
    turned = max(psnr_of(small[:, ::-1], wanted), psnr_of(small[::-1], wanted), psnr_of(small[::-1, ::-1], wanted))
    first = folder / f"{shot['viewer']}.model.ply.png"
    alike = (
        psnr_of(np.asarray(picture, np.float64), np.asarray(Image.open(first).convert("RGB"), np.float64))
        if first.exists()
        else None
    )
    is_right = ours >= LIKE_OURS_DB and ours > turned + 3 and (alike is None or alike >= ALIKE_DB)
    note = f"{ours:.1f} dB to surfkit's picture, mirrored or upside down {turned:.1f}"
    if alike is not None and name != "model.ply":
        note += f"; {alike:.1f} dB to its PLY"
    if answer.get("tiles"):
        note += f"; {answer['tiles']} tiles, {answer['splats']:,} splats"
    return Row(name, shot["viewer"], is_right, None, note)


def psnr_of(a: np.ndarray, b: np.ndarray) -> float:
    """Of colours from 0 to 255."""
    return psnr(torch.tensor(a / 255), torch.tensor(b / 255))
