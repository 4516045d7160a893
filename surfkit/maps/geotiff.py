"""GeoTIFFs: written tile by tile, then laid out as Cloud Optimized GeoTIFF with overviews; whole or not at all."""

from __future__ import annotations

import errno
import os
import re
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from surfkit.core.check import BadInput, Fault
from surfkit.core.events import FileWritten, Progress, emit
from surfkit.core.files import refuse_special, sweep, sync_folder
from surfkit.core.lock import locked
from surfkit.core.optional import needed
from surfkit.maps.grid import Grid, Window

BLOCK = 512
"""Side of the tiles within a file, cells."""
CACHE = 256
"""Megabytes of GDAL's own cache of blocks."""
LEAST_FREE = 1 << 20
"""Bytes of a disk, below which it is full."""
NOT_WRITTEN = re.compile("write (error|failed)|no space", re.IGNORECASE)
"""How GDAL says that a file could not be written."""
NODATA = -9999.0
"""Height where there is no surface."""
Kind = Literal["heights", "colors", "shades"]


@dataclass(frozen=True)
class Sheet:
    """What the files of a map have in common.

    Attributes:
        grid: The cells.
        crs: Coordinate reference system, of rasterio.
        folder: For files that are being written; on the same disk as the finished ones.
        out: For finished files.
        double: Whether heights need 64-bit floats: 32 bits would be coarser than a hundredth of a cell.
    """

    grid: Grid
    crs: Any
    folder: Path
    out: Path
    double: bool = False

    @property
    def profile(self) -> dict[str, Any]:
        """How rasterio creates a file."""
        west, _, _, north = self.grid.bounds
        with needed("rasterio", "surfkit maps"):
            from rasterio import Affine
        place = Affine(self.grid.gsd, 0, west, 0, -self.grid.gsd, north)
        size = {"width": self.grid.width, "height": self.grid.height}
        inner = {"tiled": True, "blockxsize": BLOCK, "blockysize": BLOCK, "sparse_ok": True}
        return {"driver": "GTiff", "crs": self.crs, "transform": place, "bigtiff": "IF_SAFER", **size, **inner}

    @contextmanager
    def raster(self, name: str, kind: Kind) -> Iterator[Any]:
        """A GeoTIFF, open to write and read windows, that becomes the Cloud Optimized GeoTIFF `name` in `out` at the
        end, when all went well.

        Heights have NODATA where there is nothing; colours have a fourth channel that is 0 there and 255 elsewhere;
        shades are 1 to 255, and 0 where there is nothing.
        """
        import rasterio

        heights = "float64" if self.double else "float32"
        dtype, count, nodata = {
            "heights": (heights, 1, NODATA),
            "colors": ("uint8", 4, None),
            "shades": ("uint8", 1, 0),
        }[kind]
        more = {"photometric": "RGB", "alpha": "YES"} if kind == "colors" else {}
        draft = self.folder / f"draft-{name}"
        options = {"dtype": dtype, "count": count, "nodata": nodata, "compress": "LZW", **more}
        with rasterio.Env(GDAL_CACHEMAX=CACHE), rasterio.open(draft, "w+", **self.profile, **options) as file:
            yield file
        refuse_full(self.folder)
        emit(Progress(f"compressing {name}", 0, 1))
        finished = self.folder / name
        layout = {
            "blocksize": BLOCK,
            "compress": "DEFLATE",
            "predictor": "YES",
            "overviews": "IGNORE_EXISTING",
            "resampling": "AVERAGE",
            "bigtiff": "IF_SAFER",
            "sparse_ok": True,
        }
        with rasterio.Env(GDAL_CACHEMAX=CACHE, CPL_TMPDIR=str(self.folder)):
            from rasterio.shutil import copy

            copy(draft, finished, driver="COG", **layout)
        draft.unlink()
        self.deliver(finished)
        emit(Progress(f"compressing {name}", 1, 1))

    def deliver(self, finished: Path) -> None:
        """Move a file of `folder` to `out`."""
        refuse_full(self.folder)
        with finished.open("rb+") as file:
            os.fsync(file.fileno())
        os.replace(finished, self.out / finished.name)
        sync_folder(self.out)
        emit(FileWritten(self.out / finished.name, "map"))


def window_of(window: Window) -> Any:
    """The same as rasterio has it."""
    from rasterio.windows import Window as Their

    return Their(window.left, window.top, window.width, window.height)


def refuse_full(folder: Path) -> None:
    """OSError if the disk is full: GDAL does not always say that what it wrote last found no room."""
    if shutil.disk_usage(folder).free < LEAST_FREE:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(folder))


@contextmanager
def workshop(out: Path, names: tuple[str, ...]) -> Iterator[Path]:
    """Within, no other process writes maps into `out`, and there is a folder in it for files that are being written.

    What dead processes left in such folders is deleted.

    Args:
        out: Made if it is missing.
        names: Files to be written: OSError if something else than a file has such a name.

    Raises:
        Fault: The disk is full.
    """
    for name in names:
        refuse_special(out / name)
    with locked(out):
        sweep(out, deep=False)
        folder = out / f".maps.{os.getpid()}.part"
        folder.mkdir()
        try:
            yield folder
        except Exception as error:  # of GDAL's kinds, which do not say why a file could not be written
            full = shutil.disk_usage(folder).free < LEAST_FREE or NOT_WRITTEN.search(str(error))
            if isinstance(error, BadInput) or not full:
                raise
            raise Fault(
                f"{out}: the disk is full; the maps that are in it are whole: free some space, then do it again"
            ) from error
        finally:
            with suppress(OSError):
                shutil.rmtree(folder)
