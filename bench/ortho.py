"""Orthophotos from the photographs of a rendered city, on its exact mesh: seams, pieces, corners of roofs, cost.

    python bench/ortho.py            # writes bench/results/ortho.json

PACK is shibuya-synth. Its photographs are taken as they are, and with exposures of -0.5 to 0.5 stops. Told are the
mean steps of grey between neighbouring cells, across cut lines and elsewhere, and what they are more than in an exact
orthophoto (the mean of the photographs that look down, see bench/maps.py); connected pieces of one photograph; share
of cells from photographs; corners of roofs that lie within a cell; CPU seconds and memory. --maps FOLDER measures maps
that are there, of the exact mesh from the photographs as they are.
"""

from __future__ import annotations

import argparse
import multiprocessing
import resource
import tempfile
import time
from pathlib import Path

import light
import numpy as np
import rasterio
from machine import save
from maps import corners_of, exact_orthophoto, heights_of, shift_of
from scipy import ndimage

from surfkit.apps.maps.make_maps import make_maps
from surfkit.apps.maps.map_settings import MapSettings
from surfkit.apps.texture.texture_mesh import MeshWithPhotos
from surfkit.evaluate.geometry.surface_file import read_surface
from surfkit.io.datasets.data import Data
from surfkit.io.datasets.read import read

HALF_SIDE = 110.0
"""Metres from the middle to the borders of the map: of the part that has an exact mesh."""
STOPS = 0.5
LARGE = 100
"""Cells of a piece that counts as a region."""


def draw(data: Path, truth: Path, out: Path) -> dict[str, float]:
    """Draw the maps, and tell what that took."""
    scene = read(Data(data))
    bounds = (-HALF_SIDE, -HALF_SIDE, HALF_SIDE, HALF_SIDE)
    settings = MapSettings(("orthophoto",), bounds=bounds, up="z", colors="photographs", memory="500MB")
    began = time.process_time()
    make_maps(MeshWithPhotos(read_surface(truth), scene.frame, scene.train), settings, out)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return {"CPU seconds": time.process_time() - began, "peak memory, MB": peak / 1024}


def steps(grey: np.ndarray, numbers: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(n,) absolute differences of neighbouring cells across cut lines, and (m,) within one photograph."""
    across, within = [], []
    for axis in (0, 1):
        one, other = (np.take(numbers, range(i, numbers.shape[axis] - 1 + i), axis) for i in (0, 1))
        step, both = np.abs(np.diff(grey, axis=axis)), (one > 0) & (other > 0)
        across.append(step[both & (one != other)])
        within.append(step[both & (one == other)])
    return np.concatenate(across), np.concatenate(within)


def pieces(numbers: np.ndarray) -> np.ndarray:
    """(n,) cells of each connected piece of one photograph."""
    found = [ndimage.label(numbers == number)[0] for number in np.unique(numbers[numbers > 0])]
    return np.concatenate([np.bincount(each.ravel())[1:] for each in found])


def measured(maps: Path, numbers: np.ndarray, plain: Path, truth: Path) -> dict[str, float]:
    """The figures of an orthophoto.

    Args:
        maps: Folder with orthophoto.tif and the exact heights, dsm.tif.
        numbers: (H, W) photograph of each cell; 0 for none.
        plain: The data set without changes of light.
        truth: The exact mesh.
    """
    exact, place = heights_of(maps / "dsm.tif")
    with rasterio.open(maps / "orthophoto.tif") as file:
        grey = file.read().astype(np.float64)[:3].mean(0)
    reference = exact_orthophoto(exact, place, plain, truth)
    means = [[np.nanmean(each) for each in steps(image, numbers)] for image in (grey, reference)]
    (across, within), (exact_across, exact_within) = means
    sizes, cells = pieces(numbers), numbers.size
    corners = corners_of(exact, place, read_surface(truth).vertices())
    known = np.where(numbers > 0, grey, np.nan)
    shifts = np.array([shift_of(known, reference, row, column) for row, column in corners])
    return {
        "from photographs": float((numbers > 0).mean()),
        "step across cut lines": float(across),
        "step elsewhere": float(within),
        "more than exact: across": float(across - exact_across),
        "more than exact: elsewhere": float(within - exact_within),
        "cells at cut lines": float(len(steps(grey, numbers)[0]) / cells),
        "pieces for 1e6 cells": float(len(sizes) * 1e6 / cells),
        f"pieces of {LARGE} cells and more for 1e6": float((sizes >= LARGE).sum() * 1e6 / cells),
        "cells in them": float(sizes[sizes >= LARGE].sum() / cells),
        "corners": len(corners),
        "corners within a cell": int((shifts <= 1).sum()),
        "corners: median, cells": float(np.nanmedian(shifts)),
    }


def numbers_in(maps: Path) -> np.ndarray:
    """(H, W) photograph of each cell; 0 for none."""
    with rasterio.open(maps / "orthophoto-photographs.tif") as file:
        return file.read(1).astype(np.int64)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, default=light.PACK)
    parser.add_argument("--maps", type=Path, help="only measure these")
    options = parser.parse_args()
    truth, found = options.data / "gt/mesh.ply", {}
    if options.maps is not None:
        print(measured(options.maps, numbers_in(options.maps), options.data, truth))
        return
    light.STOPS, light.BALANCE = STOPS, 0.0
    with tempfile.TemporaryDirectory() as folder:
        for name, parts in (("as they are", ()), (f"exposures of {STOPS:g} stops", ("exposure",))):
            data, out = (Path(folder) / f"{kind}-{len(parts)}" for kind in ("data", "maps"))
            light.write_variant(options.data, data, parts)
            with multiprocessing.get_context("spawn").Pool(1) as pool:  # whose memory is that of the maps alone
                cost = pool.apply(draw, (data, truth, out))
            row = measured(out, numbers_in(out), options.data, truth) | cost
            found |= {f"{name}: {key}": value for key, value in row.items()}
            print(name, {key: round(value, 4) for key, value in row.items()}, flush=True)
    print(f"wrote {save('ortho', found)}")


if __name__ == "__main__":
    main()
