import numpy as np

from surfkit.scene.set_membership import MAX_CACHED_NUMBERS, is_among


def test_as_the_sets_of_python() -> None:
    draw = np.random.default_rng(0)
    for size in (0, 1, 2, 50, 1000, 4 * MAX_CACHED_NUMBERS):
        values, others = draw.integers(-size, size, size), draw.integers(0, size + 1, size // 2)
        for some, those in ((values, others), (others, values)):
            known = set(those.tolist())
            assert is_among(some, those).tolist() == [value in known for value in some.tolist()]
