"""The recipes say what was published."""

from dataclasses import dataclass, field, replace
from typing import Any

import pytest

from surfkit.cli.recipes import recipes
from surfkit.compress.vectree import Vectree
from surfkit.core.check import BadInput
from surfkit.core.hooks import hookimpl
from surfkit.core.registry import plugins
from surfkit.densify import ADC, PruneByImportance, Trim
from surfkit.densify.base import Prune, Signal
from surfkit.densify.signal import LossGradient
from surfkit.io.datasets.data import Data
from surfkit.losses import L1, SSIM, Consensus, DepthRegression, Distortion, NormalConsistency
from surfkit.mesh.tsdf import TSDF
from surfkit.partition import ContractedGrid, QuantileGrid
from surfkit.primitives import Gaussian3D, Surfel2D
from surfkit.primitives.columns import RATES
from surfkit.runs.pipeline import run
from surfkit.runs.recipe import with_steps
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
    from surfkit.study.ablation import build
    from surfkit.study.recipes.ablations import MODEL_TABLE

    last = build(MODEL_TABLE)["+ depth regression"]
    assert replace(recipes()["citygs2-coarse"], about=last.about, mesh=last.mesh) == last
    assert last.pretrain.signal.boost == 0.9 and last.pretrain.signal.terms == ("ssim",)


def test_published_settings_of_the_other_recipes():
    known = recipes()
    flat, absolute, trimmed, light = (known[n].pretrain for n in ("flat3dgs", "absgs", "trim2dgs", "lightgaussian"))
    assert flat.losses["normal"].weight == 0.0125
    assert absolute.signal.absolute and absolute.densify == ADC(threshold=2e-4, split_threshold=4e-4, small=0.001)
    trim = trimmed.prune[0]
    assert (trim.ratio, trim.start, trim.until, trim.every, trimmed.steps) == (0.1, 31_000, 37_000, 500, 37_000)
    pruned, distilled = known["lightgaussian"].refine
    drop = pruned.stage.prune[0]
    assert drop == PruneByImportance(at=(0,), ratio=0.66, power=0.1, score="significance") and distilled.sh_degree == 2
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


def test_dogs_grows_for_30000_of_80000_steps_and_then_agrees():
    recipe = recipes()["dogs"]
    grown, agreed = recipe.pretrain, recipe.tune
    assert (grown.steps, agreed.steps) == (30_000, 50_000)
    assert grown.densify.until == 30_000 and agreed.densify is None and not agreed.prune
    assert [(prune.at, prune.ratio) for prune in grown.prune] == [((29_800,), 0.25)]
    assert isinstance(agreed.regularizers["consensus"], Consensus) and recipe.context == "tuned"
    whole = RATES["means"]  # one schedule of 80,000 steps, cut in two
    for at in (0, 10_000, 30_000):
        assert grown.rates["means"].at(at, 30_000) == pytest.approx(whole.at(at, 80_000))
        assert agreed.rates["means"].at(at, 50_000) == pytest.approx(whole.at(30_000 + at, 80_000))


def test_citygs2_on_the_scenes_of_its_paper():
    general = recipes()["citygs2"]
    for name, blocks, ratio in (("residence", (4, 2), 0.1), ("russian", (3, 3), 0.025), ("modern", (3, 3), 0.025)):
        scene = recipes()[f"citygs2-{name}"]
        assert scene.tune == replace(general.tune, prune=(Trim(ratio=ratio),)) and scene.pretrain == general.pretrain
        assert (scene.partition, scene.mesh) == (ContractedGrid(blocks=blocks), TSDF(1.0, 4.0, depth_limit=250.0))
    aerial = recipes()["citygs2-aerial"]
    rates = rates_of(aerial.pretrain, Surfel2D())
    assert [rates["means"].at(step, 30_000) for step in (0, 30_000)] == pytest.approx([8e-5, 8e-7])
    assert rates["scales"].start == 2.5e-3 and aerial.tune.densify.every == 200 and aerial.partition.blocks == (6, 6)
    assert aerial.mesh == recipes()["citygs2-street"].mesh == TSDF(1.0, 4.0, depth_limit=500.0)


def test_2dgs_in_blocks_has_nothing_of_what_citygs2_changes():
    plain, blocks, city = (recipes()[name] for name in ("2dgs", "2dgs-blocks", "citygs"))
    assert (blocks.primitive, blocks.pretrain, blocks.mesh) == (plain.primitive, plain.pretrain, plain.mesh)
    assert blocks.tune == replace(plain.pretrain, rates=city.tune.rates) and blocks.partition == city.partition


def test_the_released_code():
    released = recipes()["citygs2-released"]
    for stage, end in ((released.pretrain, 0.0025), (released.tune, 0.025)):
        assert stage.signal.boost == 0 and set(stage.losses) - set(stage.signal.terms) == {"l1"}
        assert stage.losses["depth"] == DepthRegression(start=0.5, end=end, error="ssim")
    assert released.primitive.sh_degree == 2 and released.tune.densify.threshold == 3e-4
    assert list(released.tune.prune[0].trims(958)) == list(range(1_000, 15_001, 500))
    aerial, street = (recipes()[f"citygs2-released-{name}"] for name in ("aerial", "street"))
    assert list(aerial.tune.prune[0].trims(5_621)) == list(range(1_000, 30_001, 500)) and not street.tune.prune
    assert aerial.pretrain == released.pretrain and (aerial.tune.steps, street.tune.steps) == (60_000, 60_000)
    assert {type(one.partition) for one in (released, aerial, street)} == {QuantileGrid}
    assert (street.pretrain.losses["depth"].error, street.tune.losses["depth"].error) == ("l1", "ssim")


def test_citygs2_for_streets():
    street, at = recipes()["citygs2-street"], {}
    for part in ("pretrain", "tune"):
        stage = getattr(street, part)
        at[part] = [rates_of(stage, Surfel2D())["means"].at(step, stage.steps) for step in (0, stage.steps)]
        assert stage.densify.reset_every >= stage.densify.until  # never
    assert at == {"pretrain": pytest.approx([1.6e-5, 1.6e-6]), "tune": pytest.approx([8e-6, 8e-7])}
    for stage in (street.pretrain, street.tune):
        assert stage.losses["depth"].scale_band == (0.01, 50.0)
    assert street.assign.threshold == 0.01 and street.partition.blocks == (5, 4) and street.tune.prune == ()


@dataclass(frozen=True)
class Listed(Prune):
    """With a setting that recipe.json could hold, and nobody could read."""

    steps: list = field(default_factory=list)
    """Of any kind."""

    def edit(self, points, step):
        return None


@dataclass(frozen=True)
class Held(Listed):
    """With a setting that recipe.json cannot hold."""

    steps: Any = field(default_factory=object)
    """Of any kind."""


@pytest.mark.parametrize("part", [Listed, Held])
def test_a_recipe_that_could_not_be_read_again_is_refused_before_it_runs(part, tmp_path):
    class Offers:
        @hookimpl
        def surfkit_components(self):
            return {"own": part}

    offers = Offers()
    plugins().register(offers, "offers")
    try:
        plain = recipes()["2dgs"]
        recipe = replace(plain, pretrain=replace(plain.pretrain, prune=(part(),)))
        with pytest.raises(BadInput, match="recipe cannot be saved: .*change the part"):
            run(recipe, Data(tmp_path), tmp_path / "out")
    finally:
        plugins().unregister(offers)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("loss", "said"),
    [
        (L1(weight=-1.0), "its weight in step 1 is -1; it must be 0 or more, and finite"),
        (SSIM(weight=float("inf")), "its weight in step 1 is inf"),
        (DepthRegression(start=1.0, end=float("inf")), r"its weight in step \d+ is inf"),
        (Distortion(weight=-0.5, start=1), r"its weight in step \d+ is -0.5"),
    ],
)
def test_weights_that_make_no_sense_are_refused(loss, said):
    """A negative one left the loss out without a word; an infinite one ended a run as if a photograph was at fault."""
    recipe = recipes()["2dgs"]
    recipe.refuse_unfit()
    stage = replace(recipe.pretrain, losses=recipe.pretrain.losses | {"other": loss})
    with pytest.raises(BadInput, match=rf"^pretrain\.losses\.other: {said}"):
        replace(recipe, pretrain=stage).refuse_unfit()


@pytest.mark.parametrize("losses", [{}, {"l1": L1(weight=0.0)}, {"l1": L1(weight=0.0), "ssim": SSIM(weight=0.0)}])
@pytest.mark.parametrize("path", ["pretrain", "tune"])
def test_a_stage_without_any_loss_is_refused(losses, path):
    recipe = recipes()["citygs2"]
    stage = replace(getattr(recipe, path), losses=losses, signal=LossGradient(terms=None))
    with pytest.raises(BadInput, match=rf"^{path}\.losses: .*{path}\.losses\.l1:l1"):
        replace(recipe, **{path: stage}).refuse_unfit()


def test_a_signal_needs_no_terms_of_its_own(tmp_path):
    """As a package may write one: it looks at the total alone."""

    @dataclass(frozen=True)
    class Half(Signal):
        def combine(self, chosen, total):
            return 0.5 * total

    recipe = with_steps(recipes()["2dgs"], 3)
    recipe = replace(recipe, pretrain=replace(recipe.pretrain, signal=Half()), mesh=None)
    recipe.refuse_unfit()
    assert recipe.pretrain.signal.terms is None
