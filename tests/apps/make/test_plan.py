"""Which recipe `surfkit make` chooses, by which rule."""

from dataclasses import replace

import pytest

from surfkit.apps.doctor.estimate import GpuEstimate, MachineLimits, MeshCosts
from surfkit.apps.make.plan import chosen, recipe_of, rows
from surfkit.apps.make.quality import FIXED_SECONDS, MEGAPIXEL_SECONDS, QUALITIES
from surfkit.apps.make.record import Decisions
from surfkit.cli.recipes import recipes
from surfkit.core.check import BadInput
from surfkit.densify.filters import CountCap, Elongation
from surfkit.io.datasets.data import ReadSettings
from surfkit.mesh import TSDF
from surfkit.mesh.visibility import Visibility
from surfkit.runs.recipe import complete

from .test_make import estimated

SMALL = MachineLimits(2 * 10**9, 10**11, 10**11)
"""Of these 1.8 GB can be used, and one model of 1,000,000 points needs 3.2 GB without photographs."""


def test_one_model_where_it_fits():
    found = chosen(QUALITIES["normal"], estimated(), 40, 1_200)
    assert (found.recipe, found.blocks, found.steps) == ("surface", None, 1_200)
    assert "needs 3.2 GB of memory" in found.why and "9.0 GB (90 % of what is free)" in found.why
    assert recipe_of(found).pretrain.steps == 1_200 and dict(rows(found))["time"].startswith("about 60 s for")


def test_blocks_where_it_does_not():
    found = chosen(QUALITIES["high"], estimated(room=SMALL), 40, 1_200)
    assert (found.recipe, found.blocks, found.points) == ("surface-blocks", 3, 300_000)
    recipe = complete(recipe_of(found))
    recipe.refuse_unfit()
    assert recipe.partition.blocks == (3, 3) and recipe.start.most == 300_000
    assert recipe.pretrain.densify.filters == (CountCap(300_000), Elongation())
    assert recipe.tune.densify.filters == (Elongation(),), "in the blocks, nothing is capped"
    assert "blocks" in dict(rows(found)) and found.why.startswith("blocks: one model needs 3.2 GB")


def test_a_draft_is_never_divided_and_what_is_not_for_points_cannot_be():
    found = chosen(QUALITIES["draft"], estimated(room=SMALL), 40, 500)
    assert found.recipe == "surface-short" and "never divided" in found.why
    with pytest.raises(BadInput, match="smaller photographs need less"):
        chosen(QUALITIES["normal"], estimated(room=SMALL, point_bytes=10.0), 40, 500)


def test_on_a_gpu_points_go_to_the_memory_of_the_cpu_first():
    full = estimated(gpu=GpuEstimate(9 * 10**9, 10**9, 8e3, 8 * 10**9), movable_bytes=10**9)
    assert chosen(QUALITIES["normal"], full, 40, 900).recipe == "surface"
    found = chosen(QUALITIES["normal"], replace(full, movable_bytes=8 * 10**9), 40, 900)
    assert found.recipe == "surface-blocks" and "of memory of the GPU" in found.why


def test_what_the_presets_are():
    known = recipes()
    steps = {name: each.steps(known[each.recipe], 40, "cpu") for name, each in QUALITIES.items()}
    assert steps == {"draft": 500, "normal": 1_200, "high": 2_400}
    plain = ReadSettings()
    assert QUALITIES["draft"].reading(plain).longest == 800 and QUALITIES["normal"].reading(plain).longest == 1600
    assert QUALITIES["high"].reading(plain).size(9_000, 6_000) == (9_000, 6_000)
    given = ReadSettings(scale=2.0)
    assert all(each.reading(given) is given for each in QUALITIES.values())
    assert all(known[each.recipe].test_every == 0 for each in QUALITIES.values()), "every photograph is trained on"


def test_the_mesh_that_is_delivered_is_closed_and_as_fine_as_that_of_the_recipe():
    own = recipe_of(Decisions("surface", "", 40, 100))
    made = recipe_of(Decisions("surface", "", 40, 100, mesher="visibility"))
    assert isinstance(own.mesh, TSDF), "deliveries of earlier versions go on with the mesh that they have"
    assert isinstance(made.mesh, Visibility) and made.mesh.oversampling == own.mesh.oversampling == 1.5
    assert replace(made, mesh=own.mesh) == own


def test_the_time_of_all_steps_is_told_beforehand_on_a_cpu():
    measured = estimated(depth_seconds=300.0, mesh=MeshCosts(100.0, 10**9))
    found = chosen(QUALITIES["normal"], measured, 40, 100, megapixels=30.0)
    assert found.forecast is not None
    assert found.forecast.other_seconds == 400 + FIXED_SECONDS + 30 * MEGAPIXEL_SECONDS
    told = dict(rows(found))
    assert (
        told["time"].startswith("about 11 min: 60 s for the steps")
        and "and 10 min for depth maps, mesh" in told["time"]
    )
    assert "come on top" not in told["time"] and told["memory"].endswith(
        "making the mesh takes 1.0 GB beside the points"
    )
    unknown = dict(rows(chosen(QUALITIES["normal"], estimated(), 40, 100)))
    assert "mesh, texture, maps and reports come on top" in unknown["time"] and "may take more" in unknown["memory"]
    longer = found.longer(300).forecast
    assert longer is not None and longer.other_seconds == found.forecast.other_seconds
    on_gpu = chosen(QUALITIES["normal"], estimated(gpu=GpuEstimate(10**9, 10**8, 8e2, 8 * 10**9)), 40, 100)
    assert on_gpu.forecast is not None and on_gpu.forecast.other_seconds is None
    assert "come on top" in dict(rows(on_gpu))["time"]


def test_a_longer_run_takes_as_much_longer():
    found = chosen(QUALITIES["normal"], estimated(), 40, 100).longer(300)
    assert found.steps == 300 and found.forecast is not None and found.forecast.seconds == 180
    assert Decisions("surface", "", 1, 1).longer(3).forecast is None
