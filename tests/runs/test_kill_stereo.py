"""A run that SIGKILL ends while it makes depth maps goes on from those that are there, to the same bits."""

import json
import os
import signal
from functools import partial

import pytest
from forks import started
from needs import needs_native

from surfkit.cli import main
from surfkit.cli.recipes import recipes
from surfkit.io.datasets.depth_map_index import read_made
from surfkit.testing.synthetic import Flight, photograph, write_colmap

pytestmark = needs_native
ARRAYS = ".npy", ".planes"
"""Ends of the names of files with arrays: maps that are whole, and those of the rounds of stereo."""


def die_at(array):
    """This process ends when so many arrays are written, but for the name of the last."""
    left, replace = [array], os.replace

    def replaced(unfinished, path):
        left[0] -= str(path).endswith(ARRAYS)
        if left[0] == 0:
            os.kill(os.getpid(), signal.SIGKILL)
        replace(unfinished, path)

    os.replace = replaced


MATCHED, COMPARED, AGAIN = "matching-photographs", "comparing-depth-maps", "comparing-depth-maps-round-2"
SETTINGS = "recipe:surface mesh:none --steps 4 --device cpu --pictures-every 0 --primitive.sh-degree 0".split()
SETTINGS += ["--test-every", "8"]


@pytest.fixture(scope="module")
def farm(tmp_path_factory):
    """Seven photographs to train on; each is compared with all others."""
    folder = tmp_path_factory.mktemp("farm")
    write_colmap(folder, photograph(Flight(kind="grid", views=8, width=48, height=36, points=300)), tracks=True)
    return folder


def words(data, folder):
    """Of a run in a folder."""
    return ["train", *SETTINGS, "--data", str(data), "--out", str(folder / "run")]


def killed(data, folder, at):
    """A run in a folder, whose maps are kept there too, in a process that dies at an array; never if that is -1."""
    folder.mkdir(exist_ok=True)
    log = folder / "log"
    process = started(words(data, folder), log, folder / "cache", partial(die_at, at))
    process.join()
    assert process.exitcode == (0 if at == -1 else -signal.SIGKILL), log.read_text()


def arrays(folder):
    """Every whole array in a folder, by where it is: when it was written, and what it is."""
    paths = [path for path in folder.rglob("[!.]*") if path.name.endswith(ARRAYS)]
    return {str(path.relative_to(folder)): (path.stat().st_mtime_ns, path.read_bytes()) for path in paths}


def unfinished(cache):
    """How many maps of each round are in the folder for work."""
    folders = [path for path in cache.rglob(".work/*") if path.is_dir()]
    return {path.name: count for path in folders if (count := len(list(path.glob("[!.]*.planes"))))}


def test_maps_that_are_there_are_not_made_again(farm, tmp_path, own_cache):
    """It dies in every round: while photographs are matched, and in both comparisons of depth maps."""
    assert main(words(farm, tmp_path / "whole")) == 0
    assert recipes()["surface"].depth.rounds == 2
    (made,) = (own_cache / "depth").iterdir()
    here = tmp_path / "killed"
    out, cache = here / "run", here / "cache/depth" / made.name
    killed(farm, here, at=5)
    assert unfinished(cache) == {MATCHED: 4}
    assert list(cache.rglob(".surfkit-*")), "it died while it wrote"
    before = arrays(cache)
    killed(farm, here, at=3 + 3)  # the others are matched, and two are compared
    assert unfinished(cache) == {MATCHED: 7, COMPARED: 2} and arrays(cache).items() >= before.items()
    before = arrays(cache)
    killed(farm, here, at=5 + 4)
    assert unfinished(cache) == {MATCHED: 7, COMPARED: 7, AGAIN: 3} and arrays(cache).items() >= before.items()
    killed(farm, here, at=4 + 3 * 3 + 2)  # four more before the first map, each of which is three files
    there, before = arrays(cache), read_made(cache)
    assert before.maps == 3 and not (out / "recipe.json").exists()
    assert unfinished(cache) == {AGAIN: 7}, "of the others, none is needed"
    killed(farm, here, at=-1)
    found, wanted, after = arrays(cache), arrays(made), read_made(cache)
    assert {name: content for name, (_, content) in found.items()} == {n: content for n, (_, content) in wanted.items()}
    kept = [name for name in found if there.get(name) == found[name]]
    assert len(kept) == 3 * 3 and after.maps == 7 and after.cpu_seconds > before.cpu_seconds > 0
    whole = tmp_path / "whole/run"
    assert (out / "point_cloud.ply").read_bytes() == (whole / "point_cloud.ply").read_bytes()
    images = [json.loads((folder / "metrics.json").read_text())["images"] for folder in (out, whole)]
    assert images[0] == images[1]
    assert not [path for path in here.rglob("*") if path.name.startswith(".")]
    assert sorted(path.name for path in farm.iterdir()) == ["images", "sparse"]
