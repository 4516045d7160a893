"""The flight of `programs` in formats for exchange and of scanning apps, each by its own formula of projection.

The formulas are written here from the documentation of the formats, and share nothing with the readers.
"""

import json

import numpy as np
from PIL import Image
from program_files import COLORS, DOTS, HEIGHT, POSES, WIDTH, F, photographs, seen_from
from scipy.spatial.transform import Rotation

IMAGE_AXES = {"Right": (1, 0, 0), "Left": (-1, 0, 0), "Down": (0, 1, 0), "Up": (0, -1, 0)}


def angles(turn):
    """Omega, phi, kappa in degrees of a photogrammetric M = R3(kappa) R2(phi) R1(omega)."""
    return np.degrees([np.arctan2(-turn[2, 1], turn[2, 2]), np.arcsin(turn[2, 0]), np.arctan2(-turn[1, 0], turn[0, 0])])


def elements(**values):
    return "".join(f"<{key}>{value!r}</{key}>" for key, value in values.items())


def blocks_exchange(
    folder,
    axes="XRightYDown",
    degrees=False,
    millimetres=False,
    system=None,
    origin=(0, 0, 0),
    paths=lambda name: f"D:\\flight one\\{name}",
    change=lambda text: text,
    **given,
):
    """Bentley's sample file: pixels from the centre of the first one; rotation of the world to the axes of the camera.

    Distortion as Wikipedia has Brown's: x r(r) + P1 (r^2 + 2 x^2) + 2 P2 x y.
    """
    c = {**dict.fromkeys(("K1", "K2", "K3", "P1", "P2"), 0.0), "x": WIDTH / 2 + 2.5, "y": HEIGHT / 2 - 1.75, **given}

    def pixels(name, points):
        X, Y, Z = seen_from(name, points).T
        x, y = X / Z, Y / Z
        r2 = x * x + y * y
        radial = 1 + c["K1"] * r2 + c["K2"] * r2**2 + c["K3"] * r2**3
        a = x * radial + c["P1"] * (r2 + 2 * x * x) + 2 * c["P2"] * x * y
        b = y * radial + c["P2"] * (r2 + 2 * y * y) + 2 * c["P1"] * x * y
        return np.stack([F * a + c["x"], F * b + c["y"]], 1)

    x, _, y = axes.removeprefix("X").partition("Y")
    frame = np.array([IMAGE_AXES[x], IMAGE_AXES[y], np.cross(IMAGE_AXES[x], IMAGE_AXES[y])])
    pixel = 0.004
    point = elements(x=c["x"], y=c["y"])
    if millimetres:  # from the middle of the sensor, along the axes of the camera
        off = frame @ np.array([c["x"] - (WIDTH - 1) / 2, c["y"] - (HEIGHT - 1) / 2, 0]) * pixel
        point = elements(xmm=float(off[0]), ymm=float(off[1]))
    focal = elements(SensorSize=WIDTH * pixel, FocalLength=F * pixel) if millimetres else elements(FocalLengthPixels=F)
    photos = ""
    for at, (name, (turn, centre)) in enumerate(POSES.items()):
        turned = frame @ turn
        if degrees:
            rotation = elements(**dict(zip(("Omega", "Phi", "Kappa"), map(float, angles(turned)), strict=True)))
        else:
            rotation = elements(**{f"M_{i}{j}": float(turned[i, j]) for i in range(3) for j in range(3)})
        place = elements(**dict(zip("xyz", map(float, centre + origin), strict=True)))
        photos += f"<Photo><Id>{at + 5}</Id><ImagePath>{paths(name)}</ImagePath><Component>1</Component>"
        photos += f"<Pose><Rotation>{rotation}</Rotation><Center>{place}</Center></Pose></Photo>\n"
    photos += "<Photo><Id>77</Id><ImagePath>D:/lost/IMG 9.png</ImagePath></Photo>"
    ties = ""
    for dot, color in zip(DOTS, COLORS, strict=True):
        ties += f"<TiePoint><Position>{elements(**dict(zip('xyz', map(float, dot + origin), strict=True)))}</Position>"
        shade = dict(zip(("Red", "Green", "Blue"), (color / 255).tolist(), strict=True))
        ties += f"<Color>{elements(**shade)}</Color>"
        for at, name in enumerate(POSES):
            u, v = pixels(name, dot[None])[0].tolist()
            ties += f"<Measurement><PhotoId>{at + 5}</PhotoId>{elements(x=u, y=v)}</Measurement>"
        ties += "</TiePoint>\n"
    definition = f"<SRS><Id>3</Id><Name>map</Name><Definition>{system}</Definition></SRS>" if system else ""
    text = (
        f'<?xml version="1.0" encoding="utf-8"?>\n<BlocksExchange version="3.2">\n<SpatialReferenceSystems>{definition}'
        f"</SpatialReferenceSystems>\n<Block><Name>AT</Name>{'<SRSId>3</SRSId>' if system else ''}<Photogroups>"
        f"<Photogroup><Name>Group 1</Name><ImageDimensions>{elements(Width=WIDTH, Height=HEIGHT)}</ImageDimensions>"
        f"<CameraModelType>Perspective</CameraModelType>{focal}<CameraOrientation>{axes}</CameraOrientation>"
        f"<PrincipalPoint>{point}</PrincipalPoint><Distortion>"
        f"{elements(**{key: c[key] for key in ('K1', 'K2', 'K3', 'P1', 'P2')})}</Distortion>"
        f"<AspectRatio>1</AspectRatio><Skew>0</Skew>\n{photos}</Photogroup></Photogroups>"
        f"<TiePoints>\n{ties}</TiePoints></Block></BlocksExchange>\n"
    )
    (folder / "BlocksExchangeAT.xml").write_text(change(text), encoding="utf-8")
    return photographs(folder / "images", lambda name, points: pixels(name, points) + 0.5)


def polycam(folder, kind="corrected_", change=lambda number, values: None, depth=True):
    """ARKit: camera to world by rows, x right, y up, z backward; the world has y up. No distortion.

    The world of the dots has z up: its x, y, z are ARKit's x, -z, y.
    """
    names = {name: f"keyframes/{kind}images/{at}00.jpg" for at, name in enumerate(POSES, 1)}
    back = {place: name for name, place in names.items()}
    fx, fy, cx, cy = F, F + 1.5, WIDTH / 2 + 3, HEIGHT / 2 - 2

    def project(place, points):
        X, Y, Z = seen_from(back[place], points).T
        return np.stack([fx * X / Z + cx, fy * Y / Z + cy], 1)

    cameras = folder / f"keyframes/{kind}cameras"
    cameras.mkdir(parents=True)
    photographs(folder / "made", lambda name, points: project(names[name], points))
    (folder / f"keyframes/{kind}images").mkdir()
    for name, (turn, centre) in POSES.items():
        right, down, ahead = turn
        columns = [right, -down, -ahead, centre]
        values = {}
        for column, (x, y, z) in enumerate(columns):
            values |= {f"t_0{column}": float(x), f"t_1{column}": float(z), f"t_2{column}": float(-y)}
        values |= {"fx": fx, "fy": fy, "cx": cx, "cy": cy, "width": WIDTH, "height": HEIGHT, "blur_score": 90.0}
        number = names[name].rpartition("/")[2].removesuffix(".jpg")
        change(number, values)
        (cameras / f"{number}.json").write_text(json.dumps(values))
        Image.open(folder / "made" / name).save(folder / names[name])
        (folder / "made" / name).unlink()
        if depth:
            (folder / "keyframes/depth").mkdir(exist_ok=True)
            map_mm = np.full((HEIGHT // 4, WIDTH // 4), 1250, np.uint16)
            Image.fromarray(map_mm).save(folder / f"keyframes/depth/{number}.png")
    (folder / "made").rmdir()
    return project


def record3d(folder, own=False, change=lambda values: None):
    """As nerfstudio reads it: quaternions x, y, z, w and places, camera to world with the axes of OpenGL, of a world
    with y up; K by columns.

    The world of the dots has z up: its x, y, z are ARKit's x, -z, y.
    """
    fx, fy, cx, cy = F, F + 2.0, WIDTH / 2 + 2.5, HEIGHT / 2 - 1.5
    names = {name: f"rgbd/{at}.jpg" for at, name in enumerate(POSES)}
    back = {place: name for name, place in names.items()}

    def project(place, points):
        X, Y, Z = seen_from(back[place], points).T
        return np.stack([fx * X / Z + cx, fy * Y / Z + cy], 1)

    (folder / "rgbd").mkdir()
    photographs(folder / "made", lambda name, points: project(names[name], points))
    poses = []
    for at, (name, (turn, centre)) in enumerate(POSES.items()):
        Image.open(folder / "made" / name).save(folder / names[name], quality=100)
        (folder / "made" / name).unlink()
        (folder / f"rgbd/{at}.depth").write_bytes(b"bvx2")
        right, down, ahead = turn
        x, y, z = np.stack([right, -down, -ahead, centre], 1)  # rows: along the axes of the dots
        matrix = np.stack([x, z, -y])
        poses.append([*Rotation.from_matrix(matrix[:, :3]).as_quat().tolist(), *matrix[:, 3].tolist()])
    (folder / "made").rmdir()
    values = {"w": WIDTH, "h": HEIGHT, "fps": 60, "poses": poses, "K": [fx, 0, 0, 0, fy, 0, cx, cy, 1]}
    if own:
        values |= {"perFrameIntrinsicCoeffs": [[fx, fy, cx, cy]] * len(poses), "K": [9, 0, 0, 0, 9, 0, 1, 1, 1]}
    change(values)
    (folder / "metadata").write_text(json.dumps(values))
    return project


def xmp_sidecars(folder, model="brown3", elements=True, change=lambda name, text: text, **given):
    """RealityCapture XMP camera math: x = R (X - Position); f and shares of the longer side, 36 mm."""
    c = {**dict.fromkeys(("k1", "k2", "k3", "k4", "t1", "t2", "u", "v", "skew"), 0.0), "aspect": 1.0, **given}

    def project(name, points):
        X, Y, Z = seen_from(name, points).T
        x, y = X / Z, Y / Z
        r2 = x * x + y * y
        radial = 1 + c["k1"] * r2 + c["k2"] * r2**2 + c["k3"] * r2**3 + c["k4"] * r2**4
        a = x * radial + c["t1"] * (r2 + 2 * x * x) + 2 * c["t2"] * x * y
        b = y * radial + c["t2"] * (r2 + 2 * y * y) + 2 * c["t1"] * x * y
        longer = max(WIDTH, HEIGHT)
        return np.stack(
            [
                F * a + c["skew"] * longer * b + c["u"] * longer + WIDTH / 2,
                F * c["aspect"] * b + c["v"] * longer + HEIGHT / 2,
            ],
            1,
        )

    photographs(folder / "images", project)
    for name, (turn, centre) in POSES.items():
        row = {
            "Rotation": " ".join(map(repr, map(float, turn.ravel()))),
            "Position": " ".join(map(repr, map(float, centre))),
            "DistortionCoeficients": " ".join(repr(c[key]) for key in ("k1", "k2", "k3", "k4", "t1", "t2")),
        }
        inner = "".join(f"<xcr:{key}>{value}</xcr:{key}>" for key, value in row.items()) if elements else ""
        outer = "" if elements else " ".join(f'xcr:{key}="{value}"' for key, value in row.items())
        text = (
            '<x:xmpmeta xmlns:x="adobe:ns:meta/">\n<rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">\n'
            '<rdf:Description xcr:Version="3" xcr:PosePrior="exact" xcr:Coordinates="absolute" '
            f'xcr:DistortionModel="{model}" xcr:FocalLength35mm="{F / max(WIDTH, HEIGHT) * 36!r}" '
            f'xcr:Skew="{c["skew"]!r}" xcr:AspectRatio="{c["aspect"]!r}" xcr:PrincipalPointU="{c["u"]!r}" '
            f'xcr:PrincipalPointV="{c["v"]!r}" {outer} xmlns:xcr="http://www.capturingreality.com/ns/xcr/1.1#">\n'
            f"{inner}</rdf:Description>\n</rdf:RDF>\n</x:xmpmeta>\n"
        )
        (folder / "images" / name).with_suffix(".xmp").write_text(change(name, text))
    return project


def opf_points(folder, project, ids):
    """OPF 1.0, point_cloud: a matrix from z up to y up, by columns; matches packed in 40 and 24 bits.

    Before the values of each file are bytes that must not be read.
    """
    cameras = [name for _ in DOTS for name in POSES]
    marks = [project(name, dot[None])[0] for dot in DOTS for name in POSES]
    packed = [(row * len(POSES)) | (len(POSES) << 40) for row in range(len(DOTS))]
    arrays = {
        "position": (np.array(DOTS, "<f4"), 5126, "VEC3"),
        "colour": (np.column_stack([COLORS, np.full(len(DOTS), 255)]).astype("u1"), 5121, "VEC4"),
        "camera": (np.array([list(POSES).index(name) for name in cameras], "<u4"), 5125, "SCALAR"),
        "range": (np.array(packed, "<u8").view("<u4").reshape(-1, 2), 5125, "VEC2"),
        "pixel": (np.array(marks, "<f4"), 5126, "VEC2"),
    }
    accessors, views, buffers = [], [], []
    for at, (name, (values, kind, shape)) in enumerate(arrays.items()):
        (folder / f"{name}.bin").write_bytes(bytes(8) + values.tobytes())
        accessors.append({"bufferView": at, "componentType": kind, "type": shape, "count": len(values)})
        views.append({"buffer": at, "byteOffset": 8, "byteLength": values.nbytes})
        buffers.append({"uri": f"{name}.bin", "byteLength": values.nbytes + 8})
    matches = {"cameraIds": 2, "cameraUids": [ids[name] for name in POSES], "pointIndexRanges": 3}
    matches |= {"imagePoints": {"pixelCoordinates": 4, "featureIds": 2, "scales": 2}}
    mesh = {
        "attributes": {"POSITION": 0, "COLOR_0": 1},
        "extensions": {"OPF_mesh_primitive_matches": matches},
        "mode": 0,
    }
    matrix = [1, 0, 0, 0, 0, 0, -1, 0, 0, 1, 0, 0, 0, 0, 0, 1]
    whole = {"asset": {"version": "2.0", "extensions": {"OPF_asset_version": {"version": "1.0"}}}, "scene": 0}
    whole |= {"scenes": [{"nodes": [0]}], "nodes": [{"mesh": 0, "matrix": matrix}], "meshes": [{"primitives": [mesh]}]}
    return whole | {"accessors": accessors, "bufferViews": views, "buffers": buffers}


def opf(folder, shift=(0, 0, 0), scale=(1, 1, 1), definition=None, swap=False, change=lambda files: None, **given):
    """OPF: Rx(omega) Ry(phi) Rz(kappa) from a camera (x right, y up, z backward); canonical = map + shift."""
    c = {**dict.fromkeys(("R1", "R2", "R3", "T1", "T2"), 0.0), "cx": WIDTH / 2 + 3.0, "cy": HEIGHT / 2 - 2.0, **given}

    def project(name, points):
        X, Y, Z = seen_from(name, points).T
        x, y = X / Z, Y / Z
        r2 = x * x + y * y
        radial = 1 + c["R1"] * r2 + c["R2"] * r2**2 + c["R3"] * r2**3
        a = x * radial + 2 * c["T1"] * x * y + c["T2"] * (r2 + 2 * x * x)
        b = y * radial + 2 * c["T2"] * x * y + c["T1"] * (r2 + 2 * y * y)
        return np.stack([F * a + c["cx"], F * b + c["cy"]], 1)

    def entry(kind, name):
        resource = {"uri": name.replace(" ", "%20"), "format": f"application/opf-{kind}+json"}
        return {"id": kind, "type": kind, "resources": [resource], "sources": []}

    numbers = {name: 2**63 + 5 + at for at, name in enumerate(POSES)}
    cameras = []
    for name, (turn, centre) in POSES.items():
        matrix = (np.diag([1, -1, -1]) @ turn).T  # columns: right, up and backward in the world
        omega, phi = np.arctan2(-matrix[1, 2], matrix[2, 2]), np.arcsin(matrix[0, 2])
        kappa = np.arctan2(-matrix[0, 1], matrix[0, 0])
        place = {"position": centre.tolist(), "orientation_deg": np.degrees([omega, phi, kappa]).tolist()}
        cameras.append({"id": numbers[name], "sensor_id": 7, **place})
    inner = {"type": "perspective", "focal_length_px": F, "principal_point_px": [c["cx"], c["cy"]]}
    inner |= {"radial_distortion": [c["R1"], c["R2"], c["R3"]], "tangential_distortion": [c["T1"], c["T2"]]}
    listed = [{"id": number, "uri": f"../photos/{name}".replace(" ", "%20")} for name, number in numbers.items()]
    listed += [{"id": 3, "uri": "file:///c:/data/IMG%209.png#page=0"}, {"id": 4, "uri": "DepthMap_1.tiff"}]
    captures = [{"id": each["id"], "cameras": [{"id": each["id"], "sensor_id": 7}]} for each in listed[:-1]]
    frame = {"shift": list(shift), "scale": list(scale), "swap_xy": swap}
    files = {
        "camera list.json": {"cameras": listed},
        "input.json": {"sensors": [{"id": 7, "image_size_px": [WIDTH, HEIGHT]}], "captures": captures},
        "calibrated.json": {"sensors": [{"id": 7, "internals": inner}], "cameras": cameras},
        "frame.json": {"crs": {"definition": definition}, "base_to_canonical": frame},
    }
    kinds = ("camera-list", "input-cameras", "calibrated-cameras", "scene-reference-frame")
    items = [entry(kind, f"parts/{name}") for kind, name in zip(kinds, files, strict=True)]
    (folder / "parts").mkdir()
    files["tracks.gltf"] = opf_points(folder / "parts", project, numbers)
    items[2]["resources"].append({"uri": "parts/tracks.gltf", "format": "model/gltf+json"})
    files["../survey.opf"] = {"format": "application/opf-project+json", "items": items if definition else items[:-1]}
    change(files)
    for name, contents in files.items():
        (folder / "parts" / name).write_text(json.dumps(contents))
    return photographs(folder / "images", project)
