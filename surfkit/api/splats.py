"""Splats in Python: from and to files of any format, and drawn with gradients."""

from __future__ import annotations

import atexit
from pathlib import Path
from typing import Any
from weakref import WeakSet

import torch
from torch import Tensor

from surfkit.api.listen import heard
from surfkit.core.check import BadInput
from surfkit.core.events import say
from surfkit.core.fit import fit
from surfkit.io.splats.base import Format
from surfkit.io.splats.file_axes import AxesOrAuto
from surfkit.io.splats.page import HtmlPageFormat
from surfkit.io.splats.splat_files import format_for, read_splat_file
from surfkit.io.splats.splat_table import SplatTable, Tile
from surfkit.io.splats.tiles3d import Tiles3D
from surfkit.raster.api import Maps, Render, Splats
from surfkit.raster.base import Rasterizer
from surfkit.scene.camera import Camera
from surfkit.scene.scene import Frame


def read_splats(path: str | Path, axes: AxesOrAuto = "auto") -> SplatTable:
    """The splats of a file of surfkit or of another program (.ply, .spz, .sog, .splat, .glb, .usdz), N of them.

    They are raw values, as files have them: `means` (N, 3) frame of the input, `quats` (N, 4) w x y z of any length,
    `log_scales` (N, 2) of surfels or (N, 3), `opacity_logits` (N,), `sh0` (N, 3), `sh_rest` (N, K - 1, 3).

    Args:
        path: File.
        axes: Where its x, y and z lead, such as "rdf" (right, down, forward, as in PLY files); "auto" for what the file
            says, or else a guess that a note tells.

    Raises:
        BadInput: No such file, of no known format, or damaged; or no such axes.
    """
    with heard():
        file = fit(Path, path, "read_splats")
        return read_splat_file(file, fit(AxesOrAuto, axes, "read_splats: axes"), 'axes="rdf"')


def save_splats(
    splats: SplatTable,
    path: str | Path,
    format: str | Format | None = None,
    frame: Frame | None = None,  # noqa: A002
) -> Path:
    """Write splats to a file for other programs.

    Args:
        splats: Frame of the input.
        path: File; its suffix says the format: .ply, .spz, .sog, .splat, and so on.
        format: Its name, or itself, where the suffix does not say.
        frame: `scene.frame`, for its offset of survey coordinates and their system. Without it, positions far from 0
            leave out an offset of their own, as float32 would round them; what is left out is said.

    Raises:
        BadInput: No such format, or the splats have no place in it; values that are not finite.
    """
    if not isinstance(splats, SplatTable):
        raise BadInput(f"save_splats: expected splats as of run.splats or read_splats, got {type(splats).__name__}")
    file: Path = fit(Path, path, "save_splats")
    form = format_of_words(file, format, "save_splats")
    if form.wants_tree:
        raise BadInput(f"{file}: this format takes levels of detail, which only run.export has; choose another")
    table = splats.on_cpu()
    write_told(file, form, table, Frame.of_positions(table.means.numpy()) if frame is None else frame)
    return file


def write_told(file: Path, form: Format, table: SplatTable, frame: Frame, tree: Tile | None = None) -> None:
    """Write a file of splats as `surfkit export` does, which says too what the file leaves out."""
    file.parent.mkdir(parents=True, exist_ok=True)
    with heard():
        form.write(file, table, frame, tree)
    if any(frame.shift) and not isinstance(form, (Tiles3D, HtmlPageFormat)):
        say(f"{file}: coordinates leave out the offset {' '.join(f'{value:.15g}' for value in frame.shift)}")


def format_of_words(file: Path, given: str | Format | None, where: str) -> Format:
    """The format that a call gives, by its name or itself, else that of the suffix; BadInput for none."""
    chosen: Format | None = fit(Format | None, given, f"{where}: format")
    return format_for(file) if chosen is None else chosen


def drawn(splats: SplatTable, camera: Camera, frame: Frame, near: float, rasterizer: Rasterizer) -> Maps:
    """What a camera sees of splats, differentiable in those of their tensors that require a gradient.

    Args:
        splats: Frame of the input.
        camera: Local frame.
        frame: Between the two.
        near: Nothing nearer to the camera is drawn, local units.
        rasterizer: Draws, and knows the way back.

    Raises:
        BadInput: A value is not finite.
    """
    origin = torch.as_tensor(frame.origin, dtype=torch.float64, device=splats.means.device)
    named = {
        "means": ((splats.means.double() - origin) * frame.scale).float(),
        "quats": splats.quats,
        "scales": splats.scales * frame.scale,
        "opacities": splats.opacities,
        "sh0": splats.sh0[:, None],
        "sh_rest": splats.sh_rest,
    }
    standard: dict[str, Any] = {name: value.detach().float() for name, value in named.items()}
    local = Splats(splats.kind, **standard, antialias=splats.antialias)
    render = rasterizer.render(local, camera, near, distortion=False)
    names = list(render.maps.present())
    return Maps(**dict(zip(names, _Drawn.apply(render, names, list(named), *named.values()), strict=True)))  # type: ignore[no-untyped-call]


class _Held:
    """A view that a graph needs for its way back."""

    def __init__(self, render: Render | None) -> None:
        self.render = render


_HELD: WeakSet[_Held] = WeakSet()


@atexit.register
def _let_go() -> None:
    """Graphs that a script still holds at its end are not freed by torch, and the compiled code would report that."""
    for held in list(_HELD):
        held.render = None


class _Drawn(torch.autograd.Function):
    """The maps of a view, with the rasterizer's own way back."""

    @staticmethod
    def forward(ctx: Any, render: Render, maps: list[str], splats: list[str], *tensors: Tensor) -> tuple[Tensor, ...]:
        """The maps, in the order of their names."""
        ctx.held, ctx.maps, ctx.splats = _Held(render), maps, splats
        _HELD.add(ctx.held)
        ctx.set_materialize_grads(False)
        return tuple(render.maps.present()[name].clone() for name in maps)

    @staticmethod
    def backward(ctx: Any, *grads: Tensor | None) -> tuple[Any, ...]:
        """The gradients by the tensors of the splats."""
        given = {name: grad for name, grad in zip(ctx.maps, grads, strict=True) if grad is not None}
        found = ctx.held.render.backward(Maps(**given)).tensors()
        return (None, None, None, *(found[name] for name in ctx.splats))
