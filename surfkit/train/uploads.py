"""What steps look at, on its way to where the points are."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any, Protocol, TypeVar

import torch
from torch import Tensor

from surfkit.core.check import BadInput
from surfkit.io.datasets.depth_prior import DepthPrior
from surfkit.scene.cache import out_of_turn
from surfkit.train.view_order import ViewOrder

Known = TypeVar("Known", Tensor, DepthPrior)


class TrainingPhotos(Protocol):
    """Photographs by the position of their view."""

    def __getitem__(self, at: int, /) -> Tensor:
        """(3, H, W) uint8."""


@dataclass(frozen=True)
class UploadedView:
    """What a step looks at of one view, where the points are.

    Attributes:
        photo: (3, H, W) uint8.
        mask: (H, W) bool, which pixels count; None if all do.
        prior: Its estimated depth, if there is one.
    """

    photo: Tensor
    mask: Tensor | None = None
    prior: DepthPrior | None = None

    def in_floats(self) -> Tensor:
        """(3, H, W) the photograph, in [0, 1]."""
        return self.photo.to(torch.float32).div_(255)

    @property
    def bytes(self) -> int:
        """That its tensors take."""
        tensors = [self.photo, self.mask, *(vars(self.prior).values() if self.prior else ())]
        return sum(each.nbytes for each in tensors if isinstance(each, Tensor))


class Uploads:
    """Views by position: on a CPU as they are; on a GPU uploaded, the next one while it works, and kept if it fits.

    Views that fit into the budget stay on the GPU from the first time they are shown, the others are uploaded each
    time: of a random order, it matters little which ones stay.

    Attributes:
        bytes: That are kept on the GPU.
        budget: Most that may be.
        spared: Whether the memory of the GPU has given out before.
    """

    def __init__(
        self,
        device: torch.device,
        photos: TrainingPhotos,
        masks: Sequence[Tensor | None] | None = None,
        priors: Sequence[DepthPrior | None] | None = None,
        budget_bytes: int = 0,
    ) -> None:
        self._device, self._sources = device, (photos, masks, priors)
        self.bytes, self.budget = 0, budget_bytes if device.type == "cuda" else 0
        self.spared = False
        self._kept: dict[int, UploadedView] = {}
        self._next: dict[int, UploadedView | BadInput] = {}

    def get(self, at: int) -> UploadedView | BadInput:
        """The view to show now; for a damaged photograph, what is wrong with it.

        Raises:
            BadInput: Its mask or depth prior is damaged.
        """
        if at in self._kept:
            return self._kept[at]
        found = self._next.pop(at) if at in self._next else self._read(at)
        self._next.clear()  # something else was expected
        if isinstance(found, UploadedView) and self.bytes + found.bytes <= self.budget:
            self._kept[at] = found
            self.bytes += found.bytes
        return found

    def aside(self, at: int) -> UploadedView | BadInput:
        """The same, without a prior, of a view that is looked at out of turn."""
        return self._kept[at] if at in self._kept else self._read(at, aside=True)

    def ahead(self, order: ViewOrder, skipped: Collection[int]) -> None:
        """Begin to upload the view that is shown next, if the order tells; on a CPU there is nothing to do."""
        if self._device.type == "cpu":
            return
        at = next((at for at in map(int, order.queue[order.at :]) if at not in skipped), None)
        if at is not None and at not in self._kept:
            with suppress(BadInput):  # it is raised when the view is shown
                self._next = {at: self._read(at)}

    def missing(self, coming: Sequence[int]) -> list[int]:
        """Those of some positions that have to be read; what was uploaded ahead is forgotten."""
        self._next.clear()
        return [at for at in coming if at not in self._kept]

    def lower(self) -> int:
        """Keep nothing on the GPU from now on; how many bytes were kept."""
        freed, self.bytes, self.budget = self.bytes, 0, 0
        self._kept.clear()
        self._next.clear()
        return freed

    def _read(self, at: int, aside: bool = False) -> UploadedView | BadInput:
        photos, masks, priors = self._sources
        try:
            photo = out_of_turn(photos, at) if aside else photos[at]
        except BadInput as error:
            return error
        mask = None if masks is None else out_of_turn(masks, at) if aside else masks[at]
        prior = None if priors is None or aside else priors[at]
        return UploadedView(
            uploaded(photo, self._device),
            None if mask is None else uploaded(mask, self._device),
            None if prior is None else uploaded(prior, self._device),
        )


def uploaded(known: Known, device: torch.device) -> Known:
    """A photograph, mask or depth prior on a device; to a GPU it travels while the host goes on."""
    if isinstance(known, DepthPrior):
        there: dict[str, Any] = {name: uploaded(v, device) for name, v in vars(known).items() if isinstance(v, Tensor)}
        return replace(known, **there)
    if device == known.device:
        return known
    return (known.pin_memory() if torch.cuda.is_available() else known).to(device, non_blocking=True)
