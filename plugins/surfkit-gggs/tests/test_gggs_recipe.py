"""The recipe: its weights are those of the paper, and its row stands in the table of methods."""

import pytest
import surfkit_gggs
from surfkit_gggs import GGGS
from surfkit_gggs.mesher import SolidField

from surfkit.core.registry import plugins
from surfkit.plugin import Mesher, components
from surfkit.study.ablation import build, offered_tables


@pytest.fixture(autouse=True)
def offered():
    """The plugin, as if it were installed, where it is not."""
    there = SolidField in components(Mesher).values()
    if not there:
        plugins().register(surfkit_gggs, "gggs of this test")
    yield
    if not there:
        plugins().unregister(surfkit_gggs)


def test_the_weights_are_those_of_the_paper():
    early, late = GGGS.pretrain.weights_at(7_000), GGGS.pretrain.weights_at(7_001)
    assert early.keys() == {"l1", "ssim"}
    assert (late["normal"], late["patches"], late["reprojection"]) == (0.05, 0.6, 0.02)
    assert GGGS.primitive.geometry == "solid"
    assert {GGGS.pretrain.losses[name].depth for name in ("normal", "reprojection", "patches")} == {"median"}
    GGGS.refuse_unfit()


def test_its_row_stands_in_the_table_of_methods():
    table = offered_tables()["methods"]
    assert any(row.label == "GGGS" for row in table.rows) and build(table)["GGGS"].pretrain == GGGS.pretrain
