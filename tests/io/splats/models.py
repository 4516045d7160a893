"""Random splats, and what they must be after rounding."""

import numpy as np
import torch

from surfkit.io.splats.splat_table import SPLAT_COLUMNS, SplatTable


def table(kind="gaussian", count=700, degree=3, seed=0, **changes):
    """Splats with outliers in every column."""
    draw = torch.Generator().manual_seed(seed)

    def normal(*shape):
        return torch.randn(*shape, generator=draw)

    values = {
        "means": 20 * normal(count, 3),
        "quats": normal(count, 4) * (0.01 + 10 * torch.rand(count, 1, generator=draw)),
        "log_scales": normal(count, 2 if kind == "surfel" else 3) - 3,
        "opacity_logits": 4 * normal(count),
        "sh0": normal(count, 3),
        "sh_rest": 0.2 * normal(count, (degree + 1) ** 2 - 1, 3),
    }
    return SplatTable(kind, **(values | changes))


def matched(before, after):
    """The splats of `after` in the order of `before`, by the nearest positions."""
    assert len(before) == len(after)
    nearest = torch.cdist(before.means.double(), after.means.double()).argmin(1)
    assert len(set(nearest.tolist())) == len(before), "each splat came back once"
    return after.take(nearest)


def turned(quats):
    """(N, 3, 3) rotations, by the textbook formula."""
    w, x, y, z = (quats / quats.norm(dim=1, keepdim=True)).double().unbind(1)
    rows = [
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    ]
    return torch.stack([torch.stack(row, 1) for row in rows], 1)


def differences(before, after):
    """The largest difference of each column, rotations as those of matrices and opacities as those of shares."""
    after = matched(before, after)
    found = {name: getattr(before, name).double() - getattr(after, name).double() for name in SPLAT_COLUMNS}
    found["quats"] = turned(before.quats) - turned(after.quats)
    found["opacity_logits"] = before.opacity_logits.sigmoid() - after.opacity_logits.sigmoid()
    return {name: float(value.abs().max()) if value.numel() else 0.0 for name, value in found.items()}


def same(one, other):
    """Whether two tables are equal, bit by bit."""
    return one.kind == other.kind and all(np.array_equal(getattr(one, n), getattr(other, n)) for n in SPLAT_COLUMNS)
