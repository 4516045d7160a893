import numpy as np
import pytest

from surfkit.core.check import BadInput
from surfkit.core.codec import dump, load
from surfkit.core.tree import evolve


@pytest.mark.parametrize(
    ("path", "value", "read"),
    [
        ("about", "new", lambda r: r.about),
        ("pretrain.steps", 7, lambda r: r.pretrain.steps),
        ("pretrain.losses.l1.weight", 0.5, lambda r: r.pretrain.losses["l1"].weight),
        ("pretrain.prune.0.cap", 5, lambda r: r.pretrain.prune[0].cap),
        ("pretrain.grow", None, lambda r: r.pretrain.grow),
    ],
)
def test_one_value_changes(world, path, value, read):
    base = world.Recipe(pretrain=world.Stage(prune=(world.Relocate(),)))
    before = dump(base)
    changed = evolve(base, path, value)
    assert read(changed) == value
    assert dump(base) == before
    assert load(world.Recipe, dump(changed)) == changed != base


def test_a_dict_may_gain_a_key(world):
    changed = evolve(world.Recipe(), "pretrain.losses.more", world.L1(weight=3.0))
    assert list(changed.pretrain.losses) == ["l1", "depth", "more"]


@pytest.mark.parametrize(
    ("path", "message"),
    [
        ("pretrian.steps", "Recipe has no 'pretrian'; it has about, mode, pretrain, tune"),
        ("pretrain.stepz", "pretrain has no 'stepz'; it has steps, losses"),
        ("pretrain.losses.ssim.weight", "pretrain.losses has no 'ssim'; it has l1, depth"),
        ("pretrain.prune.0.cap", "pretrain.prune has no position '0'; it is empty"),
        ("pretrain.marks.3", "pretrain.marks has no position '3'; its positions are 0 to 1"),
        ("tune.steps", "tune is None, which has no 'steps' inside; set tune itself"),
        ("pretrain.steps", "pretrain.steps: steps is 0; it must be 1 or more"),
    ],
)
def test_wrong_paths_and_values(world, path, message):
    with pytest.raises(BadInput) as caught:
        evolve(world.Recipe(), path, 0)
    assert str(caught.value).startswith(message)


def test_a_part_may_be_given_by_its_name(world):
    changed = evolve(world.Recipe(), "pretrain.grow", "adaptive")
    assert changed.pretrain.grow == world.Adaptive()
    more = evolve(changed, "pretrain.prune.0", "relocate")
    assert more.pretrain.prune == (world.Relocate(),), "the first of an empty list, as on the command line"


def test_numbers_of_numpy_are_saved_like_others(world):
    changed = evolve(world.Recipe(), "pretrain.losses.l1.weight", np.float32(0.5))
    assert load(world.Recipe, dump(evolve(changed, "pretrain.steps", np.int64(7)))).pretrain.steps == 7


@pytest.mark.parametrize(
    ("path", "value", "message"),
    [
        ("pretrain.steps", "many", 'pretrain.steps: expected a whole number, got "many"'),
        ("pretrain.steps", 2.5, "pretrain.steps: expected a whole number, got 2.5"),
        ("pretrain.losses.l1.weight", "0.5", 'pretrain.losses.l1.weight: expected a number, got "0.5"'),
        ("pretrain.losses.l1", 0.5, "pretrain.losses.l1: expected a Loss, or the name of one, got 0.5"),
        ("pretrain.grow", "adaptiv", "pretrain.grow: no Grow named 'adaptiv'; did you mean"),
        ("tune", "no", 'tune: expected a Stage, got "no"'),
    ],
)
def test_a_value_of_another_type_is_refused(world, path, value, message):
    with pytest.raises(BadInput) as caught:
        evolve(world.Recipe(), path, value)
    assert str(caught.value).startswith(message)


def test_none_takes_the_entry_of_a_dict_out(world):
    base = world.Recipe()
    assert evolve(base, "pretrain.losses.l1", None).pretrain.losses == {
        name: loss for name, loss in base.pretrain.losses.items() if name != "l1"
    }
    with pytest.raises(BadInput, match="pretrain.losses has no 'l3'"):
        evolve(base, "pretrain.losses.l3", None)


def test_keys_are_checked_too(world):
    with pytest.raises(BadInput, match="pretrain.losses: its key: expected text, got 1"):
        evolve(world.Recipe(), "pretrain.losses", {1: "l1"})


def test_what_cannot_be_saved_is_named_by_its_place(world):
    with pytest.raises(TypeError, match="pretrain.steps: float32 cannot be saved"):
        dump(world.Recipe(pretrain=world.Stage(steps=np.float32(3))))
