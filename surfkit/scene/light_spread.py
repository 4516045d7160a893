"""How far the light of photographs differs, and what is said of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from surfkit.scene.response import CURVE, corner_light, curved
from surfkit.scene.track_light import MIN_SEEN, TrackLight

UNEVEN_STOPS, UNEVEN_BALANCE, DARK_CORNER, UNEVEN_CURVE = 0.5, 0.1, 0.8, 0.03
"""Light is uneven from these on, see `LightSpread`."""


@dataclass(frozen=True)
class LightSpread:
    """How far photographs differ.

    Attributes:
        stops: From the 10th to the 90th percentile of the exposures.
        balance: The same of red, or of blue, as shares of green; the larger one.
        corner: Light that is left half a diagonal away from the middle of the picture, as a share of that in the
            middle; of the camera with the darkest corners.
        curve: Largest difference, in colours in [0, 1], between the response curve of a camera and the mean one.
        cameras: How many cameras there are.
    """

    stops: float
    balance: float
    corner: float
    curve: float = 0.0
    cameras: int = 1

    @classmethod
    def of(cls, light: TrackLight) -> LightSpread:
        """That of a fit; photographs that share too few points do not count."""
        known = light.stops[light.seen >= MIN_SEEN]
        if not len(known):
            return cls(0.0, 0.0, 1.0)
        values = np.column_stack([known.mean(1), known[:, 0] - known[:, 1], known[:, 2] - known[:, 1]])
        low, high = np.percentile(values, [10, 90], axis=0)
        stops, *balance = (high - low).tolist()
        corner = min(map(corner_light, light.cameras))
        fine = np.linspace(0, 1, 101)
        curve = max(float(np.abs(curved(fine, numbers[CURVE]) - fine).max()) for numbers in light.cameras)
        return cls(stops, 2 ** max(balance) - 1, corner, curve, len(light.cameras))

    @property
    def is_uneven(self) -> bool:
        """Whether one colour for each place cannot explain the photographs."""
        uneven = self.stops >= UNEVEN_STOPS or self.balance >= UNEVEN_BALANCE
        return uneven or self.corner <= DARK_CORNER or self.curve >= UNEVEN_CURVE

    def remedy(self, has_tracks: bool, settings: Sequence[str]) -> str:
        """What is said of light that is uneven, with what to do.

        Args:
            has_tracks: Whether the data set tells which photographs show which points.
            settings: Dotted paths of the appearances to add.
        """
        if has_tracks:
            cure = (
                f"add {' '.join(f'{one}:camera-response' for one in settings)}, which finds all of it before training"
            )
        else:
            learned = " ".join(f"{one}:exposure" for one in settings)
            cure = (
                f"add {learned}, which learns an exposure for each, or give `surfkit prepare points` and choose "
                "camera-response"
            )
        return f"the same places look different: {self}; {cure}"

    def __str__(self) -> str:
        several = f", response curves of {self.cameras} cameras by {self.curve:.0%} of the range"
        return (
            f"exposures differ by {self.stops:.1f} stops and white balance by {self.balance:.0%} (10th to 90th "
            f"percentile){several * (self.cameras > 1)}; corners have {self.corner:.0%} of the light of the middle"
        )
