import errno
import os
import resource
import signal
from contextlib import contextmanager

import pytest
import torch

from surfkit.core.check import BadInput
from surfkit.densify import ADC
from surfkit.train import checkpoint
from surfkit.train.checkpoint import before, load, load_last, restore, save
from surfkit.train.interrupt import graceful
from surfkit.train.stage import Stage

STAGE = Stage(steps=24, sh_every=6, densify=ADC(start=4, until=20, every=5, threshold=1e-6, reset_every=15))


def same(a, b) -> bool:
    groups = zip(a.points.groups, b.points.groups, strict=True)
    return all(x.keys() == y.keys() and all(torch.equal(x[k], y[k]) for k in x) for x, y in groups)


@pytest.fixture(scope="module")
def whole(request):
    """The state after a run without interruption, made once."""
    return {}


@pytest.mark.parametrize("at", [1, 6, 9, 10, 11, 15, 16, 23])
def test_an_interrupted_run_ends_with_the_same_bits(begin, whole, tmp_path, at):
    if not whole:
        trainer, state = begin(STAGE)
        list(trainer.run(state))
        whole["state"] = state
    trainer, state = begin(STAGE)
    for done in trainer.run(state):
        if done.index == at:
            break
    save(tmp_path / "c.safetensors", state)
    again = load(tmp_path / "c.safetensors")
    assert again.index == at and again.seconds == state.seconds
    list(trainer.run(again))
    assert len(again.points) > 40 and same(again, whole["state"])


def test_a_checkpoint_that_fails_midway_leaves_the_old_one(begin, tmp_path, monkeypatch):
    _, state = begin(STAGE)
    path = tmp_path / "c.safetensors"
    save(path, state)
    before = path.read_bytes()

    def full(source, target):
        raise OSError("no space left")

    monkeypatch.setattr(os, "replace", full)
    with pytest.raises(OSError, match="no space"):
        save(path, state)
    assert path.read_bytes() == before


def test_files_that_are_no_checkpoint_are_named(begin, tmp_path):
    path = tmp_path / "c.safetensors"
    path.write_bytes(b"nonsense")
    with pytest.raises(BadInput, match="no readable checkpoint"):
        load(path)
    from safetensors.torch import save_file

    save_file({"a": torch.ones(1)}, path)
    with pytest.raises(BadInput, match="format None"):
        load(path)
    _, state = begin(STAGE)
    save(path, state)
    path.write_bytes(path.read_bytes()[:-100])
    with pytest.raises(BadInput, match="no readable checkpoint"):
        load(path)


def saved_twice(begin, path):
    trainer, state = begin(STAGE)
    save(path, state)
    trainer.step(state)
    save(path, state)
    return trainer, state


def test_the_last_two_states_are_kept(begin, tmp_path):
    path = tmp_path / "c.safetensors"
    trainer, state = saved_twice(begin, path)
    assert (load(before(path)).index, load(path).index) == (0, 1)
    trainer.step(state)
    save(path, state)
    assert (load(before(path)).index, load(path).index) == (1, 2)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["c-before.safetensors", "c.safetensors"]


@pytest.mark.parametrize("where", [0.002, 0.1, 0.5, 0.999])
def test_a_flipped_bit_is_noticed_and_the_state_before_used(begin, tmp_path, where):
    path = tmp_path / "c.safetensors"
    saved_twice(begin, path)
    content = bytearray(path.read_bytes())
    content[int(where * len(content))] ^= 4
    path.write_bytes(content)
    state, damage = load_last(path)
    assert state.index == 0 and str(path) in damage
    restore(path)
    assert load_last(path)[0].index == 0 and load_last(path)[1] is None and not before(path).exists()


def test_a_cut_file_is_noticed_and_two_damaged_ones_are_named(begin, tmp_path):
    path = tmp_path / "c.safetensors"
    saved_twice(begin, path)
    path.write_bytes(path.read_bytes()[:-1])
    assert load_last(path)[0].index == 0
    before(path).write_bytes(b"")
    with pytest.raises(BadInput, match=r"c\.safetensors .*; .*c-before\.safetensors"):
        load_last(path)


def test_nothing_is_lost_between_the_two_renames(begin, tmp_path, monkeypatch):
    path, replace, calls = tmp_path / "c.safetensors", os.replace, []
    _, state = begin(STAGE)
    save(path, state)

    def dies(source, target):
        calls.append(target)
        if len(calls) == 2:
            raise KeyboardInterrupt
        replace(source, target)

    with monkeypatch.context() as patch:
        patch.setattr(os, "replace", dies)
        with pytest.raises(KeyboardInterrupt):
            save(path, state)
    assert not path.exists() and load_last(path)[1] is None and load_last(path)[0].index == 0
    assert [p.name for p in tmp_path.iterdir()] == ["c-before.safetensors"]
    save(path, state)
    assert load_last(path)[0].index == 0


@contextmanager
def small_files(most: int):
    """Within, no file can grow beyond so many bytes: what a full disk is like, as far as a test can have one."""
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (most, limits[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)


def test_a_full_disk_is_an_error_of_the_disk_and_leaves_what_was_there(begin, tmp_path):
    path = tmp_path / "c.safetensors"
    _, state = begin(STAGE)
    save(path, state)
    content = path.read_bytes()
    with small_files(len(content) // 2), pytest.raises(OSError) as error:  # noqa: PT011
        save(path, state)
    assert error.value.errno == errno.EFBIG and path.read_bytes() == content
    assert [p.name for p in tmp_path.iterdir()] == ["c.safetensors"]


def test_all_of_a_state_comes_back(begin, tmp_path):
    _, state = begin(STAGE)
    state.sh_degree, state.halvings, state.skipped, state.reset_at = 1, 2, [3], 7
    save(tmp_path / "c.safetensors", state)
    again = load(tmp_path / "c.safetensors")
    assert all(getattr(again, name) == getattr(state, name) for name in checkpoint.SCALAR_FIELDS)


def test_columns_that_do_not_fit_are_named(begin, tmp_path):
    _, state = begin(STAGE)
    state.points.exp_avg["sh0"] = state.points.exp_avg["sh0"][:-1].clone()
    save(tmp_path / "c.safetensors", state)
    with pytest.raises(BadInput, match=r"first.sh0 .*\(39, 1, 3\) .*40 points"):
        load(tmp_path / "c.safetensors")


def test_a_closed_terminal_asks_as_often_as_it_is_told_and_not_at_all_where_it_is_ignored(hangs_up):
    before = signal.getsignal(signal.SIGHUP)
    with graceful() as request:
        for _ in range(3):  # the shell tells, and the system
            os.kill(os.getpid(), signal.SIGHUP)
        assert request.asked
    assert signal.getsignal(signal.SIGHUP) is before
    signal.signal(signal.SIGHUP, signal.SIG_IGN)  # by nohup
    try:
        with graceful() as request:
            os.kill(os.getpid(), signal.SIGHUP)
            assert not request.asked and signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
    finally:
        signal.signal(signal.SIGHUP, before)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_the_first_signal_asks_and_the_handlers_come_back(number):
    before = signal.getsignal(number)
    with graceful() as request:
        assert not request.asked
        os.kill(os.getpid(), number)
        assert request.asked and signal.getsignal(number) is before
    assert signal.getsignal(number) is before
