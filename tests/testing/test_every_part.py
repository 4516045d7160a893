"""Every built-in part passes the check of its kind from the day it arrives; packages check their own parts."""

import pytest

import surfkit.testing
from surfkit.compress.levels import Hierarchy, MergedLevels, PrunedLevels
from surfkit.core.check import BadInput
from surfkit.core.registry import kebab, kind_of, offered
from surfkit.depth.patch_match import PatchMatch
from surfkit.io.datasets.base import Reader
from surfkit.mesh.poisson import Poisson
from surfkit.primitives.base import Primitive
from surfkit.runs.execute.slurm import Slurm
from surfkit.testing import check

OFFERED = {
    f"{kebab(kind_of(cls).__name__)}:{name}": cls
    for _, name, cls in offered("surfkit_components")
    if cls.__module__.startswith("surfkit.")
}
QUICK = {
    "mesher:poisson": Poisson(octree=5, points=5_000),
    "levels-of-detail:hierarchy": Hierarchy(tile_points=100, steps=3),
    "levels-of-detail:merge": MergedLevels(tile_points=100, steps=3),
    "levels-of-detail:prune": PrunedLevels(tile_points=100, steps=3),
    "executor:slurm": Slurm(cluster="debug"),
    "depth-estimator:patch-match": PatchMatch(neighbours=6, passes=1),
}
"""Settings for parts whose defaults take long, or need a cluster."""
CANNOT = ("needs the package", "surfkit was installed without", "one without CUDA", "finds no NVIDIA GPU")
"""What errors say of parts that this machine cannot use."""
ELSEWHERE = {
    "executor:ray": "tests/runs/execute/test_ray.py has a cluster for it",
    "encoding:codes": "tests/compress/test_encodings.py has codebooks for it",
    "encoding:principal-components": "tests/compress/test_encodings.py has a basis for it",
    "method:splats": "tests/runs/test_pipeline.py and most others train with it",
    "method:import": "tests/runs/methods/test_imported.py has a file for it",
    "start:splats": "tests/start/test_splats.py has a file for it",
    "start:pointmap": "tests/start/test_pointmap.py has maps for it",
    "method:stereo": "tests/runs/methods/test_method.py makes the depth maps for it",
    "feature-extractor:disk": "tests/apps/sfm/test_learnt.py has weights for it",
    "feature-extractor:aliked": "tests/apps/sfm/test_learnt.py has weights for it",
    "feature-matcher:lightglue": "tests/apps/sfm/test_learnt.py has weights for it",
    "depth-estimator:depth-anything-v2": "tests/depth/test_depth_anything.py has weights for it",
}


@pytest.mark.parametrize("name", [name for name, cls in sorted(OFFERED.items()) if not issubclass(cls, Reader)])
def test_every_part(name):
    if name in ELSEWHERE:
        pytest.skip(ELSEWHERE[name])
    try:
        check(QUICK.get(name) or OFFERED[name]())
    except BadInput as error:
        if not any(reason in str(error) for reason in CANNOT):
            raise
        pytest.skip(str(error))


@pytest.mark.parametrize("name", sorted(name for name, cls in OFFERED.items() if issubclass(cls, Primitive)))
@pytest.mark.parametrize("degree", [0, 2])
def test_primitives_of_other_degrees(name, degree):
    check(OFFERED[name](sh_degree=degree), count=20)


def test_every_kind_has_a_check():
    kinds = {kebab(kind_of(cls).__name__).replace("-", "_") for cls in OFFERED.values()}
    assert {f"check_{kind}" for kind in kinds} <= set(surfkit.testing.__all__)
