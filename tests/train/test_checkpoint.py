import os
import signal

import pytest
import torch

from surfkit.core.check import BadInput
from surfkit.densify import ADC
from surfkit.train.checkpoint import load, save
from surfkit.train.interrupt import graceful
from surfkit.train.stage import Stage

STAGE = Stage(steps=24, sh_every=6, densify=ADC(start=4, until=20, every=5, threshold=1e-6, reset_every=15))


def same(a, b) -> bool:
    groups = zip(vars(a.points).values(), vars(b.points).values(), strict=True)
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


def test_columns_that_do_not_fit_are_named(begin, tmp_path):
    _, state = begin(STAGE)
    state.points.first["sh0"] = state.points.first["sh0"][:-1].clone()
    save(tmp_path / "c.safetensors", state)
    with pytest.raises(BadInput, match=r"first.sh0 has 39 rows for 40 points"):
        load(tmp_path / "c.safetensors")


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_the_first_signal_asks_and_the_handlers_come_back(number):
    before = signal.getsignal(number)
    with graceful() as request:
        assert not request.asked
        os.kill(os.getpid(), number)
        assert request.asked and signal.getsignal(number) is before
    assert signal.getsignal(number) is before
