import io
from dataclasses import replace

import torch
from rich.console import Console

from surfkit.raster.api import Maps
from surfkit.train.progress import RunningMean, TrainingDisplay, clock, outer
from surfkit.train.trainer import CompletedStep


class Shown:
    photo = torch.zeros(3, 4, 4)


def done(index: int) -> CompletedStep:
    return CompletedStep(index, {"l1": 0.25, "ssim": 0.25}, 12_345, Maps(color=torch.full((3, 4, 4), 0.1)), Shown())


def test_clock():
    assert [clock(s) for s in (0, 61, 3723)] == ["0:00", "1:01", "1:02:03"]


def test_mean_forgets_slowly():
    mean = RunningMean()
    mean.add(4)
    mean.add(2)
    assert mean.value == 3
    for _ in range(200):
        mean.add(10)
    assert abs(mean.value - 10) < 0.01


def test_without_a_terminal_lines_are_plain_and_the_last_step_is_shown():
    out = io.StringIO()
    with TrainingDisplay("pretrain", 20, Console(file=out, width=40)) as display:
        for index in range(1, 21):
            display.show(done(index))
    lines = out.getvalue().splitlines()
    assert len(lines) == 2 and "\x1b" not in out.getvalue()
    assert lines[0].startswith("pretrain  step 1/20") and "PSNR" not in lines[0]
    for part in ("step 20/20", "it/s", "0:00 left", "12,345 points", "loss 0.5000", "  training PSNR 20.00 dB"):
        assert part in lines[1]


def test_training_psnr_is_of_what_the_photograph_would_show():
    class Darker:
        def shown(self, color):
            return color / 10

    out = io.StringIO()
    with TrainingDisplay("pretrain", 10, Console(file=out, width=40)) as display:
        for index in range(1, 11):
            display.show(replace(done(index), appearance=Darker()))
    assert "training PSNR 40.00 dB" in out.getvalue()


def test_on_a_terminal_there_is_a_bar():
    out = io.StringIO()
    with TrainingDisplay("pretrain", 3, Console(file=out, width=160, force_terminal=True)) as display:
        for index in range(1, 4):
            display.show(done(index))
    assert "━" in out.getvalue() and "step 3/3" in out.getvalue()


def test_within_another_display_the_numbers_go_there():
    out, drawn = io.StringIO(), []
    with outer(lambda *numbers: drawn.append(numbers)), TrainingDisplay("pretrain", 3, Console(file=out)) as display:
        for index in range(1, 4):
            display.show(done(index))
    assert out.getvalue() == ""
    assert drawn[-1][:3] == ("pretrain", 3, 3) and "step 3/3" in drawn[-1][3]
