"""The .splat files of antimatter15's viewer: 32 bytes for a splat, no header, no spherical harmonics.

Layout: three float32 of position, three float32 of scale (lengths, not logarithms), red, green, blue and opacity as
bytes from 0 to 255, and a rotation wxyz as bytes round(128 q) + 128. Source: github.com/antimatter15/splat, main.js.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import numpy as np
import torch

from surfkit.core.check import BadInput
from surfkit.core.files import replacing
from surfkit.io.splats.base import Format
from surfkit.io.splats.bits import SH_C0, logits, sigmoid, to_bytes
from surfkit.io.splats.ply import WRITTEN_ROWS
from surfkit.io.splats.splat_table import SplatTable, Tile
from surfkit.scene.rotations import unit
from surfkit.scene.scene import Frame

SPLAT_DTYPE = np.dtype([("xyz", "<f4", 3), ("scales", "<f4", 3), ("rgba", "u1", 4), ("rot", "u1", 4)])
MIN_READ_SCALE = float(np.finfo(np.float32).tiny)
"""Scales of 0 are read as this, which has a logarithm."""


@dataclass(frozen=True)
class Splat(Format):
    """The layout of antimatter15's viewer: 32 bytes for a splat, largest first, no spherical harmonics."""

    suffix: ClassVar[str] = ".splat"

    def write(self, path: Path, table: SplatTable, frame: Frame | None = None, tree: Tile | None = None) -> None:
        """See `Format.write`."""
        table.refuse_unsound(path)
        means, scales = table.file_means(frame), table.ellipsoid_log_scales().detach().cpu()
        opacities = sigmoid(table.opacity_logits.detach().cpu().float().numpy())
        size = np.exp(table.log_scales.detach().cpu().double().sum(1).numpy().clip(-600, 600))
        order = np.argsort(-size * opacities, kind="stable")  # viewers show what has arrived: the largest first
        with replacing(path) as file:
            for start in range(0, len(order), WRITTEN_ROWS):
                part = torch.from_numpy(order[start : start + WRITTEN_ROWS])
                rows = np.empty(len(part), SPLAT_DTYPE)
                rows["xyz"] = means[part]
                rows["scales"] = scales[part].double().exp().clamp(MIN_READ_SCALE, float(np.finfo(np.float32).max))
                colors = 0.5 + SH_C0 * table.sh0.detach().cpu()[part].float().clamp(-9, 9).numpy()
                rows["rgba"][:, :3] = to_bytes(255 * colors)
                rows["rgba"][:, 3] = to_bytes(255 * opacities[part.numpy()])
                rows["rot"] = to_bytes(128 * unit(table.quats.detach().cpu()[part].numpy()) + 128)
                file.write(rows.tobytes())

    def read(self, path: Path) -> SplatTable:
        """See `Format.read`."""
        try:
            size = Path(path).stat().st_size
            if size % SPLAT_DTYPE.itemsize:
                raise BadInput(
                    f"{path}: {size} bytes are no .splat file, which has {SPLAT_DTYPE.itemsize} for each splat"
                )
            rows = np.memmap(path, SPLAT_DTYPE, "r") if size else np.empty(0, SPLAT_DTYPE)
        except OSError as error:
            raise BadInput(f"{path}: cannot be read: {error.strerror}") from error
        scales = np.array(rows["scales"])
        if not (scales >= 0).all():
            raise BadInput(f"{path}: no .splat file, or damaged: a scale is below 0 or no number")
        table = SplatTable(
            kind="gaussian",
            means=torch.from_numpy(np.array(rows["xyz"])),
            quats=torch.from_numpy((rows["rot"].astype(np.float32) - 128) / 128),
            log_scales=torch.from_numpy(np.log(np.maximum(scales, np.float32(MIN_READ_SCALE)))),
            opacity_logits=torch.from_numpy(logits(rows["rgba"][:, 3] / 255)),
            sh0=torch.from_numpy((rows["rgba"][:, :3].astype(np.float32) / 255 - 0.5) / np.float32(SH_C0)),
            sh_rest=torch.zeros(len(rows), 0, 3),
        )
        table.refuse_unsound(path)
        return table.as_surfels_if_thin(1e-5)

    def knows(self, path: Path, head: bytes) -> bool:
        """See `Format.knows`. There is nothing to know it by but its name."""
        return path.suffix.lower() == self.suffix

    def rounding(self, table: SplatTable) -> str:
        """See `Format.rounding`."""
        harmonics = f"spherical harmonics of degrees 1 to {table.sh_degree} are left out; " if table.sh_degree else ""
        return f"{harmonics}colours and opacities are rounded to 8 bits and lie in [0, 1], rotations to 8 bits"
