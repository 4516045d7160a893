"""Some views of a scene in a file: all that is needed of them, to the last bit."""

import shutil
from dataclasses import replace

import numpy as np
import pytest
import torch

from surfkit.core.check import BadInput
from surfkit.io.datasets import extract
from surfkit.io.datasets.data import Data
from surfkit.io.datasets.depth_files import map_path
from surfkit.io.datasets.depth_prior import alignment, read_priors
from surfkit.io.datasets.read import read
from surfkit.scene.scene import Mask
from surfkit.testing.synthetic import Flight, photograph, write_colmap


@pytest.fixture(scope="module")
def farm(tmp_path_factory):
    """A data set with tracks, masks and depth maps that are off by a scale, its scene, and how they are aligned."""
    folder = tmp_path_factory.mktemp("made") / "farm"
    truth = photograph(Flight(views=8, width=64, height=48, points=250))
    write_colmap(folder, truth, tracks=True)
    for name, exact in truth.exact.items():
        path = map_path(folder, name)
        path.parent.mkdir(exist_ok=True)
        inverse = truth.scene.frame.scale / exact.depth.clamp_min(1e-9)
        np.save(path, np.where(exact.depth > 0, (inverse + 0.4) / 0.02, 0).astype(np.float32))
    data = Data(folder)
    scene = read(data)
    named = replace(scene.train[1], mask=Mask(folder / "mask.png", alpha=True), white=True)
    scene = replace(scene, train=(scene.train[0], named, *scene.train[2:]))
    return data, scene, alignment(data, scene)


def test_views_come_back_to_the_last_bit(farm, tmp_path):
    _, scene, _ = farm
    names = [scene.train[at].name for at in (4, 1, 2)]
    frame = replace(scene.frame, metres=0.1, crs="EPSG:32634", shift=(1e6 / 3, 0.0, 7.0))
    extract.save(tmp_path / "views.npz", extract.of(replace(scene, frame=frame), names, None))
    found = extract.load(tmp_path / "views.npz")
    assert found.priors is None and not found.scene.held_out and not len(found.scene.cloud.xyz)
    assert [view.name for view in found.scene.train] == sorted(names)
    for view in found.scene.train:
        true = next(other for other in scene.train if other.name == view.name)
        pose = true.camera.world_to_camera
        assert torch.equal(view.camera.world_to_camera, pose) and view.camera.world_to_camera.dtype == pose.dtype
        assert replace(view.camera, world_to_camera=pose) == replace(true.camera, world_to_camera=pose)
        assert (view.path, view.mask, view.white) == (true.path, true.mask, true.white)
    assert replace(found.scene.frame, origin=0) == replace(frame, origin=0)
    assert np.array_equal(found.scene.frame.origin, frame.origin)


def test_priors_without_the_sparse_model(farm, tmp_path):
    """The same as with it."""
    data, scene, whole = farm
    names = [view.name for view in scene.train[:3]]
    extract.save(tmp_path / "views.npz", extract.of(scene, names, whole))
    expected = read_priors(data, scene)
    bare = Data(tmp_path / "bare")
    shutil.copytree(data.path, bare.path)
    for name in ("images.txt", "points3D.txt"):
        (bare.path / "sparse" / "0" / name).write_text("")
    found = extract.load(tmp_path / "views.npz")
    assert found.priors.fits.keys() == set(names) < whole.fits.keys()
    priors = read_priors(bare, found.scene, None, found.priors)
    for at in range(3):
        assert torch.equal(priors[at].inverse, expected[at].inverse) and priors[at].inverse.any()
        assert torch.equal(priors[at].confidence, expected[at].confidence)
        assert priors[at].typical == expected[at].typical


def test_files_that_cannot_be_used(farm, tmp_path):
    path = tmp_path / "views.npz"
    with pytest.raises(BadInput, match="views.npz is not .*surfkit train"):
        extract.load(path)
    assert not extract.is_whole(path)
    _, scene, priors = farm
    extract.save(path, extract.of(scene, [scene.train[0].name], priors))
    content = path.read_bytes()
    assert extract.is_whole(path)
    rest = np.load(path)
    np.savez(tmp_path / "other.npz", **{name: rest[name] for name in rest.files if name != "poses"})
    damaged = bytearray(content)
    damaged[len(content) // 2] ^= 1
    for spoilt in (b"", content[:-30], bytes(damaged), b"nonsense", (tmp_path / "other.npz").read_bytes()):
        path.write_bytes(spoilt)
        with pytest.raises(BadInput, match="cannot be used"):
            extract.load(path)
