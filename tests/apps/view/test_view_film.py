"""Videos that the page makes of its camera path: what they show, stopping, going on, and what goes wrong."""

import threading
from contextlib import contextmanager

import numpy as np
import torch
from browser import Browser, wait_until
from needs import needs

from surfkit.apps.view.film import FilmTool
from surfkit.apps.view.server import Address, served
from surfkit.apps.view.viewer_page import show
from surfkit.apps.view.viewer_scene import ViewerPoints, ViewerScene
from surfkit.raster.api import Maps
from surfkit.scene.scene import Frame

FRAME = Frame(np.array([492_000.0, 5_260_000.0, 430.0]), 0.01, 1.0, "EPSG:32632")
CLOUD = ViewerPoints(np.eye(3, dtype=np.float32), np.zeros((3, 3), np.uint8))
FRAMES = 8


class Drawing:
    """Draws the height of the camera as a grey; waits before a frame if it is told to.

    Attributes:
        heights: That were drawn.
        hold_at: Number of the frame before which it waits.
        held: Set when it waits.
        go_on: For what.
        closing: Set when the server is about to end.
        error: To raise.
    """

    def __init__(self):
        self.heights, self.hold_at, self.error = [], None, None
        self.held, self.go_on, self.closing = threading.Event(), threading.Event(), None

    def __call__(self, view):
        if len(self.heights) == self.hold_at:
            self.held.set()
            assert self.go_on.wait()
        if self.error is not None:
            raise self.error
        camera = view.camera
        self.heights.append(float(camera.centre[2]))
        color = torch.full((3, camera.height, camera.width), self.heights[-1])
        return Maps(color=color)


@contextmanager
def path_on_page(drawing, folder):
    """A page with a path of 8 frames upwards, from 0.2 to 0.9 local units."""
    needs("viser"), needs("cv2")
    (folder / "a.ply").write_bytes(b"a model")
    subject = ViewerScene(folder / "a.ply", FRAME, np.array([0.0, 0.0, 1.0]), points=CLOUD, draw=drawing)
    with served(Address(), "test") as page:
        drawing.closing = page.closing
        show(subject, page, folder / "out")
        browser = Browser(page.url)
        browser.wait_for(Browser.is_whole)
        browser.set("frames a second", 10)
        browser.set("seconds", FRAMES / 10)
        browser.set("size", "640x360")
        for views, z in ((1, 2.0), (2, 9.0)):
            browser.stand(z)
            browser.press("add this view")
            browser.wait_for(lambda b, n=views: any(f"{n} key views" in t for t in b.texts()))
        yield browser
        browser.close()


def frames_of(video):
    cv2 = needs("cv2")
    reader, found = cv2.VideoCapture(str(video)), []
    while (read := reader.read())[0]:
        found.append(read[1])
    return found


def test_a_video_shows_the_path(tmp_path):
    drawing = Drawing()
    with path_on_page(drawing, tmp_path) as browser:
        browser.press("make the video")
        browser.wait_for(lambda b: any("path-color-640x360.mp4` is written" in t for t in b.texts()))
        browser.wait_for(lambda b: any(row.get("label") == "make the video" for row in b.gui.values()))
    assert np.allclose(drawing.heights, np.linspace(0.2, 0.9, FRAMES), atol=1e-6)
    frames = frames_of(tmp_path / "out" / "path-color-640x360.mp4")
    assert [frame.shape for frame in frames] == [(360, 640, 3)] * FRAMES
    assert np.allclose([frame.mean() / 255 for frame in frames], drawing.heights, atol=0.03)
    names = sorted(path.name for path in (tmp_path / "out").iterdir())
    assert names == ["path-color-640x360.mp4", "path.json"]


def test_it_stops_and_goes_on(tmp_path, monkeypatch):
    drawing, clicks, clicked = Drawing(), [], FilmTool._clicked
    drawing.hold_at = 3
    monkeypatch.setattr(FilmTool, "_clicked", lambda tool: clicks.append(clicked(tool)))
    with path_on_page(drawing, tmp_path) as browser:
        browser.press("make the video")
        wait_until(drawing.held.is_set)
        browser.wait_for(lambda b: any(row.get("label") == "stop" for row in b.gui.values()))
        browser.press("stop")
        wait_until(lambda: len(clicks) == 2)
        drawing.go_on.set()  # the frame that is drawn comes to its end
        browser.wait_for(lambda b: any("Stopped;" in t and "goes on." in t and "surfkit" not in t for t in b.texts()))
        out = tmp_path / "out"
        assert len(list((out / "path-color-640x360.mp4.frames").glob("*.png"))) == 4
        browser.press("make the video")
        browser.wait_for(lambda b: any("is written" in t for t in b.texts()))
        assert len(drawing.heights) == FRAMES, "each frame is drawn once"
        assert len(frames_of(out / "path-color-640x360.mp4")) == FRAMES
        browser.set("key views", "remove last")
        browser.wait_for(lambda b: "1 key views" in b.texts())
        browser.press("make the video")
        browser.wait_for(lambda b: any("two key views" in str(row) for row in b.told))
        assert sorted(path.suffix for path in out.iterdir()) == [".json", ".mp4"]


def test_the_server_ends_meanwhile(tmp_path, capsys):
    drawing = Drawing()
    drawing.hold_at = 2
    with path_on_page(drawing, tmp_path) as browser:
        drawing.go_on = drawing.closing
        browser.press("make the video")
        wait_until(drawing.held.is_set)
        thread = [each for each in threading.enumerate() if each.name == "video"][-1]
    thread.join()
    assert not thread.is_alive()
    assert len(drawing.heights) == 3 and not list((tmp_path / "out").glob("*.mp4"))
    said = capsys.readouterr().err
    assert said.count("\n") == 1 and "mp4 is not finished; the pictures so far are kept in" in said


def test_what_goes_wrong_is_said_on_the_page(tmp_path):
    drawing = Drawing()
    with path_on_page(drawing, tmp_path) as browser:
        browser.set("of", "normal")
        browser.press("make the video")
        browser.wait_for(lambda b: any("draws no normals" in t for t in b.texts()))
        drawing.error = RuntimeError("CUDA\nerror")
        browser.set("of", "color")
        browser.press("make the video")
        browser.wait_for(lambda b: "RuntimeError: CUDA error" in b.texts())
        assert not list((tmp_path / "out").glob("*.mp4"))
