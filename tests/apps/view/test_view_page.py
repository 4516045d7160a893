"""Pages of runs and files, as a browser sees them, and what is refused in one line."""

import json
import os
import re
import shlex
import signal
import struct
import subprocess
import sys
import threading
from dataclasses import replace

import numpy as np
import pytest
import torch
from browser import Browser, wait_until
from models import ORIGIN, data_set, like_3dgs
from needs import needs, needs_native

from surfkit.apps.view.browser_camera import WORLD
from surfkit.apps.view.escape_text import as_text
from surfkit.apps.view.film import FilmTool
from surfkit.apps.view.server import Address, served
from surfkit.apps.view.shared_cache import SharedCache
from surfkit.apps.view.viewer_page import show
from surfkit.apps.view.viewer_scene import opened_subject
from surfkit.cli import main
from surfkit.core.check import BadInput
from surfkit.evaluate.geometry.las import read_las
from surfkit.io.datasets.data import Data
from surfkit.io.datasets.read import read
from surfkit.io.splats.ply import write_splats
from surfkit.io.splats.splat_files import format_for, format_of
from surfkit.io.splats.splat_table import SplatTable
from surfkit.mesh.base import Mesh
from surfkit.mesh.mesh_export import write_mesh
from surfkit.partition.base import Cells, Ground
from surfkit.partition.plan import BlockPlan, PartitionPlan
from surfkit.runs.run_notes import collect_notes
from surfkit.scene.crop import read_crop
from surfkit.scene.scene import Frame

TRIANGLE = Mesh(np.eye(3, dtype=np.float32), np.array([[0, 1, 2]], np.int32), np.full((3, 3), 200, np.uint8))
GROUND = 0.125
"""Height of the mesh of the run, local units."""
SURVEY = Frame(np.array(ORIGIN), 0.1, 1.0, "EPSG:32632")


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("view")
    data = data_set(folder / "data", far=True)
    words = ["recipe:2dgs", "mesh:none", "--steps", "2", "--primitive.sh-degree", "0", "--pictures-every", "0"]
    out = folder / "run"
    assert main(["train", *words, "--data", str(data), "--out", str(out)]) == 0
    corners = np.array([[x, y, GROUND] for x, y in ((-9, -9), (9, -9), (9, 9), (-9, 9))], np.float32)
    write_mesh(out / "mesh.ply", Mesh(corners, np.array([[0, 1, 2], [0, 2, 3]], np.int32)), read(Data(data)).frame)
    (out / "mesh.json").write_text("{}")
    return out


@pytest.fixture(scope="module")
def page(run, tmp_path_factory):
    """The page of the run, and the folder for its files."""
    needs("viser")
    out = tmp_path_factory.mktemp("written")
    with opened_subject(run, "cpu") as subject, served(Address(), "test") as found:
        show(subject, found, out)
        yield found, subject, out


@pytest.fixture
def browser(page):
    found = Browser(page[0].url)
    found.wait_for(lambda b: any("first" in t or "Click on the surface" in t for t in b.texts()))
    found.wait_for(Browser.is_whole)
    yield found
    found.close()


@needs_native
def test_a_run_has_splats_and_cameras(browser, page):
    subject = page[1]
    assert any(f"all {len(subject.splats):,} splats are shown" in text for text in browser.texts())
    names = browser.wait_for(lambda b: {"/splats", "/cameras"} <= set(b.names()) and b.names())
    assert "/mesh" not in names and "/points" not in names
    browser.set("sparse points", True)
    browser.wait_for(lambda b: "/points" in b.names())
    browser.set("cameras", False)
    browser.wait_for(lambda b: "/cameras" not in b.names())


@needs_native
def test_fewer_splats_and_other_colours(browser, page):
    browser.set("colours", "height")
    browser.wait_for(lambda b: any("dark" in text and "pale" in text for text in b.texts()))
    browser.set("most splats", 100)
    said = f"100 splats, drawn by lot and enlarged, stand for {len(page[1].splats):,}"
    browser.wait_for(lambda b: any(said in text and "surfkit lod" in text for text in b.texts()))


@needs_native
def test_points_while_the_camera_moves(browser):
    browser.wait_for(lambda b: "buffer" in b.names().get("/splats", {}))
    browser.set("draw as", "points-while-moving")
    for z in range(8):
        browser.stand(float(z))
        browser.wait_for(lambda b: "point_size" in b.names().get("/splats", {}))
    browser.wait_for(lambda b: "buffer" in b.names().get("/splats", {}))


@needs_native
def test_a_click_on_a_camera_shows_its_photograph(browser, page):
    subject = page[1]
    camera = subject.views[1].camera
    ahead = camera.world_to_camera[2, :3].numpy()
    browser.click((camera.centre.numpy() - 0.1 * ahead) * WORLD, ahead)
    browser.wait_for(lambda b: any(as_text(subject.views[1].name) in text and "pixels" in text for text in b.texts()))
    browser.wait_for(lambda b: "/chosen" in b.names())
    browser.set("show", "error")
    browser.wait_for(lambda b: any("|render - photograph|" in text and "PSNR" in text for text in b.texts()))
    moved = [row for row in browser.told if row["type"] == "SetCameraPositionMessage"]
    assert np.allclose(moved[-1]["position"], camera.centre.numpy() * WORLD, atol=1e-5)
    browser.click(camera.centre.numpy() * WORLD, ahead)  # from there, through its own picture
    browser.wait_for(lambda b: any("not georeferenced" in t or "no surface" in t for t in b.texts()))


@needs_native
def test_a_click_on_the_surface_measures(browser, page):
    subject = page[1]
    browser.set("cameras", False)
    browser.set("mesh", True)
    browser.wait_for(lambda b: "/mesh" in b.names() and "/cameras" not in b.names())
    browser.set("measure", True)
    browser.wait_for(lambda b: "/measure" in b.names())
    corners = np.array([[0.0, 0.0, GROUND], [0.3, 0.0, GROUND], [0.3, 0.4, GROUND]])
    for number, place in enumerate(corners):
        browser.click((place + [0, 0, 3]) * WORLD, [0, 0, -1])
        browser.wait_for(lambda b, n=number: f"/measure/{n}" in b.names())
    exact = subject.frame.to_input(corners[2])
    said = browser.wait_for(lambda b: next((t for t in b.texts() if "not georeferenced" in t), None))
    numbers = [float(value) for value in re.findall(r"[xyz] (-?[\d.]+)", said)]
    assert np.allclose(numbers, exact, atol=0.01), "survey coordinates"
    unit = 1 / subject.frame.scale
    table = browser.wait_for(lambda b: next((t for t in b.texts() if "area from above" in t), None))
    values = [float(v.replace(",", "")) for v in re.findall(r"\| (-?[\d,.]+) ", table)]
    assert np.allclose(values, [0.7 * unit, 0.7 * unit, 0.0, 0.06 * unit**2, 0.06 * unit**2], rtol=1e-2, atol=1e-2)
    browser.wait_for(lambda b: sum(name.startswith("/measure/label") for name in b.names()) == 2)  # after the table
    browser.set("measure", False)
    browser.wait_for(lambda b: not any(name.startswith("/measure/") for name in b.names()))


@needs_native
def test_files_that_the_page_writes(browser, page):
    _, subject, out = page
    browser.set("show the box", True)
    browser.wait_for(lambda b: "/crop/box" in b.names())
    browser.press("write crop file")
    text = browser.wait_for(lambda b: next((t for t in b.texts() if "surfkit mesh" in t), None))
    crop = read_crop(out / "crop.json")
    assert str(out / "crop.json") in text and str(subject.path) in text
    places = subject.frame.to_input(subject.splats.means.numpy())
    assert 0.6 < crop.inside(places).mean() < 1
    for count in (1, 2):
        browser.press("add this view")
        browser.wait_for(lambda b, n=count: any(f"{n} key views" in t for t in b.texts()))
    browser.press("write path file")
    browser.wait_for(lambda b: any("surfkit render" in t for t in b.texts()))
    assert len(json.loads((out / "path.json").read_text())["camera_path"]) == 300


@needs_native
def test_a_video_that_was_stopped_goes_on_by_the_command(page, tmp_path, capsys, monkeypatch):
    needs("cv2")
    drawn, clicks, stopped, clicked = [], [], threading.Event(), FilmTool._clicked

    def held(view):
        drawn.append(view)
        assert len(drawn) <= 3 or stopped.wait()
        return page[1].draw(view)

    def stop(tool):
        clicks.append(clicked(tool))
        if len(clicks) == 2:
            stopped.set()

    monkeypatch.setattr(FilmTool, "_clicked", stop)

    with served(Address(), "test") as found:
        show(replace(page[1], draw=held), found, tmp_path)
        browser = Browser(found.url)
        browser.wait_for(Browser.is_whole)
        for label, value in (("seconds", 1.0), ("size", "640x360")):
            browser.set(label, value)
        for z in (1.0, 2.0):
            browser.stand(z)
            browser.press("add this view")
            browser.wait_for(lambda b, n=int(z): any(f"{n} key views" in t for t in b.texts()))
        browser.press("make the video")
        browser.wait_for(lambda b: drawn and any(row.get("label") == "stop" for row in b.gui.values()))
        browser.press("stop")
        text = browser.wait_for(lambda b: next((t for t in b.texts() if "Stopped;" in t), None))
        browser.close()
    there = {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*.png")}
    assert 0 < len(there) <= 4
    words = shlex.split(re.search("`surfkit (.*)`", text)[1])
    assert main([*words, "--keep-frames", "--device", "cpu"]) == 0
    assert "30, 1.0 s at 30 per second" in capsys.readouterr().out
    assert all(path.stat().st_mtime_ns == time_ns for path, time_ns in there.items()), (
        "what is there is not drawn again"
    )
    assert (tmp_path / "path-color-640x360.mp4").stat().st_size > 0


@needs_native
def test_two_browsers_at_once(page, browser):
    other = Browser(page[0].url)
    other.wait_for(lambda b: "/splats" in b.names())
    other.wait_for(Browser.is_whole)
    other.set("measure", True)
    other.set("mesh", True)
    other.wait_for(lambda b: {"/mesh", "/measure"} <= set(b.names()))
    other.click((0.0, 0.0, 3 * WORLD), (0, 0, -1))
    other.wait_for(lambda b: "/measure/0" in b.names())
    browser.set("sparse points", True)
    browser.wait_for(lambda b: "/points" in b.names())
    assert "/measure/0" not in browser.names() and "/points" not in other.names()
    other.close()


@needs_native
def test_the_last_browser_that_leaves_takes_what_was_chosen_for_it(page, monkeypatch):
    forgotten = []
    monkeypatch.setattr(SharedCache, "forget_choices", lambda shelf: forgotten.append(shelf))
    first, second = (Browser(page[0].url) for _ in range(2))
    for each in (first, second):
        each.wait_for(Browser.is_whole)
    forgotten.clear()  # when the one of the test before left
    first.close()
    wait_until(lambda: len(page[0].viser.get_clients()) == 1)
    assert not forgotten
    second.close()
    wait_until(lambda: forgotten)


def test_choices_that_are_forgotten_are_made_again(tmp_path):
    write_mesh(tmp_path / "a.ply", TRIANGLE, SURVEY)
    with opened_subject(tmp_path / "a.ply", "cpu") as subject:
        shelf = SharedCache(subject)
        kept = shelf.mesh(1)
        assert shelf.mesh(1) is kept
        shelf.forget_choices()
        assert shelf._mesh.cache_info().currsize == 0 and len(shelf.mesh(1).faces) == 1


@needs_native
def test_blocks(page, tmp_path):
    subject = page[1]
    east = float(np.median(subject.splats.means[:, 0]))
    boxes = ((None, None, east, None), (east, None, None, None))
    cells = Cells(Ground((1.0, 0.0, 0.0), (0.0, 1.0, 0.0)), boxes, (0, 1))
    blocks = (BlockPlan(0, ("a", "b"), 2, 125, 0.5), BlockPlan(1, ("b",), 1, 125, 0.5))
    with_plan = replace(subject, plan=PartitionPlan(cells, blocks))
    colors = SharedCache(with_plan).painted(with_plan.splats, "block")
    assert len(np.unique(colors[with_plan.splats.means[:, 0] < east], axis=0)) == 1
    assert len(np.unique(colors, axis=0)) == 2
    with served(Address(), "test") as found:
        show(with_plan, found, tmp_path)
        browser = Browser(found.url)
        browser.wait_for(Browser.is_whole)
        browser.set("blocks", True)
        browser.wait_for(lambda b: {"/blocks/lines", "/blocks/1"} <= set(b.names()))
        assert browser.names()["/blocks/0"]["text"] == "block 0: 2 views"
        browser.set("draw as", "points")
        browser.wait_for(lambda b: "point_size" in b.names().get("/splats", {}))
        browser.close()


def shown_file(path):
    """The first texts and names of the page of a file."""
    needs("viser")
    with opened_subject(path, "cpu") as subject, served(Address(), "test") as found:
        show(subject, found, path.parent / "out")
        browser = Browser(found.url)
        browser.wait_for(Browser.is_whole)
        browser.wait_for(lambda b: {"/splats", "/mesh", "/points"} & set(b.names()))
        names = set(browser.names())
        browser.close()
    return subject, names


@pytest.mark.parametrize("name", ["mesh.ply", "mesh.glb", "mesh.obj"])
def test_a_mesh_is_shown_in_its_coordinates(tmp_path, name):
    needs("trimesh")
    write_mesh(tmp_path / name, TRIANGLE, SURVEY)
    subject, names = shown_file(tmp_path / name)
    assert "/mesh" in names and "/splats" not in names
    back = subject.frame.to_input(subject.mesh.vertices)
    assert np.allclose(back, SURVEY.to_input(TRIANGLE.vertices), atol=1e-3)
    assert subject.frame.crs == "EPSG:32632" and subject.frame.metres == 1.0
    assert np.allclose(subject.mesh.colors, 200, atol=1)


@pytest.mark.parametrize("colored", [True, False])
def test_a_mesh_is_coloured_by_what_is_known_of_it(tmp_path, colored):
    needs("viser")
    values = {"views": np.float32([0, 3, 30]), "error": np.float32([0.1, 0.2, 0.3])}
    mesh = replace(TRIANGLE, values=values, colors=TRIANGLE.colors if colored else None)
    write_mesh(tmp_path / "mesh.ply", mesh, SURVEY)
    with opened_subject(tmp_path / "mesh.ply", "cpu") as subject, served(Address(), "test") as found:
        show(subject, found, tmp_path / "out")
        shelf = SharedCache(subject)
        low, middle, high = shelf.mesh_by("views", 9)[0].colors.astype(int)
        assert low[0] > low[2] + 100 and high[2] > high[0] + 100 and abs(middle[0] - middle[2]) < 150
        small, _, large = shelf.mesh_by("error", 9)[0].colors.astype(int)
        assert large[0] > large[2] + 100 and small[2] > small[0] + 100
        assert shelf.mesh_by("error", 9)[1] == "error: blue 1.04 m or less, red 2.96 m or more, grey not known"
        browser = Browser(found.url)
        browser.wait_for(Browser.is_whole)
        said = "red 1 or none, blue 10 or more photographs"
        if colored:
            browser.wait_for(lambda b: any("all 1 triangles are shown" in t and said not in t for t in b.texts()))
            browser.set("colours of the mesh", "views")
        browser.wait_for(lambda b: any(said in t and "all 1 triangles" in t for t in b.texts()))
        browser.set("mesh in grey", True)
        browser.wait_for(lambda b: not any(said in t for t in b.texts()))
        browser.close()


def test_points_are_shown(tmp_path):
    header = "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n"
    colors = "".join(f"property uchar {name}\n" for name in ("red", "green", "blue"))
    (tmp_path / "a.ply").write_text(f"{header}{colors}end_header\n0 0 0 9 8 7\n1 0 0 1 2 3\n0 1 0 4 5 6\n")
    subject, names = shown_file(tmp_path / "a.ply")
    assert "/points" in names and subject.points.rgb[0].tolist() == [9, 8, 7]
    assert np.allclose(subject.frame.to_input(subject.points.xyz)[1], [1, 0, 0], atol=1e-5)


def cloud(path, point_format, wkt=None, **colors):
    """250 points on the map, as another program may write them."""
    laspy, crs = needs("laspy"), needs("rasterio.crs")
    needs("lazrs")
    header = laspy.LasHeader(version="1.4", point_format=point_format)
    header.offsets, header.scales = np.array(ORIGIN), np.full(3, 0.01)
    known = needs("laspy.vlrs.known")
    header.vlrs.append(known.WktCoordinateSystemVlr(wkt or crs.CRS.from_epsg(32632).to_wkt()))
    made = laspy.LasData(header)
    made.x, made.y, made.z = (np.array(ORIGIN) + np.random.default_rng(0).uniform(0, 9, (250, 3))).T
    for name, values in colors.items():
        made[name] = np.asarray(values, np.uint16)
    made.write(path)
    return np.stack([made.x, made.y, made.z], 1)


def test_points_of_other_programs_are_shown(tmp_path, monkeypatch, capsys):
    many = cloud(tmp_path / "a.laz", 7, red=np.arange(250) * 257, green=np.full(250, 65535))
    subject, names = shown_file(tmp_path / "a.laz")
    assert "/points" in names and (subject.frame.crs, subject.frame.metres) == ("EPSG:32632", 1.0)
    assert np.allclose(subject.frame.to_input(subject.points.xyz), many, atol=1e-3)
    assert subject.points.rgb[:, 0].tolist() == list(range(250)) and (subject.points.rgb[:, 1:] == [255, 0]).all()
    monkeypatch.setattr("surfkit.apps.view.viewer_scene.MAX_CLOUD_POINTS", 100)
    monkeypatch.setattr("surfkit.evaluate.geometry.las.CHUNK_POINTS", 64)
    places = cloud(tmp_path / "b.las", 6)
    with opened_subject(tmp_path / "b.las", "cpu") as subject:
        assert np.allclose(subject.frame.to_input(subject.points.xyz), places[::3], atol=1e-3)
        brightness = subject.points.rgb.astype(int).sum(1)[np.argsort(places[::3, 2])]
        assert brightness[-5:].mean() > brightness[:5].mean() + 100, "colours of heights"
    cloud(tmp_path / "c.las", 6, wkt="somewhere")
    with collect_notes() as notes, opened_subject(tmp_path / "c.las", "cpu") as subject:
        assert subject.frame.crs is None
        assert any("c.las: coordinates are used without their reference system" in each for each in notes.texts)
    (tmp_path / "short.laz").write_bytes((tmp_path / "a.laz").read_bytes()[:1200])
    (tmp_path / "other.las").write_text("hello")
    capsys.readouterr()
    for name in ("short.laz", "other.las"):
        assert main(["view", str(tmp_path / name), "--no-open"]) == 2
        error = capsys.readouterr().err
        assert error.count("\n") == 1 and f"{name}: cannot be read" in error


@needs_native
@pytest.mark.parametrize("name", ["s.ply", "s.compressed.ply", "s.spz", "s.splat", "s.sog", "s.glb", "s.surfkit"])
def test_splats_of_any_format_are_shown(tmp_path, run, name):
    path = tmp_path / name
    form = format_for(path)
    form.write(path, format_of(run / "point_cloud.ply").read(run / "point_cloud.ply"))
    with opened_subject(path, "cpu") as subject:
        assert len(subject.splats) == 250 and subject.draw is not None and subject.mesh is None


@needs_native
def test_the_offset_of_a_file_of_splats(tmp_path):
    count = 50
    draw = torch.Generator().manual_seed(0)
    means = torch.randn(count, 3, generator=draw).double() + torch.tensor(ORIGIN, dtype=torch.float64)
    parts = [torch.randn(count, n, generator=draw) for n in (4, 2, 1, 3)]
    splats = SplatTable("surfel", means, parts[0], parts[1] - 3, parts[2][:, 0], parts[3], torch.zeros(count, 0, 3))
    frame = replace(SURVEY, shift=(492000.0, 5260000.0, 0.0))
    write_splats(tmp_path / "s.ply", splats, frame=frame)
    with opened_subject(tmp_path / "s.ply", "cpu") as subject:
        assert subject.frame.crs == "EPSG:32632" and subject.frame.metres == 1.0
        assert np.allclose(subject.frame.to_input(subject.splats.means.numpy()), means.numpy(), atol=1e-3)


@pytest.mark.parametrize("on_map", [True, False])
@pytest.mark.parametrize("name", ["s.ply", "s.glb", "s.spz"])
def test_what_is_up_in_a_file_of_splats(tmp_path, monkeypatch, name, on_map):
    """z on a map, as far as the file tells; -y elsewhere, which a user can change."""
    needs("viser")
    draw = torch.Generator().manual_seed(0)
    parts = [torch.randn(9, n, generator=draw) for n in (3, 4, 2, 1, 3)]
    splats = SplatTable("surfel", parts[0], parts[1], parts[2] - 3, parts[3][:, 0], parts[4], torch.zeros(9, 0, 3))
    frame = SURVEY if on_map else replace(SURVEY, crs=None, metres=None)
    path, found = tmp_path / name, []
    format_for(path).write(path, splats, frame)

    def look(subject, *_):
        found.append(subject)
        raise BadInput("enough")

    monkeypatch.setattr("surfkit.apps.view.command.show", look)
    told = on_map and not name.endswith("spz")
    for words, up in (
        ([], (0, 0, 1) if told else (0, -1, 0)),
        (["--up", "-x"], (-1, 0, 0)),
        (["--up", "y"], (0, 1, 0)),
    ):
        assert main(["view", str(path), *words, "--no-open", "--device", "cpu"]) == 2
        assert found[-1].up.tolist() == list(up) and found[-1].frame.crs == ("EPSG:32632" if told else None)


def test_what_cannot_be_shown_is_refused(tmp_path, capsys):
    needs("viser")
    (tmp_path / "empty").mkdir()
    (tmp_path / "bad.ply").write_bytes(b"ply\nformat binary_little_endian 1.0\nelement vertex 9\nend_header\n")
    (tmp_path / "text.txt").write_text("hello")
    (tmp_path / "short.glb").write_bytes(b"glTF\x02\0\0\0\xff")
    cases = {
        "nowhere": "there is no such run or file",
        "empty": "no run folder",
        "bad.ply": "bad.ply",
        "text.txt": "known",
        "short.glb": "short.glb",
    }
    for name, said in cases.items():
        assert main(["view", str(tmp_path / name)]) == 2, name
        error = capsys.readouterr().err
        assert error.startswith("surfkit: ") and error.count("\n") == 1 and said in error, error
    for words, said in (
        (["--port", "0"], "--port 0"),
        (["--out", str(tmp_path / "text.txt")], "a file"),
        (["--most", "0"], "--most 0"),
    ):
        assert main(["view", str(tmp_path / "bad.ply"), *words]) == 2
        assert said in capsys.readouterr().err


def test_a_damaged_scale_is_refused(tmp_path):
    scene = read(Data(data_set(tmp_path / "data")))
    path = like_3dgs(tmp_path / "a.ply", scene, quats=torch.zeros(len(scene.cloud.xyz), 4))
    with pytest.raises(BadInput, match="rotation of length 0"), opened_subject(path or tmp_path / "a.ply", "cpu"):
        pass


def test_ctrl_c_ends_it_at_once(tmp_path):
    needs("viser")
    write_mesh(tmp_path / "mesh.ply", TRIANGLE, SURVEY)
    words = [sys.executable, "-m", "surfkit.cli", "view", str(tmp_path / "mesh.ply"), "--no-open"]
    heard = signal.signal(
        signal.SIGINT, signal.default_int_handler
    )  # a shell's background has it ignored, for children too
    process = subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    signal.signal(signal.SIGINT, heard)
    lines = []
    while not any("Ctrl-C" in line for line in lines):
        lines.append(process.stdout.readline())
        assert lines[-1], process.stderr.read()
    url = re.search(r"http://127\.0\.0\.1:\d+/\?token=\S+", "".join(lines))[0]
    browser = Browser(url)
    browser.wait_for(lambda b: "/mesh" in b.names())
    browser.wait_for(Browser.is_whole)
    browser.set("seconds", 1000.0)
    for count in (1, 2):
        browser.press("add this view")
        browser.wait_for(lambda b, n=count: any(f"{n} key views" in t for t in b.texts()))
    browser.press("preview")
    browser.wait_for(lambda b: any(row["type"] == "SetCameraPositionMessage" for row in b.told))
    Browser(url).close()  # one that leaves at once
    os.kill(process.pid, signal.SIGINT)
    out, err = process.communicate()
    assert process.returncode == 0 and "ended" in out and not err
    browser.close()


@pytest.mark.parametrize(("number", "unit"), [(32633, 1.0), (2263, 1200 / 3937)])
def test_las_files_with_keys_of_geotiff(tmp_path, number, unit):
    """The record is written here as GeoTIFF lays it out; 2263 is in US survey feet."""
    laspy = needs("laspy")
    header = laspy.LasHeader(version="1.2", point_format=0)
    keys = struct.pack("<12H", 1, 1, 0, 2, 1024, 0, 1, 1, 3072, 0, 1, number)
    header.vlrs.append(laspy.VLR("LASF_Projection", 34735, "keys", keys))
    header.offsets = (512_000, 5_800_000, 90)
    made = laspy.LasData(header)
    made.x, made.y, made.z = np.array([[512_001, 512_003], [5_800_001, 5_800_002], [90, 91]], np.float64)
    made.write(tmp_path / "a.las")
    notes = read_las(tmp_path / "a.las")[2]
    assert notes["crs"] == f"EPSG:{number}" and np.isclose(float(notes["metres per unit"]), unit, rtol=1e-12)
