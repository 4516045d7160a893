"""What browsers that look at one subject share: what takes long is made once, and one of them draws at a time."""

from __future__ import annotations

import math
import shlex
import threading
from dataclasses import replace
from functools import cached_property, lru_cache
from typing import Literal, get_args

import numpy as np
import torch

from surfkit.apps.view.browser_geometry import (
    BrowserSplats,
    Colors,
    by_block,
    by_height,
    by_normal,
    drawn,
    fewer_faces,
    height_bounds,
    level_within,
    normals_of,
    unit_of,
)
from surfkit.apps.view.escape_text import as_code
from surfkit.apps.view.lod_selection import ChosenSplats, LodCamera, LodSplats, SampledPoints, SampledSplats
from surfkit.apps.view.picking import PointPicker, TrianglePicker, hit_splats
from surfkit.apps.view.viewer_scene import ViewerScene
from surfkit.io.splats.splat_table import SplatTable
from surfkit.mesh.base import LENGTHS, Mesh
from surfkit.mesh.value_colors import by_value, ends_of, words_of
from surfkit.raster.api import Maps
from surfkit.scene.lengths import unit_of as length_unit
from surfkit.scene.scene import View
from surfkit.scene.up_direction import map_axes

Form = Literal["splats", "points", "points-while-moving"]
SPLAT_FORMS: tuple[Form, ...] = get_args(Form)
DEFAULT_BUDGET = 1_000_000
CONE = 0.004
"""Radius, at distance 1, of the cone in which a click finds a point: four pixels of a window, about."""
MAX_POINT_ENLARGEMENT = 4.0
"""Points that stand for others are larger by no more than this: else they hide what is near them."""
CACHED_CHOICES = 2
"""Choices of splats, and of triangles, that are kept: that of now and that of before."""


class SharedCache:
    """A subject, and what has been made of it.

    Attributes:
        subject: What is looked at.
        axes: (3, 3) east, north and up in rows, local frame.
        heights: What the ends of the colours of heights are, local units along up.
        most: Splats, triangles and points that are sent to a browser, unless its user moves a slider.
        form: How splats are drawn, unless its user chooses another way; None: as points in browsers without a graphics
            card, and as splats in others.
    """

    def __init__(self, subject: ViewerScene, most: int = DEFAULT_BUDGET, form: Form | None = None) -> None:
        """Nothing is made yet."""
        self.subject, self.most, self.form = subject, most, form
        self.axes = map_axes(subject.up)
        self.heights = height_bounds(subject.positions() @ subject.up)
        self.drawing, self.making = threading.Lock(), threading.RLock()
        self._triangles: TrianglePicker | None = None
        self._places: PointPicker | None = None
        self._splats = lru_cache(CACHED_CHOICES)(self._choose_splats)
        self._mesh = lru_cache(CACHED_CHOICES)(self._choose_mesh)
        self._ends = lru_cache(CACHED_CHOICES)(self._ends_of)

    @property
    def size(self) -> int:
        """Splats, triangles or points of the subject: of what there is most."""
        splats, mesh, points = self.subject.splats, self.subject.mesh, self.subject.points
        return max(
            0 if splats is None else len(splats),
            0 if mesh is None else len(mesh.faces),
            0 if points is None else len(points.xyz),
        )

    @property
    def colors(self) -> tuple[Colors, ...]:
        """How splats can be coloured."""
        plan: tuple[Colors, ...] = ("block",) if self.subject.plan is not None else ()
        return ("as trained", "height", "normal", *plan)

    def splats(self, budget: int, colors: Colors) -> tuple[BrowserSplats, str]:
        """At most `budget` splats, and a line that says which."""
        with self.making:
            return self._splats(budget, colors)

    def mesh(self, budget: int) -> Mesh:
        """The mesh with at most `budget` triangles."""
        with self.making:
            return self._mesh(budget)

    def mesh_by(self, value: str, budget: int) -> tuple[Mesh, str]:
        """The mesh with at most `budget` triangles, coloured by one of its values, and a line that says the scale."""
        frame, mesh = self.subject.frame, self.mesh(budget)
        ends = self._ends(value)
        shown = (ends[0] / frame.scale, ends[1] / frame.scale) if value in LENGTHS else ends
        painted = replace(mesh, colors=by_value(value, mesh.values[value], ends))
        return painted, words_of(value, shown, length_unit(frame))

    def _ends_of(self, value: str) -> tuple[float, float]:
        assert self.subject.mesh is not None
        return ends_of(value, self.subject.mesh.values[value])

    @property
    def triangles(self) -> TrianglePicker:
        """Of the whole mesh, for clicks."""
        with self.making:
            if self._triangles is None:
                mesh = self.subject.mesh
                assert mesh is not None
                self._triangles = TrianglePicker(mesh.vertices, mesh.faces)
            return self._triangles

    @property
    def places(self) -> PointPicker:
        """Of all points, for clicks."""
        with self.making:
            if self._places is None:
                points = self.subject.points
                self._places = PointPicker(points.xyz if points is not None else self.subject.positions())
            return self._places

    def prepare(self) -> None:
        """Make what takes long at the first click."""
        if self.subject.mesh is not None:
            _ = self.triangles
        elif self.subject.draw is None:
            _ = self.places

    def forget_choices(self) -> None:
        """Let go of what was chosen for browsers; it is chosen again when one comes."""
        with self.making:
            self._splats.cache_clear()
            self._mesh.cache_clear()

    def draw(self, view: View) -> Maps:
        """Maps of a view."""
        assert self.subject.draw is not None
        with self.drawing:
            return self.subject.draw(view)

    def pick(self, origin: np.ndarray, direction: np.ndarray, *, mesh: bool) -> np.ndarray | None:
        """(3,) local place that a ray meets: on the mesh if that is wanted and there, else on the splats, else a point.

        Args:
            origin: (3,) local.
            direction: (3,) unit vector.
            mesh: Whether the mesh is looked at.
        """
        subject = self.subject
        if subject.mesh is not None and (mesh or subject.draw is None):
            along = self.triangles.hit(origin, direction)
        elif subject.draw is not None:
            with self.drawing:
                along = hit_splats(subject.draw, origin, direction)
        else:
            along = self.places.hit(origin, direction, CONE)
        return None if along is None else origin + along * direction

    def _choose_mesh(self, budget: int) -> Mesh:
        assert self.subject.mesh is not None
        return fewer_faces(self.subject.mesh, budget)

    def _choose_splats(self, budget: int, colors: Colors) -> tuple[BrowserSplats, str]:
        table, told = self.within(budget)
        return self.drawn(table, colors), told

    def drawn(self, table: SplatTable, colors: Colors) -> BrowserSplats:
        """Splats of the model, or such as stand for them, in the colours that are asked for."""
        return drawn(table, self.painted(table, colors), self.unit)

    def within(self, budget: int) -> tuple[SplatTable, str]:
        """At most `budget` splats: the finest level of detail that has no more, or what a lot has chosen."""
        table, levels = self.subject.splats, self.subject.levels
        assert table is not None
        if len(table) <= budget:
            return table, f"all {len(table):,} splats are shown"
        number = level_within(levels, budget) if levels is not None else None
        if levels is not None and number is not None:
            level = levels.levels[number]
            coarse = level.primitive.table(level.params).on_cpu()
            return coarse, f"{len(coarse):,} splats of level of detail {number} stand for {len(table):,}"
        chosen = self.lot.choose(budget).table
        return chosen, f"{len(chosen):,} splats, drawn by lot and enlarged, stand for {len(table):,}{self._remedy()}"

    def for_eye(self, budget: int, eye: LodCamera) -> tuple[ChosenSplats, str]:
        """At most `budget` splats for one camera, of a model that has more; and a line that says which."""
        table = self.subject.splats
        assert table is not None
        with self.making:
            found = self.levels.choose(budget, eye) if self.levels is not None else None
            if found is not None:
                told = f"{len(found):,} splats of all levels of detail stand for {len(table):,}"
            else:
                found = self.lot.choose(budget, eye)
                told = f"{len(found):,} splats, drawn by lot and enlarged, stand for {len(table):,}"
        return found, f"{told}: fine where you are, coarse far away, few beside the picture{self._remedy()}"

    def points_for_eye(self, budget: int, eye: LodCamera) -> tuple[np.ndarray, float]:
        """(n,) rows of `budget` of the points, of which there are more, for one camera.

        Also how many times larger they are drawn, so that they stand for the others; not more than LARGER.
        """
        with self.making:
            rows, raised = self.point_lot.rows(budget, eye)
        return rows.numpy(), min(math.exp(float(raised.median()) / 2), MAX_POINT_ENLARGEMENT)

    def _remedy(self) -> str:
        """How to get levels of detail, for a run that has none."""
        if self.subject.levels is not None or self.subject.scene is None:
            return ""
        command = as_code(f"surfkit lod {shlex.quote(str(self.subject.path))}")
        return f". {command} makes levels of detail, which look better"

    @cached_property
    def levels(self) -> LodSplats | None:
        """Of the model, where it has some."""
        return LodSplats(self.subject.levels) if self.subject.levels is not None else None

    @cached_property
    def lot(self) -> SampledSplats:
        """Of the model."""
        assert self.subject.splats is not None
        return SampledSplats(self.subject.splats)

    @cached_property
    def point_lot(self) -> SampledPoints:
        """Of the points."""
        assert self.subject.points is not None
        return SampledPoints(torch.from_numpy(self.subject.points.xyz))

    @cached_property
    def unit(self) -> float:
        """Of covariances: the same for all choices, so that one can take the place of another."""
        assert self.subject.splats is not None
        return unit_of(self.subject.splats)

    def painted(self, table: SplatTable, colors: Colors) -> np.ndarray | None:
        """(N, 3) uint8; None for the colours of training."""
        up = self.subject.up
        if colors == "height":
            return by_height(table.means.numpy() @ up, self.heights)
        if colors == "normal":
            return by_normal(normals_of(table, up), self.axes)
        if colors == "block" and self.subject.plan is not None:
            return by_block(self.subject.plan.cells.owner(table.means).numpy())
        return None

    def height_words(self) -> str:
        """Heights at the ends of the colours, in the coordinates of the data set."""
        frame, up = self.subject.frame, self.subject.up
        low, high = (float(frame.to_input(end * up) @ up) for end in self.heights)
        return f"dark {low:,.2f} to pale {high:,.2f}{' m' if frame.metres == 1 else ''}"
