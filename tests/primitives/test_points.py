from types import SimpleNamespace

import pytest
import torch

from surfkit.core.check import BadInput
from surfkit.primitives import Surfel2D
from surfkit.primitives.edit import Edit, NewPoints, apply, merge, withheld
from surfkit.primitives.points import Points
from surfkit.train.policies import wanted


def points(count: int = 6) -> Points:
    params = {"means": torch.arange(3.0 * count).view(count, 3), "opacities": torch.arange(1.0 * count)}
    made = Points.fresh(params)
    for group, size in ((made.exp_avg, 10.0), (made.exp_avg_sq, 100.0)):
        for name, value in params.items():
            group[name] = value + size
    made.stat("a/count").copy_(torch.arange(1.0 * count))
    return made


def mask(*rows: int, count: int = 6) -> torch.Tensor:
    return torch.zeros(count, dtype=torch.bool).index_fill(0, torch.tensor(rows, dtype=torch.int64), True)


def test_take_moves_every_column_with_its_row():
    taken = points().take(torch.tensor([4, 1]))
    assert taken.params["opacities"].tolist() == [4, 1]
    assert taken.exp_avg["opacities"].tolist() == [14, 11]
    assert taken.exp_avg_sq["means"][:, 0].tolist() == [112, 103]
    assert taken.stat("a/count").tolist() == [4, 1]


@pytest.mark.parametrize(
    ("asked", "message"),
    [
        (Edit(drop=torch.ones(6)), r"drop is torch.float32 of shape \(6,\); .*bool of shape \(6,\)"),
        (Edit(drop=torch.ones(6, dtype=torch.int64)), "drop is torch.int64"),
        (Edit(split=torch.tensor([2, 5])), r"split is torch.int64 of shape \(2,\)"),
        (Edit(clone=mask(1, count=5)), r"clone is torch.bool of shape \(5,\); .*bool or int64"),
        (Edit(move=torch.ones(6)), r"move is .*float32 or float64 of shape \(6, 3\)"),
        (Edit(opacities=0.5), "opacities is float; it must be"),
        (mask(1), "edit gives Tensor; .*surfkit.Edit"),
    ],
)
def test_what_a_policy_gives_must_fit_the_points(asked, message):
    """A mask of whole numbers would be inverted bit by bit, and then be rows: all points but two would be lost."""

    class Policy:
        def watch(self, points, step):
            pass

        def edit(self, points, step):
            return asked

    setup = SimpleNamespace(processes=None, stage=SimpleNamespace(policies=[Policy()]))
    state, step = SimpleNamespace(points=points()), SimpleNamespace(owns=None)
    with pytest.raises(BadInput, match=message):
        wanted(setup, state, step)
    asked = Edit(drop=mask(1), clone=torch.ones(6, dtype=torch.int64), move=torch.ones(6, 3))
    assert wanted(setup, state, step).counts == (1, 5, 0)
    asked = None
    assert wanted(setup, state, step) is None


def test_new_rows_start_without_a_past():
    grown = points().append({"means": torch.ones(2, 3), "opacities": torch.full((2,), 9.0)})
    assert len(grown) == 8 and grown.params["opacities"][-2:].tolist() == [9, 9]
    for group in (grown.exp_avg, grown.exp_avg_sq):
        assert group["means"].shape == (8, 3) and not group["means"][-2:].any() and group["means"][:6].any()
    assert grown.stat("a/count").tolist() == [0, 1, 2, 3, 4, 5, 0, 0]


def test_a_statistic_begins_at_zero_and_is_kept():
    made = points()
    made.stat("b/sum").add_(2)
    assert made.stat("b/sum").tolist() == [2] * 6


def test_to_moves_every_group():
    moved = points().to("meta")
    assert all(v.device.type == "meta" for group in moved.groups for v in group.values())


def test_merge_lets_drop_win_over_split_and_split_over_clone():
    merged = merge([Edit(drop=mask(0, 1), max_opacity=0.5), None, Edit(clone=mask(1, 2, 3), split=mask(0, 3, 4))])
    assert torch.equal(merged.drop, mask(0, 1))
    assert torch.equal(merged.clone, mask(2))
    assert torch.equal(merged.split, mask(3, 4))
    assert merged.max_opacity == 0.5


def test_merge_joins_masks_and_keeps_the_lowest_cap():
    merged = merge([Edit(drop=mask(0), max_opacity=0.2), Edit(drop=mask(5), max_opacity=0.01)])
    assert torch.equal(merged.drop, mask(0, 5)) and merged.max_opacity == 0.01
    assert merged.clone is None and merged.split is None


def test_merge_of_nothing_is_nothing():
    assert merge([None, None]) is None and merge([]) is None


def test_merge_adds_moves_multiplies_factors_and_makes_the_most_copies():
    half, nan = torch.full((4,), 0.5), torch.full((4,), torch.nan)
    a = Edit(
        clone=torch.tensor([2, 0, 1, 3]), move=torch.ones(4, 3), forget=mask(0, count=4), scale_by=half, opacities=nan
    )
    b = Edit(clone=mask(1, 2, count=4), drop=mask(3, count=4), move=torch.ones(4, 3), scale_by=half, opacities=half)
    both = merge([a, b])
    assert both.clone.tolist() == [2, 1, 1, 0] and both.forget.tolist() == [True, False, False, False]
    assert both.move.tolist() == [[2.0] * 3] * 4 and both.scale_by.tolist() == [0.25] * 4
    assert both.opacities.tolist() == [0.5] * 4 and merge([a, a]).opacities.isnan().all()
    assert merge([b, Edit(opacities=torch.tensor([0.2, 0.7, torch.nan, 0.5]))]).opacities.tolist() == pytest.approx(
        [0.2, 0.5, 0.5, 0.5]
    )


def test_copies_inherit_the_change_and_only_the_named_forget():
    points = Points.fresh({"means": torch.arange(9.0).view(3, 3), "opacities": torch.zeros(3)})
    points.exp_avg["means"] += 1
    edit = Edit(
        clone=torch.tensor([0, 2, 0]), opacities=torch.tensor([torch.nan, 0.75, torch.nan]),
        drop=mask(0, count=3), forget=mask(2, count=3),
    )  # fmt: skip
    after = apply(Surfel2D(), points, edit, torch.Generator())
    assert after.params["opacities"].sigmoid().tolist() == pytest.approx([0.75, 0.5, 0.75, 0.75])
    assert after.params["means"][:, 0].tolist() == [3, 6, 3, 3]
    assert after.exp_avg["means"][:, 0].tolist() == [1, 0, 0, 0], "a copy has no past"
    assert points.params["opacities"].tolist() == [0, 0, 0], "the points before the edit are as they were"


def test_copies_that_are_withheld_take_their_changes_with_them():
    edit = Edit(
        drop=mask(0, 1),
        clone=torch.tensor([0, 2, 3, 0, 0, 0]),
        split=mask(3),
        max_opacity=0.5,
        move=torch.ones(6, 3),
        opacities=torch.full((6,), 0.5),
        scale_by=torch.full((6,), 0.5),
        forget=mask(1, 2, 5),
    )
    left = withheld(edit, mask(2, 5))
    assert left.clone.tolist() == [0, 0, 3, 0, 0, 0] and not left.split.any()
    assert torch.equal(left.drop, edit.drop) and left.max_opacity == 0.5 and torch.equal(left.forget, mask(2, 5))
    assert left.opacities.nan_to_num(-1).tolist() == [0.5, -1, 0.5, -1, 0.5, 0.5]
    assert left.scale_by.tolist() == [0.5, 1, 0.5, 1, 0.5, 0.5]
    assert left.move[:, 2].tolist() == [1, 0, 1, 0, 1, 1]
    quiet = Edit(drop=mask(4), move=torch.ones(6, 3))
    assert withheld(quiet, mask()) is quiet, "what adds nothing is allowed to anyone"


def test_shared_parameters_belong_to_no_point():
    params = {"means": torch.arange(9.0).view(3, 3), "net": torch.ones(3, 2)}
    points = Points.fresh(params, ["net"])
    points.exp_avg["net"] += 1
    assert len(points) == 3 and list(points.params) == ["means"] and points.all_params().keys() == {"means", "net"}
    fewer = points.take(mask(0, count=3))
    more = points.append({"means": torch.zeros(2, 3)})
    for found, count in ((fewer, 1), (more, 5)):
        assert len(found) == count and found.exp_avg["means"].shape == (count, 3)
        assert torch.equal(found.shared["net"], params["net"]) and found.exp_avg["net"].tolist() == [[1, 1]] * 3


def rows(table: Points, parent: list[int]) -> NewPoints:
    """Points at the height of their parents' numbers, otherwise copies."""
    params = table.take(torch.tensor(parent)).params
    return NewPoints(
        params | {"means": torch.tensor(parent).float()[:, None].expand(-1, 3).clone()}, torch.tensor(parent)
    )


def test_new_points_come_last_and_have_no_past():
    table = points(4)
    for group in (table.exp_avg, table.exp_avg_sq):
        for value in group.values():
            value.fill_(2.0)
    table.stat("seen").fill_(5)
    first = mask(0, count=4)
    edit = merge([Edit(drop=first, new=rows(table, [0, 3])), Edit(clone=first.roll(1), new=rows(table, [2]))])
    assert edit.counts == (1, 4, 0)
    grown = apply(Surfel2D(), table, edit, torch.Generator())
    assert len(grown) == 3 + 1 + 3
    assert grown.params["means"][-3:, 0].tolist() == [0, 3, 2], "also of a dropped parent"
    assert not grown.exp_avg["means"][-3:].any() and grown.stats["seen"].tolist() == [5, 5, 5, 0, 0, 0, 0]
    assert (grown.exp_avg["means"][:3] == 2).all()
    left = withheld(edit, torch.tensor([False, True, True, False]))
    assert left.new.parent.tolist() == [2] and left.clone.tolist() == edit.clone.tolist()
    alone = withheld(Edit(new=rows(table, [1, 2]), drop=first), torch.tensor([False, True, False, False]))
    assert alone.new.parent.tolist() == [1] and alone.drop is first


def test_values_take_the_place_of_parameters():
    """Those of points and shared ones; copies are made afterwards, and the last of several counts."""
    table = points(3)
    table = Points(table.params, table.exp_avg, table.exp_avg_sq, shared={"net": torch.zeros(2)})
    opacities = torch.tensor([1.0, 2.0, 3.0])
    before = Edit(values={"opacities": torch.zeros(3), "net": torch.ones(2)})
    edit = merge([before, Edit(values={"opacities": opacities}, clone=torch.tensor([False, False, True]))])
    changed = apply(Surfel2D(), table, edit, torch.Generator())
    assert changed.params["opacities"].tolist() == [1, 2, 3, 3] and changed.shared["net"].tolist() == [1, 1]
    assert not table.shared["net"].any(), "the points before are as they were"
    for wrong in ({"wings": opacities}, {"net": torch.ones(3)}):
        with pytest.raises(BadInput, match="Edit.values: "):
            apply(Surfel2D(), table, Edit(values=wrong), torch.Generator())


def test_a_statistic_may_have_several_numbers_for_each_point():
    table = points(3)
    table.stat("each", 2)[1] = torch.tensor([4.0, 5.0])
    assert table.stat("each", 2).shape == (3, 2)
    assert table.take(torch.tensor([1])).stats["each"].tolist() == [[4, 5]]
    assert table.append(table.params).stats["each"].shape == (6, 2)
