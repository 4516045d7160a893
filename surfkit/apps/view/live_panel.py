"""What all browsers that look at a training share: how far it is, curves, the pictures that it writes, the pause."""

from __future__ import annotations

import itertools
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from PIL import Image

from surfkit.apps.view.control import TrainingControl
from surfkit.apps.view.escape_text import as_text
from surfkit.apps.view.follow_journal import JournalFollower, StageHistory, journals, newest_pictures, running_blocks
from surfkit.runs.execute.block_state import BlockState
from surfkit.train.watch import Watched

if TYPE_CHECKING:
    import viser
    from viser import uplot

NEWEST = "what runs now"
STROKE_COLORS = (
    "#1f77b4",
    "#ff7f0e",
    "#2ca02c",
    "#d62728",
    "#9467bd",
    "#8c564b",
    "#e377c2",
    "#7f7f7f",
    "#bcbd22",
    "#17becf",
)
CHART_PX = 160
"""Height of a chart."""
PICTURE_PX = 1200
"""Width of a picture that the run has written."""
ELSEWHERE = "Other processes train these blocks: here are their losses, but no live picture, and no pause."
PAUSED = "\n\n**Paused.**"
OPAQUE_METHOD = "The method makes these steps on its own: here are its losses, but no live picture, and no pause."
FRESH_S = 30.0
"""Since the last step of a method that still makes some."""
NO_STEPS = "No step is made at the moment, so that there is no live picture, and nothing to pause."


class LivePanel:
    """Parts of the panel that are the same in every browser."""

    def __init__(self, gui: viser.GuiApi, control: TrainingControl) -> None:
        """Build them."""
        self.gui, self.control = gui, control
        self.followers: dict[Path, JournalFollower] = {}
        self.drawn: Path | None = None
        self.charts: dict[str, tuple[Any, tuple[str, ...]]] = {}
        self.picture_path: Path | None = None
        gui.configure_theme(show_share_button=False, show_logo=False)
        gui.main_panel.dock_right()
        self.failed: dict[str, str] = {}
        self.status = gui.add_markdown("The run begins.", order=0)
        self.failures = gui.add_markdown("", visible=False, order=0.5)
        self.button = gui.add_button("pause", visible=False, order=1)
        self.button.on_click(lambda _: self._toggle())
        self.of = gui.add_dropdown("curves of", (NEWEST,), order=3)  # 2: the live picture, of each browser
        self.curves = gui.add_folder("Curves", order=4)
        self.written = gui.add_folder("Last picture in progress/", order=5, expand_by_default=False, visible=False)
        with self.written:
            self.caption = gui.add_markdown("")
            self.image = gui.add_image(np.full((2, 3, 3), 255, np.uint8))

    def show(self, out: Path | None) -> None:
        """Bring everything up to date with a run folder, and with the stage that runs in this process."""
        stage = self.control.stage
        set_if_other(self.button, "visible", stage is not None)
        set_if_other(self.button, "label", "go on" if self.control.paused else "pause")
        if out is None:
            return
        found, running = journals(out), running_blocks(out)
        set_if_other(self.of, "options", (NEWEST, *sorted(found, key=found.__getitem__)))
        last = next(reversed(found), "")
        here = f"block {min(running)}" if running else last  # of many that run, the same one all the time
        now = stage.folder if stage is not None else found.get(here, out)
        chosen = found.get(self.of.value, now)
        self.followers = {folder: self.followers.get(folder) or JournalFollower(folder) for folder in (now, chosen)}
        fresh = {folder for folder, follower in self.followers.items() if follower.read()}
        if (chosen in fresh or chosen != self.drawn) and self.followers[chosen].history.rows:
            self._draw_curves(chosen)
        set_if_other(self.status, "content", in_words(self.followers[now].history, stage, running, self.control))
        self._show_written(out)

    def tell_failed(self, what: str, said: str) -> None:
        """Show why a part of the page fails; nothing when it does not any more."""
        self.failed[what] = f"{what}: {as_text(said)}" if said else ""
        text = "\n\n".join(filter(None, list(self.failed.values())))
        set_if_other(self.failures, "content", text)
        set_if_other(self.failures, "visible", bool(text))

    def _draw_curves(self, folder: Path) -> None:
        history, self.drawn = self.followers[folder].history, folder
        losses = history.losses()
        self._chart(0, "loss", losses.pop("step"), losses)
        rows = {"training": list(self.control.psnrs[folder]), "held-out": history.held_out}
        for place, (what, each) in enumerate(rows.items(), start=1):
            title = f"PSNR of {what} views, dB"
            if each:
                steps, values = np.array(each, np.float64).T
                self._chart(place, title, steps, {"dB": values})
            elif (old := self.charts.pop(title, None)) is not None:  # of another stage
                old[0].remove()

    def _chart(self, place: int, title: str, steps: np.ndarray, lines: dict[str, np.ndarray]) -> None:
        """Draw lines over steps; a chart with other lines is a new one, in the same place."""
        data, names = (steps, *lines.values()), tuple(lines)
        chart, before = self.charts.get(title, (None, ()))
        if chart is not None and before == names:
            chart.data = data
            return
        if chart is not None:
            chart.remove()
        strokes = itertools.cycle(STROKE_COLORS)
        series: list[uplot.Series] = [{"label": "step"}]
        series += [{"label": name, "stroke": next(strokes), "width": 2} for name in names]
        with self.curves:
            chart = self.gui.add_uplot(
                data,
                tuple(series),
                title=title,
                scales={"x": {"time": False}},
                legend={"show": len(names) > 1},
                height=CHART_PX,
                order=place,
            )
        self.charts[title] = chart, names

    def _show_written(self, out: Path) -> None:
        found = newest_pictures(out)
        if not found or found[0] == self.picture_path:
            return
        with Image.open(found[0]) as image:
            image.thumbnail((PICTURE_PX, PICTURE_PX))
            self.image.image = np.asarray(image.convert("RGB"))
        self.picture_path = found[0]
        self.caption.content = f"{as_text(found[0].relative_to(out))}: photograph, render, depth, normals"
        self.written.visible = True

    def _toggle(self) -> None:
        self.control.pause(not self.control.paused)
        set_if_other(self.button, "label", "go on" if self.control.paused else "pause")


def in_words(
    history: StageHistory, stage: Watched | None, running: dict[int, BlockState], control: TrainingControl
) -> str:
    """How far a run is, in Markdown."""
    if stage is not None:
        return f"**{as_text(stage.title)}** {numbers(history)}{PAUSED if control.paused else ''}"
    if running:
        rows = [f"- block {at}: step {state.step:,} of {state.steps:,}" for at, state in running.items()]
        return "\n".join([f"{ELSEWHERE}\n", *rows])
    if history.times and history.index < history.steps and time.time() - history.times[-1] < FRESH_S:
        return f"**{as_text(history.title)}** {numbers(history)}\n\n{OPAQUE_METHOD}"
    last = f"\n\n**{as_text(history.title)}** {numbers(history)}" if history.rows else ""
    return NO_STEPS + last


def numbers(history: StageHistory) -> str:
    """Step, points, speed and loss."""
    if not history.rows:
        return "begins"
    parts = [f"step {history.index:,} of {history.steps:,}"]
    parts += [f"{history.points:,} points"] * (history.points > 0)
    parts += [f"{speed:.1f} steps a second" for speed in [history.speed] if speed]
    return ", ".join([*parts, f"loss {sum(history.rows[-1][1].values()):.4f}"])


def set_if_other(part: Any, name: str, value: Any) -> None:
    """Set an attribute of a part of the panel; what is the same is not sent again."""
    if getattr(part, name) != value:
        setattr(part, name, value)
