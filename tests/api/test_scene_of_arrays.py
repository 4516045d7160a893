"""A data set of arrays is that of the same photographs and cameras in files."""

import numpy as np
import pytest
import torch
from models import data_set

import surfkit


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    return surfkit.read(data_set(tmp_path_factory.mktemp("arrays") / "scene"))


def arrays(scene):
    """What a program of one's own may hold."""
    views = sorted([*scene.train, *scene.held_out], key=lambda view: view.name)
    cameras = [view.camera for view in views]
    return {
        "images": [(scene.photo(view) * 255).round().byte().permute(1, 2, 0).numpy() for view in views],
        "poses": np.stack([scene.frame.input_pose(each.world_to_camera) for each in cameras]),
        "intrinsics": np.array([[[c.fx, 0, c.cx], [0, c.fy, c.cy], [0, 0, 1]] for c in cameras]),
        "points": scene.points,
        "colors": scene.colors,
    }


def test_the_same_as_of_files(files, tmp_path):
    ours = surfkit.from_arrays(tmp_path / "scene", **arrays(files), scale=1)
    assert [len(ours.train), len(ours.held_out)] == [len(files.train), len(files.held_out)]
    assert np.allclose(ours.points, files.points) and (ours.colors == files.colors).all()
    for a, b in zip(ours.train, files.train, strict=True):
        assert torch.allclose(a.camera.world_to_camera, b.camera.world_to_camera) and a.camera.cx == b.camera.cx
        assert torch.equal(ours.photo(a), files.photo(b))


def test_floats_without_points_train_from_random_points_and_resume(files, tmp_path):
    given = arrays(files)
    given |= {"images": [torch.from_numpy(each) / 255 for each in given["images"]]}
    del given["points"], given["colors"]
    recipe = surfkit.evolve(surfkit.evolve(surfkit.get_recipe("2dgs"), "start", "random"), "start.points", 200)

    def train(stop):
        def on_step(step):
            if step.index == stop:
                raise KeyboardInterrupt

        scene = surfkit.from_arrays(tmp_path / "scene", **given)  # the same arrays again are the same data
        return surfkit.train(recipe, scene, tmp_path / "run", steps=4, on_step=on_step)

    with pytest.raises(KeyboardInterrupt):
        train(2)
    run = train(None)
    assert [step["index"] for step in run.steps] == [1, 2, 3, 4]


def test_poses_of_another_convention_are_told(files, tmp_path, capsys):
    given = arrays(files)
    for at, poses, said in (
        ("right", given["poses"], ()),
        ("inverse", np.linalg.inv(given["poses"]), ("world to camera",)),
        ("flipped", np.diag([1, -1, -1, 1]) @ given["poses"], ("hardly a camera sees any of the 250 points",)),
    ):
        scene = surfkit.from_arrays(tmp_path / at, **(given | {"poses": poses}))
        assert len(scene.findings) == len(said) and all(text in scene.findings[0] for text in said), at
        assert all(text in capsys.readouterr().err for text in said)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"images": [np.zeros((3, 8, 8), np.uint8)]}, r"images\[0\]: expected shape \(H, W, 3\), got \(3, 8, 8\)"),
        ({"images": [np.full((8, 8, 3), 255.0)]}, "float64 from 255 to 255; give uint8, or floats from 0 to 1"),
        ({"poses": np.eye(4)[None] * 2}, r"poses\[0\]: the left upper 3 x 3 is no rotation, as with a scale; .*diag"),
        ({"poses": np.eye(4)}, r"poses: expected shape \(1, 4, 4\), got \(4, 4\)"),
        ({"poses": np.eye(4)[None] * np.nan}, "poses: has NaN or Inf"),
        ({"intrinsics": np.eye(4)}, r"intrinsics: expected shape \(1, 3, 3\), got \(4, 4\)"),
        ({"points": np.zeros((5, 2))}, r"points: expected shape \(P, 3\), got \(5, 2\)"),
        ({"colors": np.zeros((4, 3), np.uint8)}, r"colors: expected shape \(5, 3\), got \(4, 3\)"),
        ({"names": ["a.png", "b.png"]}, "2 different names for 1 images"),
        ({"names": ["../a.png"]}, r"name '../a.png'; give a file name with a suffix"),
        ({"names": ["a"]}, r"name 'a'; give a file name with a suffix"),
        ({"scal": 2}, "did you mean 'scale'"),
    ],
)
def test_wrong_arrays(tmp_path, change, said):
    given = {
        "images": [np.zeros((8, 8, 3), np.uint8)],
        "poses": np.eye(4)[None],
        "intrinsics": np.array([[8, 0, 4], [0, 8, 4], [0, 0, 1]]),
        "points": np.ones((5, 3)),
    }
    with pytest.raises(surfkit.BadInput, match=said) as error:
        surfkit.from_arrays(tmp_path / "scene", **(given | change))
    assert "\n" not in str(error.value)


def test_a_folder_of_others_is_kept(files, tmp_path):
    (tmp_path / "scene").mkdir()
    (tmp_path / "scene" / "mine.txt").write_text("mine")
    with pytest.raises(surfkit.BadInput, match="has files that from_arrays did not write"):
        surfkit.from_arrays(tmp_path / "scene", **arrays(files))
