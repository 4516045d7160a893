"""Files of splats for tests of what reads them."""

from dataclasses import replace

import numpy as np
import torch

from surfkit.io.splats.ply import write_splats
from surfkit.io.splats.splat_table import SplatTable
from surfkit.testing.synthetic import Flight, photograph, write_colmap

ORIGIN = (492000.0, 5260000.0, 430.0)
"""In UTM, metres."""


def data_set(folder, far=False, **changes):
    """A small data set in COLMAP's layout, perhaps in survey coordinates."""
    truth = photograph(Flight(**{"width": 48, "height": 36, "points": 250} | changes))
    if far:
        frame = replace(truth.scene.frame, origin=truth.scene.frame.origin + ORIGIN)
        truth = replace(truth, scene=replace(truth.scene, frame=frame))
    folder.mkdir(parents=True, exist_ok=True)
    write_colmap(folder, truth)
    return folder


def like_3dgs(path, scene, degree=3, **changes):
    """Ellipsoids at the sparse points of a scene, in the coordinates of the data set and without any comment, as the
    program of 3DGS writes them."""
    count, draw = len(scene.cloud.xyz), torch.Generator().manual_seed(0)
    values = {
        "means": scene.cloud.xyz,
        "quats": torch.randn(count, 4, generator=draw),
        "log_scales": torch.randn(count, 3, generator=draw) * 0.3 - 3,
        "opacity_logits": torch.randn(count, generator=draw),
        "sh0": (scene.cloud.rgb / 255 - 0.5) / 0.282,
        "sh_rest": torch.randn(count, (degree + 1) ** 2 - 1, 3, generator=draw) * 0.1,
    }
    table = SplatTable("gaussian", **(values | changes)).in_input_frame(scene.frame)
    write_splats(path, table)
    raw = path.read_bytes()
    head, end, body = raw.partition(b"end_header\n")
    kept = b"".join(line for line in head.splitlines(keepends=True) if not line.startswith(b"comment"))
    path.write_bytes(kept + end + body)
    return path


def with_column(path, name, values):
    """Give a PLY file of splats, all float32, one more property behind the others."""
    head, end, body = path.read_bytes().partition(b"end_header\n")
    rows = np.frombuffer(body, "<f4").reshape(len(values), -1)
    path.write_bytes(head + f"property float {name}\n".encode() + end + np.c_[rows, values].astype("<f4").tobytes())
