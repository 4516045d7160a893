"""Depth maps of other programs beside photographs: of distorted lenses, and in other units than the cameras."""

import numpy as np
import pytest
import torch
from data_set_folders import FLIGHT, lens, nerfstudio, views_of

from surfkit.apps.doctor.examine import examine
from surfkit.cli.recipes import recipes
from surfkit.io.datasets.data import Data
from surfkit.io.datasets.depth_files import confidence_path, normal_path, save_array, write_map, write_record
from surfkit.io.datasets.depth_prior import alignment, read_priors
from surfkit.io.datasets.depth_sampling import straightened
from surfkit.io.datasets.extract import load, of, save
from surfkit.io.datasets.raw_dataset import load_pycolmap
from surfkit.io.datasets.read import read
from surfkit.io.datasets.undistort import lens_of
from surfkit.runs.run_notes import collect_notes
from surfkit.testing.synthetic import photograph

BENT = {"k1": -0.15, "k2": 0.02, "p1": 0.003, "p2": -0.002}
SLIGHTLY = {"k1": -0.06, "k2": 0.0, "p1": 0.0, "p2": 0.0}
"""Undistorted photographs have the shape of the distorted ones, within the rounding of their size."""


@pytest.fixture(scope="module")
def truth():
    return photograph(FLIGHT)


class Ground:
    """A plane before all cameras, whose inverse depth is affine along every pixel's ray."""

    def __init__(self, truth):
        self.poses = {v.name: truth.scene.frame.input_pose(v.camera.world_to_camera) for v in views_of(truth)}
        self.normal = np.mean([pose[2, :3] for pose in self.poses.values()], 0) + (0.1, -0.05, 0)
        places = [-pose[:3, :3].T @ pose[:3, 3] for pose in self.poses.values()]
        self.offset = max(place @ self.normal for place in places) + 2.0

    def inverse(self, name, rays):
        """Inverse camera z along (..., 2) rays x/z, y/z."""
        pose = self.poses[name]
        turned = pose[:3, :3] @ self.normal
        towards = rays[..., 0] * turned[0] + rays[..., 1] * turned[1] + turned[2]
        return towards / (self.offset + turned @ pose[:3, 3])


def pixels(width, height):
    return np.stack(np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5), -1)


def scene_with_maps(folder, truth, unit=1.0, by=1, points=True, bend=BENT):
    """A nerfstudio folder of a distorted lens with depth maps of its photographs, whose stored depth times `unit` is
    in units of the poses, and which are `by` times as large as the photographs."""
    ground, c = Ground(truth), lens(truth)
    camera = load_pycolmap().Camera(
        model="OPENCV", width=c["w"], height=c["h"], params=[c["fl_x"], c["fl_y"], c["cx"], c["cy"], *bend.values()]
    )
    at = pixels(c["w"] * by, c["h"] * by) / by

    def change(contents):
        contents.update(bend)
        for frame in contents["frames"]:
            name = frame["file_path"].rpartition("/")[2]
            rays = np.asarray(camera.cam_from_img(at.reshape(-1, 2))).reshape(at.shape)
            frame["depth_file_path"] = f"depth/{name[:-4]}.npy"
            save_array(folder / frame["depth_file_path"], (1 / ground.inverse(name, rays) / unit).astype(np.float32))
        contents["depth_unit_scale_factor"] = 1.0
        if not points:
            del contents["ply_file_path"]

    nerfstudio(folder, truth, change)
    if points:
        xyz = on_the_ground(ground, truth)
        rows = "".join(f"{x} {y} {z}\n" for x, y, z in xyz)
        head = f"ply\nformat ascii 1.0\nelement vertex {len(xyz)}\n" + "".join(f"property float {a}\n" for a in "xyz")
        (folder / "sparse_pc.ply").write_text(f"{head}end_header\n{rows}")
    else:
        (folder / "sparse_pc.ply").unlink()
    return ground


def on_the_ground(ground, truth):
    """(P, 3) points that the cameras see."""
    c, found = lens(truth), []
    spots = pixels(c["w"], c["h"])[::4, ::4].reshape(-1, 2)
    rays = (spots - (c["cx"], c["cy"])) / (c["fl_x"], c["fl_y"])
    for name, pose in ground.poses.items():
        local = np.column_stack([rays, np.ones(len(rays))]) / ground.inverse(name, rays)[:, None]
        found.append((local - pose[:3, 3]) @ pose[:3, :3])
    return np.concatenate(found)


def priors_of(data, normals=False):
    with collect_notes() as kept:
        scene = read(data)
        return scene, read_priors(data, scene, normals=normals), kept.texts


def off(ground, scene, view, prior):
    """Error of a prior, as a share, but for 2 % of the pixels; and the share where it has none."""
    c = view.camera
    rays = (pixels(c.width, c.height) - (c.cx, c.cy)) / (c.fx, c.fy)
    seen = prior.inverse.numpy() * scene.frame.scale
    wanted = ground.inverse(view.name.rpartition("/")[2], rays)
    return np.quantile(np.abs(seen / wanted - 1)[seen > 0], 0.98), (seen == 0).mean()


@pytest.mark.parametrize("by", [1, 3])
def test_depth_of_a_distorted_photograph_is_undistorted_with_it(tmp_path, truth, by):
    ground = scene_with_maps(tmp_path, truth, by=by)
    scene, priors, notes = priors_of(Data(tmp_path, test_every=0))
    assert any("depth maps are of distorted photographs" in note for note in notes)
    errors, lacking = zip(*(off(ground, scene, view, priors[at]) for at, view in enumerate(scene.train)), strict=True)
    assert np.median(errors) < 2e-3, "but for views that see the plane edge on"
    assert max(lacking) < 0.05


def test_an_extract_keeps_the_lens(tmp_path, truth):
    ground = scene_with_maps(tmp_path / "data", truth)
    data = Data(tmp_path / "data", test_every=0)
    scene = read(data)
    save(tmp_path / "part.npz", of(scene, [scene.train[0].name], None))
    part = load(tmp_path / "part.npz").scene
    assert part.train[0].lens == scene.train[0].lens is not None
    assert off(ground, scene, part.train[0], read_priors(data, scene)[0])[0] < 2e-3


def test_what_belongs_to_a_map_is_undistorted_with_it(tmp_path, truth):
    scene_with_maps(tmp_path, truth)
    plain = Data(tmp_path, test_every=0)
    for path in sorted((tmp_path / "depth").glob("*.npy")):
        depth = np.load(path)
        trust = (np.arange(depth.size).reshape(depth.shape) % 5 * 50).astype(np.uint8)
        save_array(confidence_path(path), trust)
        save_array(normal_path(path), np.stack([trust // 2] * 3).astype(np.int8))
    _, priors, _ = priors_of(plain, normals=True)
    camera, prior = read(plain).train[0].camera, priors[0]
    shown = prior.confidence > 0
    assert shown.float().mean() > 0.5 and prior.confidence.shape == (camera.height, camera.width)
    assert torch.equal((prior.normal[0] > 0) & (prior.inverse > 0), shown), "normals and confidence move alike"


def test_maps_that_surfkit_made_are_of_the_undistorted_photograph(tmp_path, truth):
    ground = scene_with_maps(tmp_path, truth)
    data = Data(tmp_path, test_every=0)
    scene = read(data)
    for view in scene.train:
        c = view.camera
        rays = (pixels(c.width, c.height) - (c.cx, c.cy)) / (c.fx, c.fy)
        inverse = ground.inverse(view.name.rpartition("/")[2], rays)
        write_map(tmp_path, view.name, inverse, np.ones_like(inverse))
    write_record(tmp_path, {"aligned": True, "estimator": {}})
    scene, priors, notes = priors_of(data)
    assert not any("distorted" in note for note in notes)
    assert max(off(ground, scene, view, priors[at])[0] for at, view in enumerate(scene.train)) < 1e-4


def of_undistorted_photographs(folder, ground, by=3):
    """The same maps, of the pictures that a lens without distortion would have taken: no shape tells them apart."""
    scene = read(Data(folder, test_every=0))
    for view in scene.train:
        c, name = view.camera, view.name.rpartition("/")[2]
        assert abs(c.height / c.width / (view.lens.height / view.lens.width) - 1) < 0.01
        rays = (pixels(c.width * by, c.height * by) / by - (c.cx, c.cy)) / (c.fx, c.fy)
        save_array(folder / f"depth/{name[:-4]}.npy", (1 / ground.inverse(name, rays)).astype(np.float32))


def typical_error(ground, scene, priors):
    """Of the better half of the views: others see the plane edge on."""
    return np.sort([off(ground, scene, view, priors[at])[0] for at, view in enumerate(scene.train)])[2]


@pytest.mark.parametrize("unit", [1.0, 1.2])
@pytest.mark.parametrize("straight", [False, True])
def test_sparse_points_show_of_which_photographs_maps_are_that_have_the_shape_of_both(tmp_path, truth, straight, unit):
    ground = scene_with_maps(tmp_path, truth, by=3, bend=SLIGHTLY)
    if straight:
        of_undistorted_photographs(tmp_path, ground)
    for path in (tmp_path / "depth").iterdir():
        save_array(path, np.load(path) * np.float32(unit))
    data = Data(tmp_path, test_every=0)
    scene, priors, notes = priors_of(data)
    kind = "undistorted" if straight else "distorted"
    assert any(text.startswith(f"6 depth maps are of {kind} ") for text in notes)
    assert typical_error(ground, scene, priors) == pytest.approx(1 - 1 / unit, abs=2e-4)
    known = alignment(data, scene)
    again = read_priors(data, scene, known=known)
    assert known.straight == straight and torch.equal(again[0].inverse, priors[0].inverse), "workers do the same"
    other = Data(tmp_path, test_every=0, depth_of="distorted" if straight else "undistorted")
    scene, priors, notes = priors_of(other)
    assert not any("sparse points" in note for note in notes), "who says otherwise is believed"
    assert typical_error(ground, scene, priors) > 1 - 1 / unit + 0.01


def test_what_is_assumed_of_maps_is_told_where_nothing_shows_it(tmp_path, truth):
    ground = scene_with_maps(tmp_path, truth, by=3, points=False, bend=SLIGHTLY)
    of_undistorted_photographs(tmp_path, ground)
    (note,) = [note for note in priors_of(Data(tmp_path, test_every=0))[2] if "distorted" in note]
    assert note.startswith("6 depth maps are taken for those of distorted")
    assert note.endswith("give --depth-of undistorted")
    scene, priors, notes = priors_of(Data(tmp_path, test_every=0, depth_of="undistorted"))
    assert not any("distorted" in note for note in notes)
    assert max(off(ground, scene, view, priors[at])[0] for at, view in enumerate(scene.train)) < 2e-3


def test_edges_stay_sharp_and_holes_stay_holes(truth):
    c = lens(truth)
    camera = load_pycolmap().Camera(
        model="OPENCV", width=c["w"], height=c["h"], params=[c["fl_x"], c["fl_y"], c["cx"], c["cy"], *BENT.values()]
    )
    steps = torch.full((c["h"], c["w"]), 0.25)
    steps[:, c["w"] // 2 :] = 1.0
    steps[: c["h"] // 4] = 0
    found = straightened(steps, lens_of(camera, (c["w"], c["h"])))
    assert {round(value, 4) for value in found.unique().tolist()} == {0.0, 0.25, 1.0}


@pytest.mark.parametrize(("unit", "told"), [(1000.0, "0.001"), (0.001, "1,000"), (0.01, "100"), (3.2808, "0.3048")])
def test_depth_in_other_units_is_told_by_its_factor_also_without_tracks(tmp_path, truth, unit, told):
    scene_with_maps(tmp_path, truth, unit=unit)
    data = Data(tmp_path, test_every=0)
    _, priors, notes = priors_of(data)
    (note,) = [note for note in notes if "no depth prior" in note]
    assert priors is None and f"but {told} times as large" in note and "depth_unit_scale_factor" in note
    findings = examine(data, recipes()["surface"]).diagnosis.findings
    assert [finding.text for finding in findings if finding.what == "depth-maps"] == [note], "doctor says the same"


def test_depth_with_nothing_but_the_extent_to_compare_with(tmp_path, truth):
    scene_with_maps(tmp_path / "right", truth, points=False)
    assert not any("another unit" in note for note in priors_of(Data(tmp_path / "right", test_every=0))[2])
    scene_with_maps(tmp_path / "wrong", truth, unit=1000.0, points=False)
    notes = priors_of(Data(tmp_path / "wrong", test_every=0))[2]
    assert sum("another unit" in note and "as far away as the cameras lie apart" in note for note in notes) == 1
