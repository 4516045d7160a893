"""What a mesher is: splats, the views that saw them, and a way to draw them, to triangles."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from surfkit.core.check import BadInput, expect
from surfkit.core.registry import Component
from surfkit.io.datasets.depth_prior import DepthPrior
from surfkit.raster.api import Maps, Splats
from surfkit.raster.base import Rasterizer
from surfkit.scene.scene import Frame, View

MAX_NESTING = 50
"""Lists and dicts within one another that facts may have."""
VALUES = {
    "views": "photographs that confirm the surface there",
    "error": "by how much the surface may be wrong there, a length",
}
"""Names that values of vertices may have, and what they mean."""
LENGTHS = frozenset({"error"})
"""Those that are lengths: in local units in memory, in units of the data set in files."""


@dataclass(frozen=True)
class Mesh:
    """Triangles in the local frame.

    Attributes:
        vertices: (V, 3) float32 local positions.
        faces: (F, 3) int32 rows of `vertices`, counter-clockwise seen from outside.
        colors: (V, 3) uint8, or None.
        facts: How it was made, such as the values of automatic settings: any plain values, see `require_plain`, written
            to mesh.json and shown to the user.
        values: (V,) float32 numbers of the vertices by name, see `VALUES`; lengths in local units. Every step carries
            them: a vertex that stands for several has their mean.
    """

    vertices: np.ndarray
    faces: np.ndarray
    colors: np.ndarray | None = None
    facts: Mapping[str, Any] = field(default_factory=dict)
    values: Mapping[str, np.ndarray] = field(default_factory=dict)

    def take(self, rows: np.ndarray, faces: np.ndarray) -> Mesh:
        """A mesh of some of its vertices, with what belongs to them.

        Args:
            rows: Numbers of the vertices, or a (V,) mask.
            faces: (F, 3) int32 places in `rows`.
        """
        colors = None if self.colors is None else self.colors[rows]
        values = {name: each[rows] for name, each in self.values.items()}
        return replace(self, vertices=self.vertices[rows], faces=faces, colors=colors, values=values)


@dataclass(frozen=True)
class MeshInput:
    """What is to be meshed.

    Attributes:
        splats: Activated values, local frame.
        views: Training views, with cameras in the local frame.
        draw: Maps of a view, geometry included: color, alpha, depth, median, normal.
        draw_of: Draws given splats as `draw` does all of them; None where `draw` does not draw splats.
        rasterizer: For what `draw` does not give.
        near: Local units, of the stage that trained the splats.
        frame: From the local frame back to the input's; knows metres if the data set does.
        budget_bytes: Memory to stay within; work is split into tiles when it would be exceeded.
        generator: Of every random draw.
        scratch: Folder for large temporary files, which the mesher deletes; None for the system's own.
        keep: (H, W) bool mask of a view by its position, or None for all of it; false where nothing is to be fused.
        priors: Estimated depths by position, if the mesher needs them and the data set has any.
        photo: (3, H, W) uint8 photograph of a view by its position, at the size of its camera; None where none are.
    """

    splats: Splats
    views: Sequence[View]
    draw: Callable[[View], Maps]
    rasterizer: Rasterizer
    near: float
    frame: Frame
    budget_bytes: int
    generator: torch.Generator = field(default_factory=torch.Generator)
    scratch: Path | None = None
    keep: Callable[[int], Tensor | None] = lambda at: None
    priors: Sequence[DepthPrior | None] | None = None
    photo: Callable[[int], Tensor] | None = None
    draw_of: Callable[[Splats], Callable[[View], Maps]] | None = None


class Mesher(Component):
    """A way to turn splats into triangles; progress is reported by `surfkit.core.events.Progress`."""

    @property
    def needs_prior(self) -> bool:
        """Whether it looks at depth priors.

        Only then are they read and, where the data set has none, made.
        """
        return False

    def needs_prior_of(self, views: Sequence[View], frame: Frame) -> bool:
        """Whether it looks at depth priors of these views: only if `needs_prior`.

        They may be many, and take hours to make again.
        """
        return self.needs_prior

    @property
    def most_triangles(self) -> int | None:
        """About how many triangles it gives at most, whatever the scene; None for any number. For a forecast."""
        return None

    def ready(self) -> None:
        """Check, before hours are spent, whether it can work.

        Raises:
            BadInput: A package that it needs cannot be loaded on this machine.
        """

    def refuse_unfit(self, frame: Frame) -> None:  # noqa: B027 (most meshers suit every frame)
        """Check, before hours are spent, whether its settings suit the data set.

        Raises:
            BadInput: A length is in metres, and the data set does not say how long its unit is.
        """

    @abstractmethod
    def mesh(self, subject: MeshInput) -> Mesh:
        """The surface.

        Raises:
            BadInput: There is nothing to mesh, such as no depth in any view.
        """


def require_plain(value: Any, at: str, levels: int = MAX_NESTING) -> None:
    """BadInput unless a value can be written to JSON: None, a bool, number or text, or lists and dicts of plain values.

    Args:
        value: The value.
        at: Its dotted path, for messages.
        levels: How many lists and dicts may be nested in one another.
    """
    if value is None or isinstance(value, (bool, float, str)) or (isinstance(value, int) and abs(value) < 2**63):
        return
    if isinstance(value, int):
        raise BadInput(f"{at} is an int beyond 64 bits; give text, or a float")
    if not isinstance(value, (dict, list, tuple)):
        text = repr(value)
        raise BadInput(
            f"{at} is {text if len(text) <= 60 else text[:57] + '...'} ({type(value).__name__}), which is not plain: "
            "give None, a bool, a number, text, or lists and dicts of these"
        )
    if not levels:
        raise BadInput(f"{at}: lists and dicts are nested more than {MAX_NESTING} levels deep")
    for key, item in value.items() if isinstance(value, dict) else enumerate(value):
        if isinstance(value, dict) and not isinstance(key, str):
            raise BadInput(f"{at} has the key {key!r} ({type(key).__name__}), which is not text")
        require_plain(item, f"{at}.{key}", levels - 1)


def require_triangles(mesh: Any) -> None:
    """BadInput unless it is a mesh with finite vertices, and faces that are rows of these."""
    if not isinstance(mesh, Mesh):
        raise BadInput(f"expected a surfkit.Mesh, got {type(mesh).__name__}")
    for name, array, kind in (("vertices", mesh.vertices, np.floating), ("faces", mesh.faces, np.integer)):
        if not isinstance(array, np.ndarray) or not np.issubdtype(array.dtype, kind):
            came = str(array.dtype) if isinstance(array, np.ndarray) else type(array).__name__
            raise BadInput(
                f"{name}: expected a numpy array of {'int32' if kind is np.integer else 'float32'}, got {came}"
            )
        expect(name, array, (len(array), 3))
    if not np.isfinite(mesh.vertices).all():
        row = int((~np.isfinite(mesh.vertices)).nonzero()[0][0])
        raise BadInput(f"vertices: {mesh.vertices[row].tolist()} in row {row}; all of them must be finite")
    if mesh.faces.size and not 0 <= mesh.faces.min() <= mesh.faces.max() < len(mesh.vertices):
        came = f"{mesh.faces.min()} to {mesh.faces.max()}"
        raise BadInput(f"faces: expected rows of {len(mesh.vertices)} vertices, got {came}")


def require_values(mesh: Mesh) -> None:
    """BadInput unless the values of the vertices have names that are known, and there is a number for each vertex."""
    for name, each in mesh.values.items():
        if name not in VALUES:
            raise BadInput(f"values has the name {name!r}; vertices may have {', '.join(VALUES)}")
        if each.dtype != np.float32 or each.shape != (len(mesh.vertices),):
            found = f"{each.dtype} of shape {list(each.shape)}"
            raise BadInput(f"values.{name} is {found}; give float32 of shape [{len(mesh.vertices)}], one a vertex")
