"""Checks of what deals with whole scenes: readers, starts, partitions, the assignment of views, and refinements.

Each check returns nothing and raises AssertionError with a sentence that says what is wrong.
"""

from __future__ import annotations

import itertools
import tempfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from surfkit.io.datasets.base import Reader
from surfkit.io.datasets.data import Data
from surfkit.io.datasets.raw_dataset import RawDataset
from surfkit.io.datasets.undistort import is_panorama
from surfkit.partition.assign import Assign
from surfkit.partition.base import Cells, CoarseModel, Ground, Partition
from surfkit.primitives.base import Primitive
from surfkit.primitives.columns import RATES
from surfkit.primitives.model import SplatModel
from surfkit.primitives.points import Columns
from surfkit.primitives.surfel2d import Surfel2D
from surfkit.scene.scene import SparsePoints, View
from surfkit.start.base import Start, StartInput
from surfkit.testing.equality import assert_same, unchanged
from surfkit.testing.inputs import cloud, coarse_model, mesh_input, start_input, survey
from surfkit.testing.synthetic import Synthetic
from surfkit.train.refine.base import Refine

MAX_FORECAST_FACTOR = 10.0
"""The number of points that a start expects is right within this factor."""


def check_reader(reader: Reader, folder: Path, truth: Synthetic | None = None) -> None:
    """A reader recognises its layout and no empty folder, and finds photographs with rigid poses, cameras and points in
    front of them; it writes nothing, and finds the same again.

    Args:
        reader: To check.
        folder: A data set of its layout, whole.
        truth: What the data set was made from, if it was: poses and lenses must be those, up to position, rotation and
            scale of the input frame.
    """
    name, before = type(reader).__name__, _files(folder)
    assert reader.recognises(folder), f"{name} does not recognise {folder}, which is of its layout"
    with tempfile.TemporaryDirectory() as empty:
        assert not reader.recognises(Path(empty)), f"{name} recognises an empty folder"
    found, again = reader.read(Data(folder)), reader.read(Data(folder))
    assert _files(folder) == before, f"{name} changes files of the data set"
    assert_same(f"{name}.read", found, again, "it may depend on the data set only")
    _check_shots(name, found)
    _check_sparse(name, found)
    if found.held_out is not None:
        strange = sorted(found.held_out - {shot.name for shot in found.shots})
        assert not strange, f"{name}: held_out names {strange[:1]}, which is no photograph"
    assert found.metres is None or 0 < found.metres < float("inf"), f"{name}: metres is {found.metres}"
    if truth is not None:
        _check_poses(name, found, truth)


def check_start(start: Start) -> None:
    """A start gives finite points with colours, about as many as it expects, the same again for the same state of its
    generator; it changes nothing it was given, and does without the depth prior of a photograph. Its model has as many
    points, with the columns of the primitive.

    Args:
        start: With settings for nine photographs of 64 x 48 pixels.
    """
    name, known = type(start).__name__, start_input(priors=start.needs_prior)
    with unchanged(f"{name}.cloud", known=known):
        cloud = start.cloud(known)
    _check_cloud(name, cloud)
    again = start.cloud(start_input(priors=start.needs_prior))
    assert_same(f"{name}.cloud", cloud, again, "draw from the generator")
    _check_expected(start, cloud, known)
    _check_model(start, len(cloud.xyz))


def check_partition(partition: Partition, sight: CoarseModel | None = None) -> None:
    """Its cells own every place exactly once, far away and on their sides too, and come out the same again.

    Args:
        partition: To check.
        sight: What to cut; 1,500 discs under 30 cameras if None.
    """
    name, sight = type(partition).__name__, sight or coarse_model()
    with unchanged(f"{name}.cells", splats=sight.splats, views=sight.views):
        cells = partition.cells(sight)
    assert cells == partition.cells(sight), f"{name}: the same model gives other cells"
    generator = torch.Generator().manual_seed(0)
    far = torch.randn(2_000, 3, generator=generator, dtype=torch.float64) * torch.logspace(-2, 4, 2_000)[:, None]
    places = torch.cat([far, sight.splats.means.double(), sight.centres])
    single = [replace(cells, boxes=(box,), blocks=(0,)).owner(places) == 0 for box in cells.boxes]
    owners = torch.stack(single).sum(0)
    assert int(owners.min()) == 1, f"{name}: a place has no owner"
    assert int(owners.max()) == 1, f"{name}: a place has two owners"


def check_assign(assign: Assign) -> None:
    """One row a view and one column a block, the same again for the same seed; some view joins each block of points in
    the middle of the scene, and none joins one that is far from all points and views.

    Args:
        assign: With settings by which some view joins each half of a scene of 1,500 points and 30 views.
    """
    name, sight = type(assign).__name__, coarse_model()
    sides = (None, -0.4, 1e3, None)
    boxes = tuple((low, None, high, None) for low, high in itertools.pairwise(sides))
    cells = Cells(Ground((1.0, 0.0, 0.0), (0.0, 1.0, 0.0)), boxes, (0, 1, 2))
    with unchanged(f"{name}.joins", splats=sight.splats, views=sight.views):
        joins = assign.joins(sight, cells)
    wanted = (len(sight.views), 3)
    assert joins.shape == wanted, f"{name}.joins has shape {tuple(joins.shape)}, not {wanted}"
    assert joins.dtype == torch.bool, f"{name}.joins is {joins.dtype}, not bool"
    assert_same(f"{name}.joins", joins, assign.joins(sight, cells), "draw from the seed of the model")
    joined = joins.sum(0).tolist()
    assert all(joined[:2]), f"{name}: no view joins block {joined.index(0)}, to which half of the points belong"
    assert not joined[2], f"{name}: a view joins a block without points"
    most = assign.most_views
    assert most is None or most >= 1, f"{name}.most_views is {most}; it must be 1 or more, or None"


def check_refine(
    refine: Refine,
    primitive: Primitive | None = None,
    params: Columns | None = None,
    views: Sequence[View] | None = None,
) -> None:
    """It begins with points that its primitive can draw, changes none of those given, and sees the same views again.

    Args:
        refine: To check.
        primitive: What the points are before; surfels if None.
        params: N of them; 50 random ones if None.
        views: Of the training photographs; nine of a survey if None.
    """
    name, primitive = type(refine).__name__, primitive or Surfel2D()
    params = params or primitive.init(cloud(), torch.Generator().manual_seed(0))
    views = views or survey().scene.train
    with unchanged(f"{name}.begin", params=params):
        begun = refine.begin(SplatModel(primitive, params, primitive.sh_degree), lambda _: mesh_input())
    after = refine.primitive(primitive)
    columns, shapes = after.columns(), {key: tuple(value.shape) for key, value in begun.items()}
    wanted = {key: column.shape for key, column in columns.items()}
    assert shapes.keys() == columns.keys(), f"{name}: its points have {sorted(shapes)}, not {sorted(wanted)}"
    wrong = [key for key, column in columns.items() if not column.fits(shapes[key], len(begun["means"]))]
    assert not wrong, f"{name}: the column {wrong[0]!r} has shape {shapes[wrong[0]]}, declared as {wanted[wrong[0]]}"
    unknown = set(refine.stage.rates) - set(begun) - set(RATES)
    assert not unknown, f"{name}: stage.rates names {', '.join(sorted(unknown))}, which its points do not have"
    assert after.activate(begun, after.sh_degree).sh.shape[1] == (after.sh_degree + 1) ** 2
    with unchanged(f"{name}.views", views=views):
        seen, again = ([view.camera.centre.tolist() for view in refine.views(views, 0)] for _ in range(2))
    assert seen and seen == again, f"{name}: its views are not the same again; draw them from the seed"
    there = [view.camera.centre.tolist() for view in views]
    assert refine.taught or seen == there, f"{name} has photographs of the training views only"


def _files(folder: Path) -> dict[Path, tuple[int, int]]:
    """Size and time of every file below a folder."""
    stats = {path: path.stat() for path in folder.rglob("*") if path.is_file()}
    return {path: (stat.st_size, stat.st_mtime_ns) for path, stat in stats.items()}


def _check_shots(name: str, found: RawDataset) -> None:
    names = [shot.name for shot in found.shots]
    assert names, f"{name} finds no photograph"
    assert len(set(names)) == len(names), f"{name}: two photographs have the same name"
    for shot in found.shots:
        what = f"{name}: {shot.name}"
        assert shot.path.is_file(), f"{what} has the path {shot.path}, where no file is"
        pose = shot.pose
        assert pose.shape == (4, 4) and pose.dtype == np.float64, f"{what}: the pose is not (4, 4) float64"
        turn = pose[:3, :3]
        rigid = np.allclose(turn @ turn.T, np.eye(3), atol=1e-6) and np.linalg.det(turn) > 0
        assert rigid, f"{what}: the pose is not a rotation and a translation"
        assert (pose[3] == [0, 0, 0, 1]).all() and np.isfinite(pose).all(), f"{what}: the pose is no world_to_camera"
        lens = shot.camera
        sound = lens.width > 0 and lens.height > 0 and np.isfinite(lens.params).all()
        assert sound, f"{what}: the camera has no size, or parameters that are not finite"


def _check_sparse(name: str, found: RawDataset) -> None:
    """Sparse points are of the right types, and each photograph has some before it."""
    xyz, rgb = found.xyz, found.rgb
    sound = xyz.ndim == 2 and xyz.shape[1:] == (3,) and xyz.dtype == np.float64 and np.isfinite(xyz).all()
    assert sound, f"{name}: xyz is not (P, 3) finite float64"
    assert rgb.shape == xyz.shape and rgb.dtype == np.uint8, f"{name}: rgb is not (P, 3) uint8"
    for shot in found.shots if len(xyz) else ():
        before = (xyz @ shot.pose[2, :3] + shot.pose[2, 3] > 0) | is_panorama(shot.camera)
        assert before.any(), (
            f"{name}: no sparse point lies in front of {shot.name}; poses are world_to_camera, z forward"
        )


def _check_poses(name: str, found: RawDataset, truth: Synthetic) -> None:
    """Rotations between cameras, distances up to one factor, and lenses are those of the truth."""
    views = {Path(view.name).name: view.camera for view in (*truth.scene.train, *truth.scene.held_out)}
    shots = [shot for shot in found.shots if shot.path.name in views]
    assert len(shots) >= 2, f"{name} finds {len(shots)} of the photographs {', '.join(list(views)[:3])}, ..."
    true = [views[shot.path.name].world_to_camera.numpy() for shot in shots]
    steps = [
        np.stack([pose @ np.linalg.inv(poses[0]) for pose in poses[1:]]) for poses in (true, [s.pose for s in shots])
    ]
    turned = np.abs(steps[0][:, :3, :3] - steps[1][:, :3, :3]).max()
    assert turned < 1e-3, (
        f"{name}: cameras are turned otherwise than the true ones; axes are x right, y down, z forward"
    )
    moves, wanted = steps[1][:, :3, 3], steps[0][:, :3, 3]
    factor = (moves * wanted).sum() / (wanted * wanted).sum()
    apart = np.abs(moves - factor * wanted).max() / np.abs(factor * wanted).max()
    assert factor > 0 and apart < 1e-3, f"{name}: cameras stand elsewhere than the true ones"
    for shot in shots:
        camera = views[shot.path.name]
        lens, of = shot.camera, shot.camera.width / camera.width
        got = np.array([lens.focal_length_x, lens.focal_length_y, lens.principal_point_x, lens.principal_point_y])
        right = of * np.array([camera.fx, camera.fy, camera.cx, camera.cy])
        assert np.abs(got - right).max() < 0.01 * lens.width, f"{name}: the camera of {shot.name} is not the true one"


def _check_cloud(name: str, cloud: SparsePoints) -> None:
    count = len(cloud.xyz)
    assert count, f"{name} gives no point"
    fields: dict[str, tuple[torch.dtype, tuple[int, ...]]]
    fields = {"xyz": (torch.float32, (count, 3)), "rgb": (torch.uint8, (count, 3))}
    fields |= {"normals": (torch.float32, (count, 3))} if cloud.normals is not None else {}
    fields |= {key: (torch.float32, (count,)) for key in ("opacity", "size") if getattr(cloud, key) is not None}
    for key, (dtype, shape) in fields.items():
        value = getattr(cloud, key)
        fits = value.dtype == dtype and value.shape == shape
        told = f"{value.dtype} of shape {tuple(value.shape)}"
        assert fits, f"{name}: {key} is {told}, not {dtype} of shape {shape}"
        assert torch.isfinite(value).all(), f"{name}: {key} is not finite"
    if cloud.normals is not None:
        assert ((cloud.normals.norm(dim=1) - 1).abs() < 1e-3).all(), f"{name}: a normal is not of length 1"
    if cloud.opacity is not None:
        assert ((cloud.opacity > 0) & (cloud.opacity < 1)).all(), f"{name}: opacity must lie between 0 and 1"
    assert cloud.size is None or (cloud.size > 0).all(), f"{name}: size must be above 0"


def _check_model(start: Start, count: int) -> None:
    name, primitive, known = f"{type(start).__name__}.model", Surfel2D(), start_input(priors=start.needs_prior)
    with unchanged(name, known=known):
        model = start.model(primitive, known, torch.Generator().manual_seed(1))
    again = start.model(primitive, start_input(priors=start.needs_prior), torch.Generator().manual_seed(1))
    assert_same(name, model, again, "draw from the generators")
    shapes = {key: tuple(value.shape) for key, value in model.params.items()}
    wanted = {key: (count, *column.shape) for key, column in primitive.columns().items()}
    assert shapes == wanted, f"{name} has the columns {shapes}, and those of {count} points are {wanted}"
    for key, value in model.params.items():
        assert torch.isfinite(value).all(), f"{name}: {key} is not finite"
    known_degrees = range(primitive.sh_degree + 1)
    assert model.sh_degree in known_degrees, f"{name}: sh_degree is {model.sh_degree}, not 0 to {known_degrees[-1]}"


def _check_expected(start: Start, cloud: SparsePoints, known: StartInput) -> None:
    pixels = sum(view.camera.width * view.camera.height for view in known.scene.train)
    name, foretold, count = type(start).__name__, start.expected(len(known.scene.cloud.xyz), pixels), len(cloud.xyz)
    right = isinstance(foretold, int) and count / MAX_FORECAST_FACTOR <= foretold <= count * MAX_FORECAST_FACTOR
    assert right, f"{name}.expected is {foretold}, and the start gives {count} points"
