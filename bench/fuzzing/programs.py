"""Small data sets with cameras of photogrammetry programs, to be damaged: each fills `data` in the folder of a case."""

from __future__ import annotations

import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from .data import photographs

GEOCENTRIC = (
    'GEOGCS["WGS 84",DATUM["WGS 84",SPHEROID["WGS 84",6378137,298.257223563]],PRIMEM["Greenwich",0],UNIT["degree",'
    '0.0174532925199433],AUTHORITY["EPSG","4326"]]'
)
UTM = (
    f'PROJCS["WGS 84 / UTM zone 32N",{GEOCENTRIC},PROJECTION["Transverse_Mercator"],PARAMETER["central_meridian",9],'
    'PARAMETER["scale_factor",0.9996],PARAMETER["false_easting",500000],UNIT["metre",1],AUTHORITY["EPSG","32632"]]'
)
DOWN = np.diag([1.0, -1.0, -1.0])


def shots(made: Any) -> list[tuple[str, np.ndarray, np.ndarray]]:
    """Names, rotations from the world (x right, y down, z forward) and centres."""
    poses = [
        (view.name, made.scene.frame.input_pose(view.camera.world_to_camera))
        for view in (*made.scene.train, *made.scene.held_out)
    ]
    return [(name, pose[:3, :3], -pose[:3, :3].T @ pose[:3, 3]) for name, pose in poses]


def seen(made: Any) -> tuple[np.ndarray, list[list[tuple[int, float, float]]]]:
    """(P, 3) points, and for each the positions of the photographs that show it, with pixels."""
    xyz = made.scene.frame.to_input(made.scene.cloud.xyz.numpy())
    lens = made.scene.train[0].camera
    sights: list[list[tuple[int, float, float]]] = [[] for _ in xyz]
    for at, (_, turn, centre) in enumerate(shots(made)):
        x, y, z = ((xyz - centre) @ turn.T).T
        u, v = lens.fx * x / z + lens.cx, lens.fy * y / z + lens.cy
        for row in np.flatnonzero((z > 0) & (u > 0) & (u < 24) & (v > 0) & (v < 18)):
            sights[row].append((at, float(u[row]), float(v[row])))
    return xyz, sights


def row(*values: Iterable[float] | float) -> str:
    """Numbers with spaces between."""
    return " ".join(repr(float(value)) for value in np.concatenate([np.ravel(value) for value in values]))


def metashape(here: Path) -> None:
    """A chunk on the map, with a lens that bends."""
    made, data = photographs(here)
    lens = made.scene.train[0].camera
    cameras = ""
    for at, (name, turn, centre) in enumerate(shots(made)):
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = turn.T, centre
        cameras += f'<camera id="{at}" sensor_id="0" label="{name}">\n<transform>{row(pose)}</transform>\n</camera>\n'
    values = {"f": lens.fy, "cx": lens.cx - 12, "cy": lens.cy - 9, "k1": -0.05, "k4": 0.01, "b1": 0.1}
    inner = "\n".join(f"<{name}>{value}</{name}>" for name, value in values.items())
    text = (
        '<?xml version="1.0" encoding="UTF-8"?>\n<document version="2.0.0">\n<chunk label="Chunk 1">\n<sensors>\n'
        f'<sensor id="0" type="frame">\n<resolution width="24" height="18"/>\n<calibration class="adjusted">\n{inner}\n'
        f"</calibration>\n</sensor>\n</sensors>\n<cameras>\n{cameras}</cameras>\n<reference>{GEOCENTRIC}</reference>\n"
        "<transform>\n<rotation>1 0 0 0 1 0 0 0 1</rotation>\n<translation>4265000 668000 4680000</translation>\n"
        "<scale>2</scale>\n</transform>\n</chunk>\n</document>\n"
    )
    (data / "cameras.xml").write_text(text)


def pix4d(here: Path) -> None:
    """The files in the folder of parameters."""
    made, data = photographs(here)
    lens = made.scene.train[0].camera
    lines = ["fileName imageWidth imageHeight", "camera matrix K [3x3]", "radial distortion [3x1]"]
    lines += ["tangential distortion [2x1]", "camera position t [3x1]", "camera rotation R [3x3]"]
    lines += ["camera model m = K [R|-Rt] X", ""]
    for name, turn, centre in shots(made):
        lines += [f"{name} 24 18", row(lens.fx, 0, lens.cx), row(0, lens.fy, lens.cy), "0 0 1"]
        lines += ["-0.05 0.01 0", "0.001 0.0", row(centre), *(row(part) for part in turn)]
    (data / "params").mkdir()
    (data / "params" / "p_calibrated_camera_parameters.txt").write_text("\n".join(lines) + "\n")
    (data / "params" / "p_offset.xyz").write_text("492000.0 5260000.0 0.0\n")
    (data / "params" / "p_wkt.prj").write_text(UTM)


def realitycapture(here: Path) -> None:
    """A CSV file."""
    made, data = photographs(here)
    lens = made.scene.train[0].camera
    text = "#name,x,y,alt,heading,pitch,roll,f,px,py,k1,k2,k3,k4,t1,t2\n"
    for name, turn, centre in shots(made):
        axes = (DOWN @ turn).T  # the camera's right, top and back
        angles = np.degrees(
            [-np.arctan2(-axes[0, 1], axes[1, 1]), np.arcsin(axes[2, 1]), np.arctan2(-axes[2, 0], axes[2, 2])]
        )
        numbers = row(centre, angles, lens.fx / 24 * 36, 0.01, -0.01, -0.05, 0, 0, 0.001, 0, 0)
        text += ",".join([name, *numbers.split()]) + "\n"
    (data / "cameras.csv").write_text(text)


def openmvg(here: Path) -> None:
    """An sfm_data.json with structure."""
    made, data = photographs(here)
    lens, (xyz, sights) = made.scene.train[0].camera, seen(made)
    views, poses = [], []
    for at, (name, turn, centre) in enumerate(shots(made)):
        view = {
            "local_path": "",
            "filename": name,
            "width": 24,
            "height": 18,
            "id_view": at,
            "id_intrinsic": 0,
            "id_pose": at,
        }
        views.append({"key": at, "value": {"polymorphic_id": 1073741824, "ptr_wrapper": {"id": at, "data": view}}})
        poses.append({"key": at, "value": {"rotation": turn.tolist(), "center": centre.tolist()}})
    inner = {"width": 24, "height": 18, "focal_length": lens.fx, "principal_point": [lens.cx, lens.cy]}
    wrapped = {"id": 2147483650, "data": inner | {"disto_k3": [-0.05, 0.0, 0.0]}}
    intrinsic = {"polymorphic_id": 2147483649, "polymorphic_name": "pinhole_radial_k3", "ptr_wrapper": wrapped}
    structure = [
        {
            "key": at,
            "value": {
                "X": place,
                "observations": [{"key": view, "value": {"id_feat": 0, "x": [u, v]}} for view, u, v in sights[at]],
            },
        }
        for at, place in enumerate(xyz.tolist())
    ]
    contents = {"sfm_data_version": "0.3", "root_path": "", "views": views, "extrinsics": poses, "structure": structure}
    (data / "sfm_data.json").write_text(json.dumps(contents | {"intrinsics": [{"key": 0, "value": intrinsic}]}))


def bundler(here: Path) -> None:
    """A bundle.out with tracks, and the list."""
    made, data = photographs(here)
    lens, (xyz, sights) = made.scene.train[0].camera, seen(made)
    listed = shots(made)
    lines = ["# Bundle file v0.3", f"{len(listed)} {len(xyz)}"]
    for _, turn, centre in listed:
        flipped = DOWN @ turn
        lines += [row(lens.fx, -0.05, 0), *(row(part) for part in flipped), row(-flipped @ centre)]
    for place, colour, spots in zip(xyz, made.scene.cloud.rgb.numpy(), sights, strict=True):
        shown = " ".join(f"{view} 0 {u - 12!r} {9 - v!r}" for view, u, v in spots)
        lines += [row(place), row(colour), f"{len(spots)} {shown}"]
    (data / "bundle.out").write_text("\n".join(lines) + "\n")
    (data / "list.txt").write_text("".join(f"{name} 0 {lens.fx}\n" for name, _, _ in listed))
