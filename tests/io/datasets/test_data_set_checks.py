"""The checks of splits and layouts of depth maps: our own parts keep the contract, wrong ones are found."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from surfkit.core.registry import components
from surfkit.io.datasets.depth_files import DepthFile, write_map
from surfkit.io.datasets.depth_layout import DepthLayout, DepthQuery
from surfkit.io.datasets.depth_layouts import EstimatedDepths
from surfkit.io.datasets.raw_dataset import RawDataset
from surfkit.io.datasets.split import Split
from surfkit.testing import check_depth_layout, check_split


@pytest.mark.parametrize("name", components(Split))
def test_splits(name):
    check_split(components(Split)[name]())


@pytest.mark.parametrize("name", components(DepthLayout))
def test_depth_layouts(name):
    check_depth_layout(components(DepthLayout)[name]())


def test_a_layout_with_maps(tmp_path):
    write_map(tmp_path, "a.png", np.ones((3, 4)), np.ones((3, 4)))
    check_depth_layout(EstimatedDepths(), DepthQuery(tmp_path, ["a.png"], tmp_path))


CALLS = []


@dataclass(frozen=True)
class WrongSplit(Split):
    case: str

    def held_out(self, capture: RawDataset):
        CALLS.append(0)
        names = [shot.name for shot in capture.shots]
        if self.case == "changes":
            capture.shots.pop()
        return {
            "stranger": ["nobody.png"],
            "all": names,
            "random": names[len(CALLS) % 2 :: 2],
            "changes": names[:1],
        }[self.case]


@pytest.mark.parametrize(
    ("case", "message"),
    [
        ("stranger", "holds out 'nobody.png', which is no photograph"),
        ("all", "holds out all 24 photographs"),
        ("random", "holds out other photographs when it is asked again"),
        ("changes", "changes the data set"),
    ],
)
def test_wrong_splits(case, message):
    with pytest.raises(AssertionError, match=f"WrongSplit: {message}"):
        check_split(WrongSplit(case))


@dataclass(frozen=True)
class WrongLayout(DepthLayout):
    case: str

    def find(self, query: DepthQuery):
        path = query.root / "a.npy"
        if self.case != "always" and not path.exists():
            return None
        file = {"path": path, "stranger": DepthFile(path, True)}.get(self.case, DepthFile(path, True))
        return {"b.png" if self.case == "stranger" else "a.png": file}


@pytest.mark.parametrize(
    ("case", "values", "message"),
    [
        ("always", np.ones((3, 4)), "finds .* in a data set without depth maps; it must be None"),
        ("stranger", np.ones((3, 4)), "a map of 'b.png', which is no photograph of the query"),
        ("path", np.ones((3, 4)), "the map of 'a.png' is a PosixPath, not a DepthFile"),
        ("shape", np.ones((3, 4, 5)), "the map of 'a.png' cannot be read: has shape"),
        ("empty", np.zeros((3, 4)), "the map of 'a.png' has no depth in it"),
    ],
)
def test_wrong_layouts(tmp_path: Path, case, values, message):
    np.save(tmp_path / "a.npy", values)
    with pytest.raises(AssertionError, match=f"WrongLayout: {message}"):
        check_depth_layout(WrongLayout(case), DepthQuery(tmp_path, ["a.png"], tmp_path))
