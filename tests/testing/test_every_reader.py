"""Every reader of data sets passes its check on the same scene in its own layout; readers that are wrong are named."""

from dataclasses import dataclass, replace

import exchange_files as exchange
import numpy as np
import program_files as programs
import pytest
from data_set_folders import FLIGHT, blender, city, nerfstudio, odm

from surfkit.core.registry import components
from surfkit.io.datasets.base import Reader
from surfkit.io.datasets.colmap import COLMAP
from surfkit.testing import check, check_reader
from surfkit.testing.synthetic import photograph, write_colmap

PROGRAMS = ("bundler", "metashape", "openmvg", "pix4d", "realitycapture")
EXCHANGE = ("blocks-exchange", "opf", "polycam", "record3d", "xmp-sidecars")
"""Written with a scene of their own: test_programs.py and test_exchange.py compare cameras with formulas."""


def program(name):
    def write(folder, truth):
        getattr(programs if name in PROGRAMS else exchange, name.replace("-", "_"))(folder)

    return write


WRITE = {
    "blender": blender,
    "colmap": write_colmap,
    "matrixcity": lambda folder, truth: city(folder, truth, "aerial"),
    "nerfstudio": nerfstudio,
    "odm": odm,
    **{name: program(name) for name in (*PROGRAMS, *EXCHANGE)},
}


def square(truth):
    """The scene as `blender` writes it: with square pixels, and the principal point in the middle."""
    width, height = FLIGHT.width / 2, FLIGHT.height / 2
    train, held_out = (
        tuple(replace(v, camera=replace(v.camera, fy=v.camera.fx, cx=width, cy=height)) for v in views)
        for views in (truth.scene.train, truth.scene.held_out)
    )
    return replace(truth, scene=replace(truth.scene, train=train, held_out=held_out))


@pytest.fixture(scope="module")
def truth():
    return photograph(FLIGHT)


@pytest.fixture(scope="module")
def colmap(truth, tmp_path_factory):
    folder = tmp_path_factory.mktemp("colmap")
    write_colmap(folder, truth)
    return folder


@pytest.mark.parametrize("name", components(Reader))
def test_every_reader(name, truth, tmp_path):
    """A reader of a new layout needs a function above that writes it."""
    folder = WRITE[name](tmp_path, truth) or tmp_path
    known = {"blender": square(truth), "matrixcity": None}  # the latter gives the photographs other names
    known |= dict.fromkeys((*PROGRAMS, *EXCHANGE))
    check(components(Reader)[name](), folder, known.get(name, truth))


@dataclass(frozen=True)
class Wrong(Reader):
    """What COLMAP's reader finds, spoilt."""

    def recognises(self, root):
        return COLMAP().recognises(root)

    def read(self, data):
        return self.spoilt(COLMAP().read(data))

    def spoilt(self, found):
        return found

    def posed(self, found, change):
        shots = [replace(shot, pose=change(shot.pose)) for shot in found.shots]
        return replace(found, shots=shots)


class Everything(Wrong):
    def recognises(self, root):
        return True


class Nothing(Wrong):
    def recognises(self, root):
        return False


class Writes(Wrong):
    def read(self, data):
        (data.path / "cache.bin").touch()
        return COLMAP().read(data)


class OpenGL(Wrong):
    def spoilt(self, found):
        return self.posed(found, lambda pose: np.diag([1.0, -1, -1, 1]) @ pose)


class CameraToWorld(Wrong):
    def spoilt(self, found):
        return self.posed(found, np.linalg.inv)


class Mirrored(Wrong):
    def spoilt(self, found):
        return replace(self.posed(found, lambda pose: np.diag([-1.0, 1, 1, 1]) @ pose))


class Scaled(Wrong):
    def spoilt(self, found):
        return self.posed(found, lambda pose: np.diag([0.01, 0.01, 0.01, 1]) @ pose)


class Single(Wrong):
    def spoilt(self, found):
        return replace(found, xyz=found.xyz.astype(np.float32))


class Twice(Wrong):
    def spoilt(self, found):
        return replace(found, shots=[*found.shots, found.shots[0]])


class Elsewhere(Wrong):
    def spoilt(self, found):
        return replace(found, held_out=frozenset({"nobody.png"}))


class Random(Wrong):
    def spoilt(self, found):
        return replace(found, xyz=found.xyz + np.random.default_rng().random(found.xyz.shape))


@pytest.mark.parametrize(
    ("reader", "message"),
    [
        (Everything(), "Everything recognises an empty folder"),
        (Nothing(), "Nothing does not recognise"),
        (Writes(), "Writes changes files of the data set"),
        (OpenGL(), "OpenGL: no sparse point .*view_000.png; .*world_to_camera"),
        (CameraToWorld(), "CameraToWorld: (cameras are turned otherwise|no sparse point lies in front)"),
        (Mirrored(), "Mirrored: view_000.png: the pose"),
        (Scaled(), "Scaled: view_000.png: the pose is not a rotation"),
        (Single(), r"Single: xyz is not \(P, 3\) finite float64"),
        (Twice(), "Twice: two photographs have the same name"),
        (Elsewhere(), "Elsewhere: held_out .*nobody.png"),
        (Random(), "Random.read is not repeatable: xyz"),
    ],
)
def test_readers_that_are_wrong(reader, message, colmap, truth):
    check_reader(Wrong(), colmap, truth)
    with pytest.raises(AssertionError, match=message):
        check_reader(reader, colmap, truth)
    (colmap / "cache.bin").unlink(missing_ok=True)


class Turned(Wrong):
    """Right on its own: only the truth tells that the axes of the cameras are exchanged."""

    def spoilt(self, found):
        swap = np.array([[0, 1.0, 0, 0], [-1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
        return self.posed(found, lambda pose: swap @ pose)


class Farther(Wrong):
    def spoilt(self, found):
        last = found.shots[-1]
        pose = last.pose.copy()
        pose[2, 3] += 0.5
        return replace(found, shots=[*found.shots[:-1], replace(last, pose=pose)])


@pytest.mark.parametrize(
    ("reader", "message"),
    [
        (Turned(), "Turned: cameras are turned"),
        (Farther(), "Farther: cameras stand"),
    ],
)
def test_what_only_the_truth_tells(reader, message, colmap, truth):
    check_reader(reader, colmap)
    with pytest.raises(AssertionError, match=message):
        check_reader(reader, colmap, truth)
