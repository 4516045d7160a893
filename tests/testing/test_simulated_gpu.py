"""A simulated GPU refuses what CUDA refuses, and counts how often the host waits."""

import numpy as np
import pytest
import torch

from surfkit.testing.simulated_gpu import is_there, simulated_gpu


@pytest.fixture
def gpu():
    with simulated_gpu() as gpu:
        yield gpu


def test_where_results_lie(gpu):
    a = torch.arange(6.0, device="cuda").view(2, 3)
    made = [a + 1, a[:, 0], a.T, a > 2, torch.stack([a, a]), a.max(0).values, torch.zeros_like(a), a.new_ones(2)]
    made += [*a.split(1), a.double(), torch.zeros(3).cuda(), torch.empty(2, device=a.device), a * torch.tensor(2.0)]
    made += [torch.zeros(2).to(a), a.to(torch.float64), torch.where(a > 2, a, 0.0), a.add_(1), a.nonzero()]
    assert all(each.device == torch.device("cuda", 0) and each.is_cuda for each in made)
    here = [a.cpu(), a.to("cpu"), a.to("cpu", torch.float64), torch.zeros(2), torch.zeros(2).to("cpu")]
    assert all(each.device.type == "cpu" and not each.is_cuda for each in here)


def test_gradients_lie_where_their_tensors_lie(gpu):
    x = torch.randn(3).cuda().requires_grad_()
    (gradient,) = torch.autograd.grad((x**2).sum(), x)
    assert is_there(gradient) and torch.equal(gradient.cpu(), 2 * x.detach().cpu())


def test_a_copy_is_a_copy(gpu):
    here = torch.zeros(3)
    there = here.to("cuda")
    there += 1
    assert here.tolist() == [0, 0, 0] and there.tolist() == [1, 1, 1] and here.to("cpu") is here


MIXED = {
    "a sum": lambda a, b: a + b,
    "out of a function": lambda a, b: torch.stack([a, b]),
    "in a keyword": lambda a, b: torch.where(a > 0, input=a, other=b),
    "a mask": lambda a, b: b[a > 0],
    "a value that is set": lambda a, b: a.__setitem__(slice(0, 3), b),
    "in place": lambda a, b: b.add_(a),
    "a number of the GPU": lambda a, b: b + a.sum(),
}


@pytest.mark.parametrize("name", MIXED)
def test_two_places_are_refused(gpu, name):
    with pytest.raises(RuntimeError, match="same device"):
        MIXED[name](torch.ones(3, device="cuda"), torch.ones(3))


def test_numpy_cannot_see_it(gpu):
    for look in (torch.Tensor.numpy, np.asarray, lambda t: np.from_dlpack(t)):
        with pytest.raises(TypeError, match="Tensor.cpu"):
            look(torch.zeros(3, device="cuda"))


def test_the_generator_of_the_host_draws_nothing_there(gpu):
    with pytest.raises(RuntimeError, match="generator"):
        torch.rand(3, device="cuda", generator=torch.Generator())


def test_waits_are_counted(gpu):
    a = torch.arange(4.0, device="cuda")
    (a + 1).mul_(2), torch.zeros(3).tolist(), a[:2], a.sum()
    assert gpu.waits == {}
    float(a.sum()), a[0].item(), a.tolist(), bool((a > 9).any()), a[a > 1], a.cpu()
    assert gpu.waits == {"__float__": 1, "item": 1, "tolist": 1, "__bool__": 1, "__getitem__": 1, "to cpu": 1}
