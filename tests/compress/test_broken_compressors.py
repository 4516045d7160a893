"""Compressors of a plugin that give no plan, or change the model of the run, are named in one line."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
import torch

import surfkit
from surfkit.compress.base import Compressor, Plan
from surfkit.compress.packed import Packed
from surfkit.core.check import BadInput, Fault
from surfkit.primitives import Gaussian3D
from surfkit.primitives.model import SplatModel
from surfkit.runs.compress_model import writing
from surfkit.scene.scene import SparsePoints


@dataclass(frozen=True)
class Broken(Compressor):
    """Gives something else than a plan of the model."""

    how: str = "none"

    def plan(self, model, importance, seed, device=torch.device("cpu")):
        if self.how == "changes":
            model.params["means"].mul_(0)
        plan = Packed().plan(model, importance, seed, device)
        return {
            "none": None,
            "changes": plan,
            "marks": Plan(plan.encodings, plan.tables, {"mark": torch.zeros(3)}),
            "table": Plan(plan.encodings, {**plan.tables, "mine": np.arange(4)}),
            "tensor": Plan(plan.encodings, {**plan.tables, "mine": torch.zeros(4)}),
        }[self.how]


@pytest.mark.parametrize(
    ("how", "said", "kind"),
    [
        ("none", "Broken.plan: expected Plan, got NoneType", BadInput),
        ("marks", r"Broken.plan: marks: mark: expected shape \(\d+,\), got \(3,\)", BadInput),
        ("table", "table mine: int64; types are float16", BadInput),
        ("tensor", "table mine: torch.float32; types are float16", BadInput),
        ("changes", "Broken.plan changes means in place", Fault),
    ],
)
def test_the_compressor_is_named(tmp_path: Path, how, said, kind):
    surfkit.offer("broken-compressor", Broken)
    draws = torch.Generator().manual_seed(0)
    cloud = SparsePoints(torch.rand(20, 3, generator=draws), torch.zeros(20, 3, dtype=torch.uint8))
    model = SplatModel(Gaussian3D(sh_degree=0), Gaussian3D(sh_degree=0).init(cloud, draws), 0, 0.01)
    with pytest.raises(kind, match=said):
        writing(model, None, None, 0)(tmp_path / "model.surfkit", Broken(how))
    assert not (tmp_path / "model.surfkit").exists()
