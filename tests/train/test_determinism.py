"""No operation of a training step is one that CUDA sums in any order, so the same run has the same bits twice."""

from collections import Counter

import pytest
import torch
from torch.utils._python_dispatch import TorchDispatchMode

from surfkit.raster.autograd import summed_by_owner
from surfkit.testing.simulated_gpu import OnSimulatedGpu, simulated_gpu

from .test_gpu import PARTS, staged, trained

ANY_ORDER = {
    "_adaptive_avg_pool2d_backward", "_adaptive_avg_pool3d_backward", "_ctc_loss_backward",
    "_embedding_bag_dense_backward", "adaptive_max_pool2d_backward", "avg_pool3d_backward",
    "fractional_max_pool2d_backward", "fractional_max_pool3d_backward", "max_pool3d_with_indices_backward",
    "max_unpool2d", "upsample_linear1d_backward", "upsample_bilinear2d_backward", "upsample_bicubic2d_backward",
    "upsample_trilinear3d_backward", "_upsample_bilinear2d_aa_backward", "_upsample_bicubic2d_aa_backward",
    "reflection_pad1d_backward", "reflection_pad2d_backward", "reflection_pad3d_backward",
    "replication_pad1d_backward", "replication_pad2d_backward", "replication_pad3d_backward", "nll_loss2d_forward",
    "histc", "grid_sampler_2d_backward", "grid_sampler_3d_backward", "convolution",
    "convolution_backward", "bmm_sparse",
}  # fmt: skip
"""torch.use_deterministic_algorithms, its two lists of operations of CUDA that it refuses or replaces. `kthvalue` and
`median` are left out: their values are exact, and nothing reads which of equal values they found."""
BY_INDEX = {"index_add": 2, "index_add_": 2, "scatter_add": 2, "scatter_add_": 2, "scatter": 2, "scatter_": 2,
            "scatter_reduce": 2, "scatter_reduce_": 2, "index_copy": 2, "index_copy_": 2,
            "index_select_backward": 3, "embedding_dense_backward": 1}  # fmt: skip
"""Also in these lists, but only where an index comes twice: the position of that argument."""
EXACT = {"amax", "amin"}
"""Reductions that give the same in any order."""


class AnyOrder(TorchDispatchMode):
    """Counts the operations whose result may depend on the order in which a GPU makes it."""

    def __init__(self):
        super().__init__()
        self.found, self.all = Counter(), Counter()

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        name, kwargs = func._schema.name.partition("::")[2], kwargs or {}
        self.all[name] += 1
        if self.is_any_order(name, args, kwargs):
            self.found[name] += 1
        return func(*args, **kwargs)

    def is_any_order(self, name, args, kwargs):
        if name in ("cumsum", "cumsum_", "cumprod", "logcumsumexp"):
            return args[0].is_floating_point()
        if name == "bincount":
            return len(args) > 1 and args[1] is not None
        if name in ("index_put", "index_put_", "_index_put_impl_"):
            summed = (args[3] if len(args) > 3 else kwargs.get("accumulate")) or False
            return not summed and repeats(args[1])  # with `accumulate` CUDA sorts first
        if name in BY_INDEX:
            return not EXACT & {value for value in args if isinstance(value, str)} and repeats([args[BY_INDEX[name]]])
        return name in ANY_ORDER


def repeats(indices):
    """Whether a place is named twice."""
    known = [each for each in indices if each is not None and each.dtype is torch.int64]
    if not known:
        return False
    rows = torch.stack([each.flatten() for each in torch.broadcast_tensors(*known)], 1)
    return len(rows.unique(dim=0)) < len(rows)


@pytest.mark.parametrize(("kind", "name"), PARTS, ids=[f"{kind.__name__}-{name}" for kind, name in PARTS])
def test_no_part_sums_in_any_order(tiny, begin, kind, name):
    stage, primitive = staged(kind, name)
    with simulated_gpu(), AnyOrder() as seen:
        trained(begin, stage, OnSimulatedGpu(tiny.rasterizer), tiny, primitive)
    assert len(seen.all) > 30, "nothing was seen"
    assert not seen.found


def test_sums_by_owner_are_taken_in_one_order():
    owner, values = torch.tensor([3, 0, 3, 3, 1]), torch.arange(10.0).view(5, 2)
    found = []
    with simulated_gpu(), AnyOrder() as seen:
        for device in ("cpu", "cuda"):
            found.append(summed_by_owner(values.to(device), owner.to(device), 5).cpu())
    assert torch.equal(*found) and found[0][3].tolist() == [0 + 4 + 6, 1 + 5 + 7] and found[0][4].tolist() == [0, 0]
    assert seen.found == {"index_add": 1}, "on the CPU, where it is taken in order"


@pytest.mark.parametrize("name", sorted({"grid_sampler_2d_backward", "upsample_bilinear2d_backward", "index_add_"}))
def test_what_cuda_sums_in_any_order_is_noticed(name):
    image = torch.rand(1, 1, 4, 4, requires_grad=True)
    with AnyOrder() as seen:
        if name == "index_add_":
            torch.zeros(3).index_add_(0, torch.tensor([1, 1]), torch.ones(2))
            torch.zeros(3).index_add_(0, torch.tensor([1, 2]), torch.ones(2))  # each place once
        elif name.startswith("grid"):
            torch.nn.functional.grid_sample(image, torch.zeros(1, 2, 2, 2), align_corners=False).sum().backward()
        else:
            torch.nn.functional.interpolate(image, size=8, mode="bilinear").sum().backward()
    assert seen.found == {name: 1}
