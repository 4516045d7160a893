"""Arrays in files that several threads open at a time."""

import errno
import gc
import io
import time
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from surfkit.scene.arrays import map_array, write_array


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


@pytest.mark.parametrize(
    "values",
    [
        np.arange(6, dtype=np.float32).reshape(2, 3),
        np.arange(6, dtype=np.int8).reshape(2, 3).T,
        np.zeros(0, np.uint8),
        np.arange(24).reshape(2, 3, 4)[:, ::2] > 3,
    ],
)
def test_what_is_written_is_what_numpy_reads(values):
    file = io.BytesIO()
    write_array(file, values)
    file.seek(0)
    found = np.load(file)
    assert found.dtype == values.dtype and np.array_equal(found, values)


def test_a_full_disk_has_its_number():
    """`np.save` only says how many numbers it has written."""
    with pytest.raises(OSError) as error, open("/dev/full", "wb", buffering=0) as file:
        write_array(file, np.zeros(100_000, np.float32))
    assert error.value.errno == errno.ENOSPC
