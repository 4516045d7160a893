"""Photographs that stereo can do nothing with, and depth maps of others, as a user meets them."""

import shutil
from functools import partial

import numpy as np
import pytest
import torch
from needs import needs_native
from PIL import Image

from surfkit.cli import main
from surfkit.io.datasets.depth_files import confidence_path, map_path
from surfkit.testing.synthetic import Flight, photograph, write_colmap

pytestmark = needs_native
SETTINGS = "recipe:surface mesh:none --steps 1 --device cpu --pictures-every 0 --primitive.sh-degree 0".split()
SETTINGS += ["--test-every", "8"]
HARDLY = "of the pixels of the depth maps are trusted; see whether the photographs are mirrored"
OTHERS = "there are none that can be used; make others with `surfkit prepare depth {farm} --again`"


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """Two data sets of the same place, one of them of photographs one pixel wide."""
    torch.set_num_threads(1)
    folder = tmp_path_factory.mktemp("made")
    for name, width in (("farm", 48), ("thin", 1)):
        flight = Flight(kind="grid", views=8, width=width, height=36, points=300)
        write_colmap(folder / name, photograph(flight), tracks=True)
    return folder


def grey(farm):
    for path in (farm / "images").iterdir():
        Image.new("RGB", (48, 36), (128, 128, 128)).save(path)


def same(farm):
    for path in (farm / "images").iterdir():
        if path.name != "view_000.png":
            shutil.copy(farm / "images/view_000.png", path)


def mirrored(farm):
    for path in (farm / "images").iterdir():
        with Image.open(path) as photo:
            turned = photo.transpose(Image.Transpose.FLIP_LEFT_RIGHT)
        turned.save(path)


def seen_by(farm, sees):
    """Leave only the observations of points that a photograph, by its number, is to see."""
    model = farm / "sparse/0"
    lines, tracks = (model / "images.txt").read_text().split("\n"), {}
    for at in range(1, len(lines), 2):
        words, number = lines[at].split(), at // 2
        left = [words[i : i + 3] for i in range(0, len(words), 3) if sees(number, int(words[i + 2]))]
        lines[at] = " ".join(word for spot in left for word in spot)
        for i, spot in enumerate(left):
            tracks.setdefault(spot[2], []).append(f"{number + 1} {i}")
    points = [line.split()[:8] for line in (model / "points3D.txt").read_text().splitlines()]
    (model / "images.txt").write_text("\n".join(lines))
    (model / "points3D.txt").write_text("".join(" ".join([*p, *tracks.get(p[0], [])]) + "\n" for p in points))


def two_groups(farm):
    seen_by(farm, lambda number, point: (number < 4) == (point % 2 == 0))


def apart(farm):
    seen_by(farm, lambda number, point: point % 8 == number)


def one_place(farm):
    """All photographs are the first one, and say so."""
    same(farm)
    path = farm / "sparse/0/images.txt"
    lines = path.read_text().split("\n")
    first = lines[0].split()
    for at in range(0, len(lines) - 1, 2):
        words = lines[at].split()
        lines[at], lines[at + 1] = " ".join([words[0], *first[1:9], words[9]]), lines[1]
    path.write_text("\n".join(lines))
    seen_by(farm, lambda number, point: True)


def maps(farm, size=(36, 48), name="{}", beside=(36, 48)):
    """Depth maps as another data set may have left them, whose values are no depths of this one."""
    for number in range(8):
        path = map_path(farm, name.format(f"view_{number:03}.png"))
        path.parent.mkdir(exist_ok=True)
        np.save(path, np.linspace(1, 2, size[0] * size[1], dtype=np.float32).reshape(size))
        np.save(confidence_path(path), np.ones(beside, np.float32))
    (path.parent / "depth.json").write_text('{"aligned": true}')


AGAIN = (2, "--again replaces them")
NONE = (2, "no depth can be estimated of any of 7 photographs")
CASES = {
    # what is done to the data set; exit status and words of `surfkit prepare depth`, and those of `surfkit train`
    "one pixel wide": (None, (0, HARDLY), (2, "; see whether photographs and cameras belong together")),
    "grey": (grey, (0, HARDLY), (0, "no pixel of a depth map is trusted, so the run starts from the sparse points")),
    "the same": (same, (0, HARDLY), (0, HARDLY)),
    "mirrored": (mirrored, (0, HARDLY), (0, HARDLY)),
    "two groups": (two_groups, (0, "7/7 view_"), (0, "depth maps of 7 photographs, made")),
    "nothing in common": (apart, NONE, (2, "depth maps of 0 of 7 photographs")),
    "one place": (one_place, NONE, (2, "or were taken from one place")),
    "maps of another size": (partial(maps, size=(36, 96)), AGAIN, (2, "96 x 36 px is not the shape of its photograph")),
    "maps of another place": (maps, AGAIN, (2, OTHERS)),
    "maps of other names": (partial(maps, name="other_{}"), AGAIN, (0, "estimated_depths has no map of these")),
    "confidence of another size": (
        partial(maps, beside=(2, 90)),
        AGAIN,
        (2, "it has 48 x 36 px, and its confidence 90 x 2 px"),
    ),
}


def files(folder):
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.mark.parametrize("case", CASES)
def test_it_ends_with_a_clear_word_and_nothing_half_written(made, tmp_path, own_cache, capsys, case):
    change, *wanted = CASES[case]
    farm, out = tmp_path / "farm", tmp_path / "run"
    shutil.copytree(made / ("thin" if change is None else "farm"), farm)
    if change is not None:
        change(farm)
    before = files(farm)
    lines = [
        ["train", *SETTINGS, "--data", str(farm), "--out", str(out)],
        ["prepare", "depth", str(farm), "estimator:patch-match", "--device", "cpu", "--test-every", "8"],
    ]
    for words, (status, text) in zip(lines, reversed(wanted), strict=True):
        assert main(words) == status
        told = capsys.readouterr().err
        assert text.format(farm=farm) in told
        errors = [line for line in told.splitlines() if not line.startswith("note: ") and "surfkit: " in line]
        assert len(errors) == (status == 2) and "Traceback" not in told
        if words[0] == "train":
            assert (out / "metrics.json").exists() == (status == 0) == out.exists() and files(farm) == before
        elif status == 2:
            assert files(farm) == before
    assert not [path for place in (tmp_path, own_cache) for path in place.rglob("*") if path.name.startswith(".")]
