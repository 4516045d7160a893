"""A run that SIGKILL ends while it makes depth maps goes on from those that are there, to the same bits."""

import json
import os
import signal
from functools import partial

import pytest
from forks import started
from needs import needs_native

from surfkit.cli import main
from surfkit.readers.made_maps import read_made
from surfkit.testing.synthetic import Flight, photograph, write_colmap

pytestmark = needs_native


def die_at(array):
    """This process ends when so many arrays are written, but for the name of the last."""
    left, replace = [array], os.replace

    def replaced(unfinished, path):
        left[0] -= str(path).endswith(".npy")
        if left[0] == 0:
            os.kill(os.getpid(), signal.SIGKILL)
        replace(unfinished, path)

    os.replace = replaced


SETTINGS = "recipe:surface mesh:none --steps 4 --device cpu --pictures-every 0 --primitive.sh-degree 0".split()
SETTINGS += ["--depth.rounds", "1"]


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
    paths = [path for path in folder.rglob("*.npy") if not path.name.startswith(".")]
    return {str(path.relative_to(folder)): (path.stat().st_mtime_ns, path.read_bytes()) for path in paths}


def test_maps_that_are_there_are_not_made_again(farm, tmp_path, own_cache):
    assert main(words(farm, tmp_path / "whole")) == 0
    (made,) = (own_cache / "depth").iterdir()
    here = tmp_path / "killed"
    out, cache = here / "run", here / "cache/depth" / made.name
    killed(farm, here, at=5)
    matched = arrays(cache)
    assert len(matched) == 4 and all("matching-photographs" in name for name in matched)
    assert list(cache.rglob(".*.part")), "it died while it wrote"
    killed(farm, here, at=8 + 1)  # eight more before the first map, each of which is three files
    assert arrays(cache).items() >= matched.items() and len(arrays(cache)) == 12
    killed(farm, here, at=2 + 3 * 3 + 2)
    there, before = arrays(cache), read_made(cache)
    assert before.maps == 3 and not (out / "recipe.json").exists()
    work = [name for name in there if ".work" in name]
    assert len(work) == 7 and all("comparing-depth-maps" in name for name in work), "of the others, none is needed"
    killed(farm, here, at=-1)
    found, wanted, after = arrays(cache), arrays(made), read_made(cache)
    assert {name: content for name, (_, content) in found.items()} == {n: content for n, (_, content) in wanted.items()}
    kept = [name for name in found if there.get(name) == found[name]]
    assert len(kept) == 3 * 3 and after.maps == 7 and after.cpu_seconds > before.cpu_seconds > 0
    whole = tmp_path / "whole/run"
    assert (out / "point_cloud.ply").read_bytes() == (whole / "point_cloud.ply").read_bytes()
    images = [json.loads((folder / "metrics.json").read_text())["images"] for folder in (out, whole)]
    assert images[0] == images[1]
    assert not [path for path in here.rglob("*") if path.name.startswith(".") or path.name == "lock"]
    assert sorted(path.name for path in farm.iterdir()) == ["images", "sparse"]
