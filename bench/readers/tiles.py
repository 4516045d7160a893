"""3D Tiles of a survey in web viewers: CesiumJS and 3d-tiles-renderer, in Chromium without a window.

    cd bench/readers && npm ci --ignore-scripts && cd ../..
    python bench/readers/tiles.py RUN --textures RUN/texture --out FOLDER     # what `surfkit texture` wrote
    python bench/readers/tiles.py RUN --splats scene.tiles --out FOLDER       # and `surfkit export RUN format:tiles3d`

The cameras are those of a photograph in the middle of the survey: all of it, its inner quarter, and two farther away,
one of them oblique, for which coarser tiles are enough. Where the data set has a coordinate reference system, pyproj
takes them to the Earth, and not surfkit. So a tileset in another place shows nothing. A picture is right if it is like
the photograph, or like textured.glb drawn by three.js from the same camera, and clearly less like it when mirrored; if
it has no hole that the GLB file has not; and if no tile failed and the console shows no error. The figures go to
bench/results/tiles_viewers.json, the pictures and what the pages said to FOLDER. Exit status 1 if anything is wrong.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections import Counter
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from PIL import Image
from scipy.ndimage import maximum_filter

sys.path[:0] = [str(Path(__file__).parent), str(Path(__file__).parents[1])]
from check import Row, failed, leaves, table_of  # noqa: E402
from machine import save  # noqa: E402
from pictures import psnr_of, world_of  # noqa: E402
from programs import HERE, Missing, find_chromium, find_node, node  # noqa: E402

from surfkit.io.glb import read_glb  # noqa: E402
from surfkit.runs.pipeline import opened  # noqa: E402
from surfkit.runs.resume import read_unchanged  # noqa: E402
from surfkit.scene.photos import view_photo  # noqa: E402
from surfkit.scene.scene import Frame, Scene, View  # noqa: E402

WIDTH = 600
"""Pixels; software draws slowly."""
ERROR_PX = 16
"""The geometric error at which both viewers load finer tiles by default."""
INNER = 0.25
"""Share of the photograph that the second camera shows."""
AWAY = {"oblique": (50, 2), "far": (0, 4)}
"""Degrees by which other cameras move about what they look at, and how many times as far away they are."""
LIKE_GLB_DB, MIRRORED_DB, HOLES = 24.0, 2.0, 1e-3
"""Least PSNR to the GLB file: coarser tiles have texels of up to a pixel. What a picture is better by than a mirrored
one. Largest share of pixels that are background in a tileset only."""
VIEWERS = ("cesium", "tiles-renderer")


@dataclass(frozen=True)
class Shot:
    """A camera.

    Attributes:
        name: Of its pictures.
        pose: (4, 4) float64 camera to input frame, OpenGL axes.
        fov: Vertical, degrees.
        size: Width and height, pixels.
        photo: (H, W, 3) float64 what the photograph has there, 0 to 255; None where there is none.
    """

    name: str
    pose: np.ndarray
    fov: float
    size: tuple[int, int]
    photo: np.ndarray | None


def cameras_of(scene: Scene) -> list[Shot]:
    """The cameras to draw from: of the photograph that is nearest to the middle of all."""
    view = min(scene.train, key=lambda view: float(view.camera.centre.norm()))
    whole = _crop("photograph", scene, view, 1.0)
    moved = [_moved(name, whole, scene, np.radians(tilt), times) for name, (tilt, times) in AWAY.items()]
    return [whole, _crop("inner", scene, view, INNER), *moved]


def _crop(name: str, scene: Scene, view: View, share: float) -> Shot:
    """A share of a photograph about its principal point."""
    camera = view.camera
    half = share * np.array([min(camera.cx, camera.width - camera.cx), min(camera.cy, camera.height - camera.cy)])
    left, upper = np.array([camera.cx, camera.cy]) - half
    size = (WIDTH, round(WIDTH * (half[1] / camera.fy) / (half[0] / camera.fx)))
    picture = Image.fromarray(view_photo(view).permute(1, 2, 0).numpy())
    box = (left, upper, left + 2 * half[0], upper + 2 * half[1])
    photo = np.asarray(picture.resize(size, Image.BICUBIC, box=box), np.float64)
    pose = np.eye(4)
    pose[:3, :3] = camera.world_to_camera[:3, :3].T.numpy() @ np.diag([1.0, -1.0, -1.0])
    pose[:3, 3] = scene.frame.to_input(camera.centre.numpy())
    return Shot(name, pose, float(np.degrees(2 * np.arctan(half[1] / camera.fy))), size, photo)


def _moved(name: str, shot: Shot, scene: Scene, tilt: float, times: float) -> Shot:
    """The camera moved about the middle of its picture, at the median depth of points, and then back."""
    seen = (scene.frame.to_input(scene.cloud.xyz.double().numpy()) - shot.pose[:3, 3]) @ shot.pose[:3, :3]
    depth = float(np.median(-seen[:, 2]))
    turn, to, back = np.eye(4), np.eye(4), np.eye(4)
    turn[1:3, 1:3] = [[np.cos(tilt), -np.sin(tilt)], [np.sin(tilt), np.cos(tilt)]]
    to[2, 3], back[2, 3] = -depth, times * depth
    return replace(shot, name=name, pose=shot.pose @ to @ turn @ back, photo=None)


def on_earth(pose: np.ndarray, crs: str) -> np.ndarray:
    """(4, 4) camera to ECEF (EPSG:4978) of a camera in a coordinate reference system, by pyproj."""
    from pyproj import Transformer

    convert = Transformer.from_crs(crs, "EPSG:4978", always_xy=True)
    steps = pose[:3, 3] + np.concatenate([np.zeros((1, 3)), 10.0 * pose[:3, :3].T, -10.0 * pose[:3, :3].T])
    there = np.stack(convert.transform(*steps.T), axis=1)
    left, _, right = np.linalg.svd((there[1:4] - there[4:]).T)
    found = np.eye(4)
    found[:3, :3], found[:3, 3] = left @ right, there[0]
    return found


def pose_in(path: Path, pose: np.ndarray, frame: Frame) -> np.ndarray:
    """(4, 4) of a camera in the world of a viewer that shows a GLB file or a tileset.json."""
    if path.suffix == ".json" and frame.crs:
        return on_earth(pose, frame.crs)
    shifted = pose.copy()
    shifted[:3, 3] -= frame.shift
    if path.suffix == ".json":
        shifted[:3, 3] *= frame.metres or 1.0
        return world_of(path.parent) @ shifted
    turn = read_glb(path).root["nodes"][0].get("matrix", np.eye(4).ravel())
    return np.array(turn).reshape(4, 4).T @ shifted


@dataclass(frozen=True)
class Target:
    """A file and the page that draws it.

    Attributes:
        name: Of its pictures.
        viewer: The page.
        path: tileset.json, or the GLB file that tilesets are compared with.
        is_mesh: Whether it has triangles, or splats.
        is_for_it: Whether the viewer is known to draw such files. What it makes of others is told, and not judged.
    """

    name: str
    viewer: str
    path: Path
    is_mesh: bool = True
    is_for_it: bool = True

    def entry(self, shot: Shot, frame: Frame, out: Path) -> dict[str, Any]:
        """A picture of it as view.mjs takes it."""
        matrix = pose_in(self.path, shot.pose, frame).T.ravel().tolist()
        camera = {"matrix": matrix, "fov": shot.fov, "near": 1.0, "far": 5000.0, "error": ERROR_PX}
        size = {"width": shot.size[0], "height": shot.size[1]}
        picture = str(out / f"{self.name}.{shot.name}.{self.viewer}.png")
        return {"viewer": self.viewer, "file": f"{self.name}/{self.path.name}", "camera": camera, "out": picture} | size


def targets_of(textures: list[Path], splats: list[Path]) -> list[Target]:
    """The first GLB file of the folders of textures, then each tileset in each viewer."""
    glb = next((path for folder in textures if (path := folder / "textured.glb").is_file()), None)
    tilesets = [(path.name, path / "tiles3d/tileset.json", True) for path in textures]
    tilesets += [(path.name, path / "tileset.json", False) for path in splats]
    found = [
        Target(name, viewer, path, is_mesh, is_mesh or (viewer == "cesium" and is_packed(path)))
        for name, path, is_mesh in tilesets
        for viewer in VIEWERS
    ]
    return ([Target("glb", "tiles-renderer", glb)] if glb else []) + found


def depths_of(tile: dict[str, Any], depth: int = 0) -> dict[str, int]:
    """How deep below the root the content of a tile, and of each one below it, lies."""
    own = {tile["content"]["uri"]: depth} if "content" in tile else {}
    return own | {uri: at for child in tile.get("children", []) for uri, at in depths_of(child, depth + 1).items()}


def is_packed(path: Path) -> bool:
    """Whether the splats of a tileset are compressed as SPZ."""
    tile = leaves(json.loads(path.read_text())["root"])[0]
    return any("spz" in name for name in read_glb(path.parent / tile["content"]["uri"]).root["extensionsUsed"])


def draw(pictures: list[tuple[Target, Shot]], frame: Frame, out: Path) -> list[dict[str, Any]]:
    """What the pages say of each picture and where it is; one browser for all."""
    entries = [target.entry(shot, frame, out) for target, shot in pictures]
    with TemporaryDirectory() as served:
        for name, path in {target.name: target.path for target, _ in pictures}.items():
            (Path(served) / name).symlink_to(path.parent.resolve())
        plan = out / "shots.json"
        plan.write_text(json.dumps({"chromium": find_chromium(), "folder": served, "shots": entries}))
        answers = json.loads(node(HERE / "view.mjs", plan, timeout=3600))
    (out / "answers.json").write_text(json.dumps(answers, indent=1) + "\n")
    return [{"out": entry["out"]} | answer for entry, answer in zip(entries, answers, strict=True)]


def pixels_of(path: Path) -> np.ndarray:
    """(H, W, 3) float64 of a picture, 0 to 255."""
    return np.asarray(Image.open(path).convert("RGB"), np.float64)


def is_empty(picture: np.ndarray) -> np.ndarray:
    """(H, W) where a picture shows the background."""
    return picture.max(2) < 2


def like(picture: np.ndarray, wanted: np.ndarray) -> tuple[float, float]:
    """PSNR of two (H, W, 3) pictures, and the best one when one of them is mirrored or upside down, dB."""
    turned = (picture[:, ::-1], picture[::-1], picture[::-1, ::-1])
    return psnr_of(picture, wanted), max(psnr_of(one, wanted) for one in turned)


def judged(target: Target, shot: Shot, answer: dict[str, Any], glb: np.ndarray | None) -> Row:
    """The row of a picture; with the (H, W, 3) picture of the GLB file, if there is one."""
    name = f"{target.name}, {shot.name}"
    errors = [said for said in answer["said"] if said.startswith("error")]
    faults = [*answer.get("faults", []), *errors, *([answer["error"]] if "error" in answer else [])]
    if "drawn" not in answer or faults:
        row = failed(Path(name), target.viewer, ValueError(" ".join("; ".join(faults).split())))
        return row if target.is_for_it else replace(row, is_right=None)
    kinds = "".join(f", {kind}" for kind in answer.get("kinds", []))
    depths = depths_of(json.loads(target.path.read_text())["root"])
    counts = Counter(depths[uri] for uri in answer["drawn"])
    told = [", ".join(f"{count} tiles of depth {depth}" for depth, count in sorted(counts.items())) + kinds]
    is_right = bool(answer["drawn"])
    picture = pixels_of(Path(answer["out"]))
    if glb is not None and target.is_mesh:
        same, turned = like(picture, glb)
        holes = float((is_empty(picture) & ~maximum_filter(is_empty(glb), 3)).mean())
        told.append(f"{same:.1f} dB to the GLB file, mirrored {turned:.1f}; holes {holes:.2%}")
        is_right &= same >= LIKE_GLB_DB and same > turned + MIRRORED_DB and holes <= HOLES
    if shot.photo is not None:
        same, turned = like(picture, shot.photo)
        told.append(f"{same:.1f} dB to the photograph, mirrored {turned:.1f}")
        is_right &= same > turned + MIRRORED_DB
    return Row(name, target.viewer, bool(is_right) if target.is_for_it else None, None, "; ".join(told))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path, help="folder that `surfkit train` made")
    parser.add_argument("--textures", type=Path, nargs="*", default=[], help="folders that `surfkit texture` made")
    parser.add_argument("--splats", type=Path, nargs="*", default=[], help="tilesets of splats")
    parser.add_argument("--out", type=Path, required=True, help="folder for the pictures")
    options = parser.parse_args()
    try:
        find_node()
        find_chromium()
    except Missing as error:
        print(error, file=sys.stderr)
        sys.exit(2)
    options.out.mkdir(parents=True, exist_ok=True)
    scene = read_unchanged(opened(options.run))
    shots = cameras_of(scene)
    for shot in shots:
        if shot.photo is not None:
            Image.fromarray(shot.photo.round().astype(np.uint8)).save(options.out / f"{shot.name}.png")
    targets = targets_of(options.textures, options.splats)
    pictures = [(one, shot) for one in targets for shot in shots if one.is_mesh or shot.photo is not None]
    rows, glbs = [], {}
    for (target, shot), answer in zip(pictures, draw(pictures, scene.frame, options.out), strict=True):
        if target.path.suffix == ".glb":
            glbs[shot.name] = pixels_of(Path(answer["out"]))
        else:
            rows.append(judged(target, shot, answer, glbs.get(shot.name)))
    print(table_of(rows))
    versions = json.loads((HERE / "package.json").read_text())["dependencies"]
    versions = {name: versions[name] for name in ("cesium", "3d-tiles-renderer", "three")}
    print(f"wrote {save('tiles_viewers', {'versions': versions, 'rows': [asdict(row) for row in rows]})}")
    sys.exit(1 if any(row.is_right is False for row in rows) else 0)


if __name__ == "__main__":
    main()
