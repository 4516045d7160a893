"""The cache of depth maps: damaged ones are made again, one that can only be read is used, a full disk is one line."""

import errno
import os
import shutil
from pathlib import Path
from unittest import mock

import pytest
import torch
from needs import needs_native
from PIL import Image

from surfkit.core.check import BadInput, Fault
from surfkit.core.events import Warned
from surfkit.depth import depth_map_cache as keep
from surfkit.depth import prepare_depth_maps as prepare
from surfkit.depth.patch_match import PatchMatch
from surfkit.depth.prepare_depth_maps import DepthPreparation
from surfkit.io.datasets.data import Data
from surfkit.io.datasets.depth_map_index import folder_of, read_made
from surfkit.io.datasets.fingerprint import fingerprint
from surfkit.io.datasets.read import observations, read
from surfkit.scene.photos import view_photo
from surfkit.testing.synthetic import Flight, photograph, write_colmap

pytestmark = needs_native

FAST = PatchMatch(passes=1, rounds=1)
PLENTY = 1 << 30


@pytest.fixture(scope="module")
def farm(tmp_path_factory):
    """Seven photographs to train on."""
    folder = tmp_path_factory.mktemp("farm")
    write_colmap(folder, photograph(Flight(kind="grid", views=8, width=48, height=36, points=300)), tracks=True)
    return Data(folder)


def made(data, budget=PLENTY, estimator=FAST):
    """The maps in the cache, how many, and what was warned of."""
    told = []
    scene = read(data)
    tracks = observations(data, scene)
    preparation = DepthPreparation(data, estimator, torch.device("cpu"))
    with mock.patch.object(keep, "emit", told.append):
        with keep.maps(preparation, scene, tracks, "some", budget) as (folder, known):
            assert folder == folder_of("some")
    return known.maps, [event.text for event in told if isinstance(event, Warned)]


def files(folder):
    """Every file but what changes from run to run."""
    paths = (path for path in sorted(folder.rglob("*")) if path.is_file() and path.name not in ("made.json", "in-use"))
    return {str(path.relative_to(folder)): path.read_bytes() for path in paths}


@pytest.mark.parametrize(
    ("name", "left"),
    [
        ("view_001.png.npy", b"\x93NUMPY"),
        ("view_002.png.npy", b""),
        ("view_001.png.confidence.npy", None),
        ("view_003.png.normal.npy", None),
        ("view_003.png.normal.npy", "view_003.png.confidence.npy"),
        ("view_002.png.confidence.npy", "view_002.png.npy"),
    ],
)
def test_damaged_maps_are_made_again(farm, own_cache, name, left):
    """Without its confidence, every pixel of a map counted; a photograph whose map was damaged had none."""
    made(farm)
    folder = folder_of("some")
    whole, path = files(folder), folder / "estimated_depths" / name
    path.unlink()
    if isinstance(left, str):
        shutil.copy(path.with_name(left), path)
    elif left is not None:
        path.write_bytes(left)
    count, (told,) = made(farm)
    assert count == 7 and f"damaged depth maps, 1 of 7, {name[:12]} for one" in told
    assert files(folder) == whole and made(farm) == (7, [])


@pytest.mark.parametrize("damaged", [None, "null", "{"])
@pytest.mark.parametrize("name", ["made.json", "estimated_depths/depth.json"])
def test_what_is_written_down_of_maps_is_found_out_again(farm, own_cache, name, damaged):
    made(farm)
    folder = folder_of("some")
    whole, path = files(folder), folder / name
    path.unlink()
    if damaged:
        path.write_text(damaged)
    assert made(farm) == (7, []) and files(folder) == whole


def test_a_cache_that_can_only_be_read_is_used(farm, own_cache, monkeypatch):
    made(farm)
    before = {path: path.stat().st_mtime_ns for path in own_cache.rglob("*")}
    real = os.open

    def opened(path, flags, *rest, **more):
        if flags & (os.O_RDWR | os.O_WRONLY | os.O_CREAT) and Path(path).is_relative_to(own_cache):
            raise OSError(errno.EROFS, os.strerror(errno.EROFS), str(path))
        return real(path, flags, *rest, **more)

    with monkeypatch.context() as patch:
        patch.setattr(os, "open", opened)
        patch.setattr(os, "access", lambda path, mode: mode != os.W_OK)
        assert made(farm) == (7, [])
        with keep.mark_used(folder_of("some")):
            pass
        assert {path: path.stat().st_mtime_ns for path in own_cache.rglob("*")} == before
        (folder_of("some") / "estimated_depths/view_001.png.npy").unlink()
        with pytest.raises(ValueError, match="Read-only file system.*SURFKIT_CACHE"):
            made(farm)


def test_a_full_disk_is_one_line_and_the_maps_stay(farm, own_cache, monkeypatch):
    estimate = PatchMatch.estimate

    def full(self, given, wanted):
        for found in estimate(self, given, wanted):
            yield found
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), "some.npy")

    with monkeypatch.context() as patch:
        patch.setattr(PatchMatch, "estimate", full)
        with pytest.raises(Fault, match="^some.npy: the disk is full .*SURFKIT_CACHE") as error:
            made(farm)
    assert "\n" not in str(error.value) and len(list(own_cache.rglob("*png.npy"))) == 1
    assert made(farm) == (7, [])


def test_maps_larger_than_the_budget_are_told(farm, own_cache):
    count, (told,) = made(farm, budget=1_000)
    assert count == 7 and told.endswith("more than the 1e-06 GB of --prepare-cache, and are kept")
    assert made(farm, budget=1_000) == (7, []), "told when they were made"


def test_a_photograph_that_cannot_be_read_for_a_while_is_tried_again(farm, tmp_path):
    """Too many open files, or a share that is away, say nothing of the photograph."""
    farm = Data(Path(shutil.copytree(farm.path, tmp_path / "farm")))
    first, _ = made(farm)
    whole = files(folder_of("some"))
    shutil.rmtree(folder_of("some"))

    def away(view):
        if view.name == "view_003.png":
            raise BadInput(f"{view.path}: cannot be read") from OSError(errno.EMFILE, os.strerror(errno.EMFILE))
        return view_photo(view)

    with mock.patch.object(prepare, "view_photo", away):
        with mock.patch.object(prepare, "emit") as told:
            assert made(farm) == (first - 1, [])
        (note,) = [call.args[0].text for call in told.mock_calls if isinstance(call.args[0], Warned)]
        assert note.startswith("no depth map is made of a photograph: ")
        assert read_made(folder_of("some")).without == read_made(folder_of("some")).unread == ("view_003.png",)
        with mock.patch.object(prepare, "view_photo", mock.Mock(side_effect=away)) as looked:
            assert made(farm) == (first - 1, []) and looked.call_count == 1, "at the photograph that is missing alone"
    lesser = files(folder_of("some"))
    with keep.mark_used(folder_of("some")):
        assert made(farm) == (first - 1, []) and files(folder_of("some")) == lesser, "another run looks at them"
    count, (told,) = made(farm)
    assert count == first and "'view_003.png' could not be read before, and can be now" in told
    assert files(folder_of("some")) == whole and made(farm) == (first, [])
    broken = farm.path / "images" / "view_003.png"
    broken.write_bytes(broken.read_bytes()[:400])
    shutil.rmtree(folder_of("some"))
    assert made(farm)[0] == first - 1 and read_made(folder_of("some")).without == ("view_003.png",)


def of(data, device="cpu"):
    return DepthPreparation(data, FAST, torch.device(device))


def test_maps_of_a_gpu_are_others_than_those_of_a_cpu(farm):
    scene = read(farm)
    named = [
        keep.key_of(of(farm, device), scene, fingerprint(scene), observations(farm, scene))
        for device in ("cpu", "cuda:0", "cuda:1")
    ]
    assert named[0] != named[1] == named[2]


def test_masks_leave_the_name_of_maps(farm, tmp_path):
    """Stereo does not look at them, and takes hours of a large survey."""
    other = Data(Path(shutil.copytree(farm.path, tmp_path / "farm")))
    (other.path / "masks").mkdir()
    for path in (other.path / "images").iterdir():
        Image.new("L", (48, 36), 255).save(other.path / "masks" / path.name)
    scenes = read(farm), read(other)
    assert all(view.mask for view in scenes[1].train) and not any(view.mask for view in scenes[0].train)
    one, two = (
        keep.key_of(of(data), scene, fingerprint(scene), observations(data, scene))
        for data, scene in zip((farm, other), scenes, strict=True)
    )
    assert one == two


def test_what_is_deleted_meanwhile_takes_no_room(tmp_path, monkeypatch):
    (tmp_path / "a" / "b").mkdir(parents=True)
    for name, size in (("a/one", 7), ("a/b/two", 5)):
        (tmp_path / name).write_bytes(bytes(size))
    assert keep.folder_bytes(tmp_path) == 12 and keep.folder_bytes(tmp_path / "gone") == 0
    scan = os.scandir

    def deleted(path):
        if isinstance(path, str) and Path(path).name == "b":
            shutil.rmtree(path)
        return scan(path)

    monkeypatch.setattr(os, "scandir", deleted)
    assert keep.folder_bytes(tmp_path) == 7


def test_a_smaller_budget_holds_also_where_no_map_is_made(farm):
    made(farm)
    other = folder_of("some").with_name("other")
    shutil.copytree(folder_of("some"), other)
    assert made(farm)[1] == [] and other.exists()
    assert made(farm, budget=1) == made(farm) and not other.exists(), "its own maps stay"
