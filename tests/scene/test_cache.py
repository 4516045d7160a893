"""Memory stays within the budget, values are read in the coming order, and nothing depends on either."""

import resource
import threading

import pytest

from surfkit.core.check import BadInput
from surfkit.scene import available_memory as memory
from surfkit.scene.available_memory import cache_bytes, free_bytes
from surfkit.scene.byte_semaphore import ByteSemaphore
from surfkit.scene.cache import Cache, share


class Shelf:
    """Values to read: position n gives n * 10, and it is written down that it was read."""

    def __init__(self):
        self.read, self.lock = [], threading.Lock()

    def __call__(self, at):
        with self.lock:
            self.read.append(at)
        return at * 10


def settle(cache):
    """Wait for what is being read."""
    for future in list(cache._kept.values()):
        future.result()


def test_everything_is_read_once_without_a_budget():
    shelf = Shelf()
    cache = Cache(shelf, [1] * 30)
    for _ in range(3):
        assert [cache[at] for at in range(30)] == [at * 10 for at in range(30)]
    assert sorted(shelf.read) == list(range(30)) and cache.bytes == 30
    assert cache[-1] == 290 and len(cache) == 30
    with pytest.raises(IndexError):
        cache[30]


@pytest.mark.parametrize("budget", [0, 5, 17, 40, 1000])
@pytest.mark.parametrize("threads", [1, 3])
def test_any_budget_gives_the_same_values_within_it(budget, threads):
    cache = Cache(Shelf(), [at % 7 + 1 for at in range(25)], budget, threads)
    for order in (range(25), range(24, -1, -1), [3, 3, 9, 24, 0, 9]):
        cache.expect(list(order))
        for at in order:
            assert cache[at] == at * 10
            assert cache.bytes <= max(budget, 7)


def test_looking_aside_changes_nothing_that_is_foreseen():
    shelf = Shelf()
    cache = Cache(shelf, [1] * 40, 12, threads=1)
    order = [*range(20, 40), *range(20)]
    cache.expect(order)
    for turn, at in enumerate(order):
        assert cache[at] == at * 10
        needed, now = dict(cache._needed), cache._turn
        assert cache.aside((at * 7 + 3) % 40) == (at * 7 + 3) % 40 * 10 and cache.bytes <= 12
        assert cache._needed == needed and cache._turn == now == turn
        settle(cache)
    plain = Shelf()
    cache = Cache(plain, [1] * 40, 12, threads=1)
    for at in range(40):
        assert cache[at] == at * 10
        settle(cache)
    assert len(shelf.read) <= len(plain.read) + 60, "what is looked at aside is read, and seldom anything twice"


def test_reading_follows_the_coming_order():
    shelf = Shelf()
    cache = Cache(shelf, [1] * 40, threads=1)
    settle(cache)
    before = len(shelf.read)
    coming = list(range(39, before, -1))
    cache.expect(coming)
    for at in coming:
        cache[at]
    assert shelf.read[before:] == coming


def test_what_is_kept_from_the_last_order_is_used_in_the_next():
    """With room for 60 of 100, about 60 of the next 100 need no reading."""
    shelf = Shelf()
    cache = Cache(shelf, [1] * 100, 60, threads=1)
    generator = __import__("random").Random(0)
    for _ in range(3):
        before, order = len(shelf.read), generator.sample(range(100), 100)
        cache.expect(order)
        for at in order:
            cache[at]
            settle(cache)
    assert 38 <= len(shelf.read) - before <= 46


def test_a_failure_is_raised_where_it_is_asked_for_and_nowhere_else():
    def read(at):
        if at == 2:
            raise BadInput("two.png: not a whole picture")
        return at

    cache = Cache(read, [1] * 5)
    assert [cache[at] for at in (0, 1, 3, 4)] == [0, 1, 3, 4]
    for _ in range(2):
        with pytest.raises(BadInput, match="two.png"):
            cache[2]


def test_a_failure_is_not_kept():
    short = [True]

    def read(at):
        if short[0]:
            raise MemoryError
        return at

    cache = Cache(read, [5] * 3, threads=1)
    settle_failed(cache)
    with pytest.raises(MemoryError):
        cache[1]
    short[0] = False
    assert cache.bytes == 10 and cache[1] == 1


def settle_failed(cache):
    """Wait for what is being read, and goes wrong."""
    for future in list(cache._kept.values()):
        future.exception()


def test_a_smaller_budget_lets_go_at_once():
    shelf = Shelf()
    cache = Cache(shelf, [10] * 20, threads=1)
    for at in range(20):
        assert cache[at] == 10 * at
    assert cache.bytes == 200
    cache.resize(35)
    assert cache.bytes == 30 and cache.budget == 35
    cache.expect(range(20))
    for at in range(20):
        assert cache[at] == 10 * at and cache.bytes <= 35
    cache.resize(0)
    assert cache.bytes == 0 and cache[3] == 30 and cache.bytes == 10


def test_a_gate_lets_in_what_fits_and_one_that_does_not():
    gate, taken, most = ByteSemaphore(100), [0], [0]
    lock, both = threading.Lock(), threading.Barrier(2)

    def work(count):
        with gate.taking(count):
            with lock:
                taken[0] += count
                most[0] = max(most[0], taken[0])
            if count == 50:
                both.wait()  # two of them are in at the same time
            with lock:
                taken[0] -= count

    threads = [threading.Thread(target=work, args=(count,)) for count in (50, 50, 70, 70, 300, 70)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert most[0] == 300 and gate.taken == 0


def test_no_two_large_ones_are_in_a_gate():
    gate = ByteSemaphore(100)
    entered = threading.Event()

    def work():
        with gate.taking(40):
            entered.set()

    with gate.taking(70):
        other = threading.Thread(target=work)
        other.start()
        assert not entered.wait(0.05) and gate.taken == 70
    other.join(60)
    assert entered.is_set() and gate.taken == 0


def test_a_closed_cache_reads_nothing_more():
    shelf = Shelf()
    cache = Cache(shelf, [1] * 100, threads=1)
    cache[0]
    cache.close()
    assert len(shelf.read) < 20


def test_shares():
    assert share(100, [30, 10, 0]) == [75, 25, 0]
    assert share(None, [3, 1]) == [None, None] and share(100, [0, 0]) == [0, 0]


@pytest.mark.parametrize(
    ("text", "size"), [("4GB", 4e9), ("500 MB", 5e8), ("1.5g", 1.5e9), ("2GiB", 2**31), ("0", 0), ("123", 123)]
)
def test_sizes_are_read(text, size):
    assert cache_bytes(text) == size


@pytest.mark.parametrize("text", ["", "much", "-4GB", "4 XB", "4i"])
def test_other_sizes_are_refused(text):
    with pytest.raises(BadInput, match="give a size such as 4GB"):
        cache_bytes(text)


@pytest.mark.parametrize("version", [1, 2])
def test_limits_of_control_groups_are_respected(tmp_path, monkeypatch, version):
    """The tightest group counts, and pages of cached files count as free."""
    names = [("memory.max", "memory.current"), ("memory.limit_in_bytes", "memory.usage_in_bytes")][version == 1]
    root = tmp_path / ("memory" if version == 1 else "")
    for path, most, used in (("", "max", 7), ("outer", 5_000_000, 4_000_000), ("outer/inner", 9_000_000, 1)):
        folder = root / path
        folder.mkdir(parents=True, exist_ok=True)
        (folder / names[0]).write_text(f"{most}\n")
        (folder / names[1]).write_text(f"{used}\n")
    (root / "outer/memory.stat").write_text(
        f"anon 3\n{'total_inactive_file' if version == 1 else 'inactive_file'} 200000\n"
    )
    (tmp_path / "own").write_text("4:cpu,memory:/outer/inner\n" if version == 1 else "0::/outer/inner\n")
    monkeypatch.setattr(memory, "CGROUP_ROOT", tmp_path)
    monkeypatch.setattr(memory, "PROCESS_CGROUP", tmp_path / "own")
    assert free_bytes() == 1_200_000 and cache_bytes("auto") == 600_000
    monkeypatch.setattr(memory, "PROCESS_CGROUP", tmp_path / "none")
    assert free_bytes() > 1_200_000


def test_the_limit_of_the_address_space_is_respected():
    import psutil

    limits = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (psutil.Process().memory_info().vms + 300_000_000, limits[1]))
    try:
        assert 200_000_000 < free_bytes() <= 500_000_000  # threads come and go meanwhile
    finally:
        resource.setrlimit(resource.RLIMIT_AS, limits)
