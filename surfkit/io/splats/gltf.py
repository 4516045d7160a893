"""Splats in glTF: GLB files with KHR_gaussian_splatting, as they are or with its SPZ compression.

Sources: KHR_gaussian_splatting (github.com/KhronosGroup/glTF, extensions/2.0/Khronos, release candidate of July 2026:
float attributes, linear scales, opacities in [0, 1], quaternions xyzw, harmonics with the Condon-Shortley phase, m from
-l to l, as in the files of 3DGS) and the draft KHR_gaussian_splatting_compression_spz_2 (pull request 2531 there).

The draft and its main implementation, CesiumJS, differ: by the draft, readers turn the coordinates of the SPZ data from
right-up-back to left-up-front; CesiumJS (1.145, Scene/GltfSpzLoader.js) and Cesium ion take them as they are. iTwin.js
(GaussianSplats.md) tells such files by what they lack and the base extension demands: kernel, colorSpace and
coefficients of degree 0. We write files as Cesium does, and read both.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar, Literal

import numpy as np
import torch

from surfkit.core.version import own_version
from surfkit.io.glb import FLOAT, GLB_MAGIC, UNSIGNED_BYTE, VERTICES, GlbWriter, write_glb
from surfkit.io.splats.base import Format
from surfkit.io.splats.bits import SH_C0, to_bytes
from surfkit.io.splats.file_axes import turn_between
from surfkit.io.splats.gltf_reader import COMPRESSED, MIN_NORMAL_FLOAT32, SPLATS, UPS, harmonics, read_splats
from surfkit.io.splats.rotate_splats import turned
from surfkit.io.splats.splat_table import SplatTable, Tile
from surfkit.io.splats.spz import SPZ, spz_bytes, spz_table
from surfkit.scene.rotations import unit
from surfkit.scene.scene import MAX_EXTENTS_OFFSET, Frame

Compress = Literal["none", "spz"]
Up = Literal["auto", "y", "-y", "z"]
MIN_QUATERNION_W = 0.45
"""Components w that are kept; the largest of the four is at least a half, and little less when it was rounded."""
MAX_SCALE = 1e38
"""Largest scale that is written: float32 ends there."""


@dataclass(frozen=True)
class GLTF(Format):
    """Binary glTF 2.0 with the extension KHR_gaussian_splatting of Khronos, for engines and viewers of the globe."""

    suffix: ClassVar[str] = ".glb"

    compress: Compress = "none"
    """spz packs the splats as SPZ of version 2 by the draft extension that CesiumJS reads, a tenth of the size; none
    keeps float32, by the extension as it is ratified."""

    up: Up = "auto"
    """Axis of the input that points up, or down with a minus; glTF has y. auto: z of a georeferenced data set, -y
    otherwise, as the cameras of COLMAP have it."""

    def write(self, path: Path, table: SplatTable, frame: Frame | None = None, tree: Tile | None = None) -> None:
        """See `Format.write`."""
        table.refuse_unsound(path)
        table = replace(table, means=table.file_means(frame))
        up = up_of(self.up, frame)
        notes: dict[str, Any] = {"up": up}
        if frame is not None:
            notes |= {"offset": list(frame.shift), "crs": frame.crs, "metres_per_unit": frame.metres}
        write_splats(path, table, UPS[up], self.compress, notes)

    def read(self, path: Path) -> SplatTable:
        """See `Format.read`."""
        table = read_splats(path)
        table.refuse_unsound(path)
        return turned(table, turn_between(table.axes.name))

    def knows(self, path: Path, head: bytes) -> bool:
        """See `Format.knows`."""
        return head.startswith(GLB_MAGIC)

    def rounding(self, table: SplatTable) -> str:
        """See `Format.rounding`."""
        if self.compress == "spz":
            return SPZ(version=2).rounding(table)
        return "nothing is rounded but positions, to float32"


def up_of(up: Up, frame: Frame | None) -> str:
    """The axis that `auto` stands for."""
    if up != "auto":
        return up
    return "z" if frame is not None and frame.crs else "-y"


def write_splats(path: Path, table: SplatTable, turn: np.ndarray, compress: Compress, notes: dict[str, Any]) -> None:
    """Save splats as a GLB file.

    Args:
        path: Appears only when it is complete.
        table: N splats, finite. What float32 would lose of positions far from 0 goes into the matrix of the node.
        turn: (3, 3) rotation to y up, which the node has.
        compress: As what the splats are stored.
        notes: What `asset.extras.surfkit` says besides how to read the splats back.
    """
    table = table.on_cpu()
    centre = centre_of(table, 0.0 if compress == "spz" else MAX_EXTENTS_OFFSET)
    table = replace(table, means=table.means.double() - torch.from_numpy(centre)) if centre.any() else table
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = turn, turn @ centre
    extras = {"kind": table.kind, "antialias": table.antialias, "sh_degree": table.sh_degree, **notes}
    document: dict[str, Any] = {
        "asset": {"version": "2.0", "generator": f"surfkit {own_version()}", "extras": {"surfkit": extras}},
        "scene": 0,
        "scenes": [{"name": "empty"}],
    }
    blocks = GlbWriter()
    if len(table):
        # CesiumJS asks for a matrix even where it changes nothing; of other identities, the validator warns
        plain = np.array_equal(matrix, np.eye(4)) and compress == "none"
        document["scenes"] = [{"nodes": [0]}]
        document["nodes"] = [{"mesh": 0, "name": "splats"} | ({} if plain else {"matrix": matrix.T.ravel().tolist()})]
        primitive = (_compressed if compress == "spz" else _plain)(path, blocks, table)
        document["meshes"] = [{"name": "splats", "primitives": [{"mode": 0, **primitive}]}]
        document["extensionsUsed"] = extensions_of(compress)
        if compress == "spz":
            document["extensionsRequired"] = extensions_of(compress)
    write_glb(path, document, blocks, "use the format tiles3d, or compress")


def extensions_of(compress: Compress) -> list[str]:
    """Names of the extensions that a file uses."""
    return [SPLATS, COMPRESSED] if compress == "spz" else [SPLATS]


def centre_of(table: SplatTable, far: float) -> np.ndarray:
    """(3,) float64: a whole number near the middle on axes on which that is `far` extents from 0, and 0 on others."""
    if not len(table):
        return np.zeros(3)
    low, high = (value.double().numpy() for value in torch.aminmax(table.means, dim=0))
    middle = (low + high) / 2
    extent = max(float((high - low).max()), float(table.log_scales.max().exp()))
    return np.where(np.abs(middle) > far * extent, np.round(middle), 0.0)


def _plain(path: Path, blocks: GlbWriter, table: SplatTable) -> dict[str, Any]:
    """The primitive of splats as they are, float32."""
    count = len(table)
    means = table.means.float()
    low, high = (value.tolist() for value in torch.aminmax(means, dim=0))
    columns: dict[str, tuple[str, Any]] = {
        "ROTATION": ("VEC4", lambda: np.roll(unit(table.quats.numpy()), -1, axis=1)),
        "SCALE": (
            "VEC3",
            lambda: table.ellipsoid_log_scales().double().exp().clamp(MIN_NORMAL_FLOAT32, MAX_SCALE).numpy(),
        ),
        "OPACITY": ("SCALAR", lambda: torch.sigmoid(table.opacity_logits.double()).numpy()),
        "SH_DEGREE_0_COEF_0": ("VEC3", lambda: table.sh0.numpy()),
    }
    for name, at in harmonics(table.sh_degree):
        columns[name] = ("VEC3", lambda at=at: table.sh_rest[:, at].numpy())

    def add(width: int, make: Callable[[], np.ndarray]) -> int:
        return blocks.add(4 * width * count, lambda: _bytes(make()), target=VERTICES)

    view = add(3, means.numpy)
    attributes = {"POSITION": blocks.accessor(view, componentType=FLOAT, count=count, type="VEC3", min=low, max=high)}
    view = blocks.add(4 * count, lambda: _fallback(table), target=VERTICES)
    attributes["COLOR_0"] = blocks.accessor(
        view, componentType=UNSIGNED_BYTE, count=count, type="VEC4", normalized=True
    )
    for name, (kind, make) in columns.items():
        view = add({"SCALAR": 1, "VEC3": 3, "VEC4": 4}[kind], make)
        attributes[f"{SPLATS}:{name}"] = blocks.accessor(view, componentType=FLOAT, count=count, type=kind)
    about = {"kernel": "ellipse", "colorSpace": "srgb_rec709_display", "sortingMethod": "cameraDistance"}
    return {"attributes": attributes, "extensions": {SPLATS: {**about, "projection": "perspective"}}}


def _compressed(path: Path, blocks: GlbWriter, table: SplatTable) -> dict[str, Any]:
    """The primitive of splats as SPZ, with the accessors that CesiumJS expects: no values, and no degree 0."""
    quats = torch.from_numpy(sure_rotations(table.quats.numpy()))
    data = spz_bytes(replace(table, quats=quats), 2, path)
    stored = spz_table(data, path)
    low, high = (value.tolist() for value in torch.aminmax(stored.means.float(), dim=0))
    count = len(table)
    attributes = {
        "POSITION": blocks.accessor(None, componentType=FLOAT, count=count, type="VEC3", min=low, max=high),
        "COLOR_0": blocks.accessor(None, componentType=UNSIGNED_BYTE, count=count, type="VEC4", normalized=True),
        f"{SPLATS}:SCALE": blocks.accessor(None, componentType=FLOAT, count=count, type="VEC3"),
        f"{SPLATS}:ROTATION": blocks.accessor(None, componentType=FLOAT, count=count, type="VEC4"),
    }
    for name, _ in harmonics(table.sh_degree):
        attributes[f"{SPLATS}:{name}"] = blocks.accessor(None, componentType=FLOAT, count=count, type="VEC3")
    view = blocks.add(len(data), lambda: data)
    return {"attributes": attributes, "extensions": {SPLATS: {"extensions": {COMPRESSED: {"bufferView": view}}}}}


def sure_rotations(quats: np.ndarray) -> np.ndarray:
    """(N, 4) quaternions wxyz that turn ellipsoids as the given ones do, of which SPZ of version 2 loses little.

    It has x, y and z in a byte each; w follows from them, with an error of up to 10 degrees where it is small. Half a
    turn about an axis of an ellipsoid changes nothing, and makes another component w. What was read back stays.
    """
    quats = unit(quats)
    quats = np.where(quats[:, :1] < 0, -quats, quats)
    stored = to_bytes(127.5 * quats[:, 1:] + 127.5) / 127.5 - 1
    w, x, y, z = quats.T
    halves = np.stack([(-x, w, z, -y), (-y, -z, w, x), (-z, y, -x, w)])  # times i, j and k
    best = halves[np.abs(quats[:, 1:]).argmax(1), :, np.arange(len(quats))]
    return np.where((stored**2).sum(1, keepdims=True) > 1 - MIN_QUATERNION_W**2, best, quats)


def _bytes(values: np.ndarray) -> bytes:
    return np.ascontiguousarray(values, "<f4").tobytes()


def _fallback(table: SplatTable) -> bytes:
    """Linear colours and opacities in a byte each, for programs that draw points."""
    shown = (0.5 + SH_C0 * table.sh0).clamp(0, 1)
    linear = torch.where(shown <= 0.04045, shown / 12.92, ((shown + 0.055) / 1.055) ** 2.4)
    rgba = torch.cat([linear, torch.sigmoid(table.opacity_logits)[:, None]], dim=1)
    return (255 * rgba).round().to(torch.uint8).numpy().tobytes()
