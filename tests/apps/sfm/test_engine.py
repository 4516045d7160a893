"""Long work of pycolmap: Ctrl-C, and faults in one line."""

import _thread
import signal
import subprocess
import sys
import threading
import time
from types import SimpleNamespace

import pytest

from surfkit.apps.sfm import engine
from surfkit.core.check import BadInput


@pytest.fixture
def interruptible():
    """Ctrl-C raises here, also where a shell has started the tests in the background, and so without it."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


def test_ctrl_c_cancels_the_work_and_waits_for_its_end(interruptible):
    ended = []

    def work(token):
        _thread.interrupt_main()
        while not token.is_cancelled:
            time.sleep(0.01)
        for _ in range(100):  # of somebody impatient, at any moment of the wait
            _thread.interrupt_main()
            time.sleep(0.003)
        ended.append(token.is_cancelled)

    before = signal.getsignal(signal.SIGINT)
    with pytest.raises(KeyboardInterrupt):
        engine.run("waiting", work)
    assert ended == [True] and signal.getsignal(signal.SIGINT) is before


def test_ctrl_c_just_when_the_work_is_cancelled(interruptible, monkeypatch):
    """Before it is waited for."""
    ended, cancelled = [], threading.Event()

    class Token:
        def cancel(self):
            cancelled.set()
            _thread.interrupt_main()

    def work(token):
        _thread.interrupt_main()
        ended.append(cancelled.wait())

    monkeypatch.setattr(engine, "load_engine", lambda: SimpleNamespace(CancellationToken=Token))
    with pytest.raises(KeyboardInterrupt):
        engine.run("waiting", work)
    assert ended == [True]


def test_what_work_returns_and_how_it_fails():
    assert engine.run("adding", lambda _: 1 + 1) == 2
    with pytest.raises(BadInput, match=r"adding failed.*: two lines;"):
        engine.run("adding", lambda _: (_ for _ in ()).throw(RuntimeError("two\nlines")))
    with pytest.raises(ZeroDivisionError):
        engine.run("adding", lambda _: 1 / 0)


def test_an_old_pycolmap_is_named(monkeypatch):
    monkeypatch.setattr(engine, "load_pycolmap", lambda: SimpleNamespace(__version__="3.11.1"))
    with pytest.raises(BadInput, match=r"pycolmap 4\.2 .*3\.11\.1"):
        engine.load_engine()


@pytest.mark.parametrize(
    ("before", "code"),
    [("pass", -signal.SIGTERM), ("signal.signal(signal.SIGTERM, lambda *_: sys.exit(7))", 7)],
)
def test_sigterm_does_what_it_did_before_pycolmap_was_loaded(before, code):
    program = f"""
import os, signal, sys, time
{before}
from surfkit.io.datasets.raw_dataset import load_pycolmap
load_pycolmap()
os.kill(os.getpid(), signal.SIGTERM)
time.sleep(1)
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (code, "")
