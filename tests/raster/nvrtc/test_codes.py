"""The nearest code of each vector, and sums by code, by the kernels: float64 brute force, and the bits of the CPU."""

import numpy as np
import pytest
import torch

from surfkit.compress.cuda import codes as module
from surfkit.compress.cuda.codes import CODES_SOURCE, GpuSearch, sums
from surfkit.compress.kmeans import kmeans, nearest
from surfkit.core.check import BadInput
from surfkit.raster.nvrtc.emulated import Emulated, KernelError
from surfkit.testing.simulated_gpu import GPU, simulated_gpu

from .sources import changed


def drawn(count, dimensions, seed=0):
    """(N, D) float32; the later dimensions vary less."""
    random = np.random.default_rng(seed)
    return torch.from_numpy((random.normal(size=(count, dimensions)) / (1 + np.arange(dimensions))).astype(np.float32))


def brute(vectors, codebook):
    """(N, K) float64 squared distances."""
    return np.square(vectors.double().numpy()[:, None] - codebook.double().numpy()).sum(2)


def search(on, vectors, codebook, without=None):
    there = vectors.to(on.device)
    found = GpuSearch(codebook, on.device, on).nearest(there, there, without)
    return tuple(each.cpu() for each in found)


def assert_nearest(found, true):
    index, distance = found
    assert (index.numpy() == true.argmin(1)).all()
    np.testing.assert_allclose(distance.numpy(), true.min(1), rtol=1e-6)


@pytest.mark.parametrize(
    "shape", [(1, 1, 1), (1, 200, 45), (130, 3, 2), (200, 65, 17), (129, 64, 16), (60, 300, 48)], ids=str
)
def test_nearest_is_that_of_brute_force(load, shape):
    """One vector, fewer codes than a tile, and just more."""
    count, codes, dimensions = shape
    vectors, codebook = drawn(count, dimensions), drawn(codes, dimensions, 1)
    found = search(load(CODES_SOURCE), vectors, codebook)
    assert_nearest(found, brute(vectors, codebook))
    assert all(torch.equal(a, b) for a, b in zip(found, nearest(vectors, codebook), strict=True)), "bits of the CPU"


def whole(count, seed):
    """Whole numbers: every sum is exact, and most least distances are shared."""
    return torch.from_numpy(np.random.default_rng(seed).integers(-2, 3, (count, 6)).astype(np.float32))


def test_equal_distances_go_to_the_lowest_index(load):
    vectors, codebook = whole(150, 0), whole(700, 1)
    true = brute(vectors, codebook)
    assert ((true == true.min(1, keepdims=True)).sum(1) > 1).mean() > 0.4
    index, distance = search(load(CODES_SOURCE), vectors, codebook)
    assert (index.numpy() == true.argmin(1)).all() and (distance.numpy() == true.min(1)).all()


@pytest.mark.parametrize("change", [1e14, 1e-18, 1e-30, "far away", "equal but for a bit"])
def test_rounding_errors_rule_no_nearest_code_out(load, change):
    vectors, codebook = drawn(60, 45), drawn(100, 45, 1)
    if change == "far away":
        vectors, codebook = vectors * 1e-4 + 300, codebook * 1e-4 + 300
    elif change == "equal but for a bit":
        codebook[1:] = torch.nextafter(codebook[:1], codebook[1:])
        vectors = codebook[:1] + drawn(60, 45)
    else:
        vectors, codebook = vectors * change, codebook * change
    index, _ = search(load(CODES_SOURCE), vectors, codebook)
    true = brute(vectors, codebook)
    found = np.take_along_axis(true, index.numpy()[:, None].astype(int), 1)[:, 0]
    assert (found <= true.min(1) * (1 + 1e-13)).all()
    assert torch.equal(index, nearest(vectors, codebook)[0])


def test_a_code_may_be_left_out(load):
    on, codebook = load(CODES_SOURCE), drawn(90, 7)
    own = torch.arange(90, dtype=torch.int32)
    assert_nearest(search(on, codebook, codebook, own), brute(codebook, codebook) + np.diag(np.full(90, np.inf)))
    index, distance = search(on, codebook[:1], codebook[:1], own[:1])
    assert index.tolist() == [-1] and distance.tolist() == [np.inf], "there is no other"


def summed(vectors, weights, index, codes):
    """In their order, and each step rounded."""
    total = np.zeros((codes, vectors.shape[1] + 1))
    rows = np.concatenate([vectors.double().numpy(), np.ones((len(vectors), 1))], 1)
    for row, weight, code in zip(rows, weights.numpy(), index.tolist(), strict=True):
        total[code] += weight * row
    return total


@pytest.mark.parametrize("shape", [(0, 3, 2), (1, 1, 1), (400, 30, 45), (90, 200, 64), (50, 2, 130)], ids=str)
def test_sums_have_the_bits_of_their_order(load, shape):
    count, codes, dimensions = shape
    on, vectors = load(CODES_SOURCE), drawn(count, dimensions)
    weights = torch.rand(count, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    index = torch.from_numpy(np.random.default_rng(0).integers(0, codes, count).astype(np.int32))
    found = sums(*(each.to(on.device) for each in (vectors, weights, index)), codes, on)
    assert np.array_equal(found.cpu().numpy(), summed(vectors, weights, index, codes))


def test_kmeans_has_the_bits_of_the_cpu(monkeypatch):
    """On a simulated GPU, in parts; an iteration waits six times."""
    monkeypatch.setattr(module, "VECTORS_PER_LAUNCH", 256)
    vectors, weights = drawn(600, 9), torch.rand(600, generator=torch.Generator().manual_seed(0))
    true = kmeans(vectors, 40, weights, iterations=3)
    with simulated_gpu() as gpu:
        found = kmeans(vectors, 40, weights, iterations=3, device=GPU)
        again = kmeans(vectors, 40, weights, iterations=3, device=GPU)
        assert gpu.waits == {"to cpu": 2 * 3 * 6}
        index = nearest(vectors, found, GPU)
        few = kmeans(vectors[:10], 20, device=GPU)
    assert torch.equal(found, true) and torch.equal(again, true)
    assert all(torch.equal(a, b) for a, b in zip(index, nearest(vectors, true), strict=True))
    assert torch.equal(few, kmeans(vectors[:10], 20)), "fewer vectors than codes"


def test_bad_vectors_are_refused_as_on_the_cpu():
    vectors = drawn(10, 3)
    vectors[7, 1] = torch.nan
    with simulated_gpu():
        for call in (lambda: kmeans(vectors, 2, device=GPU), lambda: nearest(vectors, drawn(3, 3), GPU)):
            with pytest.raises(BadInput, match="vectors: row 7 .*nan"):
                call()


MISTAKES = {
    "no barrier before the next dimensions": ("__syncthreads();", "", 0, "with no barrier"),
    "no barrier after staging": ("__syncthreads();", "", 1, "of the block has written|with no barrier"),
    "a vector too many": ("begin + row < rows", "begin + row <= rows", 0, "index .* of vectors, which has"),
    "codes that are not there": ("code >= count ||", "", 0, "index .* of codes, which has"),
    "the roundings are forgotten": ("* slack + tiny ? nearest[r] : -1", "? nearest[r] : 0", 0, "wrong"),
    "half of the lanes": ("step = kAcross / 2", "step = kAcross / 4", 0, "wrong"),
    "of equal ones the last": ("its_code < nearest)", "its_code > nearest)", 0, "wrong"),
    "one code too many": ("code < count; code += 32", "code <= count; code += 32", 0, "index .* of codes, which has"),
    "a lane alone": ("if (nearest >= 0) {", "if (nearest >= 0 || lane == 3) {", 0, "shfl|index"),
    "every lane writes": ("if (lane == 0) {", "if (true) {", 0, "with no barrier"),
    "a vector of the next code": ("at < end", "at <= end", 0, "wrong|index .* of order, which has"),
    "no weights in the last column": ("column <= dimensions", "column < dimensions", 0, "wrong"),
    "a column of another code": ("code * (dimensions + 1)", "code * dimensions", 0, "another block|wrong"),
    "a code without its first vector": ("at = begin", "at = begin + 1", 0, "wrong"),
}


def clustering(source):
    """Raise KernelError if the kernels do, or if they give something else than brute force."""
    on = Emulated(source)
    for vectors, codebook in ((whole(70, 0), whole(70, 1)), (drawn(130, 18), drawn(63, 18, 1) + 9)):
        true = brute(vectors, codebook)
        index, distance = search(on, vectors, codebook)
        total = sums(vectors, torch.ones(len(vectors)).double(), index.abs() % 9, 9, on)
        right = (index.numpy() == true.argmin(1)).all() and np.allclose(distance, true.min(1), 1e-6)
        if not right or not np.array_equal(total, summed(vectors, torch.ones(len(vectors)), index.abs() % 9, 9)):
            raise KernelError("wrong")


@pytest.mark.parametrize("name", [None, *MISTAKES])
def test_mistakes(name):
    if name is None:
        return clustering(CODES_SOURCE)
    old, new, skip, message = MISTAKES[name]
    with pytest.raises(KernelError, match=message):
        clustering(changed(CODES_SOURCE, old, new, skip=skip))
