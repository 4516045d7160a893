"""What is looked at: a finished run, or a file of splats, of a mesh or of points, in a local frame."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch

from surfkit.apps.render.path import up_of
from surfkit.apps.texture.texture_export import TEXTURED_NAME
from surfkit.apps.texture.texture_mesh import TEXTURE_RECORD
from surfkit.apps.view.browser_geometry import by_height, height_bounds
from surfkit.apps.view.mesh_files import MESH_SUFFIXES, TexturedGlb, other_mesh, textured
from surfkit.compress.levels.lod_tree import LodTree
from surfkit.core.check import BadInput
from surfkit.core.events import Warned, emit
from surfkit.evaluate.geometry.file_transform import Y_AXIS, Z_AXIS, notes_in, own_notes, root_of
from surfkit.evaluate.geometry.las import CLOUDS, read_las
from surfkit.evaluate.geometry.surface_file import SurfaceFile, read_surface
from surfkit.io.datasets.sparse_ply import read_points
from surfkit.io.splats.file_axes import AxesOrAuto
from surfkit.io.splats.gltf_reader import UPS
from surfkit.io.splats.models import refuse_unsound
from surfkit.io.splats.splat_files import read_splat_file
from surfkit.io.splats.splat_table import SplatTable
from surfkit.mesh.base import LENGTHS, VALUES, Mesh
from surfkit.partition.plan import PartitionPlan
from surfkit.primitives.model import SplatModel, primitive_of
from surfkit.raster.api import Maps
from surfkit.raster.select import Device
from surfkit.raster.select import select as select_rasterizer
from surfkit.runs.blocks.block import plan_file, read_plan
from surfkit.runs.context import RunContext
from surfkit.runs.make_levels import load_levels
from surfkit.runs.methods.base import Reconstruction
from surfkit.runs.pipeline import loaded
from surfkit.runs.resume import read_noting_changes
from surfkit.runs.run_method import with_drawing
from surfkit.scene.scene import Frame, Scene, View

EXTENT_POINT_SHARE = 0.9
"""Share of the positions in a file that lies within the extent of its local frame."""
MAX_CLOUD_POINTS = 10_000_000
"""Points of a cloud that are kept; a click looks among these."""
SPLATS_IN_GLTF = b"KHR_gaussian_splatting"


@dataclass(frozen=True)
class ViewerPoints:
    """A cloud: (N, 3) float32 local positions, and (N, 3) uint8 colours."""

    xyz: np.ndarray
    rgb: np.ndarray


@dataclass(frozen=True)
class ViewerScene:
    """What there is to look at; anything may be missing but one of splats, mesh and points.

    Attributes:
        path: Of the run or the file.
        frame: Where the local frame lies.
        up: (3,) unit vector, local frame.
        splats: As files hold them, local frame.
        mesh: Triangles, local frame.
        points: A cloud.
        scene: Views and sparse points of a run.
        draw: Maps of a view, by the rasterizer that the model was trained with.
        plan: How a run was cut into blocks.
        levels: Levels of detail of a run; the first is `splats` in another order.
        textured: The mesh with pictures on its triangles.
    """

    path: Path
    frame: Frame
    up: np.ndarray
    splats: SplatTable | None = None
    mesh: Mesh | None = None
    points: ViewerPoints | None = None
    scene: Scene | None = None
    draw: Callable[[View], Maps] | None = field(default=None, repr=False)
    plan: PartitionPlan | None = None
    levels: LodTree | None = None
    textured: TexturedGlb | None = None

    @property
    def views(self) -> tuple[View, ...]:
        """All cameras, those of held-out photographs last."""
        return (*self.scene.train, *self.scene.held_out) if self.scene is not None else ()

    def positions(self) -> np.ndarray:
        """(N, 3) local positions of what there is, for its bounds."""
        if self.splats is not None:
            return self.splats.means.numpy()
        return self.mesh.vertices if self.mesh is not None else self.points.xyz  # type: ignore[union-attr]


@contextmanager
def opened_subject(path: Path, device: Device, axes: AxesOrAuto = "auto") -> Iterator[ViewerScene]:
    """Within, what a run folder or a file holds.

    Args:
        path: Folder of a finished run, or a file of splats, of a mesh or of points.
        device: That draws.
        axes: Of the numbers in a file of splats.

    Raises:
        BadInput: It is neither, damaged, or there is nothing in it to look at.
    """
    if path.is_dir() and (path / "meta.json").exists():  # that is a folder of splats, unpacked SOG
        path /= "meta.json"
    if path.is_dir():
        with loaded(path, device, read_data=read_noting_changes) as (ctx, made):
            yield of_run(ctx, made)
        return
    if not path.exists():
        raise BadInput(f"{path}: there is no such run or file")
    yield of_file(path, device, axes)


def of_run(ctx: RunContext, made: Reconstruction) -> ViewerScene:
    """What a finished run holds."""
    run, frame = ctx.run, ctx.scene.frame
    made, table, mesh, levels = with_drawing(made, ctx.rasterizer), None, None, None
    if made.splats is not None and made.splats.primitive.in_ply:
        table = made.splats.primitive.table(made.splats.params).on_cpu()
        levels = load_levels(run, made.splats) if run.lod_record.exists() else None
    elif made.splats is not None:
        emit(Warned("splats of this primitive cannot be drawn in a browser: photographs, mesh and pictures are shown"))
    if run.mesh.exists() and run.mesh_record.exists():
        mesh = local_mesh(read_surface(run.mesh), frame)
    sparse = ctx.scene.cloud
    points = ViewerPoints(sparse.xyz.numpy(), sparse.rgb.numpy()) if len(sparse.xyz) else None
    if table is None and mesh is None and points is None:
        raise BadInput(f"{run.out}: it has neither splats nor a mesh nor points to look at")
    return ViewerScene(
        path=run.out,
        frame=frame,
        up=up_of(ctx.scene),
        splats=table,
        mesh=mesh,
        points=points,
        scene=ctx.scene,
        draw=made.draw,
        plan=read_plan(run).plan if plan_file(run).exists() else None,
        textured=textured_mesh(run.out) if mesh is not None else None,
        levels=levels,
    )


def textured_mesh(out: Path) -> TexturedGlb | None:
    """What `surfkit texture` has made of the mesh of the run in a folder; None where it has not, or it is damaged."""
    folder = out / "texture"
    path = folder / f"{TEXTURED_NAME}.glb"
    if not (path.exists() and (folder / TEXTURE_RECORD).exists()):
        return None
    try:
        return textured(path, root_of(path))
    except BadInput as error:  # the rest of the run can be looked at
        emit(Warned(f"the mesh is shown without its pictures: {error}"))
        return None


def of_file(path: Path, device: Device, axes: AxesOrAuto = "auto") -> ViewerScene:
    """What a file holds."""
    if path.suffix.lower() in CLOUDS:
        xyz, rgb, notes = read_las(path, MAX_CLOUD_POINTS)
        rgb = by_height(xyz[:, 2], height_bounds(xyz[:, 2])) if rgb is None else rgb
        frame = frame_of(xyz, notes)
        return ViewerScene(path, frame, Z_AXIS, points=ViewerPoints(frame.to_local(xyz).astype(np.float32), rgb))
    if holds_splats(path):
        return of_splats(path, device, axes)
    pictures, up = None, Z_AXIS
    if path.suffix.lower() in MESH_SUFFIXES:
        surface, colors, place, pictures = other_mesh(path)
        notes, up = place.notes, place.up
    else:
        surface, notes = read_surface(path), coordinates_of(path)
        colors = colors_of(surface)
    if surface.faces is not None:
        frame = frame_of(surface.vertices(), notes)
        return ViewerScene(path, frame, up, mesh=local_mesh(surface, frame, colors), textured=pictures)
    if path.suffix.lower() in MESH_SUFFIXES:
        xyz, rgb = surface.vertices(), np.full((len(surface), 3), 128, np.uint8) if colors is None else colors
    else:
        xyz, rgb = read_points(path)
    frame = frame_of(xyz, notes)
    return ViewerScene(path, frame, up, points=ViewerPoints(frame.to_local(xyz).astype(np.float32), rgb))


def of_splats(path: Path, device: Device, axes: AxesOrAuto) -> ViewerScene:
    """What a file of splats holds."""
    table = read_splat_file(path, axes)
    if not len(table):
        raise BadInput(f"{path}: there are no splats in it; write it again, or name another file")
    refuse_unsound(path, table)
    notes, up = splats_place(path)
    frame = frame_of(table.means.double().numpy(), notes)
    local = table.on_cpu().in_local_frame(frame)
    primitive = primitive_of(local)
    model = SplatModel(primitive, primitive.from_table(local, torch.Generator()), local.sh_degree)
    made = with_drawing(Reconstruction(splats=model), select_rasterizer(device)[0])
    return ViewerScene(path, frame, up, splats=local, draw=made.draw)


def splats_place(path: Path) -> tuple[dict[str, str], np.ndarray]:
    """What a file of splats says of its coordinates, and its (3,) up: z on a map, what a GLB of surfkit says, else -y.

    The last is what programs that show splats take for up, as the cameras of COLMAP mostly have it, and what the y of
    glTF and of SPZ becomes.
    """
    notes = coordinates_of(path)
    if "crs" in notes:
        return notes, Z_AXIS
    told = own_notes(root_of(path))
    if not told:
        return notes, -Y_AXIS
    unit = {"metres per unit": told.get("metres_per_unit"), "crs": told.get("crs")}
    return {name: str(value) for name, value in unit.items() if value}, UPS[told["up"]].T @ Y_AXIS


def holds_splats(path: Path) -> bool:
    """Whether a file is one of splats: what is neither a mesh nor a cloud is left to the readers of splats."""
    head = head_of(path)
    if head.startswith(b"ply"):
        return b"\nelement chunk " in head or b" f_dc_0" in head
    if path.suffix.lower() in (".glb", ".gltf"):
        return SPLATS_IN_GLTF in head
    return path.suffix.lower() not in MESH_SUFFIXES


def head_of(path: Path) -> bytes:
    """The header of a file, or the JSON of a GLB, which begins it."""
    with path.open("rb") as file:
        head = file.read(1 << 16)
    return head.partition(b"end_header")[0] if head.startswith(b"ply") else head


def coordinates_of(path: Path) -> dict[str, str]:
    """What the header of a PLY file says of its coordinates, by name."""
    text = head_of(path).decode("ascii", "replace")
    return notes_in(text) if text[:3] == "ply" else {}


def frame_of(xyz: np.ndarray, notes: Mapping[str, str]) -> Frame:
    """The local frame of a file: about the middle of its (N, 3) positions.

    Args:
        xyz: In the frame of the input, which a shift that the header names has been added to.
        notes: From `coordinates_of`.
    """
    middle = np.median(xyz, axis=0)
    extent = float(np.quantile(np.linalg.norm(xyz - middle, axis=1), EXTENT_POINT_SHARE))
    shift = tuple(float(word) for word in notes.get("offset", "0 0 0").split())
    metres = float(notes["metres per unit"]) if "metres per unit" in notes else None
    return Frame(middle, 1 / extent if extent > 0 else 1.0, metres, notes.get("crs"), shift)  # type: ignore[arg-type]


def local_mesh(surface: SurfaceFile, frame: Frame, colors: np.ndarray | None = None) -> Mesh:
    """The triangles of a file in a local frame."""
    vertices = frame.to_local(surface.vertices()).astype(np.float32)
    if colors is None:
        colors = colors_of(surface)
    return Mesh(vertices, np.ascontiguousarray(surface.faces, np.int32), colors, values=values_of(surface, frame))


def values_of(surface: SurfaceFile, frame: Frame) -> dict[str, np.ndarray]:
    """(V,) float32 values of the vertices of a PLY file by name, see `VALUES`; lengths in local units."""
    there = [name for name in VALUES if name in (surface.rows.dtype.names or ())]
    return {name: (surface.rows[name] * (frame.scale if name in LENGTHS else 1.0)).astype(np.float32) for name in there}


def colors_of(surface: SurfaceFile) -> np.ndarray | None:
    """(V, 3) uint8 of the vertices of a PLY file; None where it has none."""
    names = ("red", "green", "blue")
    if surface.rows.dtype.names is None or not set(names) <= set(surface.rows.dtype.names):
        return None
    found = np.stack([surface.rows[name] for name in names], axis=1)
    return found if found.dtype == np.uint8 else (found * (255 if found.dtype.kind == "f" else 1)).astype(np.uint8)
