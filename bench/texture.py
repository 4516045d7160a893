"""A textured mesh against held-out photographs, beside the same mesh with the colours of its vertices.

    surfkit texture RUN
    python bench/texture.py RUN [RUN/texture]

textured.glb, as trimesh reads it, and mesh.ply of the run are drawn into each held-out view, four samples a pixel, and
compared with the photograph where both are there. A mesh of as many triangles as the textured one, with the mean
colours of the vertices, is the third. Writes bench/results/texture.json with --keep, and pictures with --pictures
FOLDER.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import numpy as np
import torch
import trimesh
from machine import save
from PIL import Image

from surfkit.apps.maps.photo_sight import between
from surfkit.apps.texture.texture_mesh import local_mesh
from surfkit.apps.texture.triangle_visibility import project
from surfkit.evaluate.geometry.surface_file import read_surface
from surfkit.io.datasets.read import read
from surfkit.mesh.base import Mesh
from surfkit.mesh.shade import draw_faces
from surfkit.mesh.simplify import simplify_to
from surfkit.raster.psnr import psnr
from surfkit.runs.pipeline import opened
from surfkit.scene.camera import Camera
from surfkit.scene.photos import view_photo
from surfkit.scene.scene import Frame

FINE = 2
"""Samples along each side of a pixel."""


class Drawn:
    """What a camera sees of a mesh: the triangle of each sample, and the shares of its corners."""

    def __init__(self, mesh: Mesh, camera: Camera) -> None:
        fine = camera.resized(FINE * camera.width, FINE * camera.height)
        places = project(mesh.vertices, fine)
        _, self.face = draw_faces(places, mesh.faces, fine.width, fine.height)
        self.there = self.face >= 0
        self.corners = mesh.faces[self.face[self.there]]
        row, column = np.nonzero(self.there)
        (ax, ay), (bx, by), (cx, cy) = (places[self.corners[:, i], :2].astype(np.float64).T for i in range(3))
        area = (bx - ax) * (cy - ay) - (cx - ax) * (by - ay)
        second = ((column + 0.5 - ax) * (cy - ay) - (cx - ax) * (row + 0.5 - ay)) / area
        third = ((bx - ax) * (row + 0.5 - ay) - (column + 0.5 - ax) * (by - ay)) / area
        flat = np.stack([1 - second - third, second, third], axis=1) / places[self.corners, 2]
        self.shares = (flat / flat.sum(1, keepdims=True))[:, :, None]

    def of_corners(self, values: np.ndarray) -> np.ndarray:
        """(n, k) values of the vertices, at the samples."""
        return (values[self.corners] * self.shares).sum(1)

    def picture(self, color: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(H, W, 3) colours of pixels, and (H, W) where all their samples have one."""
        height, width = self.there.shape
        full = np.zeros((height, width, 3))
        full[self.there] = color
        grouped = full.reshape(height // FINE, FINE, width // FINE, FINE, 3).mean((1, 3))
        return grouped, self.there.reshape(height // FINE, FINE, width // FINE, FINE).all((1, 3))


class Textured:
    """A GLB file of `surfkit texture`, in the local frame."""

    def __init__(self, path: Path, frame: Frame) -> None:
        scene = trimesh.load(path, process=False)
        vertices, faces, self.uv, self.page, self.images, start = [], [], [], [], [], 0
        for node in scene.graph.nodes_geometry:
            piece = scene.geometry[scene.graph[node][1]]  # as it is in the file, not turned to y up
            vertices.append(piece.vertices)
            faces.append(piece.faces + start)
            start += len(piece.vertices)
            self.uv.append(piece.visual.uv)
            self.page.append(np.full(len(piece.faces), len(self.images)))
            self.images.append(np.asarray(piece.visual.material.baseColorTexture.convert("RGB")))
        xyz = np.concatenate(vertices) + np.array(frame.shift)
        self.mesh = Mesh(frame.to_local(xyz).astype(np.float32), np.concatenate(faces).astype(np.int32))
        self.uv, self.page = np.concatenate(self.uv), np.concatenate(self.page)

    def picture(self, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
        """See `Drawn.picture`."""
        drawn = Drawn(self.mesh, camera)
        uv, page = drawn.of_corners(self.uv), self.page[drawn.face[drawn.there]]
        color = np.zeros((len(uv), 3))
        for number, image in enumerate(self.images):
            some = page == number
            height, width = image.shape[:2]
            x, y = uv[some, 0] * width, (1 - uv[some, 1]) * height  # trimesh counts v from below
            color[some] = between(image.transpose(2, 0, 1), x, y)
        return drawn.picture(color)


def gradient(picture: np.ndarray, where: np.ndarray) -> float:
    """Mean absolute difference of the grey of neighbouring pixels, a measure of sharpness."""
    grey = picture.mean(2)
    down = np.abs(np.diff(grey, axis=0))[where[1:] & where[:-1]]
    across = np.abs(np.diff(grey, axis=1))[where[:, 1:] & where[:, :-1]]
    return float((down.mean() + across.mean()) / 2)


def main() -> None:
    """Measure."""
    parser = argparse.ArgumentParser()
    parser.add_argument("run", type=Path)
    parser.add_argument("texture", type=Path, nargs="?")
    parser.add_argument("--pictures", type=Path)
    parser.add_argument("--keep", action="store_true", help="write bench/results/texture.json")
    asked = parser.parse_args()
    folder = asked.texture or asked.run / "texture"
    run = opened(asked.run)
    scene = read(run.data)
    textured = Textured(folder / "textured.glb", scene.frame)
    whole = local_mesh(read_surface(run.mesh), scene.frame)
    few = simplify_to(whole, len(textured.mesh.faces))
    names = ("textured", "vertices", "vertices of few triangles", "photograph")
    scores, sharp = {name: [] for name in names[:-1]}, {name: [] for name in names}
    for view in scene.held_out:
        photo = view_photo(view).permute(1, 2, 0).numpy().astype(np.float64)
        made = {"textured": textured.picture(view.camera)}
        for name, mesh in (("vertices", whole), ("vertices of few triangles", few)):
            drawn = Drawn(mesh, view.camera)
            made[name] = drawn.picture(drawn.of_corners(mesh.colors.astype(np.float64)))
        where = np.all([there for _, there in made.values()], axis=0)
        for name, (picture, _) in made.items():
            scores[name].append(psnr(torch.from_numpy(picture[where] / 255), torch.from_numpy(photo[where] / 255)))
            sharp[name].append(gradient(picture, where))
        sharp["photograph"].append(gradient(photo, where))
        if asked.pictures:
            asked.pictures.mkdir(parents=True, exist_ok=True)
            row = np.concatenate([photo, made["textured"][0], made["vertices"][0]], axis=1)
            Image.fromarray(row.clip(0, 255).round().astype(np.uint8)).save(
                asked.pictures / f"{Path(view.name).stem}.png"
            )
    record = json.loads((folder / "texture.json").read_text())
    figures = {
        "photographs": f"{len(scene.train)}, held out {len(scene.held_out)}",
        "triangles": {"of the run": len(whole.faces), "textured": record["triangles"]},
        "seconds": record["seconds"],
        "MB": {path.name: round(path.stat().st_size / 1e6, 1) for path in sorted(folder.glob("textured*"))},
        "charts": record["charts"],
        "pages": record["pages"],
        "surface that photographs show": record["seen"],
        "PSNR dB": {name: round(float(np.mean(found)), 2) for name, found in scores.items()},
        "mean gradient": {name: round(float(np.mean(found)), 2) for name, found in sharp.items()},
    }
    print(json.dumps(figures, indent=2))
    if asked.keep:
        print(save("texture", figures))


if __name__ == "__main__":
    main()
