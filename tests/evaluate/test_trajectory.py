"""Alignment by cameras: a known similarity is found, also where some cameras are wrong."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from surfkit.core.check import BadInput
from surfkit.evaluate.geometry.trajectory import onto_trajectory, read_log
from surfkit.evaluate.geometry.transform import apply


def write_log(path, centres):
    """Cameras in the format of Tanks and Temples, turned in any way."""
    lines = []
    for at, centre in enumerate(centres):
        matrix = np.eye(4)
        matrix[:3, :3] = Rotation.random(random_state=at).as_matrix()
        matrix[:3, 3] = centre
        lines += [f"{at} {at} 0", *(" ".join(map(repr, map(float, row))) for row in matrix)]
    path.write_text("\n".join(lines) + "\n")


def test_a_known_similarity_is_found_among_wrong_cameras(tmp_path):
    draw = np.random.default_rng(0)
    centres = draw.normal(size=(40, 3))
    wanted = np.eye(4)
    wanted[:3, :3] = 3.5 * Rotation.from_euler("xyz", [0.3, -1, 2]).as_matrix()
    wanted[:3, 3] = 10, -4, 2
    there = apply(wanted, centres)
    write_log(tmp_path / "a.log", there)
    assert np.allclose(read_log(tmp_path / "a.log"), there)
    there[::5] += draw.normal(size=(8, 3)) * 20
    assert np.allclose(onto_trajectory(centres, there), wanted, atol=1e-9)
    with pytest.raises(BadInput, match="39 cameras for 40 of the trajectory"):
        onto_trajectory(centres[1:], there)


@pytest.mark.parametrize("text", ["", "0 0 0\n1 0 0 0\n0 1 0 0\n", "word\n" * 5])
def test_what_is_no_trajectory_is_refused(tmp_path, text):
    (tmp_path / "a.log").write_text(text)
    with pytest.raises(BadInput, match="no trajectory"):
        read_log(tmp_path / "a.log")
