"""A walk through the synthetic Shibuya, as photographs from the ground with exact poses and an exact surface.

    python bench/walk.py SCRIPTS OUT
    surfkit prepare points OUT/posed --out OUT/scene
    surfkit train recipe:surface --data OUT/scene --scale 1 --metres-per-unit 1 --test-every 8 --steps 1300
    surfkit evaluate RUN --gt OUT/truth.ply --tau 0.2 --draws 1

SCRIPTS has the data set's own city_scene.py, make_city_pack.py and shibuya-tiles.npz; they need numba. Photographs are
taken from 2 m above the road, `--apart` metres apart along the middle of streets, at each place one ahead, one to the
left and one to the right.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np
from PIL import Image
from scipy import ndimage
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import dijkstra

CELL = 0.5
"""Of the map in which the path is found, metres."""
EYE = 2.0
"""Height of the camera above the road, metres."""
TURNS = (0.0, 70.0, -70.0)
"""From the direction of the walk, degrees to the left."""
LONGEST = 140.0
"""Length of the walk, metres."""


def clearance(renderer, city) -> np.ndarray:
    """(N, N) metres from each cell of the core to the next thing that stands on the ground."""
    at = np.arange(-city.half, city.half, CELL) + CELL / 2
    x, y = np.meshgrid(at, at)
    from_above = np.stack([x, y, np.full_like(x, 500.0)], -1).reshape(-1, 3)
    down = np.broadcast_to([0.0, 0.0, -1.0], from_above.shape)
    top = 500 - renderer.cast(from_above, down)["t_hit"].numpy()
    return ndimage.distance_transform_edt((top - city.ground_z(x.ravel(), y.ravel()) < 0.3).reshape(x.shape)) * CELL


def middle_of_streets(free: np.ndarray, half: float) -> np.ndarray:
    """(K, 2) metres: the way from one side of the map to another that keeps farthest from everything."""
    rows, columns = free.shape
    number = np.arange(rows * columns).reshape(rows, columns)
    cost = np.where(free > 1.0, 1 / np.maximum(free, CELL) ** 2, 1e4)
    ends = []
    for a, b in ((np.s_[:-1], np.s_[1:]), (np.s_[:, :-1], np.s_[:, 1:])):
        ends.append((number[a].ravel(), number[b].ravel(), (cost[a] + cost[b]).ravel()))
    start, stop, weight = map(np.concatenate, zip(*ends, strict=True))
    graph = coo_matrix((weight, (start, stop)), shape=(number.size, number.size)).tocsr()
    third = columns // 3
    west = number[:, :third].ravel()[free[:, :third].argmax()]
    east = number[:, -third:].ravel()[free[:, -third:].argmax()]
    before = dijkstra(graph, directed=False, indices=west, return_predecessors=True)[1]
    way = [east]
    while way[-1] != west:
        way.append(before[way[-1]])
    xy = np.stack(np.unravel_index(way[::-1], free.shape)[::-1], 1) * CELL + CELL / 2 - half
    return ndimage.gaussian_filter1d(xy, 4.0, axis=0, mode="nearest")


def places(way: np.ndarray, apart: float) -> tuple[np.ndarray, np.ndarray]:
    """(K, 2) positions so far apart along a way, and (K,) directions in degrees from the east."""
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(way, axis=0), axis=1))])
    at = np.arange(0, min(along[-1] - 2, LONGEST), apart)
    here, ahead = (np.stack([np.interp(where, along, way[:, a]) for a in (0, 1)], 1) for where in (at, at + 2))
    return here, np.degrees(np.arctan2(*(ahead - here).T[::-1]))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scripts", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--apart", type=float, default=4.5)
    parser.add_argument("--size", type=int, nargs=2, default=(640, 426))
    parser.add_argument("--focal", type=float, default=400.0)
    parser.add_argument("--samples", type=int, default=4, help="rays a pixel")
    options = parser.parse_args()
    sys.path.insert(0, str(options.scripts))
    import city_scene
    from colmap_model import PinholeCamera, PosedImage, write_model
    from make_city_pack import Renderer, look, write_ply

    city = city_scene.build_city(options.scripts / "shibuya-tiles.npz", np.array((-175.0, 135.0)), 110.0, 150.0)
    renderer = Renderer(city, 2)
    width, height = options.size
    camera = PinholeCamera(width, height, options.focal, options.focal, width / 2, height / 2)
    here, heading = places(middle_of_streets(clearance(renderer, city), city.half), options.apart)
    (options.out / "posed" / "images").mkdir(parents=True, exist_ok=True)
    images = {}
    for at, (xy, yaw) in enumerate(zip(here, heading, strict=True)):
        centre = np.array([*xy, city.ground_z(*xy) + EYE])
        for turn in TURNS:
            number, rotation = len(images) + 1, look(yaw + turn, 0.0)
            name = f"{number - 1:03d}_{at:02d}.jpg"
            picture = renderer.image(camera, rotation, centre, options.samples, np.random.default_rng(number))
            Image.fromarray(picture).save(options.out / "posed" / "images" / name, quality=92)
            images[number] = PosedImage(name, 1, rotation, -rotation @ centre)
        print(f"place {at + 1} of {len(here)}", flush=True)
    write_model(options.out / "posed" / "sparse" / "0", {1: camera}, images, {})
    core = np.abs(city.vertices[city.faces].mean(1)[:, :2]).max(1) <= city.half + 10
    used, faces = np.unique(city.faces[core], return_inverse=True)
    write_ply(options.out / "truth.ply", city.vertices[used], faces=faces.reshape(-1, 3))


if __name__ == "__main__":
    main()
