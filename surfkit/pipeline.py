"""Recipe and data to a run folder: what happens, from top to bottom."""

from __future__ import annotations

import platform
import warnings
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import torch
from rich.console import Console

from surfkit.core.check import BadInput
from surfkit.core.codec import dump, load, read_json, write_json
from surfkit.core.events import FileWritten, StageBegan, StageEnded, Warned, emit
from surfkit.core.registry import own_version, records
from surfkit.core.schedule import rescale
from surfkit.primitives.points import Points
from surfkit.raster.api import Rasterizer
from surfkit.raster.select import Device, select
from surfkit.recipe import Recipe
from surfkit.scene.photos import Photos
from surfkit.scene.scene import Scene
from surfkit.train import checkpoint
from surfkit.train.interrupt import graceful
from surfkit.train.progress import Display, peak_memory_bytes
from surfkit.train.stage import StageState, Trainer


@dataclass(frozen=True)
class Folder:
    """Where a run keeps its files."""

    path: Path

    recipe = property(lambda self: self.path / "recipe.json")
    record = property(lambda self: self.path / "run.json")
    checkpoint = property(lambda self: self.path / "pretrain" / "checkpoint.safetensors")
    metrics = property(lambda self: self.path / "metrics.json")
    cloud = property(lambda self: self.path / "point_cloud.ply")
    pictures = property(lambda self: self.path / "pictures")
