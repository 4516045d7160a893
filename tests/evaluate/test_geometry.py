"""Whole comparisons with known answers, what they write, and inputs that do not belong together."""

import json
from dataclasses import replace

import numpy as np
import pytest
from needs import needs
from PIL import Image
from scipy.spatial import cKDTree

from surfkit.core.check import BadInput
from surfkit.evaluate.geometry import comparison, repetition
from surfkit.evaluate.geometry.comparison import Comparison, compare
from surfkit.evaluate.geometry.errors import error_colors
from surfkit.evaluate.geometry.measure_geometry import measure_geometry
from surfkit.evaluate.geometry.repetition import cloud_side
from surfkit.evaluate.geometry.sampling import face_areas, sample_faces
from surfkit.evaluate.geometry.scores import shares
from surfkit.evaluate.geometry.surface_file import SurfaceFile, part_within, read_surface
from surfkit.evaluate.geometry.transform import apply, write_transform
from surfkit.io.splats.ply import read_vertices, write_points
from surfkit.scene.crop import Crop, write_crop
from surfkit.scene.scene import Frame
from surfkit.testing.synthetic import Flight, photograph

trimesh = needs("trimesh")


def lattice(shift=(0, 0, 0), side=60, step=0.1):
    x, y = np.meshgrid(np.arange(side) * step, np.arange(side) * step)
    return np.stack([x.ravel(), y.ravel(), 0 * x.ravel()], 1) + shift


def surface(points, faces=None):
    return SurfaceFile("given", np.asarray(points, float), faces)


def still(**others):
    return Comparison(**{"crop": "none", "align": "none", "draws": 1} | others)


def f1(outcome):
    return shares(outcome.draws[0].distances, outcome.tau)


BALL = trimesh.creation.icosphere(4, 5.0)
GLOBE = surface(BALL.vertices, np.asarray(BALL.faces))


@pytest.fixture
def only_given(monkeypatch):
    """Nothing is aligned: that is most of a comparison."""
    monkeypatch.setattr(comparison, "ALIGNMENTS", ("none",))


def test_coordinates_that_are_rounded_too_far_are_told(only_given, warned):
    place = np.array([512000.0, 5412000.0, 100.0])
    truth = surface(lattice(place))
    compare(truth, truth, still(tau=0.4))
    assert not warned
    rounded = SurfaceFile("given", truth.rows.astype(np.float32))
    compare(rounded, truth, still(tau=4.0))
    assert not warned, "steps are small against tau"
    compare(rounded, truth, still(tau=0.2))
    assert "given: its coordinates are numbers of 32 bits, at the largest ones 0.5 apart" in warned[0]


@pytest.mark.parametrize("align", ["none", "rigid", "similarity"])
def test_the_truth_against_itself(align):
    assert f1(compare(GLOBE, GLOBE, still(align=align, tau=0.4))) == (1, 1, 1)
    cloud = surface(lattice())
    assert f1(compare(cloud, cloud, still(align=align))) == (1, 1, 1)


def test_tau_is_taken_from_the_truth():
    outcome = compare(surface(lattice()), surface(lattice()), still())
    assert outcome.tau == pytest.approx(0.15)
    assert compare(surface(lattice()), surface(lattice()), still(voxel=0.2)).tau == pytest.approx(0.3, rel=0.05)
    with pytest.raises(BadInput, match="give --tau"):
        compare(surface(lattice()), GLOBE, still())


def test_shifted_copies_by_hand():
    # Points 0.1 apart, thinned to voxels of 0.08, which no two share. Shifted by 1 along x, the last 10 of 60 columns
    # of either lie alone: 0.1, 0.2, ... 1.0 from the other. The first of these is within tau = 0.16.
    thin = still(tau=0.16)
    assert f1(compare(surface(lattice((0, 0, 0.15))), surface(lattice()), thin)) == (1, 1, 1)
    assert f1(compare(surface(lattice((0, 0, 0.17))), surface(lattice()), thin)) == (0, 0, 0)
    by_hand = (60 - 10 + 1) / 60
    shifted = compare(surface(lattice((1, 0, 0))), surface(lattice()), still(tau=0.16))
    assert f1(shifted) == pytest.approx((by_hand,) * 3)


def test_alignment_takes_a_shift_away_and_size_only_where_it_may():
    truth = surface(BALL.vertices * [1, 1.3, 0.7], np.asarray(BALL.faces))
    moved = surface(truth.rows * 1.08 + [0.05, -0.03, 0.02], truth.faces)
    outcomes = {way: compare(moved, truth, still(tau=0.3, align=way)) for way in ("none", "rigid", "similarity")}
    found = {way: f1(outcome)[2] for way, outcome in outcomes.items()}
    assert found["similarity"] > 0.99 and found["rigid"] < 0.7 and found["none"] < 0.7
    assert outcomes["none"].others["similarity"].alignment.scale == pytest.approx(1 / 1.08, rel=2e-3)


def test_the_whole_agrees_with_brute_force():
    draw = np.random.default_rng(0)
    truth = lattice() + draw.normal(0, 0.03, (3600, 3))
    ours = lattice()[:1800] + draw.normal(0, 0.03, (1800, 3))
    tau = 0.06
    keep = [np.ones(len(p), bool) for p in (ours, truth)]
    outcome = compare(surface(ours), surface(truth), still(tau=tau))
    a, b = outcome.draws[0].reconstruction, outcome.draws[0].truth
    assert 0.8 * keep[0].sum() < len(a) <= len(ours)  # few share a voxel
    assert cKDTree(ours).query(a)[0].max() < tau
    near = np.sqrt(((a[:, None] - b[None]) ** 2).sum(2))
    p, r = (near.min(1) < tau).mean(), (near.min(0) < tau).mean()
    assert f1(outcome) == pytest.approx((p, r, 2 * p * r / (p + r)), abs=1e-6)


def test_a_coarse_mesh_gets_enough_samples():
    square = surface([[0, 0, 0], [6, 0, 0], [6, 6, 0], [0, 6, 0]], np.array([[0, 1, 2], [0, 2, 3]]))
    p, r, _ = f1(compare(square, surface(lattice(side=61)), still(tau=0.15)))
    assert p > 0.999 and r > 0.999
    assert f1(compare(square, surface(lattice(side=61)), still(tau=0.15, samples=200)))[1] < 0.5


@pytest.mark.parametrize("far", ["reconstruction", "truth", "both"])
def test_a_large_triangle_far_away_takes_no_samples(tmp_path, monkeypatch, warned, far):
    """Half a square is there: recall 1/2, whatever lies beyond the crop volume, and however large."""
    monkeypatch.setattr(repetition, "MAX_COMPARED_POINTS", 60_000)
    sky = [[-1e5, -1e5, 500], [1e5, -1e5, 500], [0, 2e5, 500], [2.6, -7e4, 0], [9e4, 0, 0], [2.6, 7e4, 0]]

    def mesh(width, beyond):
        x, y = np.meshgrid(np.linspace(0, width, 9), np.linspace(0, 6, 9))
        corners = np.stack([x.ravel(), y.ravel(), 0 * x.ravel()], 1)
        at = np.arange(81).reshape(9, 9)
        a, b, c, d = (part.ravel() for part in (at[:-1, :-1], at[:-1, 1:], at[1:, :-1], at[1:, 1:]))
        faces = np.concatenate([np.stack([a, b, c], 1), np.stack([b, d, c], 1)])
        if beyond:
            corners, faces = np.concatenate([corners, sky]), np.concatenate([faces, [[81, 82, 83], [84, 85, 86]]])
        return surface(corners, faces)

    square = Crop(np.array([[0.0, 0], [2.4, 0], [2.4, 6], [0, 6]]), -1, 1)
    write_crop(tmp_path / "c.json", square)
    settings = still(crop=str(tmp_path / "c.json"), tau=0.1, draws=1)
    pair = mesh(1.2, far != "truth"), mesh(6, far != "reconstruction")
    p, r, _ = f1(compare(*pair, settings))
    assert p > 0.999 and 0.5 < r < 0.5 + 0.1 / 2.4, "half, and what lies within tau of it"
    assert not warned


def test_a_part_of_a_mesh_is_all_of_it_within_the_box():
    low, high = np.array([-2.0, -1, -9]), np.array([5.0, 4, 9])
    for mesh in (GLOBE, surface([[-50, -50, 1], [90, -40, 1.5], [3, 70, 0]], np.array([[0, 1, 2]]))):
        part = part_within(mesh, low, high)
        points, _ = sample_faces(mesh, 200_000, np.random.default_rng(0))
        own, _ = sample_faces(part, 20_000, np.random.default_rng(0))
        inside = ((points > low) & (points < high)).all(1)
        share = ((own > low) & (own < high)).all(1).mean()
        area, whole = face_areas(part).sum(), face_areas(mesh).sum()
        assert area * share == pytest.approx(whole * inside.mean(), rel=0.03) and share > 0.5
    assert not len(part_within(GLOBE, np.full(3, 20.0), np.full(3, 30.0)).faces)


def test_draws_differ_and_seeds_repeat(only_given):
    def run(seed):
        truth = surface(BALL.vertices * 1.07, GLOBE.faces)
        outcome = compare(GLOBE, truth, still(tau=0.4, draws=3, seed=seed))
        return [shares(draw.distances, outcome.tau) for draw in outcome.draws]

    first, again, other = run(1), run(1), run(2)
    assert first == again != other and len(set(first)) == 3
    assert np.std([draw[2] for draw in first]) < 0.02


def test_reconstructions_are_compared_with_the_same_points_of_the_truth(only_given):
    truth = surface(BALL.vertices * 1.02, GLOBE.faces)
    coarse = trimesh.creation.icosphere(3, 5.0)
    rough = surface(coarse.vertices, np.asarray(coarse.faces))
    fine, other = (compare(each, truth, still(tau=0.4, draws=2)).draws for each in (GLOBE, rough))
    for one, two in zip(fine, other, strict=True):
        assert len(one.reconstruction) and not np.array_equal(one.reconstruction, two.reconstruction)
        assert np.array_equal(one.truth, two.truth)
    assert not np.array_equal(fine[0].truth, fine[1].truth)


def test_a_given_transform_and_crop(tmp_path):
    matrix = np.eye(4)
    matrix[:3, :3] = 2 * np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1]])
    matrix[:3, 3] = [100, 200, 300]
    write_transform(tmp_path / "t.txt", matrix)
    truth = surface(apply(matrix, lattice()))
    corners = np.array([[94.05, 200.05], [101, 200.05], [101, 206.05], [94.05, 206.05]])
    write_crop(tmp_path / "c.json", Crop(corners, 299, 301))
    settings = still(transform=tmp_path / "t.txt", crop=str(tmp_path / "c.json"), tau=0.3)
    outcome = compare(surface(lattice()), truth, settings)
    assert f1(outcome) == (1, 1, 1) and len(outcome.draws[0].truth) == 30 * 30
    assert np.array_equal(outcome.draws[0].alignment.matrix, matrix)
    write_crop(tmp_path / "c.json", Crop(np.array([[0.0, 0], [1, 0], [1, 1]]), 0, 1))
    with pytest.raises(BadInput, match="0 points .*--transform.*--crop"):
        compare(surface(lattice()), truth, settings)


def test_a_large_cloud_is_thinned_while_it_is_read(monkeypatch):
    monkeypatch.setattr(repetition, "MAX_COMPARED_POINTS", 1_000)
    found = cloud_side(surface(lattice(side=200)), None)
    assert 300 < len(found.cloud) < 3_000 and found.voxel > 0.3
    assert len(cloud_side(surface(lattice(side=20)), None).cloud) == 400


@pytest.mark.parametrize(
    ("reconstruction", "options", "message"),
    [
        (lattice() + [1e6, 0, 0], {}, r"lies 1e\+06 away"),
        (lattice() * 0.001, {}, "another unit"),
        (lattice()[:, [0, 2, 1]] + [0, 60, 5], {"tau": 2.0}, "another frame or unit: after alignment"),
        (lattice()[:5], {}, "5 points of the reconstruction"),
    ],
)
def test_strangers_are_told(reconstruction, options, message):
    with pytest.raises(BadInput, match=message):
        compare(surface(reconstruction), surface(lattice()), still(**options))


def test_a_rough_fit_is_told(warned):
    compare(surface(lattice((0, 0, 0.5))), surface(lattice()), still(tau=0.16))
    assert len(warned) == 1 and "another frame or unit (--transform)" in warned[0]
    assert "0.5 apart, 3.1 times tau" in warned[0]


def test_half_of_all_far_off_is_another_frame():
    draw = np.random.default_rng(0)
    ours = draw.uniform(-30, 30, (4_000, 3))
    with pytest.raises(BadInput, match="ICP residual.*--transform"):
        compare(surface(ours), surface(lattice() * [8, 8, 1] - [24, 24, 0]), still(tau=0.1, align="similarity"))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"tau": 0.0}, "--tau 0"),
        ({"draws": 0}, "--draws 0"),
        ({"samples": 3}, "--samples 3"),
        ({"visible": 0.0}, "--visible 0"),
        ({"visible": 2.5}, "--visible 2.5"),
        ({"preset": "gauu"}, "--preset gauu: choose one of gauu-residence, "),
        ({"far": float("nan")}, "--far nan"),
    ],
)
def test_bad_settings(options, message):
    with pytest.raises(BadInput, match=message):
        Comparison(**options)


def test_a_preset_is_in_metres_and_gives_way_to_options():
    hundred_metres, matrix = Frame(np.zeros(3), 1.0, metres=100.0), np.diag([2.0, 2, 2, 1])
    found = Comparison(preset="gauu-residence").for_scene(hundred_metres, matrix)
    assert found == Comparison(voxel=found.voxel, visible=95)
    assert found.voxel == pytest.approx(0.007)  # two units of the truth are 100 m
    own = Comparison(preset="matrixcity-street", voxel=0.1, visible=0.5, tau=0.4)
    assert own.for_scene(None, matrix) == replace(own, preset=None)
    with pytest.raises(BadInput, match="--preset gauu-modern: .*0.35 m.*--metres-per"):
        Comparison(preset="gauu-modern").for_scene(Frame(np.zeros(3), 1.0), matrix)


def test_without_views_the_volume_must_be_given():
    with pytest.raises(BadInput, match="--crop auto needs the photographs"):
        compare(surface(lattice()), surface(lattice()), Comparison())


def test_colours_tell_right_from_wrong():
    colors = error_colors(np.array([0, 0.999, 1.01, 9]), 1.0).astype(int)
    assert colors[0, 2] > colors[0, 0] and colors[1, 2] > 2 * colors[1, 0]  # blue
    assert colors[2, 0] > 2 * colors[2, 2] and colors[3, 0] > colors[3, 1]  # orange, dark red


def test_everything_is_written(tmp_path):
    synthetic = photograph(Flight(views=8, width=64, height=48, points=50, test_every=0)).scene
    x, y = np.meshgrid(np.arange(-9, 9, 0.15), np.arange(-9, 9, 0.15))
    ground = np.stack([x.ravel(), y.ravel(), 0 * x.ravel()], 1)
    ours = ground[ground[:, 0] < 3] + [0, 0, 0.01]
    grey = np.zeros((len(ground), 3), np.uint8)
    write_points(tmp_path / "truth.ply", ground, grey)
    write_points(tmp_path / "ours.ply", ours, grey[: len(ours)])
    out, settings = tmp_path / "geometry", Comparison(draws=2, align="rigid", visible=0.5)
    files = (tmp_path / "ours.ply", tmp_path / "truth.ply")
    measured = measure_geometry(files, settings, out, synthetic.train, synthetic.frame)
    found = measured["geometry"]
    assert set(measured) == {"geometry"} and "normals" not in found, "of clouds there is nothing else to measure"
    assert json.loads(json.dumps(found, allow_nan=False)) == found
    assert found["precision"] > 0.99 and 0.4 < found["recall"] < 0.95 and 0 <= found["f1_std"] < 0.01
    assert set(found["alignments"]) == {"none", "rigid", "similarity"} and found["crop"]["from"] == "auto"
    assert found["alignments"]["rigid"]["scale"] == pytest.approx(1) and found["alignments"]["rigid"]["residual"] > 0
    assert found["curve"]["precision"][4] == pytest.approx(found["draws"][0]["precision"])
    names = {"crop.json", "transform.txt", "precision.ply", "recall.ply", "curve.png", "plan.png"}
    names |= {f"view{i}.png" for i in range(3)} | {"class-surface-ground.png", "class-edges-away.png"}
    names |= {f"class-views-{name.replace(' ', '-')}.png" for name, one in found["classes"]["views"].items()
              if any(one["points"].values())}  # fmt: skip
    assert {path.name for path in out.iterdir()} == names
    rows, _ = read_vertices(out / "recall.ply")
    missing = rows["red"] > rows["blue"]
    assert missing.mean() == pytest.approx(1 - found["draws"][0]["recall"], abs=1e-6)
    assert rows["x"][missing].min() > 2.9
    for name in ("curve.png", "plan.png", "view1.png"):
        with Image.open(out / name) as picture:
            assert len(picture.getcolors(1 << 20)) > 20, name
    assert read_surface(out / "precision.ply").vertices().shape[1] == 3
    settings = Comparison(draws=2, align="rigid", crop=str(out / "crop.json"), classes=False)
    again = measure_geometry(files, settings, tmp_path / "again")["geometry"]
    assert again["f1"] == found["f1"] and "classes" not in again and not list((tmp_path / "again").glob("class-*"))
