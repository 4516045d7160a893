"""Classes of places: what each point is, which views see it, and that only the class falls that is wrong."""

import json

import numpy as np
import pytest
import torch
from needs import needs
from PIL import Image
from scipy.spatial.transform import Rotation

from surfkit.evaluate.geometry.class_pictures import write_classes
from surfkit.evaluate.geometry.classes import SEEN_FROM, class_figures, classify
from surfkit.evaluate.geometry.comparison import Comparison, compare
from surfkit.evaluate.geometry.repetition import ComparedSurface
from surfkit.evaluate.geometry.sightings import near_edges, sightings
from surfkit.evaluate.geometry.surface_file import SurfaceFile, read_surface
from surfkit.evaluate.geometry.surface_normals import normals_at
from surfkit.evaluate.geometry.terrain import terrain
from surfkit.evaluate.geometry.transform import apply
from surfkit.evaluate.images.seams import Seams
from surfkit.io.splats.ply import read_vertices
from surfkit.scene.camera import Camera
from surfkit.scene.scene import Frame, View
from surfkit.scene.up_direction import up_direction
from surfkit.testing.synthetic import Flight, photograph

from .test_crop_volume import exact_visible, overhead, synthetic_points

trimesh = needs("trimesh")
pytestmark = pytest.mark.usefixtures("quick_alignment")

TAU = 0.5
HOUSES = [((-12, -10), (-4, -3), 5.0), ((3, -8), (9, 6), 8.0), ((-10, 4), (-5, 12), 3.0)]
"""Lower and upper corner, and height."""
STILL = Comparison(crop="none", align="none", draws=1, tau=TAU)


def quad(a, b, c, d):
    return np.array([[a, b, c], [a, c, d]], float)


def town(slope=0.0, widened=0.0, walls=True):
    """Triangles of houses on a ground that rises along x; walls may stand further out than the roofs end."""
    parts, lift = [], lambda x: slope * x
    for (x0, y0), (x1, y1), high in HOUSES:
        top = high + lift((x0 + x1) / 2)
        parts.append(quad((x0, y0, top), (x1, y0, top), (x1, y1, top), (x0, y1, top)))
        a, b, c, d = x0 - widened, x1 + widened, y0 - widened, y1 + widened
        for p, q in (((a, c), (b, c)), ((b, c), (b, d)), ((b, d), (a, d)), ((a, d), (a, c))) * walls:
            parts.append(quad((*p, lift(p[0])), (*q, lift(q[0])), (*q, top), (*p, top)))
    xs, ys = (sorted({-20, 20, *(c[i] for low, up, _ in HOUSES for c in (low, up))}) for i in (0, 1))
    for x0, x1 in zip(xs, xs[1:], strict=False):
        for y0, y1 in zip(ys, ys[1:], strict=False):
            inside = [low[0] <= x0 and x1 <= up[0] and low[1] <= y0 and y1 <= up[1] for low, up, _ in HOUSES]
            if not any(inside):
                z0, z1 = lift(x0), lift(x1)
                parts.append(quad((x0, y0, z0), (x1, y0, z1), (x1, y1, z1), (x0, y1, z0)))
    return np.concatenate(parts)


def mesh(triangles):
    return SurfaceFile("town", triangles.reshape(-1, 3), np.arange(3 * len(triangles)).reshape(-1, 3))


def exact_class(points, slope=0.0):
    """0 roof, 1 facade, 2 ground, -1 within tau of where two meet."""
    found = np.full(len(points), 2)
    found[np.abs(points[:, 2] - slope * points[:, 0]) > 0.1] = 1
    for low, up, high in HOUSES:
        on_top = np.abs(points[:, 2] - high - slope * (low[0] + up[0]) / 2) < 0.01
        inside = (points[:, :2] > np.array(low) - 0.1).all(1) & (points[:, :2] < np.array(up) + 0.1).all(1)
        found[on_top & inside] = 0
        rim = np.abs(points[:, :2, None] - np.array([low, up]).T[None]).min((1, 2)) < TAU
        foot = np.abs(points[:, 2] - slope * points[:, 0]) < TAU
        found[rim & inside & (on_top | foot)] = -1
        found[rim & inside & (np.abs(points[:, 2] - high - slope * (low[0] + up[0]) / 2) < TAU)] = -1
    return found


def ring(count=12, turn=None):
    """Views around the town that look at its middle, in a frame that is turned from one with z up."""
    turn = np.eye(3) if turn is None else turn
    views = []
    for angle in 2 * np.pi * np.arange(count) / count:
        eye = np.array([30 * np.cos(angle), 30 * np.sin(angle), 28.0])
        z = -eye / np.linalg.norm(eye)
        x = np.cross(z, [0, 0, 1])
        x /= np.linalg.norm(x)
        pose = np.eye(4)
        pose[:3, :3] = np.stack([x, np.cross(z, x), z]) @ turn.T
        pose[:3, 3] = -pose[:3, :3] @ turn @ eye
        views.append(View(f"{angle:.2f}", Camera(torch.from_numpy(pose), 250.0, 250.0, 160, 120, 320, 240), "none"))
    return views


FRAME = Frame(np.zeros(3), 1.0)


@pytest.mark.parametrize("slope", [0.0, 0.3])
def test_roofs_facades_and_ground_are_what_they_were_built_as(slope):
    outcome = compare(mesh(town(slope)), mesh(town(slope)), STILL)
    classes = classify(outcome, STILL)
    truth = outcome.draws[0].truth
    exact = exact_class(truth, slope)
    known = exact >= 0
    assert [(exact == kind).sum() > 300 for kind in range(3)] == [True] * 3
    assert (classes.groups[0].truth == exact)[known].mean() > 0.995
    assert classes.up.source == "z, as no cameras are known" and len(classes.groups) == 1


def test_only_the_class_falls_that_is_wrong():
    wrong = compare(mesh(town(widened=4 * TAU)), mesh(town()), STILL)
    found = class_figures(classify(wrong, STILL), wrong.draws[0], TAU)["surface"]
    # what stands out at the foot of a wall is wrong, and next to the ground
    assert found["roof"]["f1"] > 0.97 and found["ground"]["f1"] > 0.9 and found["facade"]["f1"] < 0.12
    whole = compare(mesh(town()), mesh(town()), STILL)
    found = class_figures(classify(whole, STILL), whole.draws[0], TAU)["surface"]
    assert min(one["f1"] for one in found.values()) > 0.999  # of points that are drawn anew
    lacking = compare(mesh(town(walls=False)), mesh(town()), STILL)
    found = class_figures(classify(lacking, STILL), lacking.draws[0], TAU)["surface"]
    assert found["facade"]["recall"] < 0.15 and found["roof"]["recall"] > 0.99 and found["ground"]["recall"] > 0.99


def test_what_lies_far_from_the_truth_has_a_class_of_its_own():
    high = 30.0  # a sheet, and a screen, in the air
    sheet = quad((-5, -5, high), (5, -5, high), (5, 5, high), (-5, 5, high))
    screen = quad((-5, 0, high + 5), (5, 0, high + 5), (5, 0, high + 15), (-5, 0, high + 15))
    outcome = compare(mesh(np.concatenate([town(), sheet, screen])), mesh(town()), STILL)
    group = classify(outcome, STILL).groups[0]
    z = outcome.draws[0].reconstruction[:, 2]
    assert (group.ours[(z > 29) & (z < 31)] == 0).all() and (group.ours[z > 34] == 1).all()


@pytest.mark.parametrize("given", [None, "y"])
def test_up_need_not_be_z(given):
    turn = np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0.0]]).T @ np.eye(3)
    turn = turn if turn[1, 2] > 0 else turn.T
    if given is None:
        turn = Rotation.from_rotvec([0.9, -0.4, 0.3]).as_matrix()
    triangles = town() @ turn.T
    settings = Comparison(crop="none", align="none", draws=1, tau=TAU, up=given)
    outcome = compare(mesh(triangles), mesh(triangles), settings)
    classes = classify(outcome, settings, ring(turn=turn), FRAME)
    assert np.allclose(classes.up.direction, turn[:, 2], atol=1e-6)
    assert classes.up.source == ("cameras" if given is None else "--up")
    exact = exact_class(outcome.draws[0].truth @ turn)
    assert (classes.groups[0].truth == exact)[exact >= 0].mean() > 0.99


def looking(ways, centres):
    """Cameras with forward and right directions given."""
    views = []
    for i, ((forward, right), centre) in enumerate(zip(ways, centres, strict=True)):
        pose = np.eye(4)
        pose[:3, :3] = np.stack([right, np.cross(forward, right), forward])
        pose[:3, 3] = -pose[:3, :3] @ centre
        views.append(View(str(i), Camera(torch.from_numpy(pose), 1.0, 1.0, 1, 1, 2, 2), "none"))
    return views


def test_up_of_flights_and_walks():
    draw = np.random.default_rng(0)
    grid = np.column_stack([draw.uniform(-9, 9, (30, 2)), draw.normal(5, 0.1, 30)])
    down, east = np.array([0, 0, -1.0]), np.array([1.0, 0, 0])
    one_way = looking([(down, east)] * 30, grid)  # nadir, all heading one way
    walk = looking(
        [(np.array([np.cos(a), np.sin(a), 0]), np.array([np.sin(a), -np.cos(a), 0])) for a in range(9)],
        np.column_stack([np.arange(9.0), np.zeros((9, 2))]),
    )
    for views in (one_way, walk):
        found = up_direction(None, views, FRAME, np.eye(4))
        assert np.allclose(found.direction, [0, 0, 1]) and found.source == "cameras"
    line = looking([(down, east)] * 9, np.column_stack([np.arange(9.0), np.zeros((9, 2))]))
    assert up_direction(None, line, FRAME, np.eye(4)).source == "z, as the cameras do not tell"
    assert (
        up_direction(None, line, Frame(np.zeros(3), 1.0, crs="EPSG:32632"), np.eye(4)).source == "georeferenced frame"
    )


def test_a_hill_is_ground_and_a_table_is_not():
    x, y = np.meshgrid(np.arange(-30, 30, 0.2), np.arange(-30, 30, 0.2))
    hill = 12 * np.exp(-(x**2 + y**2) / 200)
    on_table = (np.abs(x - 15) < 5) & (np.abs(y) < 4)
    points = np.stack([x, y, np.where(on_table, hill.max(), hill)], -1).reshape(-1, 3)
    found = terrain(points, np.eye(3), 0.2)
    high = found.above(points) > found.clearance
    assert (high == on_table.ravel()).mean() > 0.995


def test_classes_by_views_are_those_of_exact_rays():
    scene = photograph(Flight(views=10, width=128, height=96, test_every=0)).scene
    points = synthetic_points(60_000)
    cloud = SurfaceFile("points", points)
    settings = Comparison(crop="none", align="none", draws=1, tau=0.2)
    outcome = compare(cloud, cloud, settings)
    views = classify(outcome, settings, scene.train, scene.frame).groups[1]
    truth = outcome.draws[0].truth
    counts = np.zeros(len(truth), int)
    for view in scene.train:
        pose = scene.frame.input_pose(view.camera.world_to_camera)
        local = apply(pose, truth)
        x = view.camera.fx * local[:, 0] / local[:, 2] + view.camera.cx
        y = view.camera.fy * local[:, 1] / local[:, 2] + view.camera.cy
        inside = (local[:, 2] > 0) & (x >= 0) & (x < view.camera.width) & (y >= 0) & (y < view.camera.height)
        counts += inside & exact_visible(truth + [0, 0, 0.02], -pose[:3, :3].T @ pose[:3, 3])
    exact = np.searchsorted(SEEN_FROM, counts, "right") - 1
    assert min(np.bincount(exact, minlength=5)) > 100
    # the box and the ball are thinned to voxels, so that a few points of theirs lie within
    ground = truth[:, 2] == 0
    assert (views.truth == exact)[ground].mean() > 0.9
    assert (np.abs(views.truth - exact)[ground] <= 1).mean() > 0.99


def test_the_rim_of_a_plate_is_near_an_edge_and_its_middle_is_not():
    x, y = (line.ravel() for line in np.meshgrid(np.arange(-5, 5, 0.05), np.arange(-5, 5, 0.05)))
    plate = (np.abs(x) < 2) & (np.abs(y) < 2)
    cloud = np.concatenate([np.stack([x, y, 0 * x], 1), np.stack([x, y, 0 * x + 4], 1)[plate]])
    under = cloud[: len(x)][(np.abs(cloud[: len(x), :2]) < 1).all(1)]
    views = [overhead(at, 0, 20) for at in (-1, 0, 1)]
    found, below = sightings((cloud, under - [0, 0, 0.5]), views, FRAME, 0.05)
    top = cloud[:, 2] == 4
    inwards = 2 - np.abs(cloud[:, :2]).max(1)
    assert (found.seen[top] == 3).mean() > 0.99 and not below.seen.any()  # the plate hides what is below it
    assert (found.edges[top & (inwards < 0.08)] == 3).mean() > 0.95 and not found.edges[top & (inwards > 0.4)].any()
    far = ~top & (np.abs(cloud[:, 0]) > 3.5)
    assert found.seen[far].any() and not found.edges[far].any()


def test_an_edge_is_a_step_and_not_a_slope_or_a_hole():
    depth = np.full((40, 60), 10.0) + np.linspace(0, 5, 60)
    depth[:, 20] = np.inf
    assert not near_edges(depth, 0.01).any()
    depth[:, 40:] += 2
    near = near_edges(depth, 0.01)
    assert near[:, 35:45].all() and not near[:, :35].any() and not near[:, 45:].any()
    assert not near_edges(depth, 0.3).any()  # points so far apart make no such step


def test_points_near_seams_are_told_apart():
    seams = Seams(np.column_stack([np.zeros(400), np.linspace(-25, 25, 400)]), np.eye(3)[:2], 2.0, "2 m")
    good, bad = town(), town()
    bad[..., 2] += 2 * TAU * (np.abs(bad[..., 0]).max(1, keepdims=True) <= 4)  # the strip of ground from -4 to 3
    outcome = compare(mesh(bad), mesh(good), STILL)
    found = class_figures(classify(outcome, STILL, (), FRAME, seams), outcome.draws[0], TAU)
    assert found["seams"]["near"]["f1"] < 0.05 and found["seams"]["elsewhere"]["f1"] > 0.8
    assert found["seams_distance"] == "2 m"
    x = np.abs(outcome.draws[0].truth[:, 0])
    assert found["seams"]["near"]["points"]["truth"] == pytest.approx((x <= 2).sum(), abs=5)


@pytest.mark.parametrize("kind", ["faces", "file", "fitted"])
def test_normals(tmp_path, kind):
    ball = trimesh.creation.icosphere(5, 2.0)
    points = np.asarray(ball.vertices)
    if kind == "faces":
        side = ComparedSurface(SurfaceFile("ball", points, np.asarray(ball.faces)), None, 40_000)
    elif kind == "file":
        rows = np.zeros(len(points), [(name, "<f4") for name in ("x", "y", "z", "nx", "ny", "nz")])
        for i, axis in enumerate("xyz"):
            rows[axis], rows[f"n{axis}"] = points[:, i], 3 * points[:, i]
        rows["nx"][5] = np.nan
        head = ["ply", "format binary_little_endian 1.0", f"element vertex {len(rows)}"]
        head += [f"property float {name}" for name in rows.dtype.names] + ["end_header", ""]
        (tmp_path / "ball.ply").write_bytes("\n".join(head).encode() + rows.tobytes())
        assert read_vertices(tmp_path / "ball.ply")[0].dtype.names[3] == "nx"
        side = ComparedSurface(read_surface(tmp_path / "ball.ply"), points, len(points))
    else:
        side = ComparedSurface(SurfaceFile("ball", points), points, len(points))
    places = points[::7] * 1.01
    found = normals_at(side, places, points, np.random.default_rng(0))
    assert np.allclose(np.linalg.norm(found, axis=1), 1)
    assert np.abs((found * places).sum(1) / np.linalg.norm(places, axis=1)).min() > 0.99


def test_a_picture_of_each_class(tmp_path):
    outcome = compare(mesh(town(widened=4 * TAU)), mesh(town()), STILL)
    classes = classify(outcome, STILL, ring(), FRAME)
    figures = class_figures(classes, outcome.draws[0], TAU)
    assert json.loads(json.dumps(figures, allow_nan=False)) == figures
    write_classes(tmp_path, outcome, classes, ring(), FRAME)
    some = {f"class-surface-{name}.png" for name in ("roof", "facade", "ground")}
    some |= {"class-views-6-or-more.png", "class-edges-near.png", "class-edges-away.png"}
    assert some <= {path.name for path in tmp_path.iterdir()}

    def wrong(name):
        with Image.open(tmp_path / f"class-surface-{name}.png") as picture:
            pixels = np.asarray(picture.convert("RGB")).astype(int)
        return (pixels[..., 0] > pixels[..., 2] + 40).sum(), (pixels[..., 2] > pixels[..., 0] + 20).sum()

    assert wrong("facade")[0] > 500 and wrong("roof")[0] < 0.06 * wrong("roof")[1]
