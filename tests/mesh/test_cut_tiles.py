"""Tetrahedra of tiles are those of all points together, and what one tile has decided reaches the others."""

import numpy as np
from needs import needs_native

from surfkit.mesh.cut_tiles import UNDECIDED, DecidedTetrahedra, tiles
from surfkit.mesh.delaunay import tetrahedralised
from surfkit.raster.native import module

pytestmark = needs_native

PLACES = np.random.default_rng(0).random((4_000, 3)) * [4, 2, 1]


def names(rows):
    return set(map(tuple, np.sort(rows, axis=1).tolist()))


def owned(tile, tets):
    """Rows of all points: of the tetrahedra that a tile decides."""
    of = tile.tile_of[tets.corners]
    return tile.rows[tets.corners[(of.min(1) == tile.number) & (tets.corners < len(tile.rows)).all(1)]]


def test_tiles_fill_space_and_are_small_enough():
    parts = tiles(PLACES, 1_500, 0.3)
    own = [tile.rows[tile.tile_of[:-4] == tile.number] for tile in parts]
    assert len(parts) > 4 and np.array_equal(np.sort(np.concatenate(own)), np.arange(len(PLACES)))
    for tile, rows in zip(parts, own, strict=True):
        assert len(tile.rows) <= 1_500
        low, high = PLACES[rows].min(0) - 0.3, PLACES[rows].max(0) + 0.3
        near = ((PLACES >= low) & (PLACES <= high)).all(1)
        assert set(np.flatnonzero(near)) <= set(tile.rows), "the halo is whole"
    (whole,) = tiles(PLACES, 4_000, 0.3)
    assert whole.title == "" and len(whole.rows) == 4_000


def test_tiles_have_the_tetrahedra_of_the_whole():
    """But for those at the hull, whose balls are larger than the halo."""
    step = module().least_step(PLACES)
    whole = tetrahedralised(PLACES, step)
    wanted = names(whole.corners[(whole.corners < len(PLACES)).all(1)])
    found = [names(owned(tile, tetrahedralised(PLACES[tile.rows], step))) for tile in tiles(PLACES, 1_500, 0.3)]
    together = set().union(*found)
    assert sum(map(len, found)) == len(together), "none belongs to two"
    inner = {row for row in wanted if (np.abs(PLACES[list(row)] - [2, 1, 0.5]) < [1.8, 0.8, 0.4]).all()}
    assert len(inner) > 5_000 and inner <= together
    assert len(together & wanted) > 0.98 * len(wanted)


def test_what_is_decided_is_taken_as_it_is():
    """Every tetrahedron that an earlier tile has decided is known to each later one, with its answer."""
    decided, answers = DecidedTetrahedra(), {}
    shared = 0
    for tile in tiles(PLACES, 1_500, 0.3):
        tets = tetrahedralised(PLACES[tile.rows], tile.step)
        given = decided.of(tile, tets.corners)
        inside = (tets.corners < len(tile.rows)).all(1)
        rows = np.sort(tile.rows[np.where(inside[:, None], tets.corners, 0)], axis=1)
        full = (rows.sum(1) // 7 % 2 == 0) & inside
        for row, known, is_inside in zip(map(tuple, rows.tolist()), given, inside, strict=True):
            expected = answers.get(row, UNDECIDED) if is_inside else UNDECIDED
            assert known == expected
            shared += known != UNDECIDED
        decided.add(tile, tets.corners, full)
        answers |= {tuple(np.sort(row).tolist()): int(row.sum() // 7 % 2 == 0) for row in owned(tile, tets)}
    assert shared > 1_000
