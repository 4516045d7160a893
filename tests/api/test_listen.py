"""What is called after each step may raise anything, in any thread; one process does one thing at a time."""

import threading
from contextlib import contextmanager

import pytest
import torch
from models import data_set

import surfkit


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return surfkit.read(data_set(tmp_path_factory.mktemp("listen") / "scene"))


class Enough(Exception):
    """Of a user's own."""


def raising(error):
    """Raises in step 3, and remembers the steps that it saw."""

    def on_step(step):
        on_step.seen.append(step.index)
        if step.index == 3:
            raise error

    on_step.seen = []
    return on_step


@pytest.mark.parametrize("error", [Enough("loss is low"), KeyboardInterrupt(), SystemExit(2)])
@pytest.mark.parametrize("aside", [False, True])
def test_what_a_step_raises_stops_the_run_and_reaches_who_called(scene, tmp_path, error, aside):
    on_step, caught = raising(error), []

    def train():
        try:
            surfkit.train("2dgs", scene, tmp_path / "run", steps=8, on_step=on_step)
        except BaseException as raised:
            caught.append(raised)

    if aside:
        thread = threading.Thread(target=train)
        thread.start()
        thread.join()  # the main thread is not interrupted
    else:
        train()
    assert caught == [error] and on_step.seen == [1, 2, 3]
    with pytest.raises(surfkit.BadInput, match="3 of 8"):
        _ = surfkit.open(tmp_path / "run").splats


def test_other_work_around_this_is_refused_in_one_line(scene, tmp_path):
    with pytest.raises(surfkit.BadInput, match="still at other work .* in another process") as error:
        surfkit.train(
            "2dgs", scene, tmp_path / "run", steps=4, on_step=lambda step: surfkit.train("2dgs", scene, tmp_path / "b")
        )
    assert "\n" not in str(error.value)


@contextmanager
def float64():
    before = torch.get_default_dtype()
    torch.set_default_dtype(torch.float64)
    try:
        yield
    finally:
        torch.set_default_dtype(before)


@pytest.mark.parametrize("around", [float64, torch.no_grad, torch.inference_mode, lambda: torch.device("meta")])
def test_what_a_script_has_set_in_torch_does_not_count(scene, tmp_path, around):
    plain = surfkit.train("2dgs", scene, tmp_path / "plain", steps=3)
    with around():
        made, dtype = torch.empty(1), torch.get_default_dtype()
        inside = surfkit.train("2dgs", scene, tmp_path / "inside", steps=3)
        assert torch.get_default_dtype() == dtype and torch.empty(1).device == made.device, "and is still set"
    assert torch.equal(inside.splats.means, plain.splats.means)
