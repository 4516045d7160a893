"""A flight over dots on the ground, in the files of photogrammetry programs, each by its own formula of projection.

The formulas are written here once more, from the programs' documentation, and share nothing with the readers. Each
function fills a folder and returns what projects: (P, 3) points to (P, 2) pixels of a photograph, by its name, with the
centre of the first pixel at 0.5.
"""

import json

import numpy as np
from PIL import Image

WIDTH, HEIGHT, F = 220, 160, 190.0
HEIGHT_M = 30.0
ANGLES = {  # heading, pitch, roll in degrees, and where the camera is
    "IMG 1.png": (12.0, 4.0, -3.0, (-4.0, 1.0, 30.0)),
    "IMG 2.png": (95.0, -6.0, 5.0, (3.0, -2.0, 32.0)),
    "IMG 3.png": (-140.0, 9.0, 2.0, (1.0, 4.0, 28.0)),
    "IMG 4.png": (40.0, 25.0, -8.0, (-2.0, -9.0, 29.0)),
}
DOTS = np.array([[x, y, 0.3 * x - 0.2 * y + (x * y) % 1.5] for x in (-9, -5, -1, 3, 7) for y in (-7, -3, 1, 5)], float)
ORIGIN = np.array([492_468.0, 5_260_734.0, 430.0])
"""Of coordinates on a map."""
COLORS = np.arange(3 * len(DOTS)).reshape(-1, 3) * 4


def axes(heading, pitch, roll):
    """(3, 3) right, down in the picture, and ahead of a camera in an aircraft that looks down, its top to the nose."""
    h, p, r = np.radians([heading, pitch, roll])
    forward, right, up = (
        np.array([np.sin(h), np.cos(h), 0]),
        np.array([np.cos(h), -np.sin(h), 0]),
        np.array([0, 0, 1.0]),
    )
    nose, belly = np.cos(p) * forward + np.sin(p) * up, np.sin(p) * forward - np.cos(p) * up
    return np.stack([np.cos(r) * right + np.sin(r) * belly, -nose, np.cos(r) * belly - np.sin(r) * right])


POSES = {name: (axes(*given[:3]), np.array(given[3])) for name, given in ANGLES.items()}
"""Rotation from the world to x right, y down, z ahead; place of the camera."""


def seen_from(name, points):
    """(P, 3) points in the frame of a camera, x right, y down, z ahead."""
    turn, centre = POSES[name]
    return (points - centre) @ turn.T


def photographs(folder, project):
    """A photograph for each camera: a round spot for each dot, where the formula puts it."""
    folder.mkdir(parents=True, exist_ok=True)
    v, u = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    for name in POSES:
        grey = np.zeros((HEIGHT, WIDTH))
        for x, y in project(name, DOTS):
            grey = np.maximum(grey, np.exp(-((u - x) ** 2 + (v - y) ** 2) / (2 * 2.0**2)))
        Image.fromarray((grey * 250).round().astype(np.uint8)).convert("RGB").save(folder / name)
    return project


CHUNK = (np.eye(3), np.zeros(3), 1.0)


def metashape(folder, kind="frame", head="", tail="", change=lambda text: text, place=CHUNK, **given):
    """Metashape manual, appendix "Camera models": u = w/2 + cx + x' f + x' B1 + y' B2, P1 with r^2 + 2 x^2."""
    zero = dict.fromkeys(("cx", "cy", "b1", "b2", "k1", "k2", "k3", "k4", "p1", "p2", "p3", "p4"), 0.0)
    c = {**zero, "f": F, **given}

    def project(name, points):
        X, Y, Z = seen_from(name, points).T
        x, y = X / Z, Y / Z
        if kind == "fisheye":
            away = np.sqrt(x * x + y * y)
            x, y = x * np.arctan(away) / away, y * np.arctan(away) / away
        r2 = x * x + y * y
        radial = 1 + c["k1"] * r2 + c["k2"] * r2**2 + c["k3"] * r2**3 + c["k4"] * r2**4
        more = 1 + c["p3"] * r2 + c["p4"] * r2**2
        a = x * radial + (c["p1"] * (r2 + 2 * x * x) + 2 * c["p2"] * x * y) * more
        b = y * radial + (c["p2"] * (r2 + 2 * y * y) + 2 * c["p1"] * x * y) * more
        u = WIDTH * 0.5 + c["cx"] + a * c["f"] + a * c["b1"] + b * c["b2"]
        return np.stack([u, HEIGHT * 0.5 + c["cy"] + b * c["f"]], 1)

    onto, move, scale = place  # from the frame of the chunk to the world of the dots: scale * onto @ q + move
    cameras = ""
    for at, (name, (turn, centre)) in enumerate(POSES.items()):
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = onto.T @ turn.T, onto.T @ (centre - move) / scale
        numbers = " ".join(repr(float(value)) for value in pose.ravel())
        cameras += (
            f'<camera id="{at}" sensor_id="0" component_id="0" label="{name[:-4]}"><transform>{numbers}</transform>'
        )
        cameras += "<orientation>1</orientation></camera>\n"
    values = "".join(f"<{key}>{value!r}</{key}>" for key, value in c.items() if value)
    size = f'<resolution width="{WIDTH}" height="{HEIGHT}"/>'
    text = (
        '<?xml version="1.0" encoding="UTF-8"?>\n<document version="2.0.0">\n<chunk label="Chunk 1" enabled="true">\n'
        f'<sensors next_id="1"><sensor id="0" label="unknown" type="{kind}">{size}'
        f'<calibration type="{kind}" class="initial">{size}<f>100</f></calibration>'
        f'<calibration type="{kind}" class="adjusted">{size}{values}</calibration></sensor></sensors>\n'
        f'{head}<cameras next_id="9" next_group_id="1"><group id="0" label="G" type="folder">\n{cameras}</group>\n'
        '<camera id="7" sensor_id="0" label="IMG 7"/>\n'
        f"</cameras>\n{tail}</chunk>\n</document>\n"
    )
    (folder / "cameras.xml").write_text(change(text))
    return photographs(folder / "images", project)


def pix4d(folder, offset=ORIGIN, change=lambda text: text, **given):
    """Pix4D support, "How are the Internal and External Camera Parameters defined?": K [R|-Rt] X, R1 to R3, T1, T2."""
    c = {**dict.fromkeys(("R1", "R2", "R3", "T1", "T2"), 0.0), "f": F, "cx": WIDTH / 2, "cy": HEIGHT / 2, **given}

    def project(name, points):
        X, Y, Z = seen_from(name, points).T
        x, y = X / Z, Y / Z
        r2 = x * x + y * y
        radial = 1 + c["R1"] * r2 + c["R2"] * r2**2 + c["R3"] * r2**3
        a = x * radial + 2 * c["T1"] * x * y + c["T2"] * (r2 + 2 * x * x)
        b = y * radial + 2 * c["T2"] * x * y + c["T1"] * (r2 + 2 * y * y)
        return np.stack([c["f"] * a + c["cx"], c["f"] * b + c["cy"]], 1)

    def row(*values):
        return " ".join(f"{value:.17g}" for value in values)

    lines = ["fileName imageWidth imageHeight", "camera matrix K [3x3]", "radial distortion [3x1]"]
    lines += ["tangential distortion [2x1]", "camera position t [3x1]", "camera rotation R [3x3]"]
    lines += ["camera model m = K [R|-Rt] X", ""]
    for name, (turn, centre) in POSES.items():
        lines += [f"{name} {WIDTH} {HEIGHT}", row(c["f"], 0, c["cx"]), row(0, c["f"], c["cy"]), row(0, 0, 1)]
        lines += [row(c["R1"], c["R2"], c["R3"]), row(c["T1"], c["T2"]), row(*centre), *(row(*part) for part in turn)]
    params = folder / "1_initial/params"
    params.mkdir(parents=True)
    (params / "survey_calibrated_camera_parameters.txt").write_text(change("\n".join(lines) + "\n"))
    (params / "survey_offset.xyz").write_text(row(*offset) + "\n")
    return photographs(folder / "images", project)


def realitycapture(folder, newer=False, change=lambda text: text, **given):
    """RealityScan's templates: f * 36 mm, px and py times the longer side; OpenCV's (p1, p2) are (t2, t1)."""
    c = {**dict.fromkeys(("px", "py", "k1", "k2", "k3", "k4", "t1", "t2"), 0.0), "f": F / WIDTH * 36, **given}
    f = c["f"] * WIDTH / 36

    def project(name, points):
        X, Y, Z = seen_from(name, points).T
        x, y = X / Z, Y / Z
        r2, p1, p2 = x * x + y * y, c["t2"], c["t1"]
        radial = 1 + c["k1"] * r2 + c["k2"] * r2**2 + c["k3"] * r2**3 + c["k4"] * r2**4
        a = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
        b = y * radial + 2 * p2 * x * y + p1 * (r2 + 2 * y * y)
        return np.stack([f * a + c["px"] * WIDTH + WIDTH / 2, f * b + c["py"] * WIDTH + HEIGHT / 2], 1)

    text = "#name,x,y,alt,heading,pitch,roll,f,px,py,k1,k2,k3,k4,t1,t2\n"
    if newer:
        text = "#name,x,y,alt,yaw,pitch,roll,f_35mm,px_norm,py_norm,k1,k2,k3,k4,t1,t2\n"
    for name, (heading, pitch, roll, centre) in ANGLES.items():
        order = [c[key] for key in ("f", "px", "py", "k1", "k2", "k3", "k4", "t1", "t2")]
        text += ",".join([name, *(repr(float(v)) for v in (*centre, heading, pitch, roll, *order))]) + "\n"
    (folder / "cameras.csv").write_text(change(text))
    return photographs(folder / "images", project)


OPENMVG = {
    "pinhole": (),
    "pinhole_radial_k1": ("disto_k1", (-0.08,)),
    "pinhole_radial_k3": ("disto_k3", (-0.08, 0.05, -0.02)),
    "pinhole_brown_t2": ("disto_t2", (-0.08, 0.05, -0.02, 0.002, -0.003)),
    "fisheye": ("fisheye", (0.02, -0.01, 0.004, -0.001)),
}


def openmvg(folder, kind="pinhole_radial_k3", change=lambda contents: None, centre=(WIDTH / 2 + 3, HEIGHT / 2 - 2)):
    """openMVG: x_d = x (1 + K1 r^2 + ...) + (T2 (r^2 + 2 x^2) + 2 T1 x y); pixel centres are whole numbers."""
    given = OPENMVG[kind]
    values = given[1] if given else ()
    k1, k2, k3, t1, t2 = [*values[:3], *(0,) * (3 - len(values[:3])), *(values[3:] if len(values) == 5 else (0, 0))]

    def pixels(name, points):
        X, Y, Z = seen_from(name, points).T
        x, y = X / Z, Y / Z
        r2 = x * x + y * y
        if kind == "fisheye":
            theta = np.arctan(np.sqrt(r2))
            turned = theta * (1 + sum(value * theta ** (2 * at) for at, value in enumerate(values, 1)))
            a, b = x * turned / np.sqrt(r2), y * turned / np.sqrt(r2)
        else:
            radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
            a = x * radial + t2 * (r2 + 2 * x * x) + 2 * t1 * x * y
            b = y * radial + t1 * (r2 + 2 * y * y) + 2 * t2 * x * y
        return np.stack([F * a + centre[0], F * b + centre[1]], 1)

    def view(at, name, posed=True):
        data = {"local_path": "/", "filename": name, "width": WIDTH, "height": HEIGHT, "id_view": at}
        data |= {"id_intrinsic": 0, "id_pose": at if posed else 4294967295}
        return {
            "key": at,
            "value": {"polymorphic_id": 1073741824, "ptr_wrapper": {"id": 2147483649 + at, "data": data}},
        }

    lens = {"width": WIDTH, "height": HEIGHT, "focal_length": F, "principal_point": list(centre)}
    lens |= {given[0]: list(values)} if given else {}
    wrapped = {"id": 2147483660, "data": lens}
    contents = {
        "sfm_data_version": "0.3",
        "root_path": "/somewhere/else",
        "views": [*(view(at, name) for at, name in enumerate(POSES)), view(9, "IMG 9.png", posed=False)],
        "intrinsics": [
            {"key": 0, "value": {"polymorphic_id": 2147483649, "polymorphic_name": kind, "ptr_wrapper": wrapped}},
            {"key": 1, "value": {"polymorphic_id": 1, "ptr_wrapper": wrapped}},
        ],
        "extrinsics": [
            {"key": at, "value": {"rotation": turn.tolist(), "center": place.tolist()}}
            for at, (turn, place) in enumerate(POSES.values())
        ],
        "structure": [
            {
                "key": row,
                "value": {
                    "X": dot.tolist(),
                    "observations": [
                        {"key": at, "value": {"id_feat": row, "x": pixels(name, dot[None])[0].tolist()}}
                        for at, name in enumerate(POSES)
                    ],
                },
            }
            for row, dot in enumerate(DOTS)
        ],
        "control_points": [],
    }
    contents["views"][1]["value"]["ptr_wrapper"]["data"]["id_intrinsic"] = 1
    change(contents)
    (folder / "sfm_data.json").write_text(json.dumps(contents))
    return photographs(folder / "images", lambda name, points: pixels(name, points) + 0.5)


def bundler(folder, k1=-0.1, k2=0.04, change=lambda text: text, listed=lambda name: f"./{name} 0 190.5"):
    """Bundler v0.4 manual: P = R X + t, p = -P / P.z, p' = f r(p) p; origin in the middle, x right, y up."""
    flipped = {name: (np.array([[1], [-1], [-1]]) * turn, centre) for name, (turn, centre) in POSES.items()}

    def middle(name, points):
        turn, centre = flipped[name]
        P = points @ turn.T - turn @ centre
        p = -P[:, :2] / P[:, 2:]
        r2 = (p**2).sum(1, keepdims=True)
        return F * (1 + k1 * r2 + k2 * r2**2) * p

    def row(*values):
        return " ".join(f"{value:.17g}" for value in values)

    lines = ["# Bundle file v0.3", f"{len(POSES) + 1} {len(DOTS)}"]
    for turn, centre in flipped.values():
        lines += [row(F, k1, k2), *(row(*part) for part in turn), row(*(-turn @ centre))]
    lines += ["0 0 0"] * 5
    for at, dot in enumerate(DOTS):
        spots = enumerate(middle(name, dot[None])[0] for name in POSES)
        sights = [row(view, at, *spot) for view, spot in spots if (np.abs(spot) < (WIDTH / 2, HEIGHT / 2)).all()]
        lines += [row(*dot), row(*COLORS[at]), f"{len(sights)} {' '.join(sights)}"]
    (folder / "bundle.out").write_text(change("\n".join(lines) + "\n"))
    (folder / "list.txt").write_text("".join(f"{listed(name)}\n" for name in [*POSES, "IMG 9.png"]))
    size = np.array([WIDTH, HEIGHT])
    return photographs(folder / "images", lambda name, points: size / 2 + middle(name, points) * (1, -1))
