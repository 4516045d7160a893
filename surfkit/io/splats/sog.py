"""The .sog files of PlayCanvas, version 2: about a twentieth of a PLY file.

A zip archive of lossless WebP images with a pixel for each splat, along a Z-order curve, and of meta.json, which tells
how to read them: logarithms of positions in 16 bits between bounds; scales and colours as indices of codebooks of 256
values; rotations wxyz as the index of the largest component (252 + index in alpha) and the others in a byte each;
opacities as bytes; and of the coefficients of higher degree the index of a row of a palette, whose values are indices
of a codebook. Source: the SOG format in the user manual at developer.playcanvas.com, and what splat-transform writes.
"""

from __future__ import annotations

import io
import json
import math
import zipfile
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from PIL import Image

from surfkit.core.check import require_within
from surfkit.core.events import Warned, emit
from surfkit.core.files import replacing
from surfkit.core.version import own_version
from surfkit.io.splats.base import Format
from surfkit.io.splats.bits import sigmoid, smallest_three, to_bytes
from surfkit.io.splats.palette import codebook, nearest, palette
from surfkit.io.splats.sog_reader import is_sog, read_sog
from surfkit.io.splats.splat_table import SplatTable, Tile
from surfkit.scene.morton import morton_order
from surfkit.scene.rotations import unit
from surfkit.scene.scene import Frame

PALETTE_ROW = 64
"""Rows of the palette in one line of its image."""
THIN_CODES = 16
"""Codes of the codebook that the third scale of surfels is left: viewers need it flat, not exact."""
MAX_SH_COEFFICIENT = 64.0
"""Largest coefficient of degrees 1 to 3; real ones are about 1."""
QUIET_ROUNDING_DIVISOR = 4
"""A share of the median scale by which positions may be rounded without a warning."""


@dataclass(frozen=True)
class SOG(Format):
    """The layout of PlayCanvas and SuperSplat: images of quantised values in a zip archive, the smallest of all."""

    suffix: ClassVar[str] = ".sog"

    palette: int = 65_536
    """Most rows of spherical harmonics of degrees 1 to 3 that splats share; fewer make a smaller file."""

    effort: int = 20
    """How hard the images are compressed, 0 to 100: more is slower and a little smaller."""

    def __post_init__(self) -> None:
        require_within({"palette": (1, 65_536), "effort": (0, 100)}, self)

    def write(self, path: Path, table: SplatTable, frame: Frame | None = None, tree: Tile | None = None) -> None:
        """See `Format.write`."""
        table.refuse_unsound(path)
        table = replace(table, means=table.file_means(frame)).on_cpu()
        self._warn(path, table)
        with replacing(path) as file, zipfile.ZipFile(file, "w", zipfile.ZIP_STORED) as archive:
            for name, data in self.files(table, self.order(table), frame):
                archive.writestr(zipfile.ZipInfo(name), data)

    def order(self, table: SplatTable) -> np.ndarray:
        """(N,) int64 rows of a table on the CPU, in the order that `write` stores them in; formats may have another."""
        return morton_order(table.means.double().numpy())

    @staticmethod
    def picture_width(count: int) -> int:
        """Pixels in a line of the images of so many splats: about a square, in steps of four."""
        return max(4, math.ceil(math.sqrt(count) / 4) * 4)

    def files(self, table: SplatTable, order: np.ndarray, frame: Frame | None) -> Iterator[tuple[str, bytes]]:
        """Names and contents of the files of splats, meta.json last.

        Args:
            table: On the CPU, without the shift of the frame.
            order: (N,) rows of it, in the order that they are to be stored in.
            frame: That of the input, if the table is in it.
        """
        meta: dict[str, Any] = {
            "version": 2,
            "asset": {"generator": f"surfkit {own_version()}"},
            "count": len(table),
            **({"model": "2dgs"} if table.kind == "surfel" else {}),
            **({"model": "antialiased", "antialias": True} if table.antialias else {}),
            **({"surfkit": _frame_facts(frame)} if frame else {}),
        }
        for key, facts, images in self._groups(table, order):
            meta[key] = facts | {"files": list(images)}
            for name, pixels in images.items():
                yield name, _webp(pixels, self.effort)
        yield "meta.json", json.dumps(meta).encode()

    def _groups(self, table: SplatTable, order: np.ndarray) -> Iterator[tuple[str, dict, dict[str, np.ndarray]]]:
        """The entries of meta.json with the images that belong to them."""
        low, high, words = _positions(table.means.double().numpy()[order])
        images = {f"means_{end}.webp": _image(words >> shift & 255) for end, shift in (("l", 0), ("u", 8))}
        yield "means", {"mins": low.tolist(), "maxs": high.tolist()}, images

        scales = table.ellipsoid_log_scales().numpy()[order]
        codes = _scale_codes(scales, table.kind == "surfel")
        yield "scales", {"codebook": codes.tolist()}, {"scales.webp": _image(nearest(scales, codes))}

        largest, three = smallest_three(unit(table.quats.numpy()[order]))
        turns = np.concatenate([to_bytes(255 * (three / 2 + 0.5)), (252 + largest[:, None]).astype(np.uint8)], 1)
        yield "quats", {}, {"quats.webp": _image(turns)}

        colors, opacities = table.sh0.numpy()[order], sigmoid(table.opacity_logits.numpy()[order])
        codes = codebook(colors, 256)
        pixels = np.concatenate([nearest(colors, codes), to_bytes(255 * opacities)[:, None]], 1)
        yield "sh0", {"codebook": codes.tolist()}, {"sh0.webp": _image(pixels)}

        if table.sh_degree and len(table):
            yield "shN", *self._harmonics(table, order)

    def _harmonics(self, table: SplatTable, order: np.ndarray) -> tuple[dict, dict[str, np.ndarray]]:
        """What stands for the coefficients of higher degree."""
        count = table.sh_rest.shape[1]
        most = min(self.palette, 2 ** int(math.log2(len(table))))
        rows, label = palette(
            table.sh_rest.flatten(1).clamp(-MAX_SH_COEFFICIENT, MAX_SH_COEFFICIENT).numpy()[order], most
        )
        codes = codebook(rows, 256)
        lines = -(-len(rows) // PALETTE_ROW)
        picture = np.zeros((lines * PALETTE_ROW, count, 3), np.uint8)
        picture[: len(rows)] = nearest(rows, codes).reshape(-1, count, 3)
        picture = _opaque(picture.reshape(lines, PALETTE_ROW * count, 3))
        labels = np.stack([label & 255, label >> 8, np.zeros_like(label)], 1).astype(np.uint8)
        facts = {"count": len(rows), "bands": table.sh_degree, "codebook": codes.tolist()}
        return facts, {"shN_centroids.webp": picture, "shN_labels.webp": _image(labels)}

    def _warn(self, path: Path, table: SplatTable) -> None:
        """A warning if positions are rounded by much of the size of the splats."""
        if not len(table):
            return
        means = table.means.double().numpy()
        low, high, _ = _positions(means)
        apart = float(np.median((1 + np.abs(means)) * (high - low)) / 65_535)
        scale = table.median_scale()
        if apart > scale / QUIET_ROUNDING_DIVISOR:
            rounded = f"{apart:.3g} apart, {apart / scale:.2g} x the median scale of the splats"
            emit(Warned(f"{path}: positions are {rounded}; --format ply keeps more of such a large scene"))

    def read(self, path: Path) -> SplatTable:
        """See `Format.read`. A meta.json beside its images is read too."""
        return read_sog(Path(path))

    def knows(self, path: Path, head: bytes) -> bool:
        """See `Format.knows`."""
        return is_sog(path, head)

    def rounding(self, table: SplatTable) -> str:
        """See `Format.rounding`."""
        rows = f", spherical harmonics to a palette of at most {self.palette:,} rows" if table.sh_degree else ""
        return f"positions are rounded to 16 bits, scales and colours to 256 values, opacities to 8 bits{rows}"


def _frame_facts(frame: Frame) -> dict[str, Any]:
    """What a file says of its frame; other programs pass over it."""
    shift = {"offset": list(frame.shift)} if any(frame.shift) else {}
    crs = {"crs": frame.crs} if frame.crs else {}
    return shift | crs | ({"metres_per_unit": frame.metres} if frame.metres else {})


def _positions(means: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Bounds of the logarithms of positions, (3,) each, and (N, 3) numbers of 16 bits between them."""
    if not len(means):
        return np.zeros(3), np.zeros(3), np.zeros((0, 3), np.uint16)
    bent = np.sign(means) * np.log1p(np.abs(means))
    low, high = bent.min(0), bent.max(0)
    words = (bent - low) / np.where(high > low, high - low, 1) * 65_535
    return low, high, np.rint(words).astype(np.uint16)


def _scale_codes(scales: np.ndarray, surfels: bool) -> np.ndarray:
    """The 256 values that scales are rounded to."""
    if not surfels:
        return codebook(scales, 256)
    return np.sort(np.concatenate([codebook(scales[:, :2], 256 - THIN_CODES), codebook(scales[:, 2], THIN_CODES)]))


def _image(values: np.ndarray) -> np.ndarray:
    """(H, W, 4) pixels, a row of values in each; the last ones are left over."""
    width = SOG.picture_width(len(values))
    height = max(4, math.ceil(len(values) / width / 4) * 4)
    pixels = np.zeros((height * width, 4), np.uint8)
    pixels[:, 3] = 255
    pixels[: len(values), : values.shape[1]] = values
    return pixels.reshape(height, width, 4)


def _opaque(pixels: np.ndarray) -> np.ndarray:
    return np.concatenate([pixels, np.full((*pixels.shape[:2], 1), 255, np.uint8)], 2)


def _webp(pixels: np.ndarray, effort: int) -> bytes:
    """A lossless image; colours of transparent pixels are kept too."""
    file = io.BytesIO()
    Image.fromarray(pixels, "RGBA").save(file, "WEBP", lossless=True, exact=True, quality=effort, method=4)
    return file.getvalue()
