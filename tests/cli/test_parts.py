"""Parts that come, change or go by a word, on the real recipes."""

from dataclasses import fields
from itertools import zip_longest

import pytest

from surfkit.appearance.base import Appearance
from surfkit.apps.ablate import AblateCommand
from surfkit.apps.train import TrainCommand
from surfkit.cli.parse import parse
from surfkit.cli.recipes import recipes
from surfkit.core.check import BadInput
from surfkit.core.registry import Component, components, derived_first, kind_of, name_of
from surfkit.densify import CountCap, Elongation, PruneByOpacity, Trim
from surfkit.densify.base import Densify, Filter, Prune, Signal
from surfkit.losses.base import Loss, Regularizer
from surfkit.losses.photometric import L1
from surfkit.losses.regularizers import MeanOpacity
from surfkit.losses.surface import Distortion
from surfkit.losses.transients import Transients
from surfkit.mesh.tsdf import TSDF
from surfkit.primitives.base import Primitive
from surfkit.train.optimizer import Optimizer
from surfkit.train.stage import Stage


def stage(*words: str):
    return parse(TrainCommand, ["recipe:2dgs", *words], "surfkit train").recipe.pretrain


def test_parts_are_added_to_a_tuple_one_after_the_other():
    made = stage("pretrain.prune.0:trim", "pretrain.prune.1:opacity", "--pretrain.prune.0.ratio", "0.1")
    assert made.prune == (Trim(ratio=0.1), PruneByOpacity())
    filters = ("pretrain.densify.filters.0:elongation", "pretrain.densify.filters.1:count-cap")
    made = stage("--pretrain.densify.filters.1.points", "5000", *filters)
    assert made.densify.filters == (Elongation(), CountCap(5000))


def test_a_part_of_the_recipe_is_swapped_or_taken_away(tmp_path):
    from surfkit.core.codec import write_json
    from surfkit.core.tree import evolve
    from surfkit.study.recipes import SURFELS

    file = tmp_path / "r.json"
    write_json(file, evolve(SURFELS, "pretrain.prune", (Trim(), PruneByOpacity())))
    for words, left in {
        ("pretrain.prune.0:none",): (PruneByOpacity(),),
        ("pretrain.prune.0:opacity",): (PruneByOpacity(), PruneByOpacity()),
        ("pretrain.prune.2:trim", "--pretrain.prune.2.gamma", "1"): (Trim(), PruneByOpacity(), Trim(gamma=1.0)),
        ("pretrain.prune.1:none", "pretrain.prune.0:none"): (),
    }.items():
        assert parse(TrainCommand, [f"recipe:{file}", *words], "surfkit train").recipe.pretrain.prune == left


@pytest.mark.parametrize(
    "words", [["--mesh.no-carve"], ["mesh:tsdf", "--mesh.no-carve"], ["--mesh.carve", "--mesh.no-carve"]]
)
def test_a_switch_of_a_part_that_nobody_chose_is_turned_off(words):
    words = ["recipe:2dgs", "--no-prepare", *words, "--mesh.voxel", "2"]
    assert parse(TrainCommand, words, "surfkit train").recipe.mesh == TSDF(voxel=2.0, carve=False)
    with pytest.raises(BadInput, match="--mesh.no-voxel; .* --mesh.voxel"):
        parse(TrainCommand, ["recipe:2dgs", "--mesh.no-voxel"], "surfkit train")


def test_entries_of_a_dict_come_change_and_go():
    made = stage("pretrain.losses.normal:none", "pretrain.losses.more:l1", "--pretrain.losses.more.weight", "0.3")
    assert list(made.losses) == ["l1", "ssim", "distortion", "more"] and made.losses["more"] == L1(0.3)
    assert stage("pretrain.losses.normal:distortion").losses["normal"] == Distortion()
    assert stage("pretrain.regularizers.o:mean-opacity").regularizers == {"o": MeanOpacity()}


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["pretrain.prune.0:trimm"], "no pretrain.prune.0 named 'trimm'; did you mean 'trim'"),
        (["pretrain.prune.1:trim"], "nothing to choose at 'pretrain.prune.1'; did you mean 'pretrain.prune.0'"),
        (["pretrain.prune.0:none"], "no pretrain.prune.0 named 'none'"),
        (["pretrain.losses.normal:nrmal"], "no pretrain.losses.normal named 'nrmal'; did you mean 'normal'"),
        (["pretrain.losses.foo:none"], "no pretrain.losses.foo named 'none'"),
        (["pretrain.prune.0:trim", "pretrain.prune.0:opacity"], "pretrain.prune.0 is chosen twice"),
        (["pretrain.prune.0:trim", "--pretrain.prune.0.rat", "1"], "--pretrain.prune.0.ratio"),
        (["--pretrain.prune.0.ratio", "1"], "belongs to pretrain.prune.0:importance or pretrain.prune.0:trim, which"),
    ],
)
def test_words_that_do_not_fit_are_explained_in_a_line(words, said):
    with pytest.raises(BadInput) as caught:
        stage(*words)
    assert said in str(caught.value) and "\n" not in str(caught.value)


def test_taking_away_a_loss_that_drives_densification_is_refused(tmp_path):
    with pytest.raises(BadInput, match="signal.terms names ssim"):
        stage("--pretrain.signal.terms", "ssim", "pretrain.losses.ssim:none")


SLOTS = {
    Primitive: "primitive",
    Loss: "pretrain.losses.extra",
    Regularizer: "pretrain.regularizers.extra",
    Appearance: "pretrain.appearance",
    Transients: "pretrain.transients",
    Signal: "pretrain.signal",
    Optimizer: "pretrain.optimizer",
    Densify: "pretrain.densify",
    Filter: "pretrain.densify.filters.{}",
    Prune: "pretrain.prune.{}",
}


@pytest.mark.parametrize("recipe", ["3dgs", "citygs2-coarse"])
def test_every_component_can_be_put_into_a_recipe_by_a_word(recipe):
    """One for each slot at a time; what is about `densify` itself apart, as its filters are its own."""
    filters = len(recipes()[recipe].pretrain.densify.filters)
    offered = {slot.format(filters if base is Filter else 0): components(base) for base, slot in SLOTS.items()}
    assert all(offered.values())
    densify = [{f"pretrain.densify:{name}": cls} for name, cls in offered.pop("pretrain.densify").items()]
    rounds = zip_longest(*([(f"{slot}:{name}", cls) for name, cls in known.items()] for slot, known in offered.items()))
    for words in [*densify, *(dict(filter(None, pairs)) for pairs in rounds)]:
        made = parse(TrainCommand, [f"recipe:{recipe}", *words], "surfkit train").recipe
        for word, cls in words.items():
            assert isinstance(at(made, word.partition(":")[0]), cls), word


def at(made, path):
    """What stands at a dotted path."""
    for step in path.split("."):
        if isinstance(made, dict):
            made = made[step]
        else:
            made = made[int(step)] if step.isdecimal() else getattr(made, step)
    return made


def test_a_choice_that_is_not_there_is_no_value_of_the_option_before_it(tmp_path):
    with pytest.raises(BadInput, match="no executor named 'polo'; did you mean 'pool'"):
        parse(AblateCommand, ["--data", str(tmp_path), "executor:polo"], "surfkit ablate")


@pytest.mark.parametrize("words", [["executor:pool"], ["--executor", "pool"], ["--executor", "executor:pool"]])
def test_every_way_to_write_a_choice(words, tmp_path):
    words = ["--data", str(tmp_path), *words, "--executor.workers", "3"]
    assert parse(AblateCommand, words, "surfkit ablate").executor.workers == 3


def parts_of(recipe):
    """Paths and parts of its slots, and of those of its stages."""
    for slot in fields(recipe):
        part = getattr(recipe, slot.name)
        inner = (
            {f"{slot.name}.{each.name}": getattr(part, each.name) for each in fields(part)}
            if isinstance(part, Stage)
            else {}
        )
        yield from ((path, one) for path, one in {slot.name: part, **inner}.items() if isinstance(one, Component))


DERIVED = sorted(
    (path, base, name)
    for name, recipe in recipes().items()
    for path, part in parts_of(recipe)
    for base, cls in components(kind_of(type(part))).items()
    if cls is not type(part) and isinstance(part, cls)
)
"""Slots, names of a part that theirs is derived from, and recipes."""


@pytest.mark.parametrize(("path", "base", "name"), {each[:2]: each for each in DERIVED}.values())
def test_a_part_is_swapped_for_the_one_that_it_is_derived_from(path, base, name):
    """tyro takes a default for the first name whose class it is an instance of."""
    made = parse(TrainCommand, [f"recipe:{name}", f"{path}:{base}"], "surfkit train").recipe
    assert name_of(dict(parts_of(made))[path]) == base


def test_derived_classes_come_before_their_bases_and_others_keep_their_order():
    class Base: ...

    class Other: ...

    class Child(Base): ...

    class Grandchild(Child): ...

    known = {"base": Base, "other": Other, "grandchild": Grandchild, "child": Child}
    assert [name for name, _ in derived_first(known)] == ["grandchild", "child", "base", "other"]
    assert [name for name, _ in derived_first({"other": Other, "base": Base})] == ["other", "base"]
