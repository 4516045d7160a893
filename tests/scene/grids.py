"""Grids of the geoid for tests, written here byte by byte as NOAA lays them out."""

import struct

import numpy as np


def plane(latitude, longitude):
    """Metres above the ellipsoid: what all grids below hold, exact between their cells too."""
    return 40 + 0.3 * (latitude - 52) - 0.5 * (longitude - 8)


def write_gtx(path, south=50.0, west=5.0, rows=25, columns=29, step=0.25, values=plane):
    """A GTX file: corner, steps, size, then rows from the south, all big-endian."""
    latitude, longitude = south + step * np.arange(rows), west + step * np.arange(columns)
    heights = values(latitude[:, None], (longitude[None] + 180) % 360 - 180)
    head = struct.pack(">4d2i", south, west, step, step, rows, columns)
    path.write_bytes(head + np.broadcast_to(heights, (rows, columns)).astype(">f4").tobytes())
    return path
