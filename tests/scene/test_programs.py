"""Cameras of photogrammetry programs show known dots where the formulas of these programs put them."""

import re
from functools import partial

import numpy as np
import pytest
from PIL import Image

from surfkit.core.check import BadInput
from surfkit.readers.data import Data
from surfkit.readers.read import observations, read, read_capture, reader_of
from surfkit.run.notes import collect_notes

from . import programs
from .programs import COLORS, DOTS, HEIGHT, POSES, WIDTH, bundler, metashape, openmvg, pix4d, realitycapture

BROWN = {"k1": -0.09, "k2": 0.06, "k3": -0.03}
CASES = {
    "metashape": partial(metashape, cx=4.3, cy=-2.6, b1=1.4, p1=0.003, p2=-0.002, **BROWN),
    "metashape k4": partial(metashape, cx=4.3, k4=0.02, p1=0.001, b2=0.05, **BROWN),
    "metashape fisheye": partial(metashape, kind="fisheye", cx=-3, k1=0.03, k2=-0.01, k3=0.004, k4=-0.001),
    "metashape decentred fisheye": partial(metashape, kind="fisheye", cy=5, k1=0.03, p1=0.004, p2=-0.002),
    "pix4d": partial(pix4d, offset=(0, 0, 0), cx=114, cy=77.5, R1=-0.1, R2=0.07, R3=-0.02, T1=0.003, T2=-0.002),
    "realitycapture": partial(realitycapture, px=0.02, py=-0.015, t1=0.003, t2=-0.002, **BROWN),
    "realityscan": partial(realitycapture, newer=True, px=0.01, k4=0.02, **BROWN),
    "bundler": bundler,
    **{f"openmvg {kind}": partial(openmvg, kind=kind) for kind in programs.OPENMVG},
}


def spots(view, at):
    """Where the middle of the spot near each (P, 2) pixel of an undistorted photograph is; nan near its border."""
    grey = np.asarray(Image.open(view.path).convert("L"), float)
    found = []
    for x, y in at:
        left, top = int(x) - 4, int(y) - 4
        part = grey[max(top, 0) : top + 9, max(left, 0) : left + 9]
        v, u = np.mgrid[top : top + 9, left : left + 9] + 0.5 if part.shape == (9, 9) else (np.nan, np.nan)
        weight = part if part.shape == (9, 9) else 1.0
        found.append((np.sum(u * weight) / np.sum(weight), np.sum(v * weight) / np.sum(weight)))
    return np.array(found)


@pytest.mark.parametrize("case", CASES)
def test_dots_lie_where_the_program_puts_them(tmp_path, case):
    project = CASES[case](tmp_path)
    data = Data(tmp_path, test_every=0)
    capture, scene = read_capture(data, reader_of(data)), read(data)
    assert len(capture.shots) == len(scene.train) == len(POSES)
    off, near = [], 0.05 if "k4" in case or case == "realityscan" else 1e-6
    for shot, view in zip(capture.shots, scene.train, strict=True):
        name = shot.name if shot.name.endswith(".png") else f"{shot.name}.png"
        pixels = project(name, DOTS)
        local = DOTS @ shot.pose[:3, :3].T + shot.pose[:3, 3]
        np.testing.assert_allclose(np.asarray(shot.camera.img_from_cam(local)), pixels, atol=near)
        c, inner = view.camera, scene.frame.to_local(DOTS) @ view.camera.world_to_camera.numpy()[:3, :3].T
        inner = inner + view.camera.world_to_camera.numpy()[:3, 3]
        straight = np.stack([c.fx * inner[:, 0], c.fy * inner[:, 1]], 1) / inner[:, 2:] + (c.cx, c.cy)
        shown = ((pixels > 6) & (pixels < (WIDTH - 6, HEIGHT - 6))).all(1)
        off.append(np.linalg.norm(spots(view, straight[shown]) - straight[shown], axis=1))
    off = np.concatenate(off)
    assert np.isfinite(off).sum() > 40 and np.nanmax(off) < 0.25, "the spots of the undistorted photographs"
