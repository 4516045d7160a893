"""Frames per second that a browser draws of a large model on the page of `surfkit view`, while it orbits.

    python bench/view.py --splats 3000000 --budgets 3000000 1000000 200000

The model is a synthetic city of surfels. Chromium without a screen turns about it, as by a mouse that is dragged; each
draw call of the splats is counted. Without a GPU, WebGL is computed by the processor, and the result says so: that is
tens of times slower than any graphics card. Needs `pip install playwright` and a Chromium (--chromium).
"""

from __future__ import annotations

import argparse
import os
import shutil
import sys
import tempfile
import time
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import torch
from machine import save

from surfkit.apps.view.server import Address, served
from surfkit.apps.view.shared_cache import DEFAULT_BUDGET, SPLAT_FORMS
from surfkit.apps.view.viewer_page import show
from surfkit.apps.view.viewer_scene import ViewerScene
from surfkit.core.check import BadInput
from surfkit.core.optional import needed
from surfkit.io.splats.splat_table import SplatTable
from surfkit.scene.scene import Frame

SIZE = {"width": 1280, "height": 720}
SOFTWARE = ["--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist"]
QUIET = ["--no-sandbox", "--disable-background-networking", "--disable-sync", "--no-first-run"]
COUNTING = """
window.drawn = [];
for (const [name, at] of [["drawElementsInstanced", 4], ["drawArrays", 2]]) {
  const plain = WebGL2RenderingContext.prototype[name];
  WebGL2RenderingContext.prototype[name] = function (...given) {
    if (given[at] > 1000) window.drawn.push([performance.now(), given[at]]);
    return plain.apply(this, given);
  };
}
"""
"""Times of the draw calls of splats or points, and their number."""
RENDERER = """() => {
  const gl = document.createElement('canvas').getContext('webgl2');
  const told = gl.getExtension('WEBGL_debug_renderer_info');
  return gl.getParameter(told ? told.UNMASKED_RENDERER_WEBGL : gl.RENDERER);
}"""


def city(count: int) -> SplatTable:
    """Surfels on the ground and on the roofs and walls of a thousand houses."""
    draw = np.random.default_rng(0)
    places = draw.uniform(-1, 1, (count, 3))
    block = np.floor(places[:, :2] * 16).astype(int)
    height = np.random.default_rng(1).uniform(0.02, 0.2, (32, 32))[block[:, 0] + 16, block[:, 1] + 16]
    within = np.abs(places[:, :2] * 16 - block - 0.5).max(1)
    wall = (within > 0.34) & (within < 0.36)
    places[:, 2] = np.where(within < 0.35, height, 0.0)
    places[wall, 2] = draw.uniform(0, 1, wall.sum()) * height[wall]
    scale = 0.6 * np.sqrt(4 / count)
    normal = np.tile([1.0, 0.0, 0.0, 0.0], (count, 1)) + 0.1 * draw.normal(size=(count, 4))
    shade = 0.3 * draw.normal(size=(count, 3)) + (5 * height - 0.5)[:, None]
    return SplatTable(
        "surfel",
        torch.from_numpy(places).float(),
        torch.from_numpy(normal).float(),
        torch.from_numpy(np.log(scale) + 0.4 * draw.normal(size=(count, 2))).float(),
        torch.from_numpy(2 + draw.normal(size=count)).float(),
        torch.from_numpy(shade).float(),
        torch.zeros(count, 0, 3),
    )


def measured(browser: Any, url: str, form: str, budget: int, asked: argparse.Namespace) -> dict[str, Any]:
    """What a browser draws of `budget` splats, as splats or as points."""
    page = browser.new_page(viewport=SIZE)
    page.set_default_timeout(1000 * asked.patience)
    page.add_init_script(COUNTING)
    page.route("**/surfkit/pace?*", lambda route: route.abort())  # so that all of them are drawn: bench/pace.py
    begun = time.monotonic()
    page.goto(url)
    row = {"drawn as": form, "splats": budget, "load of the machine": round(os.getloadavg()[0], 1)}
    try:
        page.wait_for_function(f"window.drawn.filter(each => each[1] >= {int(0.99 * budget)}).length > 1")
    except Exception as error:
        if type(error).__name__ != "TimeoutError":
            raise
        return row | {"frames": 0, "seconds until drawn": f"more than {asked.patience:g}"}
    ready = time.monotonic() - begun
    page.mouse.move(400, 360)
    page.mouse.down()
    page.evaluate("window.drawn = []")
    first = page.evaluate("performance.now()")
    begun = time.monotonic()
    while (gone := time.monotonic() - begun) < asked.seconds:
        turned = gone / asked.seconds
        page.mouse.move(400 + 400 * turned, 360 + 30 * np.sin(20 * turned))
        page.wait_for_timeout(30)
    times = np.array(page.evaluate("window.drawn.map(each => each[0])"))
    last = page.evaluate("performance.now()")
    page.mouse.up()
    gaps = np.diff([first, *times, last]) / 1000
    renderer = page.evaluate(RENDERER)
    return row | {
        "seconds until drawn": round(ready, 1),
        "frames": len(times),
        "frames per second": round(1000 * len(times) / (last - first), 2),
        "longest gap, s": round(float(gaps.max()), 2),
        "webgl": renderer,
    }


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--splats", type=int, default=3_000_000)
    parser.add_argument("--budgets", type=int, nargs="+", default=[3_000_000, DEFAULT_BUDGET, 200_000])
    parser.add_argument("--seconds", type=float, default=30.0, help="of turning, for each budget")
    parser.add_argument("--patience", type=float, default=300.0, help="seconds to wait for the first frame")
    parser.add_argument("--chromium", default=shutil.which("chromium") or shutil.which("google-chrome"))
    parser.add_argument("--gpu", action="store_true", help="let the browser use the graphics card")
    asked = parser.parse_args()
    try:
        with needed("playwright", "bench/view.py"):
            from playwright.sync_api import sync_playwright
    except BadInput as error:
        print(error, file=sys.stderr)
        return 2
    if not asked.chromium:
        print("bench/view.py needs a Chromium; name one with --chromium", file=sys.stderr)
        return 2
    subject = ViewerScene(Path("city"), Frame(np.zeros(3), 1.0), np.array([0.0, 0.0, 1.0]), splats=city(asked.splats))
    rows = []
    arguments = [*QUIET, *([] if asked.gpu else SOFTWARE)]
    with tempfile.TemporaryDirectory() as folder, sync_playwright() as play:
        for form, budget in product(SPLAT_FORMS, sorted(asked.budgets)):
            browser = play.chromium.launch(executable_path=asked.chromium, args=arguments)
            with served(Address(), "bench") as page:
                show(subject, page, Path(folder), budget, form)
                rows.append(measured(browser, page.url, form, min(budget, asked.splats), asked))
            browser.close()
            print(rows[-1], flush=True)
            save("view", {"splats": asked.splats, "window": [SIZE["width"], SIZE["height"]], "rows": rows})
    return 0


if __name__ == "__main__":
    sys.exit(main())
