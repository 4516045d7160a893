"""Readers, splits and layouts of depth maps of a package that surfkit knows nothing of."""

import json
import shlex
from dataclasses import dataclass, replace
from pathlib import Path
from typing import ClassVar

import numpy as np
import pytest

from surfkit.cli import main
from surfkit.core.check import BadInput
from surfkit.core.hooks import hookimpl
from surfkit.core.registry import plugins
from surfkit.io.datasets.base import Reader
from surfkit.io.datasets.colmap import COLMAP
from surfkit.io.datasets.data import Data
from surfkit.io.datasets.depth_files import DepthFile, write_map, write_record
from surfkit.io.datasets.depth_layout import DepthLayout, DepthQuery, find_maps
from surfkit.io.datasets.depth_prior import prior_files, read_priors
from surfkit.io.datasets.fingerprint import changed, fingerprint
from surfkit.io.datasets.raw_dataset import RawDataset
from surfkit.io.datasets.read import read
from surfkit.io.datasets.split import GauUScene, Split
from surfkit.runs.command import train_command
from surfkit.runs.folder import read_data
from surfkit.runs.pipeline import opened
from surfkit.runs.run_notes import collect_notes
from surfkit.testing.synthetic import Flight, photograph, write_colmap


@dataclass(frozen=True)
class Lowest(Split):
    """Hold out the photographs taken from the lowest places."""

    count: int = 2
    """How many."""

    def held_out(self, capture: RawDataset) -> list[str]:
        heights = {shot.name: (-shot.pose[:3, :3].T @ shot.pose[:3, 3])[2] for shot in capture.shots}
        return sorted(heights, key=heights.__getitem__)[: self.count]


@dataclass(frozen=True)
class Wrong(Split):
    """Hold out a photograph that is not there."""

    def held_out(self, capture: RawDataset) -> set[str]:
        return {"nobody.png"}


@dataclass(frozen=True)
class RawFile(DepthFile):
    """Depths as bare float32 numbers."""

    width: int = 64

    def stored(self) -> np.ndarray:
        return np.fromfile(self.path, "<f4").reshape(-1, self.width)


@dataclass(frozen=True)
class Lidar(DepthLayout):
    """lidar/STEM.raw, depth in units of the data set times `unit`."""

    unit: float = 1.0
    """Units of the data set in a stored 1."""

    def find(self, query: DepthQuery) -> dict[str, DepthFile] | None:
        folder = query.root / "lidar"
        if not folder.is_dir():
            return None
        return {name: RawFile(folder / f"{Path(name).stem}.raw", True, self.unit, metric=True) for name in query.names}


@dataclass(frozen=True)
class Marked(Reader):
    """COLMAP folders with a file that says whose they are."""

    priority: ClassVar[int] = 2

    def recognises(self, root: Path) -> bool:
        return (root / "marked.txt").exists()

    def read(self, data: Data) -> RawDataset:
        return replace(COLMAP().read(data), metres=7.0, numbered=False)


class Stranger:
    @hookimpl
    def surfkit_components(self):
        return {"lowest": Lowest, "wrong": Wrong, "lidar": Lidar, "marked": Marked}


@pytest.fixture(autouse=True)
def stranger():
    plugin = Stranger()
    plugins().register(plugin, "stranger")
    yield
    plugins().unregister(plugin)


@pytest.fixture
def farm(tmp_path):
    """Folder of a data set, and the exact inverse depth of its photographs by name."""
    truth = photograph(Flight(views=6, width=64, height=48, points=250))
    write_colmap(tmp_path / "farm", truth, tracks=True)
    local = {name: truth.scene.frame.scale / exact.depth.clamp_min(1e-9).numpy() for name, exact in truth.exact.items()}
    return tmp_path / "farm", {name: np.where(truth.exact[name].depth > 0, inv, 0) for name, inv in local.items()}


def with_lidar(root, exact, unit=1.0):
    (root / "lidar").mkdir()
    for name, inverse in exact.items():
        depth = np.where(inverse > 0, 1 / np.maximum(inverse, 1e-9) / unit, 0)
        depth.astype("<f4").tofile(root / "lidar" / f"{Path(name).stem}.raw")


def test_a_split_with_a_setting_of_its_own(farm):
    root, _ = farm
    scene = read(Data(root, split=Lowest(3)))
    heights = {v.name: v.camera.centre[2].item() for v in (*scene.train, *scene.held_out)}
    assert {v.name for v in scene.held_out} == set(sorted(heights, key=heights.__getitem__)[:3])
    with pytest.raises(BadInput, match="^--split lowest .*all 6"):
        read(Data(root, split=Lowest(6)))
    with pytest.raises(BadInput, match="^--split wrong .*'nobody.png'"):
        read(Data(root, split=Wrong()))


def test_a_layout_of_depth_maps_in_a_format_of_its_own(farm):
    root, exact = farm
    with_lidar(root, exact, unit=0.25)
    data = Data(root, depth_layout=Lidar(unit=0.25))
    scene = read(data)
    with collect_notes() as notes:
        priors = read_priors(data, scene)
    assert not notes.texts
    for prior, view in zip(priors, scene.train, strict=True):
        wanted = exact[view.name] / scene.frame.scale
        np.testing.assert_allclose(prior.inverse.numpy()[wanted > 0], wanted[wanted > 0], rtol=1e-5)
    with collect_notes() as notes:
        assert read_priors(Data(root), scene) is None, "found, but in units that it does not say"
    assert "its depths are not those of the sparse points" in notes.texts[0]


def test_a_run_notices_that_the_meaning_of_maps_has_changed(farm):
    root, exact = farm
    with_lidar(root, exact)
    scene = read(Data(root))
    before, same, other = (
        fingerprint(scene, None, prior_files(Data(root, depth_layout=layout), scene))
        for layout in (None, Lidar(), Lidar(unit=2.0))
    )
    assert not changed(before, same) and "depth map" in changed(before, other)[0].what


def test_in_which_order_layouts_are_asked(farm):
    """Maps of surfkit prepare depth, then those of strangers, then those of other programs."""
    root, exact = farm
    (root / "depths").mkdir()
    (root / "depth_params.json").write_text(
        json.dumps({Path(name).stem: {"scale": 1.0, "offset": 0.0} for name in exact})
    )
    for name in exact:
        (root / "depths" / f"{Path(name).stem}.png").write_bytes(b"")
    query = DepthQuery(root, list(exact), root)
    assert {file.path.parent.name for file in find_maps(query).values()} == {"depths"}
    with_lidar(root, exact)
    assert {file.path.parent.name for file in find_maps(query).values()} == {"lidar"}
    for name, inverse in exact.items():
        write_map(root, name, inverse, np.ones_like(inverse))
    write_record(root, {"aligned": True})
    assert {file.path.parent.name for file in find_maps(query).values()} == {"estimated_depths"}
    assert {file.path.parent.name for file in find_maps(query, Lidar()).values()} == {"lidar"}


def test_a_reader_of_higher_priority_than_colmap(farm):
    root, _ = farm
    assert read(Data(root)).frame.metres is None
    (root / "marked.txt").touch()
    with collect_notes() as notes:
        assert read(Data(root)).frame.metres == 7
    assert notes.texts == [f"{root}: read as marked; it could also be read with --layout colmap"]
    with pytest.raises(BadInput, match="--model sparse/0: .*layout marked"):
        read(Data(root, model=Path("sparse/0")))


def test_on_the_command_line(farm, tmp_path, capsys):
    root, exact = farm
    with_lidar(root, exact, unit=2.0)
    words = ["train", "recipe:citygs2-coarse", "--steps", "20", "pretrain.densify:none", "mesh:none"]
    words += ["--pictures-every", "0", "--data", str(root), "--out", str(tmp_path / "run")]
    chosen = ["--split", "lowest", "--split.count", "1", "depth-layout:lidar", "--depth-layout.unit", "2"]
    assert main([*words, *chosen]) == 0
    record = json.loads((tmp_path / "run/run.json").read_text())
    assert record["data"]["split"] == {"use": "lowest", "count": 1} and not record["notes"], record["notes"]
    assert record["data"]["depth_layout"] == {"use": "lidar", "unit": 2.0}
    assert sum(camera["held_out"] for camera in json.loads((tmp_path / "run/cameras.json").read_text())) == 1
    assert main([*words, *chosen]) == 0 and "is finished" in capsys.readouterr().err
    again = shlex.split(train_command(opened(tmp_path / "run")))[1:]
    assert main(again) == 0 and "is finished" in capsys.readouterr().err
    assert main([*words, *chosen, "--split.count", "2"]) == 2
    assert "data.split.count 1, and this one has 2" in capsys.readouterr().err
    assert main([*words, "--split", "loest"]) == 2
    assert "'loest'; did you mean 'lowest'? known: gauu-scene, lowest, wrong, none" in capsys.readouterr().err
    assert main([*words, "--split"]) == 2
    assert "--split: one of gauu-scene, lowest, wrong, none" in capsys.readouterr().err
    assert main(["doctor", str(root), "--quick", *chosen]) in (0, 1)
    assert "lowest" in capsys.readouterr().out


def test_a_run_of_before_has_the_name_of_its_split_alone(tmp_path):
    before = {"path": "farm", "split": "gauu-scene", "test_every": 8}
    (tmp_path / "run.json").write_text(json.dumps({"data": before}))
    assert read_data(tmp_path) == Data(Path("farm"), split=GauUScene())
    (tmp_path / "run.json").write_text(json.dumps({"data": before | {"split": "gone"}}))
    with pytest.raises(BadInput, match="run.json: data.split: .*'gone'; known: gauu-scene, lowest, wrong"):
        read_data(tmp_path)
