"""The kernel of Adam against the update on the CPU."""

import pytest
import torch

from surfkit.primitives.points import Points
from surfkit.train import adam
from surfkit.train.adam import ADAM_SOURCE, adam_step, launch_update, launch_update_rows, update, update_rows


@pytest.mark.parametrize("shape", [(1,), (1023, 1), (1024,), (1025,), (700, 3), (65, 16, 3), (0, 3)])
def test_agrees_with_the_cpu(load, shape):
    on = load(ADAM_SOURCE)
    draw = torch.Generator().manual_seed(len(shape))
    value = torch.randn(shape, generator=draw)
    theirs = [value.clone(), torch.zeros(shape), torch.zeros(shape)]
    ours = [tensor.clone().to(on.device) for tensor in theirs]
    for index in range(1, 6):
        grad = torch.randn(shape, generator=draw) * 10.0 ** torch.randint(-8, 3, shape, generator=draw)
        launch_update(on, ours[0], grad.to(on.device), *ours[1:], 0.01, index)
        update(theirs[0], grad, *theirs[1:], 0.01, index)
    for our, their in zip(ours, theirs, strict=True):
        assert torch.allclose(our.cpu(), their, rtol=1e-5, atol=1e-7)
    if value.numel():
        assert not torch.equal(ours[0].cpu(), value)


@pytest.mark.parametrize("shape", [(1,), (1500,), (700, 3), (131, 15, 3)])
def test_some_rows_agree_with_the_cpu(load, shape):
    on = load(ADAM_SOURCE)
    draw = torch.Generator().manual_seed(len(shape))
    theirs = [torch.randn(shape, generator=draw), torch.zeros(shape), torch.zeros(shape)]
    ours = [tensor.clone().to(on.device) for tensor in theirs]
    for index in range(1, 6):
        rows = (torch.rand(shape[0], generator=draw) < 0.6).nonzero()[:, 0]
        kept = torch.rand(len(rows), generator=draw)
        grad = torch.randn(len(rows), *shape[1:], generator=draw)
        there = [tensor.to(on.device) for tensor in (rows, kept, grad)]
        launch_update_rows(on, ours[0], *there, *ours[1:], 0.01, index)
        update_rows(theirs[0], rows, kept, grad, *theirs[1:], 0.01, index)
    for our, their in zip(ours, theirs, strict=True):
        assert torch.allclose(our.cpu(), their, rtol=1e-5, atol=1e-7)


@pytest.mark.parametrize("shape", [(1025,), (131, 15, 3)])
def test_moments_in_16_bits_are_those_of_the_cpu(load, shape):
    """Rounded in the same way: the same bits, but where the arithmetic before has another last bit of 24."""
    on = load(ADAM_SOURCE)
    draw = torch.Generator().manual_seed(len(shape))
    theirs = [torch.randn(shape, generator=draw), *torch.zeros(2, *shape, dtype=torch.bfloat16)]
    ours = [tensor.clone().to(on.device) for tensor in theirs]
    for index in range(1, 8):
        rows = (torch.rand(shape[0], generator=draw) < 0.6).nonzero()[:, 0]
        kept, grad = torch.rand(len(rows), generator=draw), torch.randn(shape, generator=draw)
        there = [tensor.to(on.device) for tensor in (rows, kept, grad, grad[rows])]
        launch_update(on, ours[0], there[2], *ours[1:], 0.01, index, 7)
        update(theirs[0], grad, *theirs[1:], 0.01, index, 7)
        launch_update_rows(on, ours[0], *there[:2], there[3], *ours[1:], 0.01, index)
        update_rows(theirs[0], rows, kept, grad[rows], *theirs[1:], 0.01, index)
    for our, their in zip(ours[1:], theirs[1:], strict=True):
        assert our.dtype == torch.bfloat16 and (our.cpu() == their).float().mean() > 0.995
    assert torch.allclose(ours[0].cpu(), theirs[0], rtol=1e-3, atol=1e-4)


def test_columns_without_gradient_stay(monkeypatch):
    """`adam_step` takes the kernel for tensors of a GPU: here for all."""
    launched = []
    monkeypatch.setattr(adam, "_is_gpu", lambda tensor: launched.append(tensor) is None)
    params = {"means": torch.rand(5, 3), "opacities": torch.rand(5)}
    points = Points.fresh({name: value.clone() for name, value in params.items()})
    adam_step(points, {"means": torch.ones(5, 3)}, {"means": 0.1}, 1)
    assert launched and torch.allclose(points.params["means"], params["means"] - 0.1)
    assert torch.equal(points.params["opacities"], params["opacities"])
