"""Arrays in files that several threads open at a time."""

import gc
import time
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from surfkit.scene.arrays import map_array


@pytest.fixture
def restless():
    """Every few objects that are made, another thread has its turn."""

    def turn(phase, info):
        time.sleep(0)

    before = gc.get_threshold()
    gc.set_threshold(5)
    gc.callbacks.append(turn)
    yield
    gc.callbacks.remove(turn)
    gc.set_threshold(*before)


def test_headers_are_read_by_many_threads(tmp_path, restless):
    values = np.arange(6, dtype=np.float32).reshape(2, 3)
    np.save(tmp_path / "a.npy", values)

    def deeper(count):
        return map_array(tmp_path / "a.npy") if count == 0 else deeper(count - 1)

    with ThreadPoolExecutor(4) as pool:  # threads must not be equally deep in calls, or Python notices nothing
        found = list(pool.map(lambda at: deeper(at % 4), range(800)))
    assert all(np.array_equal(one, values) for one in found)
