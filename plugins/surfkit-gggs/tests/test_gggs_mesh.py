"""The meshers on a ball whose surface is known, and their contract."""

import numpy as np
import pytest
from surfkit_gggs.mesher import SolidField, SolidTSDF

from surfkit.mesh.opacity_surface import OpacitySurface
from surfkit.plugin import TSDF, BadInput, Warned
from surfkit.testing import check, check_mesher
from surfkit.testing.inputs import BALL_RADIUS, mesh_input


def radii(mesh):
    return np.linalg.norm(mesh.vertices, axis=1)


def test_a_ball_of_ellipsoids_becomes_a_ball_a_little_smaller_than_by_the_largest_density():
    given = mesh_input("gaussian", count=600, views=10)
    mesh, other = SolidField(longest=0).mesh(given), OpacitySurface(longest=0).mesh(given)
    assert np.abs(radii(mesh) - BALL_RADIUS).max() < 0.03 and np.abs(radii(mesh) - BALL_RADIUS).mean() < 0.006
    # A solid hides less at every place but behind it, so its surface lies deeper.
    assert radii(mesh).mean() < radii(other).mean()


def test_depth_maps_of_solids_fuse_to_the_ball_and_tell_what_they_lack():
    given = mesh_input("gaussian", count=600, views=10)
    solid, flat = (mesher.mesh(given) for mesher in (SolidTSDF(TSDF(voxel_px=2)), TSDF(voxel_px=2)))
    assert np.median(np.abs(radii(solid) - BALL_RADIUS)) < 0.01
    assert 0 <= solid.facts["pixels_without_solid_depth"] < 0.2
    assert np.abs(np.median(radii(solid)) - np.median(radii(flat))) > 1e-4, "another depth than the drawn one is fused"


@pytest.mark.parametrize("mesher", [SolidField(bisections=3), SolidTSDF(TSDF(voxel_px=3))])
def test_splats_that_are_no_solids_are_told_of(mesher, monkeypatch):
    told = []
    monkeypatch.setattr("surfkit_gggs.mesher.emit", told.append)
    mesher.mesh(mesh_input("gaussian", count=600, views=8))
    assert told == []
    mesher.mesh(mesh_input("surfel", count=600, views=8))
    assert [type(event) for event in told] == [Warned] and "surfel splats are no solids" in told[0].text


def test_they_keep_to_the_contract():
    check(SolidField(bisections=3))
    check_mesher(SolidField(bisections=3), mesh_input("gaussian", count=600, views=8))
    check(SolidTSDF(TSDF(voxel_px=3)))
    check_mesher(SolidTSDF(TSDF(voxel_px=3)), mesh_input("gaussian", count=600, views=8))


def test_solids_have_a_median_depth_alone():
    with pytest.raises(BadInput, match=r"mesh\.fusion\.depth is expected"):
        SolidTSDF(TSDF(depth="expected"))
