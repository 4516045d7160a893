"""Pictures per second of `surfkit view` in a browser without a graphics card, as a user meets them.

    python bench/pace.py --size 3000000

A city of so many surfels, so many points, and a mesh of so many triangles are opened in Chromium without a screen, at
the settings of the program. The mouse turns them in drags with rests between; each picture that has the model in it is
counted. Chromium and Playwright are as in bench/view.py.
"""

from __future__ import annotations

import argparse
import math
import os
import shutil
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
from machine import save
from playwright.sync_api import Page, sync_playwright
from view import QUIET, RENDERER, SIZE, SOFTWARE, city

from surfkit.apps.view.server import Address, served
from surfkit.apps.view.viewer_page import show
from surfkit.apps.view.viewer_scene import ViewerPoints, ViewerScene
from surfkit.mesh.base import Mesh
from surfkit.scene.scene import Frame

COUNTING = """
window.drawn = [];
for (const [name, at] of [["drawElementsInstanced", 4], ["drawArrays", 2], ["drawElements", 1]]) {
  const plain = WebGL2RenderingContext.prototype[name];
  WebGL2RenderingContext.prototype[name] = function (...given) {
    if (given[at] > 3500) window.drawn.push([performance.now(), given[at]]);
    return plain.apply(this, given);
  };
}
"""
"""Times of the draw calls of the model, and how many splats, points or corners of triangles they have."""
DRAG_S, REST_S = 8.0, 6.0
FAST = 10.0
"""Pictures a second that the page is to have."""
SPEED = 40.0
"""Of the mouse, pixels a second."""


def subjects(size: int) -> dict[str, ViewerScene]:
    """What is looked at, by name."""
    table, frame, up = city(size), Frame(np.zeros(3), 1.0), np.array([0.0, 0.0, 1.0])
    rgb = (0.5 + 0.28 * table.sh0).clamp(0, 1).mul(255).byte().numpy()
    side = math.isqrt(size // 2) + 1
    x, y = np.meshgrid(*[np.linspace(-1, 1, side)] * 2)
    hills = np.stack([x, y, 0.1 * np.sin(40 * x) * np.cos(30 * y)], axis=-1).reshape(-1, 3).astype(np.float32)
    at = np.arange(side * side, dtype=np.int32).reshape(side, side)
    a, b, c, d = (corner.ravel() for corner in (at[:-1, :-1], at[:-1, 1:], at[1:, 1:], at[1:, :-1]))
    faces, shade = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)]), 128 + 900 * hills[:, 2:]
    mesh = Mesh(hills, faces, np.repeat(shade, 3, axis=1).astype(np.uint8))
    return {
        "splats": ViewerScene(Path("city"), frame, up, splats=table),
        "points": ViewerScene(Path("city"), frame, up, points=ViewerPoints(table.means.numpy(), rgb)),
        "mesh": ViewerScene(Path("hills"), frame, up, mesh=mesh),
    }


def opened(browser: Any, url: str) -> Page:
    """A page that counts its pictures from its beginning."""
    page = browser.new_page(viewport=SIZE)
    page.set_default_timeout(600_000)
    page.add_init_script(COUNTING)
    page.goto(url)
    return page


def drag(pages: list[Page], seconds: float) -> None:
    """Turn the model in all of them with the mouse."""
    begun = time.monotonic()
    for page in pages:
        page.mouse.move(300, 360)
        page.mouse.down()
    while (gone := time.monotonic() - begun) < seconds:
        for page in pages:
            page.mouse.move(300 + SPEED * gone, 360 + 30 * np.sin(6 * np.pi * gone / seconds))
        pages[0].wait_for_timeout(30)
    for page in pages:
        page.mouse.up()


def pictures(page: Page) -> tuple[np.ndarray, np.ndarray, float]:
    """(N,) times, seconds, and (N,) sizes of the pictures since the last call; and what time it is."""
    drawn, now = page.evaluate("[window.drawn.splice(0), performance.now()]")
    times, sizes = np.array(drawn, float).reshape(-1, 2).T
    return times / 1000, sizes.astype(int), now / 1000


def rate(times: np.ndarray, first: float, last: float) -> dict[str, Any]:
    """Of the pictures of a time."""
    gaps = np.diff([first, *times, last])
    return {"a second": round(len(times) / (last - first), 2), "longest gap, s": round(float(gaps.max()), 2)}


def dragged(pages: list[Page]) -> list[dict[str, Any]]:
    """A row for each page, of a drag and the rest after it."""
    firsts = [pictures(page)[2] for page in pages]
    drag(pages, DRAG_S)
    moving = [pictures(page) for page in pages]
    pages[0].wait_for_timeout(1000 * REST_S)
    resting = [pictures(page) for page in pages]
    rows = []
    for first, (times, sizes, last), (_, at_rest, _) in zip(firsts, moving, resting, strict=True):
        half = (first + last) / 2
        fast = [at - first for at, tenth in zip(times, times[int(FAST) :], strict=False) if tenth - at <= 1]
        rows.append(
            {
                "moving": rate(times, first, last),
                "second half": rate(times[times > half], half, last),
                "seconds until ten a second": round(fast[0], 1) if fast else None,
                "things while moving": int(sizes[-1]) if len(sizes) else None,
                "things at rest": int(at_rest[-1]) if len(at_rest) else None,
                "load of the machine": round(os.getloadavg()[0], 1),
            }
        )
    return rows


def first_picture(page: Page, begun: float) -> float:
    """Seconds until it is there."""
    page.wait_for_function("window.drawn.length > 1")  # the second begins when the first is done
    return round(time.monotonic() - begun, 1)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--size", type=int, default=3_000_000)
    parser.add_argument("--of", nargs="+", default=["splats", "points", "mesh"])
    parser.add_argument("--draw", default=None, help="as `surfkit view --draw`")
    parser.add_argument("--drags", type=int, default=4)
    parser.add_argument("--browsers", type=int, default=1)
    parser.add_argument("--pictures", type=Path, default=None, help="folder for what the page looks like")
    parser.add_argument("--name", default="pace", help="of the result")
    parser.add_argument("--chromium", default=shutil.which("chromium") or shutil.which("google-chrome"))
    asked = parser.parse_args()
    found: dict[str, Any] = {"size": asked.size, "window": [SIZE["width"], SIZE["height"]], "drawn as": asked.draw}
    all_of_them = subjects(asked.size)
    with tempfile.TemporaryDirectory() as folder, sync_playwright() as play:
        for name in asked.of:
            browsers = [
                play.chromium.launch(executable_path=asked.chromium, args=[*QUIET, *SOFTWARE])
                for _ in range(asked.browsers)
            ]
            with served(Address(), "bench") as page_of:
                show(all_of_them[name], page_of, Path(folder), **({"form": asked.draw} if asked.draw else {}))
                begun = time.monotonic()
                pages = [opened(browser, page_of.url) for browser in browsers]
                row: dict[str, Any] = {
                    "seconds until the first picture": [first_picture(each, begun) for each in pages]
                }
                row["drags"] = [dragged(pages) for _ in range(asked.drags)]
                row["webgl"] = pages[0].evaluate(RENDERER)
                if asked.pictures is not None:
                    asked.pictures.mkdir(parents=True, exist_ok=True)
                    for number, each in enumerate(pages):
                        each.screenshot(path=asked.pictures / f"{name}-{number}-rest.png")
            for browser in browsers:
                browser.close()
            found[name] = row
            print(name, row, flush=True)
            save(asked.name, found)
    return 0


if __name__ == "__main__":
    sys.exit(main())
