"""Files of the user's own in a run folder, and links that lead out of it."""

import shutil

import pytest

from surfkit.cli import main
from surfkit.testing.synthetic import Flight, photograph, write_colmap

WORDS = "recipe:2dgs --steps 2 --pictures-every 0 --primitive.sh-degree 0".split()
MINE = ("lock", ".mine.part/notes.txt", ".tmpABCDEF", "sub/.inner.part/notes.txt", "mesh.blend", "mesh-lods.txt")


@pytest.fixture(scope="module")
def source(tmp_path_factory):
    folder = tmp_path_factory.mktemp("own")
    write_colmap(folder / "data", photograph(Flight(views=6, width=32, height=24, points=60)))
    assert main(["train", *WORDS, "--data", str(folder / "data"), "--out", str(folder / "run")]) == 0
    return folder


@pytest.fixture
def out(source, tmp_path):
    return shutil.copytree(source / "run", tmp_path / "run")


def test_they_stay(source, tmp_path):
    for name in MINE:
        (tmp_path / "run" / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / "run" / name).write_text("mine")
    assert main(["train", *WORDS, "--data", str(source / "data"), "--out", str(tmp_path / "run")]) == 0
    assert main(["mesh", str(tmp_path / "run")]) == 0
    assert all((tmp_path / "run" / name).read_text() == "mine" for name in MINE)


def test_a_mesh_that_is_made_again_replaces_the_one_before_in_all_its_files(out):
    assert main(["mesh", str(out), "--formats", "ply", "glb", "obj"]) == 0
    assert {path.name for path in out.glob("mesh.*")} == {
        "mesh.json", "mesh.ply", "mesh.glb", "mesh.glb.json", "mesh.obj"
    }  # fmt: skip
    assert main(["mesh", str(out)]) == 0
    assert {path.name for path in out.glob("mesh.*")} == {"mesh.json", "mesh.ply"}


@pytest.mark.parametrize("name", ["metrics.json", "point_cloud.ply", "mesh.glb"])
def test_a_folder_of_another_program_is_refused(source, tmp_path, capsys, name):
    (tmp_path / "theirs").mkdir()
    (tmp_path / "theirs" / name).write_text("theirs")
    assert main(["train", *WORDS, "--data", str(source / "data"), "--out", str(tmp_path / "theirs")]) == 2
    told = (
        f"--out {tmp_path / 'theirs'}: no run folder (no run.json in it), but it has {name!r}, which would be replaced"
    )
    assert told in capsys.readouterr().err and (tmp_path / "theirs" / name).read_text() == "theirs"
    assert [path.name for path in (tmp_path / "theirs").iterdir()] == [name]


@pytest.mark.parametrize(
    "linked", ["pretrain", "pictures", "mesh_pictures", "events.jsonl", "pictures/inner", "log.txt", "method/state"]
)
@pytest.mark.parametrize("command", ["train", "evaluate", "mesh"])
def test_links_are_not_followed_out_of_it(source, out, tmp_path, capsys, linked, command):
    mine, link = tmp_path / "mine", out / linked
    if link.exists():
        shutil.move(link, mine)
    elif linked in ("log.txt", "method/state"):
        link.parent.mkdir(exist_ok=True)
        mine.write_text("mine")
    else:
        mine.mkdir()
    link.symlink_to(mine)
    before = {path: path.read_bytes() for path in [mine, *mine.rglob("*")] if path.is_file()}
    words = {"train": [*WORDS, "--data", str(source / "data"), "--out", str(out)]}.get(command, [str(out)])
    assert main([command, *words]) == 2
    assert f"{link}: a link out of the run folder, to {mine}, where" in capsys.readouterr().err
    assert before == {path: path.read_bytes() for path in [mine, *mine.rglob("*")] if path.is_file()}


def test_a_linked_file_is_replaced_and_what_it_leads_to_stays(out, tmp_path):
    (tmp_path / "mine.txt").write_text("mine")
    (out / "metrics.json").unlink()
    (out / "metrics.json").symlink_to(tmp_path / "nowhere.json")
    (out / "notes.txt").symlink_to(tmp_path / "mine.txt")
    assert main(["evaluate", str(out), "--lpips-weights", "none"]) == 0
    assert not (out / "metrics.json").is_symlink() and not (tmp_path / "nowhere.json").exists()
    assert (out / "notes.txt").read_text() == "mine"


def test_a_link_inside_and_a_linked_run_folder_are_fine(out, tmp_path):
    shutil.move(out / "pictures", out / "elsewhere")
    (out / "pictures").symlink_to("elsewhere")
    (tmp_path / "link").symlink_to(out)
    assert main(["evaluate", str(tmp_path / "link"), "--lpips-weights", "none"]) == 0
