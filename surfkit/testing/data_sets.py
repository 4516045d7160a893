"""Checks of the parts that read data sets: splits and layouts of depth maps. Needs numpy, torch and pycolmap."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from surfkit.core.check import BadInput
from surfkit.io.datasets.data import Data
from surfkit.io.datasets.depth_files import DepthFile
from surfkit.io.datasets.depth_layout import DepthLayout, DepthQuery
from surfkit.io.datasets.raw_dataset import RawDataset
from surfkit.io.datasets.read import read_capture, reader_of
from surfkit.io.datasets.split import Split
from surfkit.testing.synthetic import Flight, photograph, write_colmap


def check_split(split: Split, capture: RawDataset | None = None) -> None:
    """AssertionError if a split holds out what is not there, everything, or something else at a second call.

    Args:
        split: The split.
        capture: A data set that it fits; by default a COLMAP folder of 24 photographs.
    """
    what = type(split).__name__
    if capture is None:
        with TemporaryDirectory() as folder:
            data = Data(_written(Path(folder), views=24))
            capture = read_capture(data, reader_of(data))
    names = [shot.name for shot in capture.shots]
    held, again = set(split.held_out(capture)), set(split.held_out(capture))
    assert held <= set(names), f"{what}: holds out {min(held - set(names))!r}, which is no photograph of the data set"
    assert len(held) < len(names), f"{what}: holds out all {len(names)} photographs"
    assert held == again, f"{what}: holds out other photographs when it is asked again"
    assert names == [shot.name for shot in capture.shots], f"{what}: changes the data set that it is given"


def check_depth_layout(layout: DepthLayout, query: DepthQuery | None = None) -> None:
    """AssertionError if a layout finds maps in a folder without any, or maps that cannot be read.

    Args:
        layout: The layout.
        query: A data set with maps of this layout, which are looked for and read; None leaves that out.
    """
    what = type(layout).__name__
    with TemporaryDirectory() as folder:
        root = _written(Path(folder), views=3)
        found = layout.find(DepthQuery(root, ["view_000.png"], root, metres=1.0))
        assert found is None, f"{what}: finds {found!r} in a data set without depth maps; it must be None"
    if query is None:
        return
    files = layout.find(query)
    assert isinstance(files, Mapping) and files, f"{what}: finds no map in {query.root}"
    for name, file in files.items():
        assert name in query.names, f"{what}: a map of {name!r}, which is no photograph of the query"
        assert isinstance(file, DepthFile), f"{what}: the map of {name!r} is a {type(file).__name__}, not a DepthFile"
        hash(file.meaning)
        try:
            inverse = file.read()
        except BadInput as error:
            raise AssertionError(f"{what}: the map of {name!r} cannot be read: {error}") from error
        assert inverse.ndim == 2 and inverse.dtype == np.float32, f"{what}: {name!r} is not (h, w) float32"
        assert (inverse > 0).any(), f"{what}: the map of {name!r} has no depth in it"


def _written(folder: Path, views: int) -> Path:
    """A COLMAP folder of small photographs."""
    write_colmap(folder, photograph(Flight(views=views, width=16, height=12, points=30, test_every=0)))
    return folder
