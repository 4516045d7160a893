import sys
import types
from pathlib import Path

import pytest
from needs import needs

from surfkit.core.check import BadInput
from surfkit.core.events import Measured, StageBegan, StepDone, emit
from surfkit.study.tensorboard import tensorboard


def test_without_the_package_one_line_says_what_to_install(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "torch.utils.tensorboard", None)
    with pytest.raises(BadInput, match=r"--tensorboard .*pip install 'surfkit\[tensorboard\]'"):
        with tensorboard(tmp_path):
            pass
    assert not list(tmp_path.iterdir())


def test_scalars_of_steps_taken_again_replace_those_before(tmp_path):
    accumulator = needs("tensorboard.backend.event_processing.event_accumulator").EventAccumulator
    for first, last, loss in ((1, 6, 0.5), (4, 8, 0.25)):
        with tensorboard(tmp_path):
            emit(StageBegan("pretrain", 8, 10, first))
            for index in range(first, last + 1):
                emit(StepDone(index, 8, {"l1": loss, "ssim": loss}, 10 + index, 1000))
            emit(Measured(last, {"a.jpg": 20.0 + last}))
    found = accumulator(str(tmp_path / "tensorboard"))
    found.Reload()
    points = {event.step: event.value for event in found.Scalars("points")}
    assert points == {index: 10 + index for index in range(1, 9)} and len(found.Scalars("points")) == 8
    assert {event.step: event.value for event in found.Scalars("loss")} == {
        i: 1.0 if i < 4 else 0.5 for i in range(1, 9)
    }
    assert found.Scalars("psnr/a.jpg")[-1].value == 28 and found.Scalars("loss/l1")[0].value == 0.5


class Written:
    """A writer that only keeps what it is given."""

    points: dict[str, list[float]] = {}

    def __init__(self, folder, purge_step, flush_secs):
        self.kept = self.points.setdefault(Path(folder).name, [])

    def add_scalar(self, name, value, index):
        self.kept += [value] * (name == "points")

    def close(self):
        pass


def test_every_block_and_refinement_has_scalars_of_its_own(tmp_path, monkeypatch):
    module = types.ModuleType("torch.utils.tensorboard")
    module.SummaryWriter = Written
    monkeypatch.setitem(sys.modules, "torch.utils.tensorboard", module)
    with tensorboard(tmp_path):
        for block in (None, 0, 1):
            emit(StageBegan("pretrain" if block is None else "tune", 2, 10, block=block))
            for index in (1, 2):
                emit(StepDone(index, 2, {"l1": 0.5}, 10 * index + (9 if block is None else block), 1000))
        emit(StageBegan("refine0", 1, 10))
        emit(StepDone(1, 1, {"l1": 0.5}, 5, 1000))
    assert Written.points == {"tensorboard": [19, 29], "block-000": [10, 20], "block-001": [11, 21], "refine0": [5]}
