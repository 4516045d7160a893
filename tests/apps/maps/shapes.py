"""Meshes with known heights, as `read_surface` gives them, and maps of them."""

import numpy as np

from surfkit.apps.maps.map_grid import MapGrid, Window
from surfkit.apps.maps.zbuffer import ZBuffer
from surfkit.evaluate.geometry.surface_file import SurfaceFile

UTM = (451_234.0, 5_873_211.0)


def surface_of(vertices, faces, colors=None):
    """A mesh in memory, as `read_surface` gives it."""
    layout = [(axis, "<f8") for axis in "xyz"] + [(name, "u1") for name in ("red", "green", "blue")] * (
        colors is not None
    )
    rows = np.zeros(len(vertices), layout)
    rows["x"], rows["y"], rows["z"] = np.asarray(vertices, float).T
    if colors is not None:
        rows["red"], rows["green"], rows["blue"] = np.asarray(colors).T
    return SurfaceFile("mesh.ply", rows, np.asarray(faces, np.int32).reshape(-1, 3))


def heightfield(height, low, high, count=40, color=None):
    """A mesh of the graph of a function over a square, its vertices jittered, and its heights exact at them."""
    draw = np.random.default_rng(0)
    x, y = np.meshgrid(*(np.linspace(low[i], high[i], count) for i in range(2)), indexing="ij")
    step = (high[0] - low[0]) / (count - 1)
    for axis in (x, y):
        axis[1:-1, 1:-1] += draw.uniform(-0.3, 0.3, (count - 2, count - 2)) * step
    number = np.arange(count * count).reshape(count, count)
    a, b, c, d = number[:-1, :-1], number[1:, :-1], number[1:, 1:], number[:-1, 1:]
    faces = np.concatenate([np.stack(each, -1).reshape(-1, 3) for each in ((a, b, c), (a, c, d))])
    vertices = np.stack([x, y, height(x, y)], -1).reshape(-1, 3)
    return surface_of(vertices, faces, None if color is None else color(vertices[:, 0], vertices[:, 1]))


def merged(*meshes):
    starts = np.cumsum([0, *(len(mesh) for mesh in meshes)])
    faces = np.concatenate([mesh.faces + start for mesh, start in zip(meshes, starts, strict=False)])
    return surface_of(np.concatenate([mesh.vertices() for mesh in meshes]), faces)


def box(low, high):
    corners = np.array([[x, y, z] for x in (low[0], high[0]) for y in (low[1], high[1]) for z in (low[2], high[2])])
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    return surface_of(corners, [tri for a, b, c, d in quads for tri in ((a, b, c), (a, c, d))])


def drawn(surface, grid):
    """(H, W) heights and faces of a whole map, and eastings and northings of the centres."""
    buffer = ZBuffer(Window(0, 0, grid.width, grid.height))
    buffer.draw(grid.to_cells(surface.vertices(surface.faces.ravel())).reshape(-1, 3, 3), np.arange(len(surface.faces)))
    return buffer.height, buffer.face, *centres(grid)


def centres(grid):
    columns, rows = np.meshgrid(np.arange(grid.width) + 0.5, np.arange(grid.height) + 0.5)
    return (grid.west + columns) * grid.gsd, (grid.north - rows) * grid.gsd


def grid_of(gsd, west, south, east, north):
    return MapGrid.around(np.eye(3), gsd, (west, south, east, north))


def gpkg_version(path):
    """The version of a GeoPackage, such as 10200 for 1.2.0: `user_version` of SQLite, from byte 60 on."""
    return int.from_bytes(path.read_bytes()[60:64], "big")
