"""k-means and the search of the nearest code, against float64 brute force, plain Lloyd and exact arithmetic."""

import resource
from contextlib import contextmanager

import numpy as np
import pytest
import torch
from needs import needs, needs_native

from surfkit.compress import kmeans as clustering
from surfkit.compress import nearest as search
from surfkit.compress.kmeans import Lloyd, kmeans, nearest
from surfkit.core.check import BadInput
from surfkit.raster import native

TORCH = "torch"
ENGINES = [*(native.module().kernels() if native.module() else []), TORCH]
"""Compilations of the kernels, and what works without a compiler."""


@contextmanager
def using(engine):
    """Everything runs in one compilation of the kernels, or without any."""
    if engine == TORCH:
        with pytest.MonkeyPatch.context() as patch:
            for module in (search, clustering):
                patch.setattr(module, "module", lambda: None)
            yield
        return
    before = native.module().kernels_in_use()
    native.module().use_kernels(engine)
    yield
    native.module().use_kernels(before)


@contextmanager
def threads(number):
    before = torch.get_num_threads()
    torch.set_num_threads(number)
    yield
    torch.set_num_threads(before)


def clustered(count, dimensions, clusters=40, seed=0, spread=0.2):
    """(N, D) float32 in clusters of different sizes; the later dimensions vary less."""
    random = np.random.default_rng(seed)
    middles = random.normal(size=(clusters, dimensions)) / np.sqrt(1 + np.arange(dimensions))
    which = random.choice(clusters, count, p=random.dirichlet(np.ones(clusters)))
    noise = spread * random.normal(size=(count, dimensions)) / np.sqrt(1 + np.arange(dimensions))
    return torch.from_numpy((middles[which] + noise).astype(np.float32))


def brute(vectors, codebook):
    """(N, K) float64 squared distances."""
    x, c = vectors.double().numpy(), codebook.double().numpy()
    return np.stack([np.square(row - c).sum(1) for row in x])


def same(one, other):
    return all(
        a.dtype == b.dtype and a.numpy().tobytes() == b.numpy().tobytes() for a, b in zip(one, other, strict=True)
    )


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize(
    "shape", [(1, 1, 1), (7, 2, 3), (130, 16, 2), (200, 17, 45), (333, 500, 24), (50, 1000, 48)], ids=str
)
def test_nearest_is_that_of_brute_force(engine, shape):
    count, codes, dimensions = shape
    vectors, codebook = clustered(count, dimensions), clustered(codes, dimensions, seed=1)
    with using(engine):
        index, distance = nearest(vectors, codebook)
    true = brute(vectors, codebook)
    assert index.dtype == torch.int32 and distance.dtype == torch.float32 and index.shape == distance.shape == (count,)
    assert (index.numpy() == true.argmin(1)).all()
    np.testing.assert_allclose(distance.numpy(), true.min(1), rtol=1e-6)


@pytest.mark.parametrize("engine", ENGINES)
def test_equal_distances_go_to_the_lowest_index(engine):
    """Whole numbers: every sum is exact, and most least distances are shared."""
    random = np.random.default_rng(0)
    vectors, codebook = (torch.from_numpy(random.integers(-2, 3, (n, 6)).astype(np.float32)) for n in (500, 3000))
    true = brute(vectors, codebook)
    assert ((true == true.min(1, keepdims=True)).sum(1) > 1).mean() > 0.5
    with using(engine):
        index, distance = nearest(vectors, codebook)
    assert (index.numpy() == true.argmin(1)).all() and (distance.numpy() == true.min(1)).all()


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize(
    "change",
    [
        lambda x: x * 1e14,
        lambda x: x * 1e-18,
        lambda x: x * 1e-30,
        lambda x: x + 1000,
        lambda x: x * 1e-4 + 300 * torch.sign(x[:, :1]),
        lambda x: x + 3e4 * torch.sign(x[:, :1]),
        lambda x: torch.where(torch.arange(len(x))[:, None] % 97 == 5, 1e12 * x, x),
        lambda x: x * torch.tensor([1e6, 1e3, 1, 1e-3, 1e-6, 1e-9, 1, 1, 1]).repeat(5)[: x.shape[1]],
    ],
    ids=[
        "large",
        "small",
        "tiny",
        "far away",
        "two tight clusters far apart",
        "two clusters far apart",
        "outliers",
        "different scales",
    ],
)
def test_rounding_errors_rule_no_nearest_code_out(engine, change):
    vectors, codebook = change(clustered(150, 45)), change(clustered(300, 45, seed=1))
    features, true = search.DistanceBounds.of(codebook), brute(vectors, codebook)
    with using(engine):
        every = search.searching(codebook, features).nearest(vectors, features(vectors))  # fewer leave room for errors
        for index, _ in (every, nearest(vectors, codebook)):
            found = np.take_along_axis(true, index.numpy()[:, None].astype(int), 1)[:, 0]
            assert (found <= true.min(1) * (1 + 1e-13)).all()


@pytest.mark.parametrize("engine", ENGINES)
def test_codes_at_nearly_the_same_distance_are_told_apart(engine):
    """By less than float32 can tell: the same numbers in other orders, one of them by a few bits larger."""
    random, numbers = np.random.default_rng(0), np.linspace(0.1, 1, 45, dtype=np.float32)
    for away in [0.0, 300.0, 1e6] * 10:  # also where float32 products cannot tell any two codes apart
        vectors, codes = torch.zeros(1, 46), torch.zeros(100, 46)
        for code, more in enumerate(random.permutation(60)):
            larger = np.where(np.arange(45) == 20, numbers + more * np.spacing(numbers), numbers)
            codes[code, :45] = torch.from_numpy(random.permutation(larger))
        vectors[:, 45] = codes[:60, 45] = away
        codes[60:, 45] = -away - 50
        features = search.DistanceBounds.of(codes)  # all of them: fewer leave room for errors
        with using(engine):
            index, _ = search.searching(codes, features).nearest(vectors, features(vectors))
        assert index[0] == brute(vectors, codes)[0].argmin()


def test_nearest_has_the_same_bits_everywhere():
    """On any number of threads, with any instruction set, without a compiler, and in any parts."""
    vectors, codebook = clustered(3000, 45), clustered(700, 45, seed=1)
    with using(TORCH):
        expected = nearest(vectors, codebook)
    for engine in ENGINES:
        for number in (1, 2, 5):
            with using(engine), threads(number):
                assert same(expected, nearest(vectors, codebook)), f"{engine}, {number} threads"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(search, "VECTORS_PER_CALL", 100)
        patch.setattr(search, "MAX_TORCH_DISTANCES", 7000)
        for engine in {*ENGINES[:1], TORCH}:
            with using(engine):
                assert same(expected, nearest(vectors, codebook)), f"{engine} in small parts"


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize("used", [1, 3, 8, 44, 45])
def test_no_number_of_features_changes_a_bit(engine, used):
    vectors, codebook = clustered(400, 45), clustered(260, 45, seed=1)
    with using(engine):
        all_of_them = search.DistanceBounds.of(codebook)
        features = search.DistanceBounds(all_of_them.mean, all_of_them.axes, used)
        found = search.searching(codebook, features).nearest(vectors, features(vectors))
        assert same(found, nearest(vectors, codebook))


def test_distances_of_features_are_at_most_those_of_vectors():
    vectors = clustered(300, 24)
    features = search.DistanceBounds.of(vectors)
    true = torch.cdist(vectors.double(), vectors.double())
    for used in (1, 5, 23, 24):
        few = search.DistanceBounds(features.mean, features.axes, used)(vectors)
        assert few.shape == (300, min(used + 1, 24))
        bound = torch.cdist(few.double(), few.double())
        assert (bound <= true + 1e-6).all() and bound.sum() > 0.3 * true.sum()


@needs_native
def test_nearest_makes_no_matrix_of_all_distances():
    vectors, codebook = clustered(100_000, 4), clustered(10_000, 4, seed=1)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    nearest(vectors, codebook)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 200_000, "kB; the matrix takes 4,000,000"


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize("codes, dimensions", [(256, 24), (8192, 45), (65536, 48)])
def test_calls_are_short_and_cover_all_rows(engine, codes, dimensions):
    """Between them, Python sees Ctrl-C."""
    codebook = torch.zeros(codes, dimensions)
    features = search.DistanceBounds(torch.zeros(dimensions).double(), torch.eye(dimensions).double(), dimensions)
    with using(engine), threads(2):
        parts = list(search.searching(codebook, features).parts(100_001))
    assert [part.start for part in parts] == [0, *(part.stop for part in parts[:-1])] and parts[-1].stop == 100_001
    for part in parts:
        assert (part.stop - part.start) * codes * dimensions <= 5e9


def distortion(vectors, codebook, weights=None):
    return np.average(brute(vectors, codebook).min(1), weights=weights)


def plain_lloyd(vectors, codes, iterations):
    """Textbook k-means in numpy, from vectors drawn at random."""
    x = vectors.double().numpy()
    centres = x[np.random.default_rng(0).permutation(len(x))[:codes]]
    for _ in range(iterations):
        index = (np.square(x).sum(1)[:, None] - 2 * x @ centres.T + np.square(centres).sum(1)).argmin(1)
        for code in np.unique(index):
            centres[code] = x[index == code].mean(0)
    return torch.from_numpy(centres.astype(np.float32))


def test_distortion_is_as_good_as_that_of_others():
    for clusters, plain, scipy in ((150, 0.75, 0.88), (40, 0.9, 0.97)):
        vectors = clustered(4000, 12, clusters=clusters)
        ours = distortion(vectors, kmeans(vectors, 128))
        assert ours < plain * distortion(vectors, plain_lloyd(vectors, 128, 10))
        theirs, _ = needs("scipy.cluster.vq").kmeans2(vectors.numpy().copy(), 128, 10, minit="++", rng=0)
        assert ours < scipy * distortion(vectors, torch.from_numpy(theirs))


def test_weights_count_as_often_as_they_say():
    """When nothing changes any more, each code is the weighted mean of its vectors."""
    vectors = clustered(1500, 8)
    weights = torch.where(vectors[:, 0] > 0, 10.0, 0.1) * (torch.arange(1500) % 3 > 0)
    codebook = kmeans(vectors, 30, weights, iterations=200)
    index = nearest(vectors, codebook)[0].numpy()
    for code in range(30):
        mine = index == code
        mean = np.average(vectors.double().numpy()[mine], axis=0, weights=weights.double().numpy()[mine])
        np.testing.assert_allclose(codebook[code], mean, rtol=1e-5, atol=1e-6)
    plain = kmeans(vectors, 30, iterations=200)
    assert distortion(vectors, codebook, weights) < 0.9 * distortion(vectors, plain, weights)


def test_vectors_without_weight_count_nothing():
    vectors, weights = clustered(1000, 8), torch.ones(1000)
    weights[::2] = 0
    assert torch.equal(kmeans(vectors, 20, weights), kmeans(vectors[1::2], 20))
    assert torch.equal(kmeans(vectors, 20, torch.zeros(1000)), kmeans(vectors, 20)), "all zero: equal weights"
    assert torch.equal(kmeans(vectors, 20, torch.full((1000,), 4.0)), kmeans(vectors, 20))


LINE = torch.tensor([0, 1, 10, 11, 12, 20, 29, 30, 50.0])[:, None]
"""Vectors on a line."""


def moved(codebook, weight=None):
    """The codes after one iteration with the vectors of the line, sorted."""
    lloyd = Lloyd(
        LINE, np.ones(9) if weight is None else np.array(weight), len(codebook), np.random.default_rng(0), 1, None
    )
    return sorted(lloyd.improved(torch.tensor(codebook)[:, None]).flatten().tolist())


def test_a_code_without_vectors_moves_to_the_largest_weighted_error():
    assert moved([0.5, 11, 27, 50, 999]) == [0.5, 11, 20, 29.5, 50]
    heavy = [9, 9, 1, 1, 1, 0.01, 0.01, 0.01, 1]
    assert moved([0.5, 11, 27, 50, 999], heavy) == pytest.approx([0, 1, 11, (20 + 29 + 30) / 3, 50])


def test_close_codes_are_merged_where_a_split_gains_more():
    assert moved([0, 1, 11, 27, 50.0]) == [0.5, 11, 20, 29.5, 50]
    assert moved([0.5, 10, 11.5, 20, 29.5, 50]) == [0.5, 10, 11.5, 20, 29.5, 50], "nothing gains more than it costs"
    assert moved([0.5, 0.6, 11, 27, 50]) == [0.5, 11, 20, 29.5, 50], "a code without vectors is near one with them"


def test_the_sum_never_rises():
    vectors, weight = clustered(3000, 9, clusters=90), np.random.default_rng(0).random(3000) ** 3
    lloyd = Lloyd(vectors, weight, 64, np.random.default_rng(0), 1, None)
    codebook, seen = lloyd.seeds(), []
    for _ in range(12):
        seen.append(distortion(vectors, codebook, weight))
        codebook = lloyd.improved(codebook)
    assert (np.diff(seen) <= 1e-9).all() and seen[-1] < 0.7 * seen[1]


def test_dead_codes_come_to_life():
    """Most vectors are one: seeds fall on it, and yet all codes are used."""
    vectors = torch.cat([torch.zeros(5000, 3), clustered(300, 3)])
    codebook = kmeans(vectors, 100)
    assert len(nearest(vectors, codebook)[0].unique()) > 95
    assert distortion(vectors, codebook) < 0.1 * distortion(vectors, codebook[:10])


@pytest.mark.parametrize("engine", ENGINES)
def test_a_code_may_be_left_out(engine):
    codebook = clustered(100, 7)
    own = torch.arange(100, dtype=torch.int32)
    features = search.DistanceBounds.of(codebook)
    with using(engine):
        index, distance = search.searching(codebook, features).nearest(codebook, features(codebook), own)
    true = brute(codebook, codebook) + np.diag(np.full(100, np.inf))
    assert (index.numpy() == true.argmin(1)).all()
    np.testing.assert_allclose(distance.numpy(), true.min(1), rtol=1e-6)


def test_few_different_vectors_are_found_exactly():
    different = clustered(20, 5)
    vectors = different[torch.arange(500) % 20]
    for codes, iterations in ((20, 0), (20, 10), (21, 0), (64, 10)):
        codebook = kmeans(vectors, codes, iterations=iterations)
        index, distance = nearest(vectors, codebook)
        assert codebook.shape == (codes, 5) and not distance.any() and len(index.unique()) == 20
    assert kmeans(vectors, 19).shape == (19, 5) and nearest(vectors, kmeans(vectors, 19))[1].max() > 0
    weights = (torch.arange(500) % 20 < 8).float()
    assert not nearest(different[:8], kmeans(vectors, 8, weights))[1].any(), "as many as have a weight"
    signs = kmeans(torch.tensor([[0.0], [-0.0]] * 50 + [[1.0]]), 2, iterations=0)
    assert sorted(signs.flatten().tolist()) == [0, 1]


def test_no_vector_and_one():
    assert torch.equal(kmeans(torch.zeros(0, 3), 4), torch.zeros(4, 3))
    assert torch.equal(kmeans(torch.tensor([[1.0, 2, 3]]), 2), torch.tensor([[1.0, 2, 3]] * 2))
    index, distance = nearest(torch.zeros(0, 3), torch.zeros(0, 3))
    assert index.shape == distance.shape == (0,) and index.dtype == torch.int32
    assert nearest(torch.zeros(0, 3), torch.zeros(5, 3))[0].shape == (0,)


def test_kmeans_has_the_same_bits_everywhere():
    vectors, weights = clustered(2500, 20), torch.rand(2500, generator=torch.Generator().manual_seed(0))
    with using(TORCH):
        expected = kmeans(vectors, 150, weights, iterations=5)
    for engine in ENGINES:
        for number in (1, 2, 5):
            with using(engine), threads(number):
                found = kmeans(vectors, 150, weights, iterations=5)
                assert same([expected], [found]), f"{engine}, {number} threads"
    assert not torch.equal(expected, kmeans(vectors, 150, weights, iterations=5, seed=1))


def test_arguments_stay_as_they_are():
    vectors, weights = clustered(400, 5), torch.ones(400)
    before = vectors.clone(), weights.clone()
    nearest(vectors, kmeans(vectors, 30, weights))
    assert same(before, (vectors, weights))
    strided = torch.cat([vectors, vectors], 1)[:, :5].requires_grad_()
    assert torch.equal(kmeans(strided, 30), kmeans(vectors, 30))


def test_iterations_look_at_a_sample_alone():
    vectors, seen = clustered(6000, 6), []
    codebook = kmeans(vectors, 32, sample=1500, iterations=3, progress=lambda *at: seen.append(at))
    assert seen[-1] == (1500 * 3,) * 2
    assert distortion(vectors, codebook) < 1.15 * distortion(vectors, kmeans(vectors, 32))


def test_progress_rises_to_the_end_and_may_stop_the_work():
    vectors, seen = clustered(2000, 6), []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(search, "VECTORS_PER_CALL", 500)
        kmeans(vectors, 10, iterations=100, progress=lambda *at: seen.append(at))
    done, of = zip(*seen, strict=True)
    assert list(done) == sorted(set(done)) and set(of) == {done[-1]} and len(seen) > 10

    def stop(done, of):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        kmeans(vectors, 10, progress=stop)


def with_value(value):
    vectors = clustered(10, 3)
    vectors[7, 1] = value
    return vectors


@pytest.mark.parametrize(
    "call, message",
    [
        (lambda: kmeans(with_value(float("nan")), 2), "vectors: row 7 .*nan; .*finite"),
        (lambda: kmeans(with_value(float("inf")), 2), "vectors: row 7 .*inf; .*finite"),
        (lambda: kmeans(with_value(-1e16), 2), "vectors: row 7 .*-1e[+]16; .*1e[+]15"),
        (lambda: kmeans(clustered(10, 3).double(), 2), "vectors: expected float32, got float64"),
        (lambda: kmeans(torch.zeros(10), 2), r"vectors: expected shape \(N, D\), got \(10,\)"),
        (lambda: kmeans(torch.zeros(10, 0), 2), r"vectors: .*one column, got \(10, 0\)"),
        (lambda: kmeans(clustered(10, 3), 2, torch.ones(9)), r"weights: expected shape \(10,\), got \(9,\)"),
        (
            lambda: kmeans(clustered(2, 3), 2, torch.tensor([1, -1.0])),
            "weights: row 1 .*-1; .*negative",
        ),
        (lambda: kmeans(clustered(2, 3), 2, torch.tensor([torch.nan, 1])), "weights: row 0 has the value nan"),
        (lambda: kmeans(clustered(10, 3), 0), "codes is 0; .*1"),
        (lambda: kmeans(clustered(10, 3), 2, iterations=-1), "iterations is -1; .*0"),
        (lambda: kmeans(clustered(10, 3), 5, sample=4), "sample is 4; .*5"),
        (
            lambda: nearest(clustered(5, 3), clustered(5, 4)),
            r"codebook: expected shape \(K, D\) with D = 3, got \(5, 4\)",
        ),
        (lambda: nearest(clustered(5, 3), with_value(float("nan"))), "codebook: row 7 has the value nan"),
        (lambda: nearest(clustered(5, 3), torch.zeros(0, 3)), "codebook: .*no codes.* 5 vectors"),
    ],
)
def test_bad_input_is_named(call, message):
    with pytest.raises(BadInput, match=message):
        call()
