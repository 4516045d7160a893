"""The page of splats: it loads nothing, its data are those of the splats, and its script decodes and sorts them."""

import base64
import gzip
import io
import itertools
import json
import math
import re
import shutil
import subprocess
import threading
import urllib.request
from dataclasses import replace
from html.parser import HTMLParser

import numpy as np
import pytest
import torch
from needs import needs
from PIL import Image

from surfkit.core.check import BadInput
from surfkit.io.splats.page import HtmlPageFormat
from surfkit.raster.api import Splats
from surfkit.raster.reference import draw
from surfkit.runs.run_notes import collect_notes
from surfkit.scene.camera import Camera
from surfkit.scene.scene import Frame, View
from surfkit.testing.format_checks import splat_table

from .models import turned

NODE = shutil.which("node")
BROWSER = shutil.which("chromium") or shutil.which("google-chrome")
TYPE = {"type": ""}


class Elements(HTMLParser):
    """Tags with their attributes, and the text of each, as a browser finds them."""

    def __init__(self, text):
        super().__init__()
        self.found, self.is_open = [], False
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        self.found.append((tag, dict(attrs), []))
        self.is_open = True

    def handle_endtag(self, tag):
        self.is_open = False

    def handle_data(self, data):
        if self.is_open:
            self.found[-1][2].append(data)

    def text(self, tag, **attributes):
        """Of the one element that has these attributes and no others but a type."""
        wanted = {**attributes, **TYPE}
        (found,) = [text for name, there, text in self.found if name == tag and {**there, **TYPE} == wanted]
        return "".join(found)


def facts_of(path):
    return json.loads(Elements(path.read_text()).text("script", id="facts"))


def decoded(path):
    """Means in the input, log scales, quaternions wxyz, opacities, degree 0 and the rest, float64, by spz's README."""
    page, facts = Elements(path.read_text()), facts_of(path)
    data = np.frombuffer(gzip.decompress(base64.b64decode(page.text("script", id="splats"))), np.uint8)
    assert bytes(data[:4]) == b"NGSP" and data[4] == 3
    count, degree, bits = int(data[8:12].view("<u4")[0]), int(data[12]), int(data[13])
    widths = [9, 1, 3, 3, 4, 3 * ((degree + 1) ** 2 - 1)]
    ends = 16 + count * np.cumsum([0, *widths])
    assert ends[-1] == len(data)
    parts = [data[a:b].reshape(count, w) for a, b, w in zip(ends[:-1], ends[1:], widths, strict=True)]
    low, middle, high = np.moveaxis(parts[0].reshape(count, 3, 3).astype(int), 2, 0)
    fixed = low + 256 * middle + 65536 * high
    means = (fixed - (fixed >= 2**23) * 2**24) / 2.0**bits * facts["unit"] + facts["centre"]
    scales = parts[3] / 16 - 10 + np.log(facts["unit"])
    words = np.ascontiguousarray(parts[4]).view("<u4")[:, 0].astype(np.int64)
    quats = np.zeros((count, 4))
    for row, word in enumerate(words):
        three = [((word >> at & 511) / 511) * 2**-0.5 * (-1 if word >> at & 512 else 1) for at in (20, 10, 0)]
        xyzw = three[:]
        xyzw.insert(word >> 30, max(0.0, 1 - sum(value**2 for value in three)) ** 0.5)
        quats[row] = np.roll(xyzw, 1)
    rest = (parts[5].astype(float) - 128) / 128
    return means, scales, quats, parts[1][:, 0] / 255, (parts[2] / 255 - 0.5) / 0.15, rest.reshape(count, -1, 3)


@pytest.mark.parametrize("degree", [0, 1])
@pytest.mark.parametrize("kind", ["gaussian", "surfel"])
def test_the_data_are_those_of_the_splats(tmp_path, kind, degree):
    far = torch.tensor([512_345.0, 5_678_901.0, 123.0], dtype=torch.float64)
    table = splat_table(kind, 200, 3)
    table = replace(table, means=table.means.double() * 37 + far, log_scales=table.log_scales + np.log(37))
    HtmlPageFormat(sh_degree=degree).write(tmp_path / "a.html", table)
    means, scales, quats, opacities, sh0, rest = decoded(tmp_path / "a.html")
    near = torch.cdist(table.means - far, torch.from_numpy(means) - far).argmin(1)
    assert sorted(near.tolist()) == list(range(200))
    radius = np.exp(np.median(table.log_scales[:, :2]))
    assert np.abs(means[near] - table.means.numpy()).max() < radius / 64
    wide = table.ellipsoid_log_scales().numpy()
    apart = np.abs(scales[near] - wide)
    assert apart[:, :2].max() <= 1 / 32 + 1e-6 and (kind == "surfel" or apart.max() <= 1 / 32 + 1e-6)
    assert kind == "gaussian" or (scales[near][:, 2] < scales[near][:, :2].min(1) - 3).all(), "discs are flat"
    shapes = turned(torch.from_numpy(quats[near])) - turned(table.quats.double())
    assert float(shapes.abs().max()) < 4 / 511
    assert np.abs(opacities[near] - table.opacity_logits.sigmoid().numpy()).max() <= 0.5 / 255 + 1e-6
    assert np.abs(sh0[near] - table.sh0.numpy()).max() <= 0.5 / 255 / 0.15 + 1e-6
    assert rest.shape[1] == (3 if degree else 0)
    if degree:
        assert np.abs(rest[near] - table.sh_rest[:, :3].numpy()).max() <= 4 / 128 + 1 / 256 + 1e-6


def test_it_loads_nothing_and_names_are_text(tmp_path):
    path = tmp_path / '<b>A & "B"<script>alert(1)<script>.html'
    pose = torch.eye(4, dtype=torch.float64)
    camera = Camera(pose, 50.0, 50.0, 20.0, 15.0, 40, 30)
    view = View("</script><img src=x onerror=alert(1)>.jpg", camera, tmp_path / "none")
    HtmlPageFormat().write_seen(path, splat_table(count=9), Frame(np.zeros(3), 1.0), [view], None)
    text = path.read_text()
    page = Elements(text)
    tags = [tag for tag, _, _ in page.found]
    assert not {"img", "link", "iframe", "base", "object", "b"} & set(tags) and tags.count("script") == 3
    assert (
        tags.count("title") == 1
        and page.text("title") == path.stem == page.found[tags.index("canvas")][1]["aria-label"]
    )
    for _, attributes, _ in page.found:
        assert not {"src", "href", "srcset", "data", "action"} & set(attributes)
    assert not re.search(r"https?:|//[a-z]+\.|@import|url\(|\bfetch\b|XMLHttpRequest|WebSocket|innerHTML", text)
    (policy,) = [at["content"] for tag, at, _ in page.found if at.get("http-equiv") == "Content-Security-Policy"]
    assert policy.startswith("default-src 'none'; ")
    assert facts_of(path)["views"][0]["name"] == view.name


def test_views_are_those_of_the_cameras(tmp_path):
    """The page projects splats to the pixels to which the cameras do, by facts alone."""
    frame = Frame(np.array([500_000.0, 5_600_000.0, 80.0]), 0.02, 1.0, "EPSG:32632", (500_000.0, 5_600_000.0, 0.0))
    local = splat_table(count=60, degree=0)
    local = replace(local, means=local.means * 0.3)
    views = []
    for at, name in enumerate(("away", "seen")):
        pose = torch.eye(4, dtype=torch.float64)
        angle = 0.7 + np.pi * (at == 0)
        pose[:3, :3] = torch.tensor(
            [[np.cos(angle), 0, -np.sin(angle)], [0, 1, 0], [np.sin(angle), 0, np.cos(angle)]], dtype=torch.float64
        )
        pose[:3, 3] = torch.tensor([0.1, -0.2, 3.0 if at else -3.0])
        views.append(View(name, Camera(pose, 80.0, 80.0, 40.0, 30.0, 80, 60), tmp_path / name))
    HtmlPageFormat().write_seen(
        tmp_path / "a.html", local.in_input_frame(frame), frame, views, np.array([0.0, 0.0, 1.0])
    )
    facts = facts_of(tmp_path / "a.html")
    assert [view["name"] for view in facts["views"]] == ["away", "seen"] and facts["start"] == 1
    assert facts["up"] == [0, 0, 1]
    seen, camera = facts["views"][1], views[1].camera
    means = local.in_input_frame(frame).means.numpy()
    there = ((means - facts["centre"]) / facts["unit"] - seen["eye"]) @ np.reshape(seen["turn"], (3, 3)).T
    pixels = there[:, :2] / there[:, 2:] * seen["focal"] * 60 + [seen["aspect"] * 60 / 2, 30]
    x, y, z = camera.project(local.means).numpy().T
    np.testing.assert_allclose(pixels, np.stack([x, y], 1), atol=1e-5)
    depth = there[:, 2] * facts["unit"] * frame.scale
    np.testing.assert_allclose(depth, z, rtol=1e-9)
    assert seen["away"] * facts["unit"] * frame.scale == pytest.approx(float(np.median(z)), rel=0.2)


def test_it_does_not_begin_at_the_rim(tmp_path):
    """Where half a picture is empty, though all splats are in it."""
    side = torch.linspace(-1, 1, 40, dtype=torch.float64)
    means = torch.cartesian_prod(side, side, torch.zeros(1, dtype=torch.float64))
    table = splat_table(count=1600, degree=0)
    views = []
    for name, x in (("rim", 3.0), ("middle", 0.0)):
        pose = torch.eye(4, dtype=torch.float64)
        pose[:3, 3] = torch.tensor([x, 0.0, 4.0 if x else 1.8])  # from the middle, not all are seen
        views.append(View(name, Camera(pose, 40.0, 40.0, 40.0, 20.0, 80, 40), tmp_path / name))
    HtmlPageFormat().write_seen(tmp_path / "a.html", replace(table, means=means), Frame(np.zeros(3), 1.0), views, None)
    facts = facts_of(tmp_path / "a.html")
    assert facts["views"][facts["start"]]["name"] == "middle"
    back = np.array([0.0, 0.0, 1.0])  # the middle looks up then
    HtmlPageFormat().write_seen(tmp_path / "a.html", replace(table, means=means), Frame(np.zeros(3), 1.0), views, back)
    assert facts_of(tmp_path / "a.html")["start"] == 1, "both look the same way"
    level = views[0].camera.world_to_camera.clone()
    level[:3, :3] = torch.tensor([[0.0, 1.0, 0.0], [0.0, 0.0, -1.0], [-1.0, 0.0, 0.0]])
    level[:3, 3] = torch.tensor([0.0, 0.0, 3.0])
    views = [views[1], replace(views[0], camera=replace(views[0].camera, world_to_camera=level))]
    HtmlPageFormat().write_seen(tmp_path / "a.html", replace(table, means=means), Frame(np.zeros(3), 1.0), views, back)
    assert facts_of(tmp_path / "a.html")["start"] == 1, "not at the ceiling"


def test_of_many_splats_those_are_kept_of_which_most_is_seen(tmp_path):
    table = splat_table(count=50)
    with collect_notes() as notes:
        HtmlPageFormat(max_splats=20).write(tmp_path / "a.html", table)
    radii = np.sort(table.log_scales.exp().numpy(), axis=1)
    shown = radii[:, 1] * radii[:, 2] * table.opacity_logits.sigmoid().numpy()
    means = decoded(tmp_path / "a.html")[0]
    near = torch.cdist(torch.from_numpy(means), table.means.double()).argmin(1).tolist()
    assert sorted(near) == sorted(np.argsort(-shown)[:20].tolist())
    assert "20 of 50 splats" in notes.texts[0] and "--format.max-splats" in notes.texts[0]
    assert facts_of(tmp_path / "a.html")["told"] == "20 splats of 50"
    with pytest.raises(BadInput, match="max_splats"):
        HtmlPageFormat(max_splats=0)


@pytest.mark.skipif(NODE is None, reason="node is not installed")
def test_the_script_decodes_and_sorts(tmp_path):
    """In node, as far as it needs no browser: texels word by word, and the order of the worker."""
    table = splat_table(count=300, degree=1)
    HtmlPageFormat().write(tmp_path / "a.html", table)
    page = Elements(tmp_path.joinpath("a.html").read_text())
    (tmp_path / "page.js").write_text(page.text("script"))
    (tmp_path / "splats.txt").write_text(page.text("script", id="splats"))
    (tmp_path / "run.js").write_text(
        """
        const fs = require("fs"), vm = require("vm"), told = {};
        globalThis.window = globalThis;
        globalThis.onmessage = null;
        globalThis.document = {
          getElementById: (id) => (id === "facts" ? { textContent: "{}" } : told),
          querySelector: () => ({ getContext: () => null }),
        };
        vm.runInThisContext(fs.readFileSync("page.js", "utf8"));
        vm.runInThisContext("globalThis.parts = { unpacked, decoded, sorter, about }");
        parts.unpacked(fs.readFileSync("splats.txt", "utf8")).then((data) => {
          const { xyz, words, grain, count } = parts.decoded(data);
          globalThis.postMessage = (order) => {
            const turn = parts.about([0, 0, 1], Math.PI / 2);
            const found = { xyz: [...xyz], words: [...words.slice(0, 8 * count)], grain, order: [...order], turn };
            console.log(JSON.stringify({ ...found, told: told.textContent }));
          };
          parts.sorter();
          globalThis.onmessage({ data: { xyz } });
          globalThis.onmessage({ data: { forward: [0.6, 0, 0.8], offset: 3, near: 0.05 } });
        });
        """
    )
    done = subprocess.run([NODE, "run.js"], cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    found, facts = json.loads(done.stdout), facts_of(tmp_path / "a.html")
    assert "too old: WebGL 2" in found["told"], "a browser that cannot is told"
    means, scales, quats, opacities, sh0, rest = decoded(tmp_path / "a.html")
    xyz = np.reshape(found["xyz"], (-1, 3))
    np.testing.assert_allclose(xyz * facts["unit"] + facts["centre"], means, atol=1e-5)
    words = np.array(found["words"], np.uint32).reshape(-1, 8)
    np.testing.assert_allclose(words[:, :3].astype(np.int32) * found["grain"], xyz, atol=1e-6)
    texels = words[:, 3:].copy().view(np.uint8).reshape(-1, 20)
    np.testing.assert_allclose((texels[:, :3] / 255 - 0.5) / 0.15, sh0)
    np.testing.assert_allclose(texels[:, 3] / 255, opacities)
    np.testing.assert_allclose(texels[:, 8:11] / 16 - 10 + np.log(facts["unit"]), scales)
    coefficients = np.concatenate([texels[:, 12:20], texels[:, 11:12]], 1)
    np.testing.assert_allclose((coefficients.astype(float) - 128) / 128, rest.reshape(-1, 9))
    depths = xyz @ [0.6, 0, 0.8] - 3
    assert sorted(found["order"]) == np.flatnonzero(depths >= 0.05).tolist() and len(found["order"]) > 50
    assert (np.diff(depths[found["order"]]) <= 1e-4).all(), "the farthest first"
    np.testing.assert_allclose(np.reshape(found["turn"], (3, 3)) @ [1, 0, 0], [0, 1, 0], atol=1e-12)


@pytest.fixture(scope="module")
def shown(tmp_path_factory):
    """Draws a page in Chromium without a GPU: a file to its picture, (H, W, 3) float64 of 0 to 1."""
    connect = needs("websockets.sync.client", "a websocket client").connect
    home = tmp_path_factory.mktemp("browser")
    flags = ["--headless", "--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
    flags += ["--remote-debugging-port=0", f"--user-data-dir={home}", "about:blank"]
    started = subprocess.Popen([BROWSER, *flags], stderr=subprocess.PIPE, text=True)
    address = next(line for line in started.stderr if "DevTools listening" in line).split()[-1]
    threading.Thread(target=started.stderr.read, daemon=True).start()
    base = address.replace("ws://", "http://").partition("/devtools")[0]
    with urllib.request.urlopen(f"{base}/json") as answer:
        (tab,) = [each["webSocketDebuggerUrl"] for each in json.load(answer) if each["type"] == "page"]
    with connect(tab, max_size=None) as socket:

        def call(method, **given):
            socket.send(json.dumps({"id": (number := next(numbers)), "method": method, "params": given}))
            while (said := json.loads(socket.recv())).get("id") != number:
                pass
            return said["result"]

        def show(path, width, height):
            call("Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=1, mobile=False)
            call("Page.navigate", url=path.as_uri())
            drawn = "document.body && document.body.dataset.state === 'drawn'"
            while not call("Runtime.evaluate", expression=drawn)["result"].get("value"):
                pass
            hide = "for (const name of ['told', 'more']) document.getElementById(name).hidden = true"
            call("Runtime.evaluate", expression=f"{hide}; new Promise(requestAnimationFrame)", awaitPromise=True)
            data = base64.b64decode(call("Page.captureScreenshot", format="png")["data"])
            return np.asarray(Image.open(io.BytesIO(data)).convert("RGB")) / 255

        numbers = itertools.count()
        yield show
        call("Browser.close")
    started.wait()


@pytest.mark.skipif(BROWSER is None, reason="chromium is not installed")
@pytest.mark.parametrize("kind", ["gaussian", "surfel"])
def test_the_page_draws_what_the_rasterizer_draws(tmp_path, kind, shown):
    """Large splats too, beside the picture and before it: to first order, a disc spreads where it is not."""
    table = splat_table(kind, 300, 1)
    draws = torch.Generator().manual_seed(3)
    means = torch.randn(300, 3, generator=draws) * 0.7
    scales = torch.full_like(table.log_scales, math.log(0.06)) + 0.3 * torch.randn(
        table.log_scales.shape, generator=draws
    )
    if kind == "surfel":
        means[:4] = torch.tensor([[1.2, -0.9, -1.3], [-1.0, 0.8, -1.0], [0.9, 1.1, 0.4], [-1.3, -0.9, 1.0]])
        scales[:4] = math.log(0.4)
    table = replace(table, means=means, log_scales=scales)
    pose = torch.eye(4, dtype=torch.float64)
    pose[2, 3] = 3.0
    camera = Camera(pose, 90.0, 90.0, 60.0, 45.0, 120, 90)
    views = [View("a", camera, tmp_path / "a.png")]
    HtmlPageFormat().write_seen(tmp_path / "a.html", table, Frame(np.zeros(3), 1.0), views, None)
    opacities = table.opacity_logits.sigmoid()
    splats = Splats(kind, means, table.quats, scales.exp(), opacities, table.sh0[:, None], table.sh_rest)
    expected = draw(splats, camera, 1e-3).maps.color.clamp(0, 1).permute(1, 2, 0).double().numpy()
    off = shown(tmp_path / "a.html", 120, 90) - expected
    assert expected.std() > 0.1 and 10 * np.log10(1 / (off**2).mean()) > 42
