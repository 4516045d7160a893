"""Depth priors: three conventions, alignment to the sparse points, and what cannot be used."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from surfkit.core.check import BadInput
from surfkit.io.datasets.data import Data
from surfkit.io.datasets.depth_files import confidence_path, map_path, normal_path, write_map, write_record
from surfkit.io.datasets.depth_layout import DepthQuery, find_maps
from surfkit.io.datasets.depth_prior import alignment, list_reasons, read_priors, resized
from surfkit.io.datasets.read import observations, read
from surfkit.losses import L1, DepthRegression, NormalConsistency, NormalPrior
from surfkit.runs.run_notes import collect_notes
from surfkit.scene.align import align, sample
from surfkit.testing.synthetic import Flight, photograph, write_colmap
from surfkit.train.data_cache import scale_band


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A data set with tracks, and the truth about it."""
    folder = tmp_path_factory.mktemp("made") / "farm"
    truth = photograph(Flight(views=6, width=64, height=48, points=250))
    write_colmap(folder, truth, tracks=True)
    return folder, truth


@pytest.fixture
def farm(made, tmp_path):
    """A copy to write maps into: its data, scene, and exact inverse depth by name, 1/input units."""
    folder, truth = made
    data = Data(Path(shutil.copytree(folder, tmp_path / "farm")))
    scene = read(data)
    exact = {name: (truth.scene.frame.scale / e.depth.clamp_min(1e-9)).numpy() for name, e in truth.exact.items()}
    return data, scene, {name: np.where(truth.exact[name].depth > 0, inv, 0) for name, inv in exact.items()}


def priors_of(data, scene, normals=False):
    """The priors, and what was warned of."""
    with collect_notes() as kept:
        notes = kept.texts
        return read_priors(data, scene, normals=normals), notes


def relative(data, exact, scale=0.02, offset=-0.4):
    """Write maps whose values are not inverse depths but related to them by an affine map."""
    for name, inverse in exact.items():
        path = map_path(data.path, name)
        path.parent.mkdir(exist_ok=True)
        np.save(path, np.where(inverse > 0, (inverse - offset) / scale, 0).astype(np.float32))


def check_exact(priors, scene, exact, share=2e-3):
    """The priors are the truth in 1/local units, at almost every pixel."""
    for prior, view in zip(priors, scene.train, strict=True):
        wanted = exact[view.name] / scene.frame.scale
        there = wanted > 0
        error = np.abs(prior.inverse.numpy()[there] / wanted[there] - 1)
        assert np.quantile(error, 0.9) < share and (prior.inverse.numpy()[~there] == 0).all()
        assert torch.equal(prior.confidence, (prior.inverse > 0).float())


def test_tracks_project_to_where_they_are_observed(farm):
    data, scene, exact = farm
    tracks = observations(data, scene)
    for view in scene.train:
        seen, camera = tracks.seen[view.name], view.camera
        pose = camera.world_to_camera.numpy()
        local = tracks.xyz[seen.points] @ pose[:3, :3].T + pose[:3, 3]
        x = (camera.fx * local[:, 0] / local[:, 2] + camera.cx) / camera.width
        y = (camera.fy * local[:, 1] / local[:, 2] + camera.cy) / camera.height
        assert len(x) > 20 and np.abs(np.stack([x, y], 1) - seen.at).max() < 1e-4
        at, inverse = tracks.of(view)
        error = np.abs(sample(exact[view.name], at) / scene.frame.scale / inverse - 1)
        assert np.median(error) < 0.01  # the map is sampled at pixels; points are anywhere


def test_alignment_is_by_median_and_mean_deviation():
    draw = np.random.default_rng(0)
    m = draw.normal(3, 1, 40)
    c = 0.2 * m + 1.5
    assert align(m, c) == pytest.approx((0.2, 1.5))
    c[:8] += 5  # outliers move a mean, not a median
    t_c, t_m = sorted(c)[19:21], sorted(m)[19:21]
    s_c = sum(abs(v - sum(t_c) / 2) for v in c) / 40
    s_m = sum(abs(v - sum(t_m) / 2) for v in m) / 40
    assert align(m, c) == pytest.approx((s_c / s_m, sum(t_c) / 2 - s_c / s_m * sum(t_m) / 2))


@pytest.mark.parametrize("unit", [1e-4, 1.0, 1e4])
def test_alignment_does_not_depend_on_the_unit(unit):
    m = np.linspace(1, 2, 12)
    assert align(m, unit * m)[0] == pytest.approx(unit)
    with pytest.raises(BadInput, match="one depth"):
        align(m, unit * (1 + 1e-3 * m))
    with pytest.raises(BadInput, match="constant"):
        align(0 * m + 4, unit * m)
    with pytest.raises(BadInput, match="only 10 sparse points"):
        align(np.where(np.arange(12) < 2, np.nan, m), unit * m)


def test_samples_are_bilinear_at_pixel_centres():
    values = np.array([[1.0, 2.0, 4.0], [3.0, 5.0, 7.0]])
    at = np.array([[0.5, 1.5, 1.0, 0.0, 2.5]]).T / 3
    assert sample(values, np.hstack([at, 0 * at + 0.25])) == pytest.approx([1, 2, 1.5, 1, 4])
    assert sample(values, np.array([[1 / 3, 0.5]])) == pytest.approx([(1 + 2 + 3 + 5) / 4])
    values[1, 2] = np.nan
    assert np.isnan(sample(values, np.array([[0.8, 0.6]]))) and sample(values, np.array([[0.3, 0.6]])) > 0


def test_relative_maps_are_aligned(farm):
    data, scene, exact = farm
    relative(data, exact)
    priors, notes = priors_of(data, scene)
    assert notes == []
    check_exact(priors, scene, exact, share=0.03)  # sparse points are not at the centres of pixels
    depths = [observations(data, scene).of(view)[1] for view in scene.train]
    assert priors[0].typical == pytest.approx(float(np.median([np.median(c) for c in depths])))


def test_points_with_a_large_error_do_not_count(farm):
    data, scene, exact = farm
    relative(data, exact)
    points = data.path / "sparse/0/points3D.txt"
    rows = [line.split(" ") for line in points.read_text().splitlines()]
    points.write_text("".join(" ".join([*row[:7], "1.5", *row[8:]]) + "\n" for row in rows))
    priors, notes = priors_of(data, scene)
    assert priors is None and "only 0 sparse points" in notes[0]


def test_maps_that_came_in_input_units_are_taken_as_they_are(farm):
    data, scene, exact = farm
    for name, inverse in exact.items():
        write_map(data.path, name, inverse, (inverse > 0).astype(float))
    write_record(data.path, {"aligned": True})
    priors, notes = priors_of(data, scene)
    assert notes == []
    check_exact(priors, scene, exact, share=1e-5)
    for name, inverse in exact.items():
        write_map(data.path, name, 3 * inverse, np.ones_like(inverse))
    priors, notes = priors_of(data, scene)
    assert priors is None and "not those of the sparse points" in notes[0]


def test_hierarchical_3dgs(farm):
    data, scene, exact = farm
    (data.path / "depths").mkdir()
    params, scale, offset = {}, 0.5, -0.01
    for name, inverse in exact.items():
        stored = ((inverse - offset) / scale * 65536).round().clip(0, 65535).astype(np.uint16)
        Image.fromarray(np.where(inverse > 0, stored, 0).astype(np.uint16)).save(data.path / "depths" / name)
        params[Path(name).stem] = {"scale": scale, "offset": offset}
    (data.path / "sparse/0/depth_params.json").write_text(json.dumps(params))
    priors, notes = priors_of(data, scene)
    assert notes == []
    check_exact(priors, scene, exact)


@pytest.mark.parametrize("end", ["png", "npy"])
def test_nerfstudio(farm, end):
    data, scene, exact = farm
    (data.path / "depth").mkdir()
    frames = []
    for name, inverse in exact.items():
        path = f"depth/{Path(name).stem}.{end}"
        millimetres = np.where(inverse > 0, 1000 / np.maximum(inverse, 1e-9), 0)
        if end == "png":
            Image.fromarray(millimetres.round().clip(0, 65535).astype(np.uint16)).save(data.path / path)
        else:
            np.save(data.path / path, millimetres)
        frames.append({"file_path": f"./images/{name}", "depth_file_path": path})
    (data.path / "transforms.json").write_text(json.dumps({"frames": frames}))
    priors, notes = priors_of(data, scene)
    assert notes == []
    check_exact(priors, scene, exact)


@pytest.mark.parametrize(
    ("keys", "file"),
    [
        ({"integer_depth_scale": 1 / 1000}, "transforms.json"),
        ({"integer_depth_scale": 1 / 1000, "enable_depth_loading": True}, "transforms_train.json"),
    ],
)
@pytest.mark.parametrize("slash", ["/", "\\"])
def test_instant_ngp(farm, keys, file, slash):
    data, scene, exact = farm
    (data.path / "depth").mkdir()
    frames = []
    for name, inverse in exact.items():
        millimetres = np.where(inverse > 0, 1000 / np.maximum(inverse, 1e-9), 0).round().clip(0, 65535)
        Image.fromarray(millimetres.astype(np.uint16)).save(data.path / f"depth/{Path(name).stem}.png")
        frames.append(
            {"file_path": f"images{slash}{Path(name).stem}", "depth_path": f"depth{slash}{Path(name).stem}.png"}
        )
    (data.path / file).write_text(json.dumps(keys | {"frames": frames}))
    priors, notes = priors_of(data, scene)
    assert notes == []
    check_exact(priors, scene, exact)


def test_depth_that_instant_ngp_is_told_not_to_load_is_not_read(farm):
    data, scene, exact = farm
    frames = [{"file_path": f"images/{name}", "depth_path": "depth.png"} for name in exact]
    (data.path / "transforms.json").write_text(json.dumps({"enable_depth_loading": False, "frames": frames}))
    assert find_maps(DepthQuery(data.path, list(exact), data.path)) == {}


def test_what_cannot_be_used_is_listed_once(farm):
    data, scene, exact = farm
    relative(data, exact)
    paths = [map_path(data.path, view.name) for view in scene.train]
    good = np.load(paths[0])
    paths[0].unlink()
    np.save(paths[1], good[:, :40])
    np.save(paths[2], np.full_like(good, 7))
    paths[3].write_bytes(b"no array")
    priors, notes = priors_of(data, scene)
    assert [prior is None for prior in priors] == [True] * 4 + [False]
    names = [view.name for view in scene.train]
    assert len(notes) == 1 and notes[0].startswith("4 of 5 photographs train without a depth prior: ")
    for text in (f"no map: {names[0]}", f"40 x 48 px is not the shape of its photograph: {names[1]}"):
        assert text in notes[0]
    assert f"constant: {names[2]}" in notes[0] and "cannot be read" in notes[0] and names[3] in notes[0]
    np.save(paths[4], np.full_like(good, np.nan))
    priors, notes = priors_of(data, scene)
    assert (
        priors is None
        and "everything that learns from them is switched off" in notes[0]
        and f"no value in it: {names[4]}" in notes[0]
    )


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        (lambda values: 1 / np.where(values > 0, values, 1e9), "as in a map of depth"),
        (lambda values: np.random.default_rng(0).uniform(1, 2, values.shape), "hardly follow the sparse points"),
    ],
)
def test_maps_of_depth_or_of_other_photographs_are_told(farm, wrong, said):
    data, scene, exact = farm
    relative(data, {name: wrong(values) for name, values in exact.items()})
    assert [note for note in priors_of(data, scene)[1] if said in note]


def test_a_scale_far_from_the_others_is_a_failure(farm):
    data, scene, exact = farm
    relative(data, exact)
    view = scene.train[2]
    np.save(map_path(data.path, view.name), 5.2 * np.load(map_path(data.path, view.name)))
    priors, notes = priors_of(data, scene)
    assert priors[2] is None and notes == [
        f"1 of 5 photographs train without a depth prior: its scale is far from that of the other images: {view.name}"
    ]
    assert sum(prior is None for prior in priors) == 1
    where = NormalConsistency(where="unknown")  # uses priors, and learns no depth
    assert scale_band({"depth": DepthRegression(scale_band=(0.5, 2.0)), "normal": where}) == (0.5, 2.0)
    losses = {"depth": DepthRegression(scale_band=(0.15, 50.0)), "prior": NormalPrior()}
    assert scale_band(losses) == (0.15, 50.0) and scale_band({"l1": L1()}) == (0.2, 5.0)
    assert len(alignment(data, scene, band=scale_band(losses)).fits) == 5


def test_without_any_map_the_warning_says_what_to_run(farm):
    data, scene, _ = farm
    off = "so everything that learns from them is switched off, such as the losses depth and normal-prior"
    for normals in (False, True):
        priors, notes = priors_of(data, scene, normals)
        assert priors is None and notes == [
            f"{data.path} has no depth priors, {off}; make them with `surfkit prepare depth {data.path}`"
        ]


def test_priors_without_normals_are_warned_of_where_a_loss_wants_some(farm):
    data, scene, exact = farm
    relative(data, exact)
    assert priors_of(data, scene)[1] == []
    priors, notes = priors_of(data, scene, normals=True)
    assert priors[0].normal is None and notes == [
        "5 of 5 depth priors have no normals, and the loss normal-prior learns nothing from those; "
        f"make others with `surfkit prepare depth {data.path} --again`"
    ]
    up = np.stack([0 * exact[scene.train[0].name]] * 2 + [-np.ones_like(exact[scene.train[0].name])])
    for view in scene.train[1:]:
        write_map(data.path, view.name, np.load(map_path(data.path, view.name)), np.ones_like(up[0]), up)
    (note,) = priors_of(data, scene, normals=True)[1]
    assert note.startswith("1 of 5 depth priors have no normals")
    write_map(data.path, scene.train[0].name, np.load(map_path(data.path, scene.train[0].name)), up[0] + 1, up)
    assert priors_of(data, scene, normals=True)[1] == []


def test_maps_that_saw_held_out_photographs_are_warned_of(farm):
    data, scene, exact = farm
    for name, inverse in exact.items():
        write_map(data.path, name, inverse, np.ones_like(inverse))
    write_record(data.path, {"aligned": True, "matched": [view.name for view in scene.train]})
    assert priors_of(data, scene)[1] == []
    write_record(data.path, {"aligned": True, "matched": list(exact)})
    priors, notes = priors_of(data, scene)
    assert priors is not None and len(notes) == 1 and scene.held_out[0].name in notes[0]


def test_round_trip_of_files(tmp_path):
    draw = np.random.default_rng(0)
    inverse, confidence = draw.random((5, 7)).astype(np.float32), draw.random((5, 7))
    inverse[0, 0] = 0
    write_map(tmp_path, "left/a.jpg", inverse, confidence)
    file = find_maps(DepthQuery(tmp_path, ["left/a.jpg", "b.jpg"], tmp_path))
    assert list(file) == ["left/a.jpg"] and file["left/a.jpg"].path == tmp_path / "estimated_depths/left/a.jpg.npy"
    again = file["left/a.jpg"].read()
    assert np.isnan(again[0, 0]) and np.array_equal(np.nan_to_num(again), inverse)
    assert np.abs(file["left/a.jpg"].read_confidence() - confidence).max() <= 0.5 / 255 + 1e-6
    np.save(confidence_path(file["left/a.jpg"].path), confidence.astype(np.float16))
    assert np.abs(file["left/a.jpg"].read_confidence() - confidence).max() < 1e-3
    assert {path.name for path in (tmp_path / "estimated_depths/left").iterdir()} == {
        "a.jpg.npy",
        "a.jpg.confidence.npy",
    }


def test_resizing_is_smooth_on_surfaces_and_sharp_between_them():
    near, far = 2.0, 1.0
    columns = torch.arange(12.0)
    inverse = torch.where(columns < 6, near + 0.01 * columns, far + 0.01 * columns).expand(8, -1).clone()
    inverse[:, 9] = 0
    for size in ((16, 24), (4, 6), (5, 9)):
        found = resized(inverse, size)
        values = found[found > 0]
        assert found.shape == size and (((values - near).abs() < 0.2) | ((values - far).abs() < 0.2)).all()
    double = resized(inverse, (16, 24))
    assert (double[:, 18:20] == 0).all() and (double == 0).sum() == 32
    slope = near + 0.01 * ((torch.arange(24) + 0.5) / 2 - 0.5)
    torch.testing.assert_close(double[0, 1:11], slope[1:11])
    assert resized(inverse, (8, 12)) is inverse


def test_memory_is_bounded_and_priors_are_read_ahead(farm):
    data, scene, exact = farm
    relative(data, exact)
    budget = 2 * 2 * 4 * 64 * 48
    everything, small = (read_priors(data, scene, most) for most in (None, budget))
    for at in range(len(small)):
        assert torch.equal(small[at].inverse, everything[at].inverse)
        assert torch.equal(small[at].confidence, everything[at].confidence)
        assert small.bytes <= budget
    half = replace(scene.train[0], camera=scene.train[0].camera.resized(32, 24))
    smaller = read_priors(data, replace(scene, train=(half, *scene.train[1:])))[0]
    assert smaller.inverse.shape == smaller.confidence.shape == (24, 32) and smaller.coarseness == 1
    twice = replace(scene.train[0], camera=scene.train[0].camera.resized(128, 96))
    assert read_priors(data, replace(scene, train=(twice, *scene.train[1:])))[0].coarseness == 2


def test_normals_are_kept_in_bytes_and_given_as_unit_vectors(made, farm):
    data, scene, exact = farm
    truth = made[1].exact
    for name, inverse in exact.items():
        write_map(data.path, name, inverse, np.ones_like(inverse), truth[name].normal.numpy())
    write_record(data.path, {"aligned": True})
    assert np.load(normal_path(map_path(data.path, scene.train[0].name))).dtype == np.int8
    plain, priors = read_priors(data, scene), read_priors(data, scene, normals=True)
    assert plain[0].normal is None and list(plain.sizes) == [8 * 64 * 48] * len(plain)
    assert list(priors.sizes) == [11 * 64 * 48] * len(priors)
    for view, prior in zip(scene.train, priors, strict=True):
        wanted = truth[view.name].normal.float()
        there = wanted.abs().sum(0) > 0
        assert prior.normal.dtype == torch.float32 and (prior.normal[:, ~there] == 0).all()
        torch.testing.assert_close(prior.normal.norm(dim=0)[there], torch.ones(int(there.sum())))
        assert (prior.normal - wanted).abs().max() < 1 / 127
    half = replace(scene.train[0], camera=scene.train[0].camera.resized(32, 24))
    smaller = read_priors(data, replace(scene, train=(half, *scene.train[1:])), normals=True)[0].normal
    torch.testing.assert_close(smaller, priors[0].normal[:, 1::2, 1::2])  # the pixel right of and below the middle
    write_map(data.path, scene.train[0].name, exact[scene.train[0].name], np.ones((48, 64)))
    assert read_priors(data, scene, normals=True)[0].normal is None


def test_normals_of_another_kind_are_a_reason_not_to_use_a_map(farm):
    data, scene, exact = farm
    for name, inverse in exact.items():
        write_map(data.path, name, inverse, np.ones_like(inverse))
    write_record(data.path, {"aligned": True})
    np.save(normal_path(map_path(data.path, scene.train[1].name)), np.zeros((48, 64, 3), np.float32))
    priors, notes = priors_of(data, scene)
    assert priors[1] is None and priors[0] is not None
    assert "normals are float32 of shape (48, 64, 3), not int8 of (3, height, width)" in notes[0]


def test_of_many_photographs_a_warning_names_the_first():
    names = [f"{at}.jpg" for at in range(12)]
    assert list_reasons(dict.fromkeys(names[:11], "no map")) == f"no map: {', '.join(names[:11])}"
    assert list_reasons(dict.fromkeys(names, "no map")) == f"no map: {', '.join(names[:10])} and 2 others"
