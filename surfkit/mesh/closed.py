"""A closed surface for printing and simulation: every edge has two triangles, which pass it in opposite directions.

The surface is cut where more than two triangles meet (Gueziec, Taubin, Lazarus and Horn, "Cutting and stitching:
converting sets of polygons to manifold surfaces", 2001). Its holes are filled; open ground gets walls around its rim,
down to a flat base.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from heapq import heapify, heappop, heappush

import numpy as np

from surfkit.core.check import BadInput
from surfkit.mesh.base import Mesh
from surfkit.mesh.clean import large_enough
from surfkit.mesh.holes import areas_of, edges, fill, rings
from surfkit.mesh.manifold import apart, separated
from surfkit.mesh.shade import OPEN_GROUND_SHARE
from surfkit.mesh.simplify import collapsed, require_kernels

MAX_FILLED_EDGES = 64
"""Edges of holes that are filled with the least area; from larger ones, ears are cut until they have as few."""
BASE_MARGIN_SHARE = 0.02
"""By how much the base lies below the lowest point, as a share of the width of the mesh."""
MIN_PART_SHARE = 0.01
"""Share of the area of the largest part below which an open part is left out."""
BASE_COLLAPSE_COST = 1e-6
"""What simplifying the flat base may cost: it is flat, so this is for rounding only; see `collapsed`."""


@dataclass(frozen=True)
class Closing:
    """What was done to close a mesh.

    Attributes:
        cut: Vertices that were doubled, where more than two triangles met at an edge, or parts at a vertex only.
        holes: That were filled.
        largest_hole: Edges of the largest of them.
        skirts: Parts of open ground that got walls and a base.
        base: Height of the base along the direction that is up, local units; None without skirts.
        dropped: Parts that were left out: small open ones, small bodies, and those that enclose nothing or are inside
            out.
        dropped_triangles: That these had.
        bodies: Closed parts that are left.
        volume: That these enclose, local units cubed.
    """

    cut: int
    holes: int
    largest_hole: int
    skirts: int
    base: float | None
    dropped: int
    dropped_triangles: int
    bodies: int = 0
    volume: float = 0.0


UNCHANGED = Closing(0, 0, 0, 0, None, 0, 0)
"""Of a mesh that was closed before."""


def closed(mesh: Mesh, up: np.ndarray, most: int | None = None, least: int = 1) -> tuple[Mesh, Closing]:
    """The mesh, closed, and what was done.

    What is added has the colours of its rim, no views, and an error that is not known (NaN).

    Args:
        mesh: Welded, without triangles that have no area.
        up: (3,) unit vector, local frame.
        most: Bodies that are kept; see `clean`. None: all.
        least: Triangles that a body must have to stay.

    Raises:
        BadInput: It cannot be closed, or encloses nothing; there are no compiled kernels.
    """
    require_kernels("closing a mesh")
    given = len(np.unique(mesh.faces))
    mesh = separated(mesh)
    cut = len(mesh.vertices) - given
    mesh, scraps = _without_scraps(mesh)
    known, free = edges(mesh)
    loops = rings(free)
    at_rim = _rims(mesh, loops, up)
    rims, holes = [loops[at] for at in at_rim], [loop for at, loop in enumerate(loops) if at not in at_rim]
    mesh, base = _filled(mesh, holes, known), None
    if rims:
        heights = mesh.vertices.astype(np.float64) @ up
        across = mesh.vertices.astype(np.float64) - heights[:, None] * up
        base = float(heights.min() - BASE_MARGIN_SHARE * np.ptp(across, axis=0).max())
        mesh = _on_base(mesh, rims, up, base)
    closing = Closing(cut, len(holes), max(map(len, holes), default=0), len(rims), base, *scraps)
    mesh, closing = bodies_of(mesh, closing, most, least)
    mesh, closing = bodies_of(apart(mesh), closing)
    require_closed(mesh)
    return mesh, closing


def require_closed(mesh: Mesh, name: str = "the mesh") -> None:
    """BadInput, which names the mesh, unless each edge has two triangles, one each way."""
    if wrong := open_or_crowded(mesh):
        raise BadInput(f"{name} cannot be closed: {wrong:,} of its edges do not have two triangles, one each way")


def open_or_crowded(mesh: Mesh) -> int:
    """Edges that do not have two triangles, one each way, where vertices in one place are taken for one."""
    places = np.ascontiguousarray(mesh.vertices + np.float32(0)).view(np.void(12))[:, 0]
    one = np.unique(places, return_inverse=True)[1][mesh.faces].astype(np.int64)
    start, end = one.ravel(), np.roll(one, -1, 1).ravel()
    names, edge = np.unique(np.minimum(start, end) << 32 | np.maximum(start, end), return_inverse=True)
    forth = np.bincount(edge, start < end, len(names))
    back = np.bincount(edge, start > end, len(names))
    return int(((forth != 1) | (back != 1)).sum())


def _part_of_vertices(mesh: Mesh) -> np.ndarray:
    """(V,) number of the connected part of each vertex."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    a, b = mesh.faces[:, :2].ravel(), mesh.faces[:, 1:].ravel()
    links = coo_matrix((np.ones(len(a), bool), (a, b)), shape=(len(mesh.vertices),) * 2)
    return connected_components(links, directed=False)[1]


def _without_scraps(mesh: Mesh) -> tuple[Mesh, tuple[int, int]]:
    """The mesh without open parts that are small beside the largest part, and how many parts and triangles they were.

    They are loose sheets, which would become columns on the base, or thin as paper.
    """
    parts = _part_of_vertices(mesh)
    areas = np.bincount(parts[mesh.faces[:, 0]], areas_of(mesh.vertices, mesh.faces), parts.max() + 1)
    scraps = areas < MIN_PART_SHARE * areas.max()
    is_open = np.zeros(len(areas), bool)
    is_open[parts[edges(mesh)[1][:, 0]]] = True
    scraps &= is_open
    stays = ~scraps[parts[mesh.faces[:, 0]]]
    return _of_faces(mesh, stays), (int(scraps.sum()), int((~stays).sum()))


def _of_faces(mesh: Mesh, stays: np.ndarray) -> Mesh:
    """The mesh with some of its triangles, and the vertices that these have."""
    used, at = np.unique(mesh.faces[stays], return_inverse=True)
    return mesh.take(used, at.reshape(-1, 3).astype(np.int32))


def _rims(mesh: Mesh, loops: list[np.ndarray], up: np.ndarray) -> set[int]:
    """Which loops are the rims of open ground: the longest of each part that faces up, on the whole."""
    parts = _part_of_vertices(mesh)
    a, b, c = (mesh.vertices[mesh.faces[:, corner]].astype(np.float64) for corner in range(3))
    areas, of_face = np.cross(b - a, c - a), parts[mesh.faces[:, 0]]
    grounds = np.bincount(of_face, areas @ up) > OPEN_GROUND_SHARE * np.bincount(of_face, np.linalg.norm(areas, axis=1))
    longest: dict[int, tuple[float, int]] = {}
    for at, loop in enumerate(loops):
        places, own = mesh.vertices[loop].astype(np.float64), int(parts[loop[0]])
        length = float(np.linalg.norm(places - np.roll(places, 1, 0), axis=1).sum())
        if grounds[own] and length > longest.get(own, (0.0, 0))[0]:
            longest[own] = length, at
    return {at for _, at in longest.values()}


def _filled(mesh: Mesh, loops: list[np.ndarray], known: np.ndarray) -> Mesh:
    """The mesh with loops of open edges filled; `known` are the names of its edges, see `edges`."""
    by_length: dict[int, list[np.ndarray]] = {}
    made, fans = [], []
    for loop in loops:
        ears, rest = _without_ears(mesh.vertices, loop, known)
        made.append(ears)
        by_length.setdefault(len(rest), []).append(rest)
    for length, alike in by_length.items():
        if length > MAX_FILLED_EDGES:
            fans += alike
            continue
        step = max(1, 1_000_000 // length**2)
        for at in range(0, len(alike), step):
            some = np.stack(alike[at : at + step])
            places = fill(mesh.vertices[some].astype(np.float64))
            faces = some[np.arange(len(some))[:, None, None], places]
            flat = areas_of(mesh.vertices, faces.reshape(-1, 3)).reshape(len(some), -1).min(1) <= 0
            bad = _has_known(faces, some, known) | flat
            made.append(faces[~bad].reshape(-1, 3))
            fans += list(some[bad])
    mesh = replace(mesh, faces=np.concatenate([mesh.faces, *made]).astype(np.int32))
    return _fanned(mesh, fans) if fans else mesh


def _without_ears(vertices: np.ndarray, loop: np.ndarray, known: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(T, 3) triangles on two edges of a loop each, the shortest third side first, and the loop that is left.

    That has `MAX_FILLED_EDGES`, or more where all third sides are edges of the mesh already.
    """
    if len(loop) <= MAX_FILLED_EDGES:
        return np.empty((0, 3), np.int64), loop
    places, count = vertices[loop].astype(np.float64), len(loop)
    before, after = [*range(-1, count - 1)], [*range(1, count), 0]
    before[0] = count - 1

    def ear(at: int) -> tuple[float, int, int, int]:
        a, c = before[at], after[at]
        return float(((places[a] - places[c]) ** 2).sum()), at, a, c

    heap, ears, gone, left = [ear(at) for at in range(count)], [], np.zeros(count, bool), count
    heapify(heap)
    while heap and left > MAX_FILLED_EDGES:
        _, at, a, c = heappop(heap)
        if gone[at] or (before[at], after[at]) != (a, c):
            continue
        low, high = sorted((int(loop[a]), int(loop[c])))
        name = low << 32 | high
        found = int(np.searchsorted(known, name))
        if (found < len(known) and known[found] == name) or not np.cross(
            places[at] - places[a], places[c] - places[a]
        ).any():
            continue
        ears.append((loop[a], loop[at], loop[c]))
        gone[at], after[a], before[c], left = True, c, a, left - 1
        heappush(heap, ear(a))
        heappush(heap, ear(c))
    return np.array(ears, np.int64).reshape(-1, 3), loop[~gone]


def _has_known(faces: np.ndarray, loops: np.ndarray, known: np.ndarray) -> np.ndarray:
    """(R,) whether (R, T, 3) triangles that fill (R, n) loops have an inner edge that the mesh has already."""
    sides = np.sort(faces[:, :, [[0, 1], [1, 2], [2, 0]]].reshape(len(faces), -1, 2), axis=2).astype(np.int64)
    around = np.sort(np.stack([loops, np.roll(loops, -1, 1)], 2), axis=2).astype(np.int64)
    names, outer = sides[..., 0] << 32 | sides[..., 1], around[..., 0] << 32 | around[..., 1]
    there = known[np.searchsorted(known, names).clip(max=len(known) - 1)] == names
    return (there & ~np.isin(names, outer)).any(1)


def _fanned(mesh: Mesh, loops: list[np.ndarray]) -> Mesh:
    """The mesh with a fan over each loop, about a new vertex in its middle."""
    sizes, ends = np.array([len(loop) for loop in loops]), np.concatenate(loops)
    following = np.concatenate([np.roll(loop, -1) for loop in loops])
    owner = np.repeat(np.arange(len(loops)), sizes)

    def mean(rows: np.ndarray) -> np.ndarray:
        return np.stack([np.bincount(owner, column) for column in rows[ends].T], 1) / sizes[:, None]

    first = len(mesh.vertices)
    mesh = _with_vertices(mesh, mean(mesh.vertices), None if mesh.colors is None else mean(mesh.colors))
    return replace(
        mesh, faces=np.concatenate([mesh.faces, np.stack([ends, following, first + owner], 1)]).astype(np.int32)
    )


def _with_vertices(mesh: Mesh, places: np.ndarray, colors: np.ndarray | None) -> Mesh:
    """The mesh with more vertices, that no view has seen."""
    unknown = {"views": 0.0, "error": np.nan}
    shades = mesh.colors
    if shades is not None:
        assert colors is not None, "new vertices have colours where the others have"
        shades = np.concatenate([shades, np.rint(colors).astype(np.uint8)])
    return replace(
        mesh,
        vertices=np.concatenate([mesh.vertices, places.astype(np.float32)]),
        colors=shades,
        values={
            name: np.concatenate([each, np.full(len(places), unknown[name], np.float32)])
            for name, each in mesh.values.items()
        },
    )


def _on_base(mesh: Mesh, rims: list[np.ndarray], up: np.ndarray, base: float) -> Mesh:
    """The mesh with walls under rims, and below each a flat copy of its part, turned over, with few triangles.

    A copy of the part and no polygon: seen from above, a rim may cross itself.

    Args:
        mesh: Closed but for the rims, of which a part has one.
        rims: Vertices, as what fills them would pass them.
        up: (3,) unit vector.
        base: Height of the base along it.
    """
    of_vertex, faces = _part_of_vertices(mesh), [mesh.faces]
    of_face = of_vertex[mesh.faces[:, 0]]
    for rim in rims:
        part = _of_faces(replace(mesh, faces=faces[0]), of_face == of_vertex[rim[0]])
        used = np.flatnonzero(of_vertex == of_vertex[rim[0]])  # the vertices of the part, in their order
        at_rim = np.searchsorted(used, rim)
        fixed = np.zeros(len(used), bool)
        fixed[at_rim] = True
        flat = part.vertices + (base - part.vertices.astype(np.float64) @ up)[:, None] * up
        copy = replace(part, vertices=flat.astype(np.float32), faces=np.ascontiguousarray(part.faces[:, ::-1]))
        places, bottom, into = collapsed(copy, 1, BASE_COLLAPSE_COST, fixed, flat=True)
        shade = None
        if part.colors is not None:
            shade = np.zeros((len(places), 3))
            shade[into] = part.colors
        first = len(mesh.vertices)
        low = first + into[at_rim]
        mesh = _with_vertices(mesh, places, shade)
        next_rim, next_low = np.roll(rim, -1), np.roll(low, -1)
        faces += [np.stack([rim, next_rim, next_low], 1), np.stack([rim, next_low, low], 1), first + bottom]
    return replace(mesh, faces=np.concatenate(faces).astype(np.int32))


def bodies_of(mesh: Mesh, closing: Closing, most: int | None = None, least: int = 1) -> tuple[Mesh, Closing]:
    """The bodies of a closed mesh that enclose something, and what was done to it, with these and those left out.

    Of more and smaller bodies than wanted, see `closed`, those stay that `clean` would keep, and the one that encloses
    most. Moving vertices, as simplification does, may turn a small body inside out.

    Raises:
        BadInput: None encloses anything.
    """
    parts = np.unique(_part_of_vertices(mesh)[mesh.faces[:, 0]], return_inverse=True)[1]
    sizes = np.bincount(parts)
    middle = mesh.vertices.mean(0, dtype=np.float64)
    a, b, c = (mesh.vertices[mesh.faces[:, corner]] - middle for corner in range(3))
    volumes = np.bincount(parts, (a * np.cross(b, c)).sum(1)) / 6
    stays = volumes > 0
    if not stays.any():
        raise BadInput("the mesh cannot be closed: none of its parts encloses anything")
    stays[stays] = large_enough(sizes[stays], len(sizes) if most is None else most, least)
    stays[volumes.argmax()] = True
    dropped = closing.dropped + int((~stays).sum()), closing.dropped_triangles + int(sizes[~stays].sum())
    told = replace(closing, dropped=dropped[0], dropped_triangles=dropped[1], bodies=int(stays.sum()))
    return _of_faces(mesh, stays[parts]), replace(told, volume=float(volumes[stays].sum()))
