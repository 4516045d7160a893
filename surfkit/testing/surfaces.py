"""Checks of what makes surfaces: meshers, and the trust in pixels of depth maps.

Each check returns nothing and raises AssertionError with a sentence that says what is wrong.
"""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from surfkit.core.check import BadInput
from surfkit.core.codec import dump
from surfkit.mesh.base import Mesh, Mesher, MeshInput, require_values
from surfkit.mesh.overlap import Depths
from surfkit.mesh.trust import Trust
from surfkit.testing.equality import assert_same, unchanged
from surfkit.testing.inputs import BALL_RADIUS, exact_depths, exact_priors, mesh_input, survey


def check_mesher(mesher: Mesher, subject: MeshInput | None = None) -> None:
    """Its mesh is whole, faces the cameras, has facts that mesh.json can keep, and the same area when it is made again.

    Args:
        mesher: To check; a coarse one is faster.
        subject: What to mesh; a ball of surfels with cameras all around it if None, which the mesh must come close to.

    Raises:
        BadInput: The mesher cannot work on this machine.
    """
    mesher.ready()
    name, ball = type(mesher).__name__, subject is None
    subject = subject or mesh_input(count=600, views=10)
    if not mesher.needs_prior:
        subject = replace(subject, priors=None)
    with unchanged(f"{name}.mesh", splats=subject.splats, views=subject.views, priors=subject.priors):
        mesh = mesher.mesh(replace(subject, generator=torch.Generator().manual_seed(1)))
    assert isinstance(mesh, Mesh), f"{name}.mesh gives {type(mesh).__name__}, not a surfkit.Mesh"
    _check_whole(name, mesh)
    again = mesher.mesh(replace(subject, generator=torch.Generator().manual_seed(1)))
    sides, centres = _sides(mesh), torch.stack([view.camera.centre for view in subject.views]).numpy()
    area, other = _areas(sides), _areas(_sides(again))
    assert abs(area.sum() - other.sum()) <= 1e-3 * area.sum(), f"{name}: the same splats give another surface"
    towards = _towards(sides, centres)
    assert area[towards > 0].sum() > area[towards < 0].sum(), f"{name}: most of the mesh faces away from the cameras"
    if ball:
        _check_ball(name, mesh, area)


def check_trust(trust: Trust) -> None:
    """The weights of a trust are finite and 0 or more, one for each pixel, also without a prior and without any depth;
    they repeat themselves, and agree with true depth maps: most of their pixels are not left out.

    Args:
        trust: To check.
    """
    name, truth = type(trust).__name__, survey()
    depths, drawn = exact_depths(truth)
    prior, depth = exact_priors(truth)[4], drawn[4].need("depth")
    for what, given in {
        "": prior,
        " without a prior": None,
        " without prior normals": replace(prior, normal=None),
    }.items():
        with unchanged(f"{name}.within", maps=drawn[4], prior=given):
            weight = trust.within(drawn[4], depth, given)
        _check_weights(f"{name}.within{what}", weight, depth)
        assert_same(f"{name}.within{what}", weight, trust.within(drawn[4], depth, given), "draw nothing")
        kept = float((weight > 0)[depth > 0].float().mean())
        assert kept > 0.5, f"{name}.within{what} leaves out {1 - kept:.0%} of the pixels of a true depth map"
    weight = trust.among(4, depths)
    _check_weights(f"{name}.among", weight, depth)
    assert_same(f"{name}.among", weight, trust.among(4, depths), "draw nothing")
    kept = float((weight > 0)[depth > 0].float().mean())
    assert kept > 0.5, f"{name}.among leaves out {1 - kept:.0%} of the pixels of true depth maps"
    nothing = Depths(depths.cameras, lambda at: torch.zeros_like(drawn[at].need("depth")))
    _check_weights(f"{name}.among, where no view has a depth,", trust.among(4, nothing), depth)


def _check_weights(what: str, weight: Tensor, depth: Tensor) -> None:
    assert weight.shape == depth.shape, f"{what} has shape {tuple(weight.shape)}, not {tuple(depth.shape)}"
    assert torch.isfinite(weight).all(), f"{what} is not finite"
    assert (weight >= 0).all(), f"{what} is below 0 for some pixel"


def _check_whole(name: str, mesh: Mesh) -> None:
    """Types and shapes, rows that are there, finite places and facts that can be saved."""
    vertices, faces, colors = mesh.vertices, mesh.faces, mesh.colors
    wanted: list[tuple[str, np.ndarray, type[np.generic], int]]
    wanted = [("vertices", vertices, np.float32, 3), ("faces", faces, np.int32, 3)]
    wanted += [("colors", colors, np.uint8, 3)] if colors is not None else []
    for what, array, dtype, width in wanted:
        fits = isinstance(array, np.ndarray) and array.dtype == dtype and array.ndim == 2 and array.shape[1] == width
        told = f"{array.dtype} of shape {array.shape}" if hasattr(array, "dtype") else type(array).__name__
        assert fits, f"{name}: {what} are {told}; they must be a numpy array of {np.dtype(dtype).name} and shape (n, 3)"
    assert len(faces), f"{name}: there is no face"
    assert np.isfinite(vertices).all(), f"{name}: a vertex is not finite"
    there = faces.min() >= 0 and faces.max() < len(vertices)
    assert there, f"{name}: a face names a vertex that is not there"
    assert colors is None or len(colors) == len(vertices), f"{name}: colors are not one for each vertex"
    try:
        require_values(mesh)
    except BadInput as error:
        raise AssertionError(f"{name}: {error}") from error
    try:
        json.dumps(dump(dict(mesh.facts)), allow_nan=False)
    except (TypeError, ValueError) as error:
        raise AssertionError(f"{name}: mesh.json cannot keep the facts: {error}") from error


def _check_ball(name: str, mesh: Mesh, area: np.ndarray) -> None:
    """Half of its area lies within a tenth of the radius of the ball, in local units."""
    distance = np.linalg.norm(mesh.vertices[mesh.faces].mean(1), axis=1)
    near = float(area[np.abs(distance - BALL_RADIUS) < 0.1 * BALL_RADIUS].sum() / area.sum())
    assert near > 0.5, f"{name}: {1 - near:.0%} of the mesh lies farther than a tenth of the radius from the ball"


def _sides(mesh: Mesh) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(F, 3) float64 first corners, and from there to the second and third."""
    a, b, c = (mesh.vertices[mesh.faces[:, k]].astype(np.float64) for k in range(3))
    return a, b - a, c - a


def _areas(sides: tuple[np.ndarray, np.ndarray, np.ndarray]) -> np.ndarray:
    return np.linalg.norm(np.cross(sides[1], sides[2]), axis=1) / 2


def _towards(sides: tuple[np.ndarray, np.ndarray, np.ndarray], centres: np.ndarray) -> np.ndarray:
    """(F,) above 0 where a face looks towards the nearest of the (V, 3) cameras."""
    corner, b, c = sides
    nearest = centres[((corner[:, None] - centres[None]) ** 2).sum(2).argmin(1)]
    return np.einsum("ni,ni->n", np.cross(b, c), nearest - corner)
