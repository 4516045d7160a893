"""What a stage changes step by step, and where it lies."""

from __future__ import annotations

from dataclasses import dataclass, field

import torch

from surfkit.primitives.points import Columns, Points
from surfkit.primitives.storage import Storage
from surfkit.train.point_blocks import PointBlocks
from surfkit.train.view_order import ViewOrder


@dataclass
class StageState:
    """What an interrupted stage needs to go on as if nothing had happened."""

    points: Points
    order: ViewOrder
    generator: torch.Generator
    index: int = 0
    """Steps done."""
    seconds: float = 0.0
    """Wall time of the steps done."""
    cpu_seconds: float = 0.0
    """CPU time of the steps done, all threads, seconds."""
    peak_memory_bytes: int = 0
    """Most memory held so far; 0 where the system does not tell."""
    peak_gpu_bytes: int = 0
    """Most memory of the GPU held so far; 0 without one."""
    appearances: Columns = field(default_factory=dict)
    """What is known of the appearance of each photograph (`train.image_appearance`)."""
    reset_at: int = 0
    """Step that last lowered the opacities; 0 if none has."""
    sh_degree: int = 0
    """Of the spherical harmonics so far. It never falls, also when the schedule becomes a longer one."""
    halvings: int = 0
    """How often the learning rates have been halved, after numbers that were not finite."""
    skipped: list[int] = field(default_factory=list)
    """Positions of photographs that turned out damaged, and are not shown any more."""
    whole: bool = True
    """Whether it is that after a step, and not one in which a step has changed a part."""
    blocks: PointBlocks | None = None
    """Bounds of blocks of points, for steps that look only into some; made anew where they are not of these points."""
    frozen: Columns = field(default_factory=dict)
    """Raw parameters of points that are drawn behind and before `points`, and that nothing changes; none if empty."""

    def move(self, device: torch.device, home: Storage | None = None) -> None:
        """Put what is optimised, and what is drawn with it, on a device; counts stay where the host reads them. `home`:
        where the points are kept, if not there."""
        home = home or Storage(device)
        if self.points.storage != home:
            self.points, self.blocks = self.points.to(home), None  # which hold the columns
            self.frozen = {name: home.held(value) for name, value in self.frozen.items()}
        self.appearances = {n: v.to(device) if v.is_floating_point() else v for n, v in self.appearances.items()}

    @property
    def seed(self) -> int:
        """Of what is drawn in the coming step beside the generator, in [0, 2^63)."""
        return (self.generator.initial_seed() * 1_000_003 + self.index + 1) % 2**63
