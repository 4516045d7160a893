"""Meshers and trusts that break their contract are named, with what is wrong."""

import itertools
from dataclasses import dataclass, replace

import numpy as np
import pytest
import torch

from surfkit.mesh.base import Mesh, Mesher
from surfkit.mesh.trust import Trust
from surfkit.testing import check_mesher, check_trust
from surfkit.testing.inputs import BALL_RADIUS


@dataclass(frozen=True)
class Ball(Mesher):
    """The ball that the check shows, as an octahedron whose sides have been divided."""

    radius: float = BALL_RADIUS

    def mesh(self, subject):
        x, y, z = np.eye(3)
        sides = [(i * x, j * y, k * z)[:: i * j * k] for i in (1, -1) for j in (1, -1) for k in (1, -1)]
        for _ in range(3):
            sides = [part for side in sides for part in divided(*side)]
        vertices = np.concatenate(sides) * self.radius
        faces = np.arange(len(vertices)).reshape(-1, 3)
        return self.spoilt(Mesh(vertices.astype(np.float32), faces.astype(np.int32), facts=self.facts()), subject)

    def facts(self):
        return {"sides": 8, "made of": ("octahedron", None), "each": {"a": [1, 2.5]}}

    def spoilt(self, mesh, subject):
        return mesh


def divided(a, b, c):
    ab, bc, ca = (p / np.linalg.norm(p) for p in (a + b, b + c, c + a))
    return [(a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca)]


class Inwards(Ball):
    def spoilt(self, mesh, subject):
        return replace(mesh, faces=np.ascontiguousarray(mesh.faces[:, ::-1]))


class Long(Ball):
    def spoilt(self, mesh, subject):
        return replace(mesh, faces=mesh.faces.astype(np.int64))


class Beyond(Ball):
    def spoilt(self, mesh, subject):
        return replace(mesh, faces=mesh.faces + np.int32(1))


class Holes(Ball):
    def spoilt(self, mesh, subject):
        vertices = mesh.vertices.copy()
        vertices[5] = np.nan
        return replace(mesh, vertices=vertices)


class Empty(Ball):
    def spoilt(self, mesh, subject):
        return replace(mesh, faces=mesh.faces[:0])


class Arrays(Ball):
    def facts(self):
        return {"centre": np.zeros(3)}


class Infinite(Ball):
    def facts(self):
        return {"centre": {1, 2}}


CALLS = itertools.count()


class Draws(Ball):
    def spoilt(self, mesh, subject):
        return replace(mesh, vertices=mesh.vertices * np.float32(1 + 0.01 * next(CALLS)))


class Moves(Ball):
    def spoilt(self, mesh, subject):
        subject.splats.means.add_(1)
        return mesh


@pytest.mark.parametrize(
    ("mesher", "message"),
    [
        (Inwards(), "Inwards: .*faces away"),
        (Long(), r"Long: faces are int64 of shape \(512, 3\); .*int32 .*\(n, 3\)"),
        (Beyond(), "Beyond: a face names"),
        (Holes(), "Holes: a vertex is not finite"),
        (Empty(), "Empty: there is no face"),
        (Arrays(), "Arrays: mesh.json .*facts: centre: ndarray"),
        (Infinite(), "Infinite: mesh.json .*facts: centre: set"),
        (Draws(), "Draws: the same splats give another surface"),
        (Moves(), "Moves.mesh changed .*splats.means"),
        (Ball(radius=0.7), "Ball: 100% of the mesh"),
    ],
)
def test_meshers_that_are_wrong(mesher, message):
    check_mesher(Ball())
    with pytest.raises(AssertionError, match=message):
        check_mesher(mesher)


@dataclass(frozen=True)
class Even(Trust):
    """All pixels alike."""

    def within(self, maps, depth, prior):
        return torch.ones_like(depth)

    def among(self, at, depths):
        return torch.ones_like(depths.read(at))


class Negative(Even):
    def within(self, maps, depth, prior):
        return maps.alpha - 2


class One(Even):
    def among(self, at, depths):
        return torch.tensor(1.0)


class Divides(Even):
    def among(self, at, depths):
        return depths.read(at) / depths.read(at).max()


class Nobody(Even):
    def within(self, maps, depth, prior):
        return torch.zeros_like(depth)


class Clears(Even):
    def within(self, maps, depth, prior):
        maps.depth.zero_()
        return torch.ones_like(depth)


@pytest.mark.parametrize(
    ("trust", "message"),
    [
        (Negative(), "Negative.within is below 0 for some pixel"),
        (One(), r"One.among has shape \(\), not \(48, 64\)"),
        (Divides(), "Divides.among, .*not finite"),
        (Nobody(), "Nobody.within .*100% of the pixels"),
        (Clears(), "Clears.within changed .*maps.depth"),
    ],
)
def test_trusts_that_are_wrong(trust, message):
    check_trust(Even())
    with pytest.raises(AssertionError, match=message):
        check_trust(trust)
