"""A start from pointmaps of exact geometry in frames of their own."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from surfkit.core.check import BadInput
from surfkit.primitives.surfel2d import Surfel2D
from surfkit.start.pointmap_start import PointmapStart, umeyama
from surfkit.testing import check_start
from surfkit.testing.inputs import start_input, survey
from surfkit.testing.synthetic import SURFACES


def write_pointmaps(folder, wrong=0.2, far=()):
    """Exact points of each photograph of the survey, in another frame each, some of them wrong with low confidence or
    off their rays; photographs at the positions `far` have nothing but noise."""
    truth, draw = survey(), np.random.default_rng(0)
    for at, view in enumerate(truth.scene.train):
        depth = truth.exact[view.name].depth
        pose = view.camera.world_to_camera.numpy()
        local = (view.camera.rays(torch.float64) * depth).permute(1, 2, 0).numpy()
        world = (local - pose[:3, 3]) @ pose[:3, :3]
        turn = Rotation.random(random_state=at).as_matrix()
        points = (0.2 + at) * world @ turn.T + draw.normal(0, 5, 3)
        spoilt = draw.random(depth.shape) < wrong
        points[spoilt] += draw.normal(0, 0.5 * (0.2 + at), (spoilt.sum(), 3))
        if at in far:
            points = draw.normal(size=points.shape)
        confidence = np.where(spoilt & (draw.random(depth.shape) < 0.5), 0.1, 1.0)
        np.savez(folder / f"{view.name}.npz", points=points.astype(np.float32), confidence=confidence)
    return truth


def test_points_lie_on_the_surface_whatever_the_frames_of_the_pointmaps(tmp_path, monkeypatch):
    told = []
    monkeypatch.setattr("surfkit.start.pointmap_start.emit", lambda event: told.append(str(event)))
    truth = write_pointmaps(tmp_path, far=(4,))
    cloud = PointmapStart(maps=str(tmp_path), points=3_000, unsure=0.1).cloud(start_input())
    assert 1_500 < len(cloud.xyz) <= 3_000
    places = truth.scene.frame.to_input(cloud.xyz.numpy())
    error = np.min([surface.distance(places) for surface in SURFACES], axis=0)
    assert np.median(error) < 0.01 and (error < 0.3).mean() > 0.99  # metres; seen from 15
    names = " ".join(told)
    assert truth.scene.train[4].name in names and truth.scene.train[3].name not in names


def test_contract(tmp_path):
    write_pointmaps(tmp_path)
    check_start(PointmapStart(maps=str(tmp_path), points=1_000))


def test_a_similarity_is_found_again():
    draw = np.random.default_rng(0)
    source, turn = draw.normal(size=(20, 3)), 3 * Rotation.random(random_state=0).as_matrix()
    assert np.allclose(umeyama(source, source @ turn.T + [1, 2, 3]), np.column_stack([turn, [1, 2, 3]]))


def test_what_cannot_be_used_is_one_line(tmp_path):
    known = start_input()
    with pytest.raises(BadInput, match="name the folder"):
        PointmapStart().refuse_unfit(Surfel2D(), known.scene)
    with pytest.raises(BadInput, match="no pointmap of these photographs fits"):
        PointmapStart(maps=str(tmp_path)).cloud(known)
    name = known.scene.train[0].name
    np.save(tmp_path / f"{name}.npy", np.zeros((4, 5)))
    with pytest.raises(BadInput, match=r"float64 of shape \(4, 5\); a pointmap is floats of"):
        PointmapStart(maps=str(tmp_path)).cloud(known)
    (tmp_path / f"{name}.npy").write_bytes(b"nothing")
    with pytest.raises(BadInput, match="cannot be read"):
        PointmapStart(maps=str(tmp_path)).cloud(known)
    (tmp_path / f"{name}.npy").unlink()
    np.savez_compressed(tmp_path / f"{name}.npz", points=np.random.default_rng(0).random((40, 50, 3)))
    whole = (tmp_path / f"{name}.npz").read_bytes()
    (tmp_path / f"{name}.npz").write_bytes(whole[:200] + bytes(60) + whole[260:])
    with pytest.raises(BadInput, match="cannot be read"):
        PointmapStart(maps=str(tmp_path)).cloud(known)
    np.savez(tmp_path / f"{name}.npz", points=np.zeros((4, 5, 3)), confidence=np.full((4, 5), "x"))
    with pytest.raises(BadInput, match="must have a number for each point"):
        PointmapStart(maps=str(tmp_path)).cloud(known)
    np.savez(tmp_path / f"{name}.npz", points=np.zeros((0, 5, 3)))
    with pytest.raises(BadInput, match="a pointmap is floats of"):
        PointmapStart(maps=str(tmp_path)).cloud(known)
    with pytest.raises(BadInput, match="start.unsure"):
        replace(PointmapStart(), unsure=1.0)
