"""Every row of every table that comes with surfkit trains two steps, and is measured."""

import numpy as np
import pytest
import torch

from surfkit.io.datasets.data import Data
from surfkit.study.recipes.ablations import TABLES
from surfkit.study.study import AblationPlan, ablate
from surfkit.testing.synthetic import Flight, photograph, write_colmap

pytestmark = pytest.mark.usefixtures("quick_comparison")


class Silent:
    def begin(self, *_):
        pass

    def end(self, *_):
        pass


@pytest.fixture(scope="module")
def farm(tmp_path_factory):
    """A data set with tracks and exact depth maps: without these, rows that learn from depth are blank."""
    torch.set_num_threads(1)
    folder = tmp_path_factory.mktemp("data") / "farm"
    made = photograph(Flight(kind="grid", views=9, width=48, height=36, points=300))
    write_colmap(folder, made, tracks=True)
    (folder / "estimated_depths").mkdir()
    for name, exact in made.exact.items():
        inverse = torch.where(exact.depth > 0, 1 / exact.depth, 0).float().numpy()
        np.save(folder / "estimated_depths" / f"{name}.npy", inverse)
    return Data(folder)


@pytest.fixture(scope="module")
def out(tmp_path_factory):
    """One folder for all tables, as they have rows in common."""
    return tmp_path_factory.mktemp("tables")


@pytest.fixture(scope="module", autouse=True)
def cache(tmp_path_factory):
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("SURFKIT_CACHE", str(tmp_path_factory.mktemp("cache")))
        yield


@pytest.mark.parametrize("name", TABLES)
def test_every_row_trains(farm, out, name):
    rows = tuple(row.label for row in TABLES[name].rows)
    report = ablate(AblationPlan(TABLES[name], (farm,), out, steps=2, rows=rows, device="cpu"), Silent())
    (found,) = report["data_sets"]
    for row in found["rows"]:
        assert row["failed"] is None, row
        known = {"seconds", "cpu_seconds", "peak_memory_bytes"}
        if not row["label"].startswith("stereo alone"):
            known |= {"psnr", "psnr_aligned", "ssim", "ssim_aligned", "points", "bytes", "fps"}
        assert row["mean"].keys() == known, row["label"]
    if name == "model":
        rows = {row["label"]: row["mean"] for row in found["rows"]}
        assert rows["+ VQ (Ours-s)"]["bytes"] < 0.6 * rows["+ SH degree 2"]["bytes"], "that of the compressed file"
        assert rows["+ SH degree 2"]["bytes"] < rows["+ trim (Ours-b)"]["bytes"]
        assert rows["+ prune (LightGaussian)"]["points"] < rows["+ parallel tuning"]["points"]
        folders = [run["folder"] for row in found["rows"] for run in row["runs"]]
        assert len(set(folders)) == len(folders) == 14
