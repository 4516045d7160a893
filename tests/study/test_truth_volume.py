"""F1 of a mesh in a table does not depend on the meshes that were measured before it."""

import numpy as np
import pytest

from surfkit.evaluate.geometry import comparison
from surfkit.evaluate.geometry.comparison import Comparison
from surfkit.study.truth import Truth
from surfkit.testing.synthetic import Flight, photograph

TAU, HALF_M, SIDE = 0.25, 8.0, 30


def level(z, half=HALF_M):
    """Vertices and faces of a level square."""
    x, y = (each.ravel() for each in np.meshgrid(*[np.linspace(-half, half, SIDE)] * 2))
    at = np.arange(SIDE * SIDE).reshape(SIDE, SIDE)
    a, b, c, d = (each.ravel() for each in (at[:-1, :-1], at[:-1, 1:], at[1:, :-1], at[1:, 1:]))
    return np.stack([x, y, np.full(x.size, z)], 1), np.concatenate([np.stack([a, b, c], 1), np.stack([b, d, c], 1)])


def write(path, *parts):
    vertices = np.concatenate([part[0] for part in parts])
    faces = np.concatenate([part[1] + at * SIDE * SIDE for at, part in enumerate(parts)])  # all but the last are level
    head = f"ply\nformat ascii 1.0\nelement vertex {len(vertices)}\n"
    head += "property double x\nproperty double y\nproperty double z\n"
    head += f"element face {len(faces)}\nproperty list uchar int vertex_indices\nend_header\n"
    rows = [" ".join(f"{it:.6f}" for it in row) for row in vertices] + [f"3 {a} {b} {c}" for a, b, c in faces]
    path.write_text(head + "\n".join(rows) + "\n")


@pytest.mark.usefixtures("quick_comparison")
def test_a_false_ground_counts_whatever_was_measured_before(tmp_path, monkeypatch):
    monkeypatch.setattr(comparison, "ALIGNMENTS", ("none",))
    scene = photograph(Flight(kind="grid", views=9, width=48, height=36, points=300)).scene
    write(tmp_path / "truth.ply", level(0.0))
    write(tmp_path / "good.ply", level(0.0))
    write(tmp_path / "false.ply", level(0.0), level(-10 * TAU, HALF_M / 2))
    wide = np.array([[-40.0, -40, -10 * TAU], [40, -40, -10 * TAU], [40, 40, -10 * TAU], [-40, 40, -10 * TAU]])
    write(tmp_path / "wide.ply", level(0.0), (wide, np.array([[0, 1, 2], [0, 2, 3]])))
    truth = Truth(tmp_path / "truth.ply", TAU, Comparison(classes=False, align="none", draws=1))
    found = {}
    for order in (("good", "false"), ("false", "good")):
        for name in (*order, "wide"):
            out = tmp_path / "-".join(order) / name
            figures = truth.compare(tmp_path / f"{name}.ply", out, scene)["geometry"]
            found.setdefault(name, []).append(figures["precision"])
    assert found["good"] == pytest.approx([1, 1], abs=0.01) and found["false"] == pytest.approx([0.8, 0.8], abs=0.05)
    assert found["wide"] == pytest.approx([0.5, 0.5], abs=0.05), "no corner of its false ground lies in the volume"
