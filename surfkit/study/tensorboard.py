"""Scalars of a run for TensorBoard."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from surfkit.core.events import Measured, StageBegan, StepDone
from surfkit.core.hooks import hookimpl
from surfkit.core.optional import needed
from surfkit.core.registry import plugins


class TensorBoardWriter:
    """Writes losses, points, memory and held-out PSNR; steps that a run takes again replace those it lost.

    Every block and every refinement has a folder of its own, which TensorBoard shows as a run of its own.
    """

    def __init__(self, folder: Path, writer: type) -> None:
        self.folder, self.kind = folder, writer
        self.writer: Any = None

    @hookimpl
    def surfkit_event(self, event: Any) -> None:
        """See one event."""
        if isinstance(event, StageBegan):
            self.close()
            self.writer = self.kind(str(self.folder / _folder(event)), purge_step=event.first, flush_secs=10)
        elif self.writer is None:
            return
        elif isinstance(event, StepDone):
            for name, value in event.losses.items():
                self.writer.add_scalar(f"loss/{name}", value, event.index)
            self.writer.add_scalar("loss", sum(event.losses.values()), event.index)
            self.writer.add_scalar("points", event.points, event.index)
            self.writer.add_scalar("peak memory, bytes", event.peak_memory_bytes, event.index)
            if event.peak_gpu_bytes:
                self.writer.add_scalar("peak GPU memory, bytes", event.peak_gpu_bytes, event.index)
        elif isinstance(event, Measured):
            for name, value in event.psnr.items():
                self.writer.add_scalar(f"psnr/{name}", value, event.index)

    def close(self) -> None:
        """Write what is still held back."""
        if self.writer is not None:
            self.writer.close()
            self.writer = None


def _folder(began: StageBegan) -> str:
    """Where the scalars of a stage go: those that count their steps anew must not replace others."""
    if began.block is not None:
        return f"block-{began.block:03}"
    return began.stage if began.stage.startswith("refine") else ""


@contextmanager
def tensorboard(out: Path) -> Iterator[None]:
    """Within, scalars of the run are written to tensorboard/ in its folder.

    Raises:
        BadInput: The package is missing or cannot be loaded.
    """
    with needed("tensorboard", "--tensorboard"):
        from torch.utils.tensorboard import SummaryWriter
    scalars = TensorBoardWriter(out / "tensorboard", SummaryWriter)
    plugins().register(scalars, "tensorboard")
    try:
        yield
    finally:
        plugins().unregister(scalars)
        scalars.close()
