from dataclasses import dataclass

import pytest

from surfkit.core.check import BadInput
from surfkit.core.describe import settings, summary
from surfkit.core.hooks import hookimpl
from surfkit.core.registry import Component, components, failures, find, kebab, kind_of, name_of
from surfkit.core.registry import offer as offer_own


def offer(registry, name, **parts):
    class Offer:
        @hookimpl
        def surfkit_components(self):
            return {key.replace("_", "-"): value for key, value in parts.items()}

    registry.plugins().register(Offer(), name)


def test_lookup_by_kind(world):
    assert components(world.Grow) == {"adaptive": world.Adaptive, "relocate": world.Relocate}
    assert list(components(Component)) == ["adaptive", "depth", "l1", "relocate"]
    assert find(world.Loss, "depth") is world.Depth
    assert name_of(world.Depth()) == "depth"
    assert kind_of(world.Depth) is world.Loss
    assert components(world.Empty) == {}


def test_unknown_names(world):
    with pytest.raises(
        BadInput,
        match="^no Grow .*'adaptiv'; .*'adaptive'. known: adaptive, relocate; or install the plugin",
    ):
        find(world.Grow, "adaptiv")
    with pytest.raises(BadInput, match="^no Empty named 'x'; known: none; or install"):
        find(world.Empty, "x")

    @dataclass(frozen=True)
    class Stranger(world.Loss):
        pass

    with pytest.raises(BadInput, match="no plugin in use offers .*Stranger"):
        name_of(Stranger())


def test_same_name_in_two_kinds_is_fine(world, bare):
    @dataclass(frozen=True)
    class Other(world.Empty):
        pass

    offer(bare, "other", depth=Other)
    assert find(world.Empty, "depth") is Other
    assert find(world.Loss, "depth") is world.Depth


def test_same_name_in_one_kind_names_both_owners(world, bare):
    @dataclass(frozen=True)
    class Other(world.Loss):
        pass

    offer(bare, "acme", depth=Other)
    with pytest.raises(BadInput, match="two .*a Loss .*'depth': .*Depth .stand-in. .*Other .acme."):
        components(world.Loss)


@dataclass
class Thawed(Component):
    pass


class Undecorated(Component):
    pass


@dataclass(frozen=True)
class Uses(Component):
    use: str = ""


@pytest.mark.parametrize(
    ("parts", "message"),
    [
        ({"thawed": Thawed}, "Thawed must be a frozen dataclass"),
        ({"undecorated": Undecorated}, "Undecorated must be a frozen dataclass"),
        ({"Uses": Uses}, "'Uses' is not a name in kebab-case"),
        ({"uses": Uses}, "has a setting named 'use'"),
        ({"int": int}, "not a subclass of surfkit.Component"),
        ({"none": None}, "not a subclass of surfkit.Component"),
    ],
)
def test_bad_offers_put_the_plugin_aside(world, bare, parts, message):
    offer(bare, "acme", **parts)
    assert set(components(world.Loss)) == {"l1", "depth"}
    assert message in failures()[0].error
    with pytest.raises(BadInput, match="plugin acme .*surfkit_components: "):
        find(world.Loss, "l2")


def test_a_built_in_mistake_is_not_hidden(bare, monkeypatch):
    offer(bare, "mine", thawed=Thawed)
    monkeypatch.setattr(bare, "BUILTIN", ("mine",))
    with pytest.raises(BadInput, match="must be a frozen dataclass"):
        components(Component)


def test_names():
    assert [kebab(name) for name in ("Prune", "LossGradient", "Surfel2D", "ADC")] == [
        "prune",
        "loss-gradient",
        "surfel2-d",
        "adc",
    ]


def test_description(world):
    assert summary(world.Adaptive) == "Clone and split."
    assert summary(Thawed) == ""
    every, reset, empty = settings(world.Adaptive)
    assert (every.name, every.type, every.default) == ("every", "int", "100")
    assert every.help == "Steps between edits, at least one."
    assert (reset.default, empty.type, empty.default) == ("3000", "list of Empty", "()")
    assert [s.type for s in settings(world.Depth)] == ["int", "int or none"]
    stage = {s.name: s for s in settings(world.Stage)}
    assert stage["grow"].default == "adaptive" and stage["grow"].help == ""
    assert stage["losses"].default == "l1: l1, depth: depth"


def test_a_part_of_a_script_is_offered_and_replaced(world, bare):
    for given in (1.0, 2.0):  # a cell of a notebook that is run again

        @dataclass(frozen=True)
        class Mine(world.Loss):
            weight: float = given

        with pytest.raises(BadInput, match=r"in a script call surfkit.offer\(NAME, Mine\)"):
            name_of(Mine())
        offer_own("mine", Mine)
        assert name_of(Mine()) == "mine" and find(world.Loss, "mine")().weight == given


def test_a_part_of_a_script_takes_no_name_of_others(world, bare):
    @dataclass(frozen=True)
    class Mine(world.Loss):
        """Mine."""

    with pytest.raises(BadInput, match="L1 .* is named 'l1' already; choose another name"):
        offer_own("l1", Mine)
    with pytest.raises(BadInput, match="not a name in kebab-case"):
        offer_own("My Loss", Mine)


def test_a_setting_without_a_type_is_refused(world, bare):
    @dataclass(frozen=True)
    class Mine(world.Loss):
        """Mine."""

        weight = 0.5

    with pytest.raises(BadInput, match=r"Mine: weight = 0.5 has no type, .* write weight: float = 0.5, or ClassVar"):
        offer_own("mine", Mine)
