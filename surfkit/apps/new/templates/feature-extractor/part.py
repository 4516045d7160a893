"""Corners, with the pixels around them as descriptors."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import torch
from scipy.ndimage import gaussian_filter, maximum_filter, sobel
from torch import Tensor
from surfkit.plugin import BadInput, FeatureExtractor, Features, Find


@dataclass(frozen=True)
class NewPart(FeatureExtractor):
    """Corners (Shi and Tomasi 1994), each with the smoothed pixels around it: for photographs of one size and turn."""

    descriptors: ClassVar[str] = "new-part"
    in_torch: ClassVar[bool] = False

    radius: int = 5
    """Pixels around a corner in each direction that are its descriptor, every second one."""

    def __post_init__(self) -> None:
        if self.radius < 2:
            raise BadInput(f"new-part.radius is {self.radius}; it must be 2 or more")

    def opened(self, most: int, device: torch.device) -> Find:
        """See `FeatureExtractor.opened`."""
        steps = np.arange(-self.radius, self.radius + 1, 2)

        def find(photo: Tensor) -> Features:
            grey = gaussian_filter(photo.numpy().mean(0), 1.0)
            x, y = sobel(grey, 1), sobel(grey, 0)
            xx, yy, xy = (gaussian_filter(product, 2.0) for product in (x * x, y * y, x * y))
            strength = (xx + yy) / 2 - np.hypot((xx - yy) / 2, xy)
            strength[strength < maximum_filter(strength, 7)] = 0
            rows, columns = (values[self.radius : -self.radius] for values in np.indices(grey.shape))
            rows, columns = (values[:, self.radius : -self.radius].ravel() for values in (rows, columns))
            best = np.argsort(-strength[rows, columns], kind="stable")[:most]
            rows, columns = rows[best], columns[best]
            kept = strength[rows, columns] > 0
            rows, columns = rows[kept], columns[kept]
            around = grey[rows[:, None, None] + steps[:, None], columns[:, None, None] + steps]
            flat = around.reshape(len(rows), -1)
            flat = flat - flat.mean(1, keepdims=True)
            flat /= np.maximum(np.linalg.norm(flat, axis=1, keepdims=True), 1e-6)
            middle = np.column_stack([columns + 0.5, rows + 0.5, np.ones(len(rows)), np.zeros(len(rows))])
            return Features(middle.astype(np.float32), flat.astype(np.float16))

        return find
