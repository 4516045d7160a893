import torch

from surfkit.primitives import Surfel2D
from surfkit.primitives.base import apply
from surfkit.primitives.points import Edit, Points, merge, withheld


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
    assert all(v.device.type == "meta" for group in vars(moved).values() for v in group.values())


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


def test_merge_adds_nudges_and_makes_the_most_copies():
    a = Edit(clone=torch.tensor([2, 0, 1, 3]), nudge={"means": torch.ones(4, 3)}, forget=mask(0, count=4))
    b = Edit(
        clone=mask(1, 2, count=4), drop=mask(3, count=4), nudge={"means": torch.ones(4, 3), "scales": torch.ones(4, 2)}
    )
    both = merge([a, b])
    assert both.clone.tolist() == [2, 1, 1, 0] and both.forget.tolist() == [True, False, False, False]
    assert both.nudge["means"].tolist() == [[2.0] * 3] * 4 and both.nudge["scales"].tolist() == [[1.0] * 2] * 4


def test_copies_inherit_the_nudge_and_only_the_named_forget():
    points = Points.fresh({"means": torch.arange(9.0).view(3, 3), "opacities": torch.zeros(3)})
    points.exp_avg["means"] += 1
    edit = Edit(
        clone=torch.tensor([0, 2, 0]), nudge={"opacities": torch.tensor([0.0, 5, 0])},
        drop=mask(0, count=3), forget=mask(2, count=3),
    )  # fmt: skip
    after = apply(Surfel2D(), points, edit, torch.Generator())
    assert after.params["opacities"].tolist() == [5, 0, 5, 5]
    assert after.params["means"][:, 0].tolist() == [3, 6, 3, 3]
    assert after.exp_avg["means"][:, 0].tolist() == [1, 0, 0, 0], "a copy has no past"
    assert points.params["opacities"].tolist() == [0, 0, 0], "the points before the edit are as they were"


def test_copies_that_are_withheld_take_their_nudge_with_them():
    edit = Edit(
        drop=mask(0, 1),
        clone=torch.tensor([0, 2, 3, 0, 0, 0]),
        split=mask(3),
        max_opacity=0.5,
        nudge={"means": torch.ones(6, 3), "opacities": torch.ones(6)},
        forget=mask(1, 2, 5),
    )
    left = withheld(edit, mask(2, 5))
    assert left.clone.tolist() == [0, 0, 3, 0, 0, 0] and not left.split.any()
    assert torch.equal(left.drop, edit.drop) and left.max_opacity == 0.5 and torch.equal(left.forget, mask(2, 5))
    assert left.nudge["opacities"].tolist() == [1, 0, 1, 0, 1, 1]
    assert left.nudge["means"][:, 2].tolist() == [1, 0, 1, 0, 1, 1]
    quiet = Edit(drop=mask(4), nudge={"means": torch.ones(6, 3)})
    assert withheld(quiet, mask()) is quiet, "what multiplies nothing is allowed to anyone"
