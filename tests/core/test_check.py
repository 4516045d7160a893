import numpy as np
import pytest

from surfkit.core.check import BadInput, expect


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
