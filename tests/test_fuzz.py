"""A few hundred of the cases of `bench/fuzz.py`: damaged files end in one line, whatever is wrong with them."""

import sys
from pathlib import Path
from types import SimpleNamespace

import pytest
from needs import needs, needs_native

from surfkit.core.check import BadInput

hypothesis = needs("hypothesis")
pytestmark = needs_native
BENCH = Path(__file__).parents[1] / "bench"
CASES = 8
TARGETS = (
    "splats-compressed-ply", "splats-gltf", "splats-gltf-spz", "splats-ply", "splats-sog", "splats-splat",
    "splats-spz", "splats-spz-4", "splats-surfkit",
    "colmap-text", "colmap-binary", "photographs", "surface", "lenses-and-masks", "depth-arrays", "depth-pictures",
    "nerfstudio", "points-as-text", "blender", "matrixcity", "odm", "bundler", "metashape", "openmvg", "pix4d",
    "realitycapture", "recipe", "run", "stopped-run", "blocks", "comparison", "outputs", "memory",
    "numbers-evaluate", "numbers-prepare", "numbers-stereo", "numbers-mesh", "numbers-tetra", "numbers-train",
    "numbers-doctor",
)  # fmt: skip


@pytest.fixture(scope="module")
def bench():
    """The modules of the bench: of cases, damage, limits and targets."""
    sys.path.insert(0, str(BENCH))
    try:
        from fuzzing import case, damage, limits, targets

        yield SimpleNamespace(case=case, damage=damage, limits=limits, targets=targets)
    finally:
        sys.path.remove(str(BENCH))


def test_every_target_is_here(bench):
    assert tuple(bench.targets.TARGETS) == TARGETS


@pytest.mark.parametrize("name", TARGETS)
def test_damage_is_one_line(bench, name, tmp_path):
    case = bench.case.Fuzz(name, tmp_path)
    assert case.case([]) is None and case.files, "what is whole is taken"

    @hypothesis.settings(
        max_examples=CASES,
        deadline=None,
        database=None,
        derandomize=True,
        phases=[hypothesis.Phase.generate],
        suppress_health_check=list(hypothesis.HealthCheck),
    )
    @hypothesis.given(bench.damage.damages(case.files))
    def check(listed):
        assert (found := case.case(listed)) is None, found

    check()


def test_what_must_not_happen_is_noticed(bench, tmp_path, monkeypatch):
    """A crash, a write elsewhere and an endless loop."""
    case = bench.case.Fuzz("points-as-text", tmp_path)

    def found(read):
        with monkeypatch.context() as patch:
            patch.setattr("surfkit.io.datasets.transforms.read_points", read)
            return case.case([]).what

    def writing(path):
        (path.parent / "x").touch()
        raise BadInput("no points")

    def looping(path):
        while True:
            pass

    assert found(lambda path: 1 // 0) == "ZeroDivisionError in transforms.py points"
    assert found(writing).startswith("wrote outside the run folder: ['open ")
    monkeypatch.setattr(bench.limits, "CPU_SECONDS", 1)
    assert found(looping).startswith("TimeoutError")
