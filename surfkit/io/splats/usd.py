"""Splats in OpenUSD: .usdz files with a ParticleField of UsdVol, which OpenUSD has since 26.03.

Source: pxr/usd/usdVol/schema.usda of PixarAnimationStudios/OpenUSD: linear scales, opacities in [0, 1], quaternions,
harmonics of a particle next to one another in the order of the files of 3DGS. Its kernels are standard normal
distributions, of an ellipsoid, or of a surflet: the disc in the plane of x and y.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar, Literal

import numpy as np
import torch

from surfkit.core.check import BadInput
from surfkit.io.splats.base import Format
from surfkit.io.splats.file_axes import Axes, FileAxes, turn_between
from surfkit.io.splats.gltf import MAX_SCALE, Up, centre_of, up_of
from surfkit.io.splats.gltf_reader import LOG_SCALE_ROUNDING, MAX_OPACITY, MIN_NORMAL_FLOAT32, UPS, joined
from surfkit.io.splats.rotate_splats import parts_of, turned
from surfkit.io.splats.splat_table import SplatTable, Tile
from surfkit.io.splats.tiles3d import box_of
from surfkit.io.usdz import NOTES, USDZ_SUFFIX, knows_usdz, new_stage, open_usdz, place_prim, require_usd, write_usdz
from surfkit.scene.rotations import unit
from surfkit.scene.scene import MAX_EXTENTS_OFFSET, Frame

Kernel = Literal["ellipsoid", "surflet"]
USD_AXES: dict[str, Axes] = {"Y": "rub", "Z": "rfu"}
"""Axes of a stage by the one that is up."""
COEFFICIENTS, DEGREE = "radiance:sphericalHarmonicsCoefficients", "radiance:sphericalHarmonicsDegree"
SURFLET_SCHEMAS = (
    "ParticleFieldPositionAttributeAPI", "ParticleFieldOrientationAttributeAPI", "ParticleFieldScaleAttributeAPI",
    "ParticleFieldOpacityAttributeAPI", "ParticleFieldKernelGaussianSurfletAPI",
    "ParticleFieldSphericalHarmonicsAttributeAPI",
)  # fmt: skip
"""What a field of surflets is made of."""


@dataclass(frozen=True)
class USD(Format):
    """OpenUSD (.usdz) with its ParticleField3DGaussianSplat, for Omniverse and other programs of film and games."""

    suffix: ClassVar[str] = USDZ_SUFFIX

    kernel: Kernel = "ellipsoid"
    """ellipsoid is what most programs know; surfels are thin ones then. surflet says that splats are flat discs, by the
    more general ParticleField; for surfels only."""

    up: Up = "auto"
    """Axis of the input that points up, or down with a minus. auto: z of a georeferenced data set, -y otherwise, as the
    cameras of COLMAP have it."""

    def write(self, path: Path, table: SplatTable, frame: Frame | None = None, tree: Tile | None = None) -> None:
        """See `Format.write`."""
        require_usd("the format usd")
        table.refuse_unsound(path)
        if self.kernel == "surflet" and table.kind != "surfel":
            raise BadInput(
                f"{path}: kernel surflet is for surfels (2DGS), and these splats are ellipsoids; leave it out"
            )
        table = replace(table.on_cpu(), means=table.file_means(frame))
        up = up_of(self.up, frame)
        notes = {"up": up, "kind": table.kind, "antialias": table.antialias}
        if frame is not None:
            notes |= {"offset": tuple(frame.shift), "crs": frame.crs}
        stage = new_stage("Z" if up == "z" else "Y", None if frame is None else frame.metres, notes)
        centre, turn = centre_of(table, MAX_EXTENTS_OFFSET), np.eye(3) if up == "z" else UPS[up]
        if centre.any():
            table = replace(table, means=table.means.double() - torch.from_numpy(centre))
        matrix = np.eye(4)
        matrix[:3, :3], matrix[:3, 3] = turn, turn @ centre
        prim = stage.DefinePrim("/splats", "ParticleField3DGaussianSplat")
        if self.kernel == "surflet":
            prim.SetTypeName("ParticleField")
            for schema in SURFLET_SCHEMAS:
                prim.AddAppliedSchema(schema)
        stage.SetDefaultPrim(prim)
        place_prim(prim, matrix)
        _fill(prim, table)
        write_usdz(path, stage)

    def read(self, path: Path) -> SplatTable:
        """See `Format.read`."""
        require_usd("the format usd")
        from pxr import UsdGeom

        stage = open_usdz(path)
        notes = stage.GetRootLayer().customLayerData.get(NOTES, {})
        back = np.eye(4)
        if notes:
            if notes.get("up") not in tuple(UPS) or notes.get("kind") not in ("surfel", "gaussian"):
                raise BadInput(f"{path}: damaged: its notes are not what surfkit writes; write or copy it again")
            back[:3, :3] = np.eye(3) if notes["up"] == "z" else UPS[notes["up"]].T
            back[:3, 3] = notes.get("offset", (0, 0, 0))
        tables = list(_tables(path, stage, back))
        if not tables:
            raise BadInput(f"{path}: no file of splats: no prim of its scene is a ParticleField")
        is_mixed = len({table.kind for table in tables}) > 1
        table = joined([_ellipsoids(each) for each in tables] if is_mixed else tables, 0)
        table.refuse_unsound(path)
        if notes:
            table = replace(table, antialias=bool(notes.get("antialias", False)))
            return table.as_surfels() if notes["kind"] == "surfel" else table
        axes = FileAxes(USD_AXES[UsdGeom.GetStageUpAxis(stage)], True)
        return turned(replace(table.as_surfels_if_thin(LOG_SCALE_ROUNDING), axes=axes), turn_between(axes.name))

    def knows(self, path: Path, head: bytes) -> bool:
        """See `Format.knows`."""
        return knows_usdz(head)

    def rounding(self, table: SplatTable) -> str:
        """See `Format.rounding`."""
        return "nothing is rounded but positions, to float32"


def _fill(prim: Any, table: SplatTable) -> None:
    """The attributes of N splats."""
    from pxr import Vt

    scales = table.ellipsoid_log_scales().double().exp().clamp(MIN_NORMAL_FLOAT32, MAX_SCALE).numpy()
    harmonics = torch.cat([table.sh0[:, None], table.sh_rest], dim=1).numpy().reshape(-1, 3)
    columns = {
        "positions": (Vt.Vec3fArray, table.means.numpy()),
        "orientations": (Vt.QuatfArray, np.roll(unit(table.quats.numpy()), -1, axis=1)),  # in memory, w is the last
        "scales": (Vt.Vec3fArray, scales),
        "opacities": (Vt.FloatArray, torch.sigmoid(table.opacity_logits.double()).numpy()),
        COEFFICIENTS: (Vt.Vec3fArray, harmonics),
    }
    for name, (kind, values) in columns.items():
        prim.GetAttribute(name).Set(kind.FromNumpy(np.ascontiguousarray(values, np.float32)))
    prim.GetAttribute(DEGREE).Set(table.sh_degree)
    if len(table):
        prim.GetAttribute("extent").Set(Vt.Vec3fArray.FromNumpy(box_of(table).astype(np.float32)))


def _tables(path: Path, stage: Any, back: np.ndarray) -> Iterator[SplatTable]:
    """The splats of each particle field, placed in the stage and then by the (4, 4) matrix `back`."""
    from pxr import Usd, UsdGeom, UsdVol

    for prim in stage.Traverse():
        if not prim.IsA(UsdVol.ParticleField):
            continue
        kernels = [kind for kind, schema in (
            ("gaussian", UsdVol.ParticleFieldKernelGaussianEllipsoidAPI),
            ("surfel", UsdVol.ParticleFieldKernelGaussianSurfletAPI),
        ) if prim.HasAPI(schema)]  # fmt: skip
        if len(kernels) != 1:
            raise BadInput(f"{path}: {prim.GetPath()} has no Gaussian kernel, or two; only such splats are read")
        matrix = UsdGeom.Xformable(prim).ComputeLocalToWorldTransform(Usd.TimeCode.EarliestTime())
        try:
            turn, scale, move = parts_of(back @ np.array(matrix).T)
        except BadInput as error:
            raise BadInput(f"{path}: {prim.GetPath()}: {error}") from error
        yield turned(_table(path, prim, kernels[0]), turn, scale, move)


def _table(path: Path, prim: Any, kind: Any) -> SplatTable:
    """The splats of a particle field, in its own coordinates."""
    from pxr import Usd

    def values(name: str, count: int | None, default: float, width: int = 3) -> np.ndarray:
        for spelled in (name, f"{name}h"):  # of 32 and of 16 bits
            found = prim.GetAttribute(spelled).Get(Usd.TimeCode.EarliestTime()) if prim.HasAttribute(spelled) else None
            if found is not None and (len(found) or not count):
                rows = np.array(found, np.float32).reshape(-1, width)
                if count is not None and len(rows) != count:
                    raise BadInput(
                        f"{path}: {prim.GetPath()}.{spelled} has {len(rows)} values, not {count}; write it again"
                    )
                return rows
        return np.full((count or 0, width), default, np.float32)

    means = values("positions", None, 0.0)
    count, degree = len(means), prim.GetAttribute(DEGREE).Get()
    if degree not in (0, 1, 2, 3):
        raise BadInput(f"{path}: {prim.GetPath()} has spherical harmonics of degree {degree}; 0 to 3 are read")
    each = (degree + 1) ** 2
    harmonics = values(COEFFICIENTS, count * each, 0.0).reshape(count, each, 3)
    quats = values("orientations", count, 0.0, 4)
    quats[~quats.any(1), 3] = 1  # none is authored: not turned
    opacity = values("opacities", count, 1.0, 1)[:, 0].astype(np.float64).clip(MIN_NORMAL_FLOAT32, MAX_OPACITY)
    scales = np.log(values("scales", count, 1.0).clip(MIN_NORMAL_FLOAT32))
    return SplatTable(
        kind=kind,
        means=torch.from_numpy(means),
        quats=torch.from_numpy(np.roll(quats, 1, axis=1)),
        log_scales=torch.from_numpy(scales[:, :2].copy() if kind == "surfel" else scales),
        opacity_logits=torch.from_numpy(np.log(opacity / (1 - opacity)).astype(np.float32)),
        sh0=torch.from_numpy(harmonics[:, 0].copy()),
        sh_rest=torch.from_numpy(harmonics[:, 1:].copy()),
    )


def _ellipsoids(table: SplatTable) -> SplatTable:
    """The same splats as ellipsoids."""
    return replace(table, kind="gaussian", log_scales=table.ellipsoid_log_scales())
