"""The page of splats: it loads nothing, its data are those of the splats, and its script decodes and sorts them."""

import base64
import gzip
import json
import re
import shutil
import subprocess
from dataclasses import replace
from html.parser import HTMLParser

import numpy as np
import pytest
import torch

from surfkit.core.check import BadInput
from surfkit.export.page import Page
from surfkit.run.notes import collect_notes
from surfkit.scene.camera import Camera
from surfkit.scene.scene import Frame, View
from surfkit.testing.files import splat_table

from .models import turned

NODE = shutil.which("node")
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
    Page(sh_degree=degree).write(tmp_path / "a.html", table)
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
    Page().write_seen(path, splat_table(count=9), Frame(np.zeros(3), 1.0), [view], None)
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
    Page().write_seen(tmp_path / "a.html", local.in_input_frame(frame), frame, views, np.array([0.0, 0.0, 1.0]))
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


def test_of_many_splats_those_are_kept_of_which_most_is_seen(tmp_path):
    table = splat_table(count=50)
    with collect_notes() as notes:
        Page(max_splats=20).write(tmp_path / "a.html", table)
    radii = np.sort(table.log_scales.exp().numpy(), axis=1)
    shown = radii[:, 1] * radii[:, 2] * table.opacity_logits.sigmoid().numpy()
    means = decoded(tmp_path / "a.html")[0]
    near = torch.cdist(torch.from_numpy(means), table.means.double()).argmin(1).tolist()
    assert sorted(near) == sorted(np.argsort(-shown)[:20].tolist())
    assert "the 20 of 50 splats are kept of which most is seen; --format.max-splats keeps more" in notes.texts[0]
    assert facts_of(tmp_path / "a.html")["told"] == "20 splats of 50"
    with pytest.raises(BadInput, match="max_splats"):
        Page(max_splats=0)


@pytest.mark.skipif(NODE is None, reason="node is not installed")
def test_the_script_decodes_and_sorts(tmp_path):
    """In node, as far as it needs no browser: texels word by word, and the order of the worker."""
    table = splat_table(count=300, degree=1)
    Page().write(tmp_path / "a.html", table)
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
