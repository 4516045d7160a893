"""The recipes say what was published."""

from dataclasses import replace

import pytest

from surfkit.cli.recipes import recipes
from surfkit.compress.vectree import Vectree
from surfkit.core.check import BadInput
from surfkit.losses import L1, SSIM, Distortion, NormalConsistency
from surfkit.pipeline import with_steps
from surfkit.primitives import Gaussian3D, Surfel2D
from surfkit.train.stage import rates_of


def test_3dgs():
    recipe = recipes()["3dgs"]
    stage, grow = recipe.pretrain, recipe.pretrain.densify
    assert recipe.primitive == Gaussian3D(sh_degree=3, antialias=False)
    assert (stage.steps, stage.sh_every) == (30_000, 1_000)
    assert stage.losses == {"l1": L1(weight=0.8), "ssim": SSIM(weight=0.2)}
    assert (grow.threshold, grow.small, grow.start, grow.until, grow.every) == (2e-4, 0.01, 500, 15_000, 100)
    assert (grow.cull_opacity, grow.cull_scale, grow.reset_every, grow.reset_opacity) == (0.005, 0.1, 3_000, 0.01)
    assert stage.signal.terms is None and stage.signal.boost == 0
    at = {name: (rate.at(0, 30_000), rate.at(30_000, 30_000)) for name, rate in rates_of(stage, Surfel2D()).items()}
    assert at["means"] == pytest.approx((1.6e-4, 1.6e-6))
    constant = {"scales": 5e-3, "quats": 1e-3, "opacities": 5e-2, "sh0": 2.5e-3, "sh_rest": 1.25e-4}
    assert {name: ends for name, ends in at.items() if name != "means"} == {k: (v, v) for k, v in constant.items()}


def test_2dgs():
    recipe = recipes()["2dgs"]
    losses = recipe.pretrain.losses
    assert recipe.primitive == Surfel2D(sh_degree=3)
    assert losses["normal"] == NormalConsistency(weight=0.05, start=7_000, depth="expected")
    assert isinstance(losses["distortion"], Distortion) and losses["distortion"].weight_at(20_000, 30_000) == 0
    assert recipe.pretrain.densify.cull_opacity == 0.05
    assert recipe.pretrain.rates == recipes()["3dgs"].pretrain.rates


@pytest.mark.parametrize("name", ["2dgs", "3dgs"])
@pytest.mark.parametrize("steps", [1, 7, 300, 1_000, 2_000, 7_000, 30_000, 60_000])
def test_any_number_of_steps_is_the_whole_schedule(name, steps):
    stage = with_steps(recipes()[name], steps).pretrain
    assert stage.steps == steps
    assert abs(stage.densify.until - steps / 2) <= 0.5
    assert abs(stage.sh_every - max(1, steps / 30)) <= 0.5
    assert 1 <= stage.densify.every <= max(100, steps / 300)
    if name == "2dgs":
        assert abs(stage.losses["normal"].start - steps * 7 / 30) <= 0.5


def test_no_steps_are_refused():
    with pytest.raises(BadInput, match="--steps 0"):
        with_steps(recipes()["3dgs"], 0)


def test_citygs2_coarse_is_the_last_row_of_the_upper_half_of_the_ablation_table():
    from surfkit.recipes.ablations import MODEL
    from surfkit.report.ablation import build

    *_, last = build(MODEL).values()
    assert replace(recipes()["citygs2-coarse"], about=last.about, mesh=last.mesh) == last
    assert last.pretrain.signal.boost == 0.9 and last.pretrain.signal.terms == ("ssim",)


def test_published_settings_of_the_other_recipes():
    known = recipes()
    flat, absolute, trimmed, light = (known[n].pretrain for n in ("flat3dgs", "absgs", "trim2dgs", "lightgaussian"))
    assert flat.losses["normal"].weight == 0.0125
    assert absolute.signal.absolute and (absolute.densify.threshold, absolute.densify.small) == (4e-4, 0.001)
    trim = trimmed.prune[0]
    assert (trim.ratio, trim.start, trim.until, trim.every, trimmed.steps) == (0.1, 31_000, 37_000, 500, 37_000)
    pruned, distilled = known["lightgaussian"].refine
    drop = pruned.stage.prune[0]
    assert (drop.at, drop.ratio, drop.power) == ((0,), 0.66, 0.1) and distilled.sh_degree == 2
    assert (light.steps, pruned.stage.steps, distilled.stage.steps) == (30_000, 5_000, 5_000)
    assert known["lightgaussian"].compress == Vectree(ratio=0.6, codes=8192)


def test_citygs2_t_begins_its_blocks_from_the_first_7000_steps_of_the_same_pretraining():
    whole, tiny = recipes()["citygs2-s"], recipes()["citygs2-t"]
    assert tiny.pretrain.steps == 7_000 and tiny.tune == whole.tune
    for index in (1, 2_500, 7_000):
        for name, rate in rates_of(whole.pretrain, whole.primitive).items():
            assert rates_of(tiny.pretrain, tiny.primitive)[name].at(index, 7_000) == pytest.approx(
                rate.at(index, 30_000)
            )
        for name, loss in whole.pretrain.losses.items():
            assert tiny.pretrain.losses[name].weight_at(index, 7_000) == pytest.approx(loss.weight_at(index, 30_000))
    assert tiny.pretrain.densify == whole.pretrain.densify


def test_citygs2_trims_by_the_mean_as_the_paper_does():
    (trim,) = recipes()["citygs2"].tune.prune
    assert (trim.ratio, trim.score, trim.gamma, trim.start, trim.until, trim.every) == (
        0.025, "mean", 0.5, 1_000, 15_000, 500,
    )  # fmt: skip


def test_citygs2_short_goes_on_at_the_pace_of_pretraining():
    whole, short = recipes()["citygs2"], recipes()["citygs2-short"]
    assert short.pretrain == whole.pretrain and short.tune.rates == short.pretrain.rates != whole.tune.rates
    assert replace(short.tune, rates=whole.tune.rates, prune=whole.tune.prune) == whole.tune and not short.tune.prune


def test_citygs2_for_streets():
    street, at = recipes()["citygs2-street"], {}
    for part in ("pretrain", "tune"):
        stage = getattr(street, part)
        at[part] = [rates_of(stage, Surfel2D())["means"].at(step, stage.steps) for step in (0, stage.steps)]
        assert stage.densify.reset_every >= stage.densify.until  # never
    assert at == {"pretrain": pytest.approx([1.6e-5, 1.6e-6]), "tune": pytest.approx([8e-6, 8e-7])}
    assert street.assign.least == 0.01 and street.partition.blocks == (5, 4) and street.tune.prune == ()
