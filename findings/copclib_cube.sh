#!/usr/bin/env bash
# copclib misses points of a COPC file in a box, without an error, where its cube does not begin at the least coordinates.
#
# copclib 2.6.3, laspy 2.7.0 with lazrs 0.8.2. COPC gives the cube of the octree as a center and half of a side; it need not
# begin where the points do. Of a road of 200 m by 20 m, in a cube around its middle, laspy finds all 6,000 points of a box,
# and all points in the cubes of their nodes. copclib lays the cube at the header's least x, y and z, whatever the center
# says: `GetPointsWithinBox` gives 3,720 points, `GetNodesIntersectBox` leaves out two of five nodes, and
# `ValidateSpatialBounds` calls the file invalid. With a cube that begins at the least coordinates both agree.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet copclib==2.6.3 laspy==2.7.0 lazrs==0.8.2 numpy==2.4.6
"$folder/venv/bin/python" -W error - "$folder" <<'PYTHON'
import itertools
import sys
from pathlib import Path

import copclib
import laspy
import numpy as np
from laspy.copc import Bounds, load_octree_for_query

SIZE, HALF = np.array([200.0, 20.0, 4.0]), 100.0
BOX = (20.0, 0.0, 80.0, 20.0)  # the road from 20 m to 80 m


def write(path, center):
    """A road of 20,000 points in a cube of two levels around `center`: a quarter of the points in the root."""
    grid = np.stack(np.meshgrid(np.arange(400) / 2, np.arange(50) / 2.5, indexing="ij"), -1).reshape(-1, 2)
    places = np.column_stack([grid + 0.13, np.arange(len(grid)) % 400 / 100])
    config = copclib.CopcConfigWriter(6, (0.01, 0.01, 0.01), (0, 0, 0))
    config.las_header.min, config.las_header.max = list(places.min(0)), list(places.max(0))
    info = config.copc_info
    info.center_x, info.center_y, info.center_z, info.halfsize, info.spacing = *center, HALF, 2.0
    writer = copclib.FileWriter(str(path), config)
    root, half = np.arange(len(places)) % 4 == 0, (places >= center).astype(int)
    chosen = {(0, 0, 0, 0): root}
    for key in itertools.product((0, 1), repeat=3):
        chosen[1, *key] = ~root & (half == key).all(1)
    for key, inside in chosen.items():
        points = copclib.Points(config.las_header)
        for xyz in places[inside]:
            point = points.CreatePoint()
            point.x, point.y, point.z = xyz
            points.AddPoint(point)
        if len(points):
            writer.AddNode(copclib.VoxelKey(*key), points)
    writer.Close()


def seen_by_laspy(path):
    """Numbers of points in all nodes, of those outside of the cube of their node, in the box, and of nodes of the box."""
    box = Bounds(np.array(BOX[:2]), np.array(BOX[2:]))
    with laspy.CopcReader.open(path) as reader:
        total = outside = 0
        for node in load_octree_for_query(reader.source, reader.copc_info, reader.root_page):
            found = reader._fetch_and_decompress_points_of_nodes([node])
            xyz = np.column_stack([found.x, found.y, found.z])
            total += len(xyz)
            outside += int(((xyz < node.bounds.mins - 1e-6) | (xyz > node.bounds.maxs + 1e-6)).any(1).sum())
        whole = box.ensure_3d(reader.header.mins, reader.header.maxs)
        nodes = load_octree_for_query(reader.source, reader.copc_info, reader.root_page, query_bounds=whole)
        return total, outside, len(reader.query(box)), len(nodes)


def seen_by_copclib(path):
    """Numbers of points in all nodes, in the box, and of nodes of the box; whether the file is valid."""
    reader, box = copclib.FileReader(str(path)), copclib.Box(*BOX)
    inside, nodes = reader.GetPointsWithinBox(box), reader.GetNodesIntersectBox(box)
    return len(reader.GetAllPoints()), len(inside), len(nodes), reader.ValidateSpatialBounds()


found = {}
for name, center in (("around the middle", SIZE / 2), ("at the least coordinates", np.array([0.13, 0.13, 0.0]) + HALF)):
    path = Path(sys.argv[1]) / "road.copc.laz"
    write(path, center)
    laspys, copclibs = found[name] = seen_by_laspy(path), seen_by_copclib(path)
    print(f"cube {name}:")
    print("    laspy: {} points, {} outside of their node, {} in the box, in {} nodes".format(*laspys))
    print("    copclib: {} points, {} in the box, in {} nodes, valid: {}".format(*copclibs))
assert found["around the middle"] == ((20000, 0, 6000, 5), (20000, 3720, 3, False)), "the behaviour has changed"
assert found["at the least coordinates"] == ((20000, 0, 6000, 2), (20000, 6000, 2, True)), "the behaviour has changed"
PYTHON
