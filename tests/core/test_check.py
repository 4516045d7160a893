import math
from types import SimpleNamespace

import numpy as np
import pytest

from surfkit.core.check import BadInput, collecting, expect, few, leaving_out, reject, require_within


def test_letters_are_bound_and_passed_on():
    sizes = expect("means", np.zeros((5, 3)), ("N", 3))
    assert sizes == {"N": 5}
    assert expect("sh", np.zeros((5, 4, 3)), ("N", "K", 3), sizes) == {"N": 5, "K": 4}
    assert sizes == {"N": 5}


@pytest.mark.parametrize(
    ("shape", "wanted", "message"),
    [
        ((5, 4), ("N", 3), r"^means: expected shape \(N, 3\), got \(5, 4\)$"),
        ((5,), ("N", 3), r"^means: expected shape \(N, 3\), got \(5,\)$"),
        ((5, 3, 1), ("N", 3), r"got \(5, 3, 1\)$"),
        ((4, 5), ("N", "N"), r"expected shape \(N, N\), got \(4, 5\)$"),
        ((6,), ("M",), r"^means: expected shape \(M,\) with M = 5, got \(6,\)$"),
    ],
)
def test_other_shapes_are_refused(shape, wanted, message):
    with pytest.raises(BadInput, match=message):
        expect("means", np.zeros(shape), wanted, {"M": 5})


def test_shapeless():
    with pytest.raises(BadInput, match="got list, which has no shape"):
        expect("means", [1, 2], ("N",))


def read_three():
    """Reads three items, of which two are wrong, and goes on where that is asked for."""
    read = []
    for item in "abc":
        with leaving_out():
            if item == "b":
                raise BadInput("b is wrong")
            read.append(item)
    if len(read) < 3:
        reject(BadInput("fewer than three"))
    return read


def test_faults_are_raised_unless_they_are_collected():
    with pytest.raises(BadInput, match="b is wrong"):
        read_three()
    with collecting() as faults:
        assert read_three() == ["a", "c"]
        with collecting() as inner:
            reject(BadInput("inner"))
        with pytest.raises(KeyError), leaving_out():
            raise KeyError("no mistake of the user")
    assert [str(fault) for fault in faults] == ["b is wrong", "fewer than three"] and len(inner) == 1
    with pytest.raises(BadInput, match="b is wrong"):
        read_three()


def test_a_few_names_stand_for_many():
    assert few(["a"]) == "'a'" and few(["a", "b", "c"]) == "'a', 'b', 'c'"
    assert few(list("abcde")) == "'a', 'b', 'c' and 2 more"


def test_settings_outside_their_range_are_named():
    ranges = {"a": (1, 5), "b": (0.5, 2.0)}
    require_within(ranges, SimpleNamespace(a=1, b=2.0))
    for a, b, said in (
        (0, 1.0, "a is 0; it must lie between 1 and 5"),
        (2, math.nan, "b is nan; it must lie between 0.5 and 2"),
        (10**400, 1.0, f"a is {10**400}; it"),
        (2, math.inf, "b is inf; it"),
    ):
        with pytest.raises(BadInput) as caught:
            require_within(ranges, SimpleNamespace(a=a, b=b))
        assert str(caught.value).startswith(said)
