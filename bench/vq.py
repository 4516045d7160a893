"""Measure vector quantisation against faiss: `python bench/vq.py [MODEL.ply]`.

Seconds and distortion of `kmeans` and of the final `nearest` over all vectors, and of faiss-cpu with as many codes,
iterations and threads, in turns after a warm-up; medians, and the medians of the ratios ours / faiss, as other programs
may run on the machine. Vectors are random ones in clusters, and the spherical harmonics of a trained model where a PLY
file is given. faiss is not among the packages that surfkit needs: `pip install faiss-cpu`.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from machine import save

from surfkit.compress.kmeans import kmeans, nearest
from surfkit.io.splats.ply import read_splats

SIDES = ("ours", "faiss")


def clustered(count: int, dimensions: int, clusters: int) -> np.ndarray:
    """(N, D) float32 around random places, of different sizes and spreads."""
    random = np.random.default_rng(0)
    middles, spread = random.normal(size=(clusters, dimensions)), 0.3 * np.exp(random.normal(size=(clusters, 1)) / 2)
    which = random.choice(clusters, count, p=random.dirichlet(np.ones(clusters)))
    return (middles[which] + spread[which] * random.normal(size=(count, dimensions))).astype(np.float32)


def harmonics(path: Path, most: int) -> np.ndarray:
    """(N, D) float32 spherical harmonics of degree 1 and more of a model, in a random order."""
    rows = read_splats(path).sh_rest.flatten(1).numpy()
    return np.ascontiguousarray(rows[np.random.default_rng(0).permutation(len(rows))[:most]])


def ours(vectors: np.ndarray, codes: int, iterations: int, seed: int) -> np.ndarray:
    """(N,) squared distances to the nearest code, after k-means."""
    x = torch.from_numpy(vectors)
    return nearest(x, kmeans(x, codes, seed=seed, iterations=iterations))[1].numpy()


def of_faiss(vectors: np.ndarray, codes: int, iterations: int, seed: int) -> np.ndarray:
    """The same by faiss."""
    import faiss

    faiss.omp_set_num_threads(torch.get_num_threads())
    sizes = {"min_points_per_centroid": 1, "max_points_per_centroid": 256}
    means = faiss.Kmeans(vectors.shape[1], codes, niter=iterations, seed=seed + 1, **sizes)
    means.train(vectors)
    return means.index.search(vectors, 1)[0][:, 0]


def timed(action: Callable[[], np.ndarray]) -> dict[str, float]:
    """Seconds, seconds of all threads, and mean of what comes."""
    began, work = time.perf_counter(), time.process_time()
    distance = action()
    seconds, work = time.perf_counter() - began, time.process_time() - work
    return {"s": seconds, "CPU s": work, "mean squared distance": float(distance.astype(np.float64).mean())}


def compared(vectors: np.ndarray, codes: int, options: argparse.Namespace) -> dict:
    """Medians of both and of their ratios."""
    actions = dict(zip(SIDES, (ours, of_faiss), strict=True))
    for action in actions.values():
        action(vectors[:4000], 64, 2, 0)
    rounds = [
        {name: timed(lambda a=a, r=r: a(vectors, codes, options.iterations, r)) for name, a in actions.items()}
        for r in range(options.rounds)
    ]
    found: dict = {"vectors": list(vectors.shape), "codes": codes, "iterations": options.iterations}
    for name in SIDES:
        found[name] = {key: middle(each[name][key] for each in rounds) for key in rounds[0][name]}
    found["ours / faiss"] = {
        key: middle(each["ours"][key] / each["faiss"][key] for each in rounds) for key in found["ours"]
    }
    return found


def middle(values) -> float:
    """The median, to four digits."""
    return float(f"{statistics.median(values):.4g}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("model", type=Path, nargs="?", help="PLY file of a trained model with spherical harmonics")
    parser.add_argument("--codes", type=int, nargs="+", default=[1024, 8192])
    parser.add_argument("--vectors", type=int, default=400_000, help="at most")
    parser.add_argument("--iterations", type=int, default=10)
    parser.add_argument("--rounds", type=int, default=3, help="the median of so many")
    parser.add_argument("--threads", type=int, default=2)
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    try:
        import faiss
    except ImportError:
        parser.error("faiss is not installed; pip install faiss-cpu, then call this again")
    data = {"2000 clusters, 45 dimensions": clustered(options.vectors, 45, 2000)}
    if options.model:
        data["spherical harmonics of a model"] = harmonics(options.model, options.vectors)
    figures: dict = {"faiss": faiss.__version__, "rounds": options.rounds}
    for name, vectors in data.items():
        for codes in options.codes:
            figures[f"{name}, {codes} codes"] = found = compared(vectors, codes, options)
            ratio = found["ours / faiss"]
            print(f"{name}, {codes} codes: {found['ours']['s']:.1f} s, {found['faiss']['s']:.1f} s by faiss;", end=" ")
            print(
                f"ours / faiss: CPU {ratio['CPU s']:.3f}, distortion {ratio['mean squared distance']:.4f}", flush=True
            )
    print(f"wrote {save('vq', figures)}")


if __name__ == "__main__":
    main()
