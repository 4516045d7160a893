"""GeoTIFFs: a file for each tile, then all of them as a Cloud Optimized GeoTIFF with overviews; whole or not at all.

Tiles and finished files outlive an interruption: the next call for the same maps goes on with them.
"""

from __future__ import annotations

import errno
import os
import re
import shutil
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from surfkit.apps.maps.map_grid import MapGrid
from surfkit.apps.maps.owned_files import (
    NAMES_FILE,
    UNFINISHED_FOLDER,
    claim,
    forget_unfinished,
    keep_names,
    own_files,
    refuse_foreign,
)
from surfkit.apps.maps.rasters import TILE_SIDE_CELLS, Kind, Raster
from surfkit.core.check import BadInput, Fault
from surfkit.core.codec import read_json, write_json
from surfkit.core.events import FileWritten, Progress, emit
from surfkit.core.files import refuse_special, sweep, sync_folder
from surfkit.core.lock import locked
from surfkit.core.stages import kept_parts

GDAL_CACHE_MB = 256
"""Megabytes of GDAL's own cache of blocks."""
MIN_FREE_DISK_BYTES = 1 << 20
"""Bytes of a disk, below which it is full."""
NOT_WRITTEN = re.compile("write (error|failed)|no space", re.IGNORECASE)
"""How GDAL says that a file could not be written."""
RESAMPLING = {"numbers": "MODE", "counts": "NEAREST"}
"""How overviews are made of kinds whose values have no mean: a half of a photograph confirms nothing."""
TILES_SUFFIX = ".tiles"
"""Ending of the names of folders with the tiles of a raster."""


@dataclass(frozen=True)
class GeoTiffSettings:
    """What the files of a map have in common.

    Attributes:
        grid: The cells.
        crs: Coordinate reference system, of rasterio.
        folder: For files that are being written; on the same disk as the finished ones.
        out: For finished files.
        double: Whether heights need 64-bit floats: 32 bits would be coarser than a hundredth of a cell.
        replaced: Names of files of maps before that are deleted when the first new one is there.
    """

    grid: MapGrid
    crs: Any
    folder: Path
    out: Path
    double: bool = False
    replaced: tuple[str, ...] = ()

    @contextmanager
    def raster(self, name: str, kind: Kind) -> Iterator[Raster]:
        """A raster to write tiles of, that becomes the Cloud Optimized GeoTIFF `name` in `out` when all went well.

        Heights have NODATA where there is nothing; colours have a fourth channel that is 0 there and 255 elsewhere;
        shades are 1 to 255, and 0 where there is nothing; so are numbers, of 32 bits. Counts are 0 and more,
        of 16 bits, and NO_COUNT where there is nothing.
        """
        import rasterio

        folder = self.folder / f"{name}{TILES_SUFFIX}"
        folder.mkdir(exist_ok=True)
        raster = Raster(folder, self.grid, self.crs, kind, self.double, name)
        with rasterio.Env(GDAL_CACHEMAX=GDAL_CACHE_MB):
            yield raster
        refuse_full(self.folder)
        emit(Progress(f"compressing {name}", 0, 1))
        finished = self.folder / name
        layout = {
            "blocksize": TILE_SIDE_CELLS,
            "compress": "DEFLATE",
            "predictor": "YES",
            "overviews": "IGNORE_EXISTING",
            "resampling": RESAMPLING.get(kind, "AVERAGE"),
            "bigtiff": "IF_SAFER",
            "sparse_ok": True,
        }
        with rasterio.Env(GDAL_CACHEMAX=GDAL_CACHE_MB, CPL_TMPDIR=str(self.folder)):
            from rasterio.shutil import copy

            copy(raster.whole(), finished, driver="COG", **layout)
        self.deliver(finished)
        emit(Progress(f"compressing {name}", 1, 1))

    def once(self, names: Sequence[str], make: Callable[[], dict[str, Any]]) -> dict[str, Any]:
        """The facts that `make` returns, which delivers files; what an interrupted call has made is not made again.

        Args:
            names: Of the files.
            make: Makes them; the facts are what JSON has.
        """
        record = self.folder / f"{names[0]}.json"
        if record.exists():
            known = read_json(record, dict[str, Any])
            if known["files"] == self._stamps(names):
                return known["facts"]
        facts = make()
        write_json(record, {"facts": facts, "files": self._stamps(names)})
        for tiles in self.folder.glob(f"*{TILES_SUFFIX}"):
            shutil.rmtree(tiles)
        return facts

    def _stamps(self, names: Sequence[str]) -> list[list[int] | None]:
        """Size and time of delivered files."""
        states = [(self.out / name).stat() if (self.out / name).exists() else None for name in names]
        return [state and [state.st_size, state.st_mtime_ns] for state in states]

    def deliver(self, finished: Path) -> None:
        """Move a file of `folder` to `out`."""
        refuse_full(self.folder)
        with finished.open("rb+") as file:
            os.fsync(file.fileno())
        claim(self.out, finished.name)
        for name in self.replaced:
            (self.out / name).unlink(missing_ok=True)
        os.replace(finished, self.out / finished.name)
        sync_folder(self.out)
        emit(FileWritten(self.out / finished.name, "map"))


def refuse_full(folder: Path) -> None:
    """OSError if the disk is full: GDAL does not always say that what it wrote last found no room."""
    if shutil.disk_usage(folder).free < MIN_FREE_DISK_BYTES:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(folder))


@contextmanager
def workshop(out: Path, names: tuple[str, ...], key: str = "") -> Iterator[Path]:
    """Within, no other process writes maps into `out`, and there is a folder in it for files that are being written.

    What an interrupted call with the same key has finished is in it. It stays when this call is interrupted.

    Args:
        out: Made if it is missing.
        names: Files to be written: OSError if something else than a file has such a name, or a file that is not ours.
        key: Of all that the maps depend on.

    Raises:
        Fault: The disk is full.
    """
    for name in names:
        refuse_special(out / name)
    folder = out / UNFINISHED_FOLDER
    with locked(out):
        refuse_foreign(out, names)
        sweep(out, deep=False)
        before = own_files(out)
        try:
            with kept_parts(folder, key):
                keep_names(out, before)
                try:
                    yield folder
                except BadInput:  # the same command would come to it again
                    forget_unfinished(out)
                    raise
                finally:
                    if not own_files(out):  # nothing is finished, nor was
                        (folder / NAMES_FILE).unlink(missing_ok=True)
        except Exception as error:  # of GDAL's kinds, which do not say why a file could not be written
            full = shutil.disk_usage(out).free < MIN_FREE_DISK_BYTES or NOT_WRITTEN.search(str(error))
            if isinstance(error, BadInput) or not full:
                raise
            raise Fault(
                f"{out}: the disk is full; the maps that are in it are whole: free some space, then do it again"
            ) from error
