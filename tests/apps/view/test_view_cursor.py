"""Coordinates under a pointer that moves: as a click shows them, asked for by a script on viser's page."""

import gzip
import json
import re
import threading
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, nullcontext, suppress
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from browser import Browser, ask, cookie, get, tag, wait_until
from needs import needs
from scipy.spatial.transform import Rotation

from surfkit.apps.view.browser_camera import WORLD
from surfkit.apps.view.cursor import Cursor
from surfkit.apps.view.http_answers import Script, with_script
from surfkit.apps.view.picking import PointPicker, hit_points
from surfkit.apps.view.server import Address, served
from surfkit.apps.view.viewer_page import show
from surfkit.apps.view.viewer_scene import ViewerPoints, ViewerScene
from surfkit.mesh.base import Mesh
from surfkit.raster.api import Maps
from surfkit.scene.scene import Frame

FRAME = Frame(np.array([492_000.0, 5_260_000.0, 430.0]), 0.01, 1.0, "EPSG:32632")
UP = np.array([0.0, 0.0, 1.0])
SLOPE, OFFSET = np.array([0.4, -0.2]), 3.0
"""Of the plane z = SLOPE @ (x, y) + OFFSET, of which there is a square."""
CORNERS = np.array([[-2.0, -2.0], [2.0, -2.0], [2.0, 2.0], [-2.0, 2.0]])
PLANE = Mesh(
    np.column_stack([CORNERS, CORNERS @ SLOPE + OFFSET]).astype(np.float32), np.array([[0, 1, 2], [0, 2, 3]], np.int32)
)
WIDTH, HEIGHT, FOV = 800, 600, 1.0
"""Of the window of `Browser`."""
TEXT = re.compile(r"E (-?[\d.]+), N (-?[\d.]+), height (-?[\d.]+) \(EPSG:32632\)")


@contextmanager
def shown(subject, folder):
    needs("viser")
    with served(Address(), "test") as page:
        show(subject, page, folder)
        yield page


@pytest.fixture(scope="module")
def page(tmp_path_factory):
    with shown(ViewerScene(Path("plane"), FRAME, UP, mesh=PLANE), tmp_path_factory.mktemp("out")) as found:
        yield found


@contextmanager
def connected(page):
    found = Browser(page.url)
    found.wait_for(Browser.is_whole)
    if not page.script.missing:  # the page is there as soon as its client is known
        found.wait_for(lambda b: ask(page, client=tag(b)[0])[0] != 404)
    yield found
    found.close()


@pytest.fixture
def browser(page):
    with connected(page) as found:
        yield found


def ray_of_three(turn, at, px, py):
    """Of the middle of a pixel, as three.js has it: it looks along -z, y is up, and inverts the projection."""
    focal, near, far = 1 / np.tan(FOV / 2), 0.01, 1e3
    projection = np.zeros((4, 4))
    projection[0, 0], projection[1, 1], projection[3, 2] = focal * HEIGHT / WIDTH, focal, -1
    projection[2, 2:] = (far + near) / (near - far), 2 * far * near / (near - far)
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = turn @ np.diag([1.0, -1.0, -1.0]), at
    device = [2 * (px + 0.5) / WIDTH - 1, 1 - 2 * (py + 0.5) / HEIGHT, 0.5, 1.0]
    place = pose @ np.linalg.inv(projection) @ device
    direction = place[:3] / place[3] - at
    return at, direction / np.linalg.norm(direction)


def test_it_says_what_a_click_says(page, browser):
    client = tag(browser)[0]
    draw = np.random.default_rng(0)
    hits = 0
    for _ in range(12):
        turn = Rotation.from_rotvec(draw.normal(0, 0.3, 3))
        at = draw.normal(0, 3.0, 3) * [1, 1, 0.5]
        lens = (FOV, 0.01, 1e3, HEIGHT, WIDTH)
        wxyz = tuple(turn.as_quat()[[3, 0, 1, 2]].tolist())
        before = tag(browser)[1]
        ask(page, client=client, x=0, y=0)  # so that the browser is told of the next camera
        browser.send(
            browser.messages.ViewerCameraMessage(wxyz, tuple(at.tolist()), *lens, (0.0, 0.0, 50.0), (0.0, -1.0, 0.0))
        )
        browser.wait_for(lambda b, before=before: tag(b)[1] != before)
        px, py = draw.integers(0, WIDTH), draw.integers(0, HEIGHT)
        x, y = (px + 0.5 - WIDTH / 2) / (HEIGHT / 2), (py + 0.5) / (HEIGHT / 2) - 1
        status, said = ask(page, client=client, x=x, y=y)
        assert status == 200

        origin, direction = ray_of_three(turn.as_matrix(), at, px, py)
        origin = origin / WORLD
        along = (SLOPE @ origin[:2] + OFFSET - origin[2]) / (direction[2] - SLOPE @ direction[:2])
        exact = origin + along * direction
        if along <= 0 or np.abs(exact[:2]).max() > 2:
            assert said == ""
            continue
        hits += 1
        assert np.allclose([float(value) for value in TEXT.fullmatch(said).groups()], FRAME.to_input(exact), atol=2e-3)
        browser.click(origin * WORLD, direction)
        browser.wait_for(lambda b, said=said: said in b.texts())
    assert 4 < hits < 12


def test_nothing_is_said_of_the_sky(page, browser):
    browser.stand(50.0)  # above the plane, looking up
    assert ask(page, client=tag(browser)[0], x=0.1, y=0.1) == (200, "")


def test_what_is_wrong_is_refused_in_a_line(page, browser):
    client = tag(browser)[0]
    for asked in ({}, {"x": 0}, {"x": "a", "y": 0}, {"x": "nan", "y": 0}, {"x": 0, "y": "inf"}, {"x": 0, "y": 1.5}):
        status, said = ask(page, client=client, **asked)
        assert status == 400 and len(said) < 80, asked
    for wrong in ("", "-1", "77", "x", "²", "9" * 5000, "0; "):
        status, said = ask(page, client=wrong, x=0, y=0)
        assert (status, said) == (404, "no such client"), wrong
    assert get(page, "/surfkit/other", **cookie(page))[0] == 404


def test_a_client_that_has_gone(page):
    with connected(page) as browser:
        client = tag(browser)[0]
        assert ask(page, client=client, x=0, y=0)[0] == 200
    wait_until(lambda: ask(page, client=client, x=0, y=0)[0] == 404)


def test_the_switch(page, browser):
    client = tag(browser)[0]
    browser.set("follow the pointer", False)
    browser.wait_for(lambda b: tag(b)[0] == "")
    assert ask(page, client=client, x=0, y=0)[0] == 409
    browser.set("follow the pointer", True)
    browser.wait_for(lambda b: tag(b)[0] == client)
    assert ask(page, client=client, x=0, y=0)[0] == 200


def test_the_script_is_told_once_when_the_camera_moves(page, browser):
    client, turn = tag(browser)
    browser.stand(1.0)
    browser.stand(2.0)
    browser.press("show all")
    browser.wait_for(lambda b: any(row["type"] == "SetCameraPositionMessage" for row in b.told))
    assert tag(browser)[1] == turn, "nothing is shown"
    assert ask(page, client=client, x=0, y=0)[0] == 200
    for z in (3.0, 4.0, 5.0):
        browser.stand(z)
    browser.wait_for(lambda b: tag(b)[1] != turn)
    browser.press("show all")
    told = len(browser.told)
    browser.wait_for(lambda b: any(row["type"].startswith("SetCamera") for row in b.told[told:]))
    assert int(tag(browser)[1]) == int(turn) + 1


def test_two_threads_that_know_of_a_change_tell_the_script_once():
    both = threading.Barrier(2)

    class Together(Cursor):
        """Both threads look whether there is something to tell before one of them tells it, if that can be."""

        @property
        def shown(self):
            found = vars(self)["shown"]
            with suppress(threading.BrokenBarrierError):
                both.wait(0.2)
            return found

        @shown.setter
        def shown(self, value):
            vars(self)["shown"] = value

    part = SimpleNamespace(value=True, on_update=lambda action: None)
    gui = SimpleNamespace(add_checkbox=lambda *_, **more: part, add_html=lambda text: SimpleNamespace(content=text))
    cursor = Together(SimpleNamespace(gui=gui, client_id=7), nullcontext(), lambda x, y: "")
    cursor.answer(0.0, 0.0)
    with ThreadPoolExecutor(2) as pool:
        for _ in range(2):
            pool.submit(cursor.changed)
    assert cursor.turn == 1


def test_one_at_a_time_and_the_server_goes_on(tmp_path):
    entered, leave = threading.Event(), threading.Event()

    def draw(view):
        entered.set()
        assert leave.wait()
        return Maps(median=torch.full((1, 1), 2.0))

    points = ViewerPoints(np.eye(3, dtype=np.float32), np.zeros((3, 3), np.uint8))
    with (
        shown(ViewerScene(Path("p"), FRAME, UP, points=points, draw=draw), tmp_path) as page,
        connected(page) as browser,
    ):
        client, first = tag(browser)[0], []
        thread = threading.Thread(target=lambda: first.append(ask(page, client=client, x=0, y=0)))
        thread.start()
        assert entered.wait()
        assert ask(page, client=client, x=0, y=0) == (429, "one at a time")
        assert get(page, "/", **cookie(page))[0] == 200 and not first
        with connected(page) as other:
            assert tag(other)[0] != client
        leave.set()
        thread.join()
        status, said = first[0]
        height = float(TEXT.fullmatch(said)[3])
        assert status == 200 and height == pytest.approx(430 + 200), "2 units of 100 m above the camera"
        assert ask(page, client=client, x=0, y=0) == (200, said)


@pytest.mark.parametrize("coding", ["identity", "gzip"])
def test_the_page_has_the_script(page, coding):
    status, body, headers = get(page, "/", **cookie(page), **{"Accept-Encoding": coding})
    assert status == 200 and headers["Content-Encoding"] == coding
    assert int(headers["Content-Length"]) == len(body) and "ETag" not in headers
    text = gzip.decompress(body) if coding == "gzip" else body
    mark = b'<script src="surfkit/script.js" defer></script></body>'
    assert text.count(mark) == 1 and text.rstrip().endswith(b"</html>")
    plain = (Path(needs("viser").__file__).parent / "client" / "build" / "index.html").read_bytes()
    assert text.replace(mark, b"</body>") == plain
    status, script, headers = get(page, "/surfkit/script.js", **cookie(page))
    assert status == 200 and headers["Content-Type"].startswith("text/javascript")
    assert b"surfkit/ask?" in script and b"surfkit-cursor" in script and b"innerHTML" not in script
    assert headers["Cache-Control"] == "no-store"


def test_a_page_of_another_form_works_without_it(capsys):
    headers, http11 = needs("websockets.datastructures").Headers, needs("websockets.http11")
    script = Script()
    page = http11.Response(200, "OK", headers({"Content-Type": "text/html"}), b"<html><p>1")
    assert script.into(page) is page and not capsys.readouterr().err, "no script was set"
    script.set("1", lambda asked: (200, json.dumps(dict(asked))), "there is less to see")
    other = http11.Response(200, "OK", headers({"Content-Type": "application/javascript"}), b"</body>")
    assert script.into(other) is other and not script.missing
    for _ in range(2):
        assert script.into(page) is page
    said = capsys.readouterr().err
    assert said.startswith("surfkit: this version of viser") and said.count("\n") == 1, "said once"
    assert script.missing and with_script(b"</body>", "br") is None
    tags = headers({"Content-Type": "text/html", "Content-Length": "8", "ETag": "a", "Last-Modified": "b"})
    found = script.into(http11.Response(200, "OK", tags, b"</body>1"))
    assert found.body.endswith(b"</script></body>1") and sorted(found.headers) == ["content-length", "content-type"]
    assert int(found.headers["Content-Length"]) == len(found.body)


def test_clicks_work_without_it(tmp_path):
    with shown(ViewerScene(Path("plane"), FRAME, UP, mesh=PLANE), tmp_path) as page:
        page.script.missing = True
        with connected(page) as browser:
            assert not any(row.get("label") == "follow the pointer" for row in browser.gui.values())
            browser.click((0.0, 0.0, 0.0), (0.0, 0.0, 1.0))
            browser.wait_for(lambda b: any("height 730.000" in text for text in b.texts()))
            assert ask(page, client=0, x=0, y=0)[0] == 404


def test_points_are_met_by_cells_as_one_by_one():
    draw = np.random.default_rng(4)
    xyz = np.concatenate([draw.uniform(-1, 1, (30_000, 3)) * [1, 1, 0.1], draw.normal(0, 9, (50, 3))]).astype(
        np.float32
    )
    found = PointPicker(xyz)
    assert len(found.starts) > 50
    answers = []
    for origin in draw.normal(0, 2, (60, 3)):
        direction = draw.uniform(-1, 1, 3) - origin
        direction /= np.linalg.norm(direction)
        spread = 10 ** draw.uniform(-3.5, -1.5)
        answers.append((found.hit(origin, direction, spread), hit_points(xyz, origin, direction, spread)))
    assert all((a is None) == (b is None) and (a is None or abs(a - b) < 1e-9) for a, b in answers)
    assert 15 < sum(a is not None for a, _ in answers) < 60
    assert PointPicker(xyz[:1]).hit(
        xyz[0] - np.array([0.0, 0.0, 2.0]), np.array([0.0, 0.0, 1.0]), 0.01
    ) == pytest.approx(2)
    far = np.zeros((500, 3), np.float32)
    far[-1] = 1e12
    assert PointPicker(far).hit(np.array([0.0, 0.0, -2.0]), np.array([0.0, 0.0, 1.0]), 0.01) == pytest.approx(2)
    assert PointPicker(np.zeros((5, 3), np.float32)).hit(np.ones(3), np.array([1.0, 0.0, 0.0]), 0.01) is None
