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
        ("pretrain.marks.2", "pretrain.marks has no position '2'; its positions are 0 to 1"),
        ("tune.steps", "tune is None, which has no 'steps' inside; set tune itself"),
        ("pretrain.steps", "pretrain.steps: steps is 0; it must be 1 or more"),
    ],
)
def test_wrong_paths_and_values(world, path, message):
    with pytest.raises(BadInput) as caught:
        evolve(world.Recipe(), path, 0)
    assert str(caught.value).startswith(message)
