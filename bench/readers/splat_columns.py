"""Splats as plain arrays, read without surfkit, and how far two tables of them are apart."""

from __future__ import annotations

import json
import zipfile
from dataclasses import dataclass, fields, replace
from pathlib import Path

import numpy as np
from scipy.optimize import linear_sum_assignment
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree
from scipy.spatial.distance import cdist

C0 = 0.28209479177387814
TYPES = {
    "float": "<f4",
    "float32": "<f4",
    "double": "<f8",
    "uint": "<u4",
    "uint32": "<u4",
    "uchar": "u1",
    "uint8": "u1",
}


@dataclass(frozen=True)
class Splats:
    """N splats in the axes of the PLY file.

    Attributes:
        means: (N, 3).
        log_scales: (N, 3).
        quats: (N, 4) wxyz, of length 1.
        alpha: (N,) opacity from 0 to 1.
        dc: (N, 3) coefficients of degree 0.
        rest: (N, 3 (K - 1)) further coefficients: all of red, then green, then blue.
    """

    means: np.ndarray
    log_scales: np.ndarray
    quats: np.ndarray
    alpha: np.ndarray
    dc: np.ndarray
    rest: np.ndarray

    def __len__(self) -> int:
        return len(self.means)

    def rows(self, at: np.ndarray) -> Splats:
        """Some of them, in the order of the indices."""
        return Splats(*(getattr(self, field.name)[at] for field in fields(self)))


def made(means, log_scales, quats, alpha, dc, rest) -> Splats:
    """Float64 columns, quaternions brought to length 1."""
    wide = [np.asarray(values, np.float64) for values in (means, log_scales, quats, alpha, dc, rest)]
    wide[2] = wide[2] / np.linalg.norm(wide[2], axis=1, keepdims=True)
    return Splats(*wide)


def sigmoid(x: np.ndarray) -> np.ndarray:
    """1 / (1 + exp(-x)), also for Inf."""
    return 0.5 * (1 + np.tanh(np.asarray(x, np.float64) / 2))


def elements(path: Path) -> dict[str, np.ndarray]:
    """The elements of a binary little-endian PLY file as record arrays."""
    data = path.read_bytes()
    head, _, body = data.partition(b"end_header\n")
    found: dict[str, tuple[int, list]] = {}
    for words in (line.split() for line in head.decode().splitlines()):
        if words and words[0] == "element":
            found[words[1]] = last = (int(words[2]), [])
        elif words and words[0] == "property":
            last[1].append((words[2], TYPES[words[1]]))
    tables, at = {}, 0
    for name, (count, layout) in found.items():
        tables[name] = np.frombuffer(body, layout, count, at)
        at += tables[name].nbytes
    return tables


def read_ply(path: Path) -> Splats:
    """The splats of a PLY file in the layout of 3DGS."""
    rows = elements(path)["vertex"]
    columns = {
        stem: [n for n in rows.dtype.names if n.startswith(stem)] for stem in ("scale_", "rot_", "f_dc_", "f_rest_")
    }

    def stack(names):
        ordered = sorted(names, key=lambda name: int(name.rsplit("_", 1)[1]))
        return np.stack([rows[n] for n in ordered], 1).astype(np.float64) if names else np.zeros((len(rows), 0))

    means = np.stack([rows[axis] for axis in "xyz"], 1)
    some = {stem: stack(names) for stem, names in columns.items()}
    return made(means, some["scale_"], some["rot_"], sigmoid(rows["opacity"]), some["f_dc_"], some["f_rest_"])


def from_columns(path: Path, count: int, degree: int, linear: bool) -> Splats:
    """What spz.mjs (log scales, wxyz, logits) and gltf.mjs (linear scales, xyzw, opacities) write."""
    rest = 3 * ((degree + 1) ** 2 - 1)
    values = np.fromfile(path, "<f4").astype(np.float64)
    widths = [3, 3, 4, 1, 3, rest]
    if values.size != count * sum(widths):
        raise ValueError(f"{path}: {values.size} values for {count} splats of degree {degree}")
    ends = np.cumsum(np.array(widths) * count)
    means, scales, quats, opacity, dc, sh = (p.reshape(count, -1) for p in np.split(values, ends[:-1]))
    if linear:
        sh = np.concatenate([p.reshape(count, 3) for p in np.split(sh.ravel(), rest // 3)], 1) if rest else sh
        sh = sh.reshape(count, -1, 3).transpose(0, 2, 1).reshape(count, rest)  # colour inside -> all of red first
        return made(means, np.log(scales), quats[:, [3, 0, 1, 2]], opacity[:, 0], dc, sh)
    return made(means, scales, quats, sigmoid(opacity[:, 0]), dc, sh)


def to_columns(splats: Splats, path: Path) -> None:
    """What `spz.mjs --write` reads."""
    logits = np.log(np.clip(splats.alpha, 1e-7, 1 - 1e-7)) - np.log1p(-np.clip(splats.alpha, 1e-7, 1 - 1e-7))
    parts = (splats.means, splats.log_scales, splats.quats, logits, splats.dc, splats.rest)
    np.concatenate([part.ravel() for part in parts]).astype("<f4").tofile(path)


SIGNS = {"y": (0, 8, 10), "z": (1, 11, 13), "x": (2, 12, 14), "xy": (3,), "yz": (4,), "xz": (6,), "xyz": (9,)}


def turned(splats: Splats) -> Splats:
    """Turned by 180 degrees about x: y and z change sign, and what of SH is odd in them. Its own inverse."""
    flips = np.ones(15)
    for axes, indices in SIGNS.items():
        flips[list(indices)] = (-1) ** sum(axis in "yz" for axis in axes)
    per = splats.rest.shape[1] // 3
    quats = splats.quats * [1, 1, -1, -1]
    return replace(splats, means=splats.means * [1, -1, -1], quats=quats, rest=splats.rest * np.tile(flips[:per], 3))


def rotations(quats: np.ndarray) -> np.ndarray:
    """(N, 3, 3) rotation matrices of unit quaternions wxyz."""
    w, x, y, z = quats.T
    rows = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )
    return np.array(rows).transpose(2, 0, 1)


def alike(quats: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """Of the 8 quaternions of an ellipsoid (half turns about its axes, signs), those nearest to the wanted ones."""
    w, x, y, z = quats.T
    same = np.stack([(w, x, y, z), (-x, w, z, -y), (-y, -z, w, x), (-z, y, -x, w)]).transpose(2, 0, 1)  # (N, 4, 4)
    near = np.einsum("nkc,nc->nk", same, wanted)
    best = np.abs(near).argmax(1)
    rows = np.arange(len(quats))
    return same[rows, best] * np.where(near[rows, best] < 0, -1, 1)[:, None]


@dataclass(frozen=True)
class Bounds:
    """How far each attribute may be off: a scalar, or one value for each splat (and component) of the file."""

    means: float | np.ndarray = 0.0
    log_scales: float | np.ndarray = 0.0
    quats: float | np.ndarray = 0.0
    alpha: float = 0.0
    dc: float | np.ndarray = 0.0
    rest: float | np.ndarray = 0.0


def partners(reference: Splats, got: Splats, bounds: Bounds) -> np.ndarray:
    """For each splat of the file the index of its own in the reference: the nearest by all attributes."""
    order, axes = np.arange(len(got)), got.log_scales.shape[1]
    if np.all(np.abs(got.means - reference.means) <= bounds.means + 1e-9):
        return order

    has_rest = bool(got.rest.shape[1] and np.isfinite(bounds.rest).all())
    names = ("means", "log_scales", "alpha", "dc", *(["rest"] * has_rest))
    units = [np.maximum(np.median(getattr(bounds, name)), 1e-6) for name in names]

    def scaled(splats: Splats) -> np.ndarray:
        parts = [splats.means, splats.log_scales[:, :axes], splats.alpha[:, None], splats.dc, splats.rest[:, ::5]]
        parts = [part / unit for part, unit in zip(parts, units, strict=False)]
        directions = rotations(splats.quats)
        lines = np.einsum("nik,njk->nkij", directions, directions)  # the same for an axis and its opposite
        lines = lines[(slice(None), slice(None), *np.triu_indices(3))]
        return np.concatenate([*parts, lines.reshape(len(splats), -1) / max(0.01, float(np.median(bounds.quats)))], 1)

    some = min(16, len(reference))
    far, near = (values.reshape(len(got), some) for values in cKDTree(scaled(reference)).query(scaled(got), k=some))
    taken = np.zeros(len(reference), bool)
    order[:] = -1
    for pair in np.argsort(far, axis=None, kind="stable"):  # the nearest pairs first, each splat once
        mine, its = divmod(int(pair), some)
        if order[mine] < 0 and not taken[near[mine, its]]:
            order[mine] = near[mine, its]
            taken[order[mine]] = True
    if (order < 0).any():
        raise ValueError(f"{(order < 0).sum()} splats have no partner of their own in the reference")
    return exchanged(order, near, scaled(got), scaled(reference))


def exchanged(order: np.ndarray, near: np.ndarray, ours: np.ndarray, theirs: np.ndarray) -> np.ndarray:
    """Partners exchanged within groups of splats that are near the same ones, such as clones, for the least squares."""
    holder = np.empty(len(theirs), np.int64)
    holder[order] = np.arange(len(order))
    wrong = np.flatnonzero(order != near[:, 0])
    place = (near[wrong] == order[wrong, None]).argmax(1)
    links = [(row, holder[other]) for row, last in zip(wrong, place, strict=True) for other in near[row, :last]]
    if not links:
        return order
    rows, others = np.array(links).T
    graph = coo_matrix((np.ones(len(rows)), (rows, others)), (len(order), len(order)))
    group = connected_components(graph, directed=False)[1]
    order = order.copy()
    for name in np.unique(group[wrong]):
        members = np.flatnonzero(group == name)
        costs = cdist(ours[members], theirs[order[members]], "sqeuclidean")
        order[members] = order[members][linear_sum_assignment(costs)[1]]
    return order


def difference(reference: Splats, got: Splats, bounds: Bounds) -> dict[str, float]:
    """The largest error of each attribute as a share of what is allowed; above 1 they disagree.

    Raises:
        ValueError: Other numbers of splats or coefficients, or splats without a partner.
    """
    if len(reference) != len(got):
        raise ValueError(f"{len(got)} splats; the reference has {len(reference)}")
    if got.rest.shape[1] not in (reference.rest.shape[1], 0):
        raise ValueError(f"{got.rest.shape[1]} further coefficients; the reference has {reference.rest.shape[1]}")
    mine = reference.rows(partners(reference, got, bounds))
    shares = {}
    for name in ("means", "log_scales", "quats", "alpha", "dc", "rest"):
        a, b = getattr(mine, name), getattr(got, name)
        if name == "quats":
            a = alike(a, b)
        if name == "rest" and not b.shape[1]:
            continue
        if name == "log_scales":  # programs that know surfels leave out the third scale
            a = a[:, : b.shape[1]]
        error = np.abs(a - b)
        allowed = np.asarray(getattr(bounds, name), np.float64)
        allowed = np.broadcast_to(allowed[..., : error.shape[-1]] if allowed.ndim else allowed, error.shape)
        allowed = allowed + 2e-6 * np.maximum(1, np.abs(a))
        shares[name] = float((error / allowed).max(initial=0)) if np.isfinite(b).all() else float("inf")
    return shares


def representable(splats: Splats, form: str) -> Splats:
    """The splats with all values brought into the range that a format has."""
    if form == "spz":
        dc = splats.dc.clip(-0.5 / 0.15, 0.5 / 0.15)
        return replace(
            splats, log_scales=splats.log_scales.clip(-10, 255 / 16 - 10), dc=dc, rest=splats.rest.clip(-1, 127 / 128)
        )
    if form == "splat":
        return replace(splats, dc=splats.dc.clip(-0.5 / C0, 0.5 / C0))
    if form == "compressed-ply":
        return replace(splats, log_scales=splats.log_scales.clip(-20, 20), rest=splats.rest.clip(-4, 4))
    return splats


def precision(form: str, path: Path, reference: Splats) -> Bounds:
    """What the specification of a format allows, for the very file."""
    if form == "spz":
        return spz_bounds(spz_head(path), reference)
    if form == "splat":
        return Bounds(0, 0, 0.02, 1 / 255, 1 / (255 * C0), 0)
    if form == "compressed-ply":
        tables = elements(path)
        chunks = tables["chunk"][np.arange(len(tables["vertex"])) // 256]

        def step(stem: str, axes: str, counts) -> np.ndarray:
            extent = [chunks[f"max_{stem}{a}"].astype(np.float64) - chunks[f"min_{stem}{a}"] for a in axes]
            return np.stack([0.505 * e / c for e, c in zip(extent, counts, strict=True)], 1) + 1e-5

        colours = step("", "rgb", (255,) * 3) / C0
        return Bounds(
            step("", "xyz", (2047, 1023, 2047)),
            step("scale_", "xyz", (2047, 1023, 2047)),
            0.004,
            0.51 / 255,
            colours,
            1 / 32,
        )
    if form == "sog":
        return sog_precision(path, reference)
    return Bounds(1e-6, 1e-5, 1e-5, 1e-6, 1e-6, 1e-6)


def spz_bounds(head: dict[str, int], reference: Splats) -> Bounds:
    """Half a step of each attribute; SH are rounded to 5 and 4 bits, by the library downwards."""
    # The dropped component of a quaternion is the root of what the others leave: its error grows as it gets small.
    quats = np.array([0.12, 0.006, 0.006, 0.006]) if head["version"] == 2 else 0.004
    per = reference.rest.shape[1] // 3
    steps = np.tile([4.5 / 128 if k < 3 else 8.5 / 128 for k in range(per)], 3)
    step = 2.0 ** -head["fractional_bits"]
    return Bounds(0.5001 * step, 0.5001 / 16, quats, 0.51 / 255, 0.51 / (255 * 0.15), steps)


def sog_precision(path: Path, reference: Splats) -> Bounds:
    """16 bits of the logarithm of positions; as far as values can be from a code; a palette for the rest of SH."""
    meta = sog_meta(path)
    mins, maxs = (np.array(meta["means"][key]) for key in ("mins", "maxs"))
    means = 1.01 * (maxs - mins) / 65535 * (1 + np.abs(reference.means).max(0))

    def farthest(key: str, values: np.ndarray) -> float:
        codes = np.sort(meta[key]["codebook"])
        return max(0.51 * np.diff(codes).max(), codes[0] - values.min(), values.max() - codes[-1]) + 1e-4

    scales, colours = farthest("scales", reference.log_scales), farthest("sh0", reference.dc)
    return Bounds(means, scales, 0.025, 1.01 / 255, colours, np.inf)


def sog_meta(path: Path) -> dict:
    """meta.json of a bundled or an unbundled SOG."""
    if path.suffix == ".json":
        return json.loads(path.read_text())
    with zipfile.ZipFile(path) as bundle:
        return json.loads(bundle.read("meta.json"))


def spz_head(path: Path) -> dict[str, int]:
    """Version, number of points, degree and fractional bits of a .spz file."""
    import gzip

    data = path.read_bytes()
    head = gzip.decompress(data)[:16] if data[:2] == b"\x1f\x8b" else data[:16]
    version, count = (int(x) for x in np.frombuffer(head, "<u4", 2, 4))
    return {"version": version, "points": count, "degree": head[12], "fractional_bits": head[13]}
