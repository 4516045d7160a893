"""A textured mesh, from the settings of a user to a folder of files."""

from __future__ import annotations

import errno
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from surfkit.apps.texture.candidates import NO_PHOTO, Candidates
from surfkit.apps.texture.choose import choose_views
from surfkit.apps.texture.fill import PaintInput, Pictures
from surfkit.apps.texture.find_candidates import LOOKED_FOLDER, candidates_of
from surfkit.apps.texture.pieces import MeshClusters
from surfkit.apps.texture.prefetch_photos import PrefetchedPhotos, by_photograph
from surfkit.apps.texture.regions import Region, divide, middles
from surfkit.apps.texture.resolution import pixel_sizes
from surfkit.apps.texture.seam_levelling import SeamCorrections, level
from surfkit.apps.texture.texture_atlas import MAX_FILLED_SHARE, Atlas, make_atlas, texels_of
from surfkit.apps.texture.texture_cache import Arrays, TextureCache, identity, seen
from surfkit.apps.texture.texture_export import TEXTURED_NAME, TILES_FOLDER, TexturedMesh, TextureExport, deliver
from surfkit.apps.texture.topology import neighbours, with_short_edges
from surfkit.apps.texture.triangle_visibility import TriangleVisibility, project, sight
from surfkit.core.check import BadInput, few
from surfkit.core.codec import write_json
from surfkit.core.events import FileWritten, Progress, Warned, emit
from surfkit.core.files import refuse_own, replacing_folder
from surfkit.core.lock import locked
from surfkit.core.stages import kept_parts, key_of
from surfkit.core.version import own_version
from surfkit.evaluate.geometry.surface_file import SurfaceFile
from surfkit.io.splats.tileset import site_of
from surfkit.mesh.base import Mesh
from surfkit.mesh.holes import areas_of
from surfkit.mesh.simplify import require_simplification, simplify_to
from surfkit.scene.crop import Axis
from surfkit.scene.lengths import Length, unit_of
from surfkit.scene.one_light import OneLight
from surfkit.scene.scene import Frame, View

Format = Literal["obj", "glb", "tiles3d", "usdz"]
TEXTURE_RECORD = "texture.json"
"""What the textured mesh is; written last."""
UNFINISHED_SUFFIX = ".unfinished"
"""Ending of the name of the folder, beside the one that is written, for what is finished of it."""
TEXELS_PER_TRIANGLE = 6.0
"""Texels of a triangle by default, were each photograph to look straight at the surface."""
MAX_EDGE_TEXELS, MAX_EDGE_RATIO = 32.0, 4.0
"""Longer edges are halved: in texels, and in edges of a triangle of mean size; and those of a quarter of a page."""
MIN_TEXEL_PIXELS = 0.5
"""Of the median pixel on the surface: smaller texels would show nothing more."""
MIN_LEVEL_TRIANGLES = 100
"""Triangles of a level of detail."""


@dataclass(frozen=True)
class TextureSettings:
    """What is written, and how fine it is."""

    formats: tuple[Format, ...] = ("obj", "glb", "tiles3d")
    """Files to write: obj (with an MTL file and pictures), glb, tiles3d, a folder with tileset.json for CesiumJS and
    other viewers of 3D Tiles, and usdz, OpenUSD, which needs `pip install 'surfkit[usd]'`."""

    triangles: int | Literal["auto"] = "auto"
    """Triangles to simplify the mesh to; where the surface is flat, large ones are divided again. `auto` is one for 6
    texels, and no more than the mesh has."""

    texel: Length = "auto"
    """Side of a texel on the surface, metres; in units of the data set where it does not say how long these are. `auto`
    is the resolution of the photographs: they are then copied pixel by pixel."""

    size: int = 4096
    """Largest side of a picture of the atlas, a power of two. Each tile of 3D Tiles has its own."""

    pictures: Pictures = "jpeg"
    """Pictures of the atlas: jpeg, or png, which loses nothing and is larger."""

    up: Axis | None = None
    """Axis of the data set that points up, for GLB and 3D Tiles. Default: z if it is georeferenced, else what the
    cameras tell."""

    geoid: str | None = None
    """The geoid, where heights are above sea level: a grid of it (GTX, GeoTIFF), or the metres by which it lies above
    the ellipsoid; for tiles3d. Default: what the coordinate reference system says, and without a vertical part the
    ellipsoid."""

    def __post_init__(self) -> None:
        if not self.formats:
            raise BadInput("--formats: name at least one of obj, glb, tiles3d, usdz")
        if self.geoid is not None and "tiles3d" not in self.formats:
            raise BadInput("--geoid: only 3D Tiles need it; add tiles3d to --formats, or leave --geoid out")
        if self.triangles != "auto" and not 4 <= self.triangles <= 10**9:
            raise BadInput(f"--triangles {self.triangles}: give 4 to 1e9, or auto")
        if self.texel != "auto" and not 0 < self.texel < float("inf"):
            raise BadInput(f"--texel {self.texel:g}: it is a length, so it must be above 0, or auto")
        if not 128 <= self.size <= 16384 or self.size & (self.size - 1):
            raise BadInput(f"--size {self.size}: give a power of two from 128 to 16384")


@dataclass(frozen=True)
class MeshWithPhotos:
    """What is textured, or drawn on maps.

    Attributes:
        surface: The mesh, in the frame of the input.
        frame: Of the data set.
        views: The photographs to use.
    """

    surface: SurfaceFile
    frame: Frame
    views: Sequence[View] = ()


def make_texture(subject: MeshWithPhotos, settings: TextureSettings, out: Path, budget_bytes: int) -> dict[str, Any]:
    """Write a textured mesh into a folder, and return what texture.json says: lengths are in units of the input.

    Args:
        subject: What to texture.
        settings: How.
        out: The folder; an earlier textured mesh in it is replaced when the new one is complete. Beside it lies what an
            interrupted call has finished of the same, which is not done again.
        budget_bytes: Memory for photographs.

    Raises:
        BadInput: A package is missing, or no photograph shows the mesh.
        OSError: There is a file, or a folder that holds other files.
    """
    began = time.perf_counter()
    refuse_foreign(out)
    work, frame = out.with_name(f"{out.name}{UNFINISHED_SUFFIX}"), subject.frame
    if "tiles3d" in settings.formats:
        refuse_unplaced(frame, settings.geoid)
    key = key_of(
        settings, own_version(), identity(subject.surface), seen(subject.views), frame.crs, frame.metres, frame.scale,
        list(frame.shift), frame.to_input(np.eye(3)).tolist(),
    )  # fmt: skip
    with locked(work), kept_parts(work, key):
        kept = TextureCache(work)
        made = textured(subject, settings, budget_bytes, kept)
        record = facts_of(made, subject)
        with replacing_folder(out) as folder:
            how = TextureExport(
                frame, subject.views, set(settings.formats), settings.pictures, settings.up, work, settings.geoid
            )
            more = coarser(subject, settings, budget_bytes, made, kept) if "tiles3d" in settings.formats else ()
            record["files"] = deliver(made, more, how, folder)
            record["seconds"] = round(time.perf_counter() - began, 1)
            write_json(folder / TEXTURE_RECORD, record)
    for name in (*record["files"], TEXTURE_RECORD):
        emit(FileWritten(out / name, "textured mesh"))
    return record


def refuse_unplaced(frame: Frame, geoid: str | None) -> None:
    """BadInput, before anything is done, where 3D Tiles of a data set would have no place on Earth."""
    try:
        site_of(frame, geoid)
    except BadInput as error:
        raise BadInput(f"{error}; or leave tiles3d out of --formats") from error


def facts_of(made: TexturedMesh, subject: MeshWithPhotos) -> dict[str, Any]:
    """What texture.json says of a textured mesh."""
    mesh, atlas, light = made.paint.mesh, made.paint.atlas, made.paint.light
    seen, areas = atlas.view != NO_PHOTO, areas_of(mesh.vertices, mesh.faces)
    return {
        "mesh": str(subject.surface.path),
        "crs": subject.frame.crs,
        "offset": list(subject.frame.shift),
        "metres_per_unit": subject.frame.metres,
        "unit": unit_of(subject.frame),
        "texel": float(f"{made.texel:.3g}"),
        "triangles": len(mesh.faces),
        "seen": round(float(areas[seen].sum() / areas.sum()), 6),
        "photographs": len(np.unique(atlas.view[seen])),
        "outliers": made.outliers,
        "gains": [round(gain, 4) for gain in light.gains],
        "corners": [round(float(light.corners.min()), 4), round(float(light.corners.max()), 4)],
        "charts": len(atlas.page),
        "pages": [[page.width, page.height] for page in atlas.pages],
        "tiles": int(atlas.tile.max()) + 1,
    }


def textured(
    subject: MeshWithPhotos,
    settings: TextureSettings,
    budget_bytes: int,
    kept: TextureCache = TextureCache(),
    finer: Mesh | None = None,
    region: Region | None = None,
    light: OneLight | None = None,
) -> TexturedMesh:
    """Choose a photograph for each triangle of the mesh, simplified; arguments and errors as for `make_texture`.

    What is known already can be given: `finer`, the mesh simplified before, `region`, the regions of the tiles, and
    `light` of the photographs.
    Each step is kept in `kept` when it is finished, and not done again if it is there.
    """
    require_simplification("simplifying a mesh")
    surface, frame = subject.surface, subject.frame
    sizes = pixel_sizes(surface, subject.views, frame)
    if np.isnan(sizes).all():
        raise BadInput(f"{surface.path}: no photograph shows any of it, so it has no texture")
    texel, views = float(np.nanmedian(sizes)), subject.views
    if settings.texel != "auto":
        wanted = settings.texel / (frame.metres or 1.0)
        if wanted < MIN_TEXEL_PIXELS * texel:
            emit(Warned(f"texels of {wanted:.3g} are finer than pixels, {texel:.3g} on the surface: these are taken"))
        else:
            texel, views = wanted, reduced(views, sizes, wanted)

    def simplified() -> Mesh:
        given = local_mesh(surface, frame) if finer is None else finer
        return prepared(given, settings, texel * frame.scale)

    mesh = kept_mesh(kept, simplified)
    photos = PrefetchedPhotos(views, budget_bytes)
    beyond, edge = neighbours(mesh.faces)

    def choose() -> Arrays:
        longest = settings.size // 2  # so that each chart fits on a page
        found, used, outliers = look_at_all(mesh, photos, longest, kept, light)
        return {"view": choose_views(found, used, beyond, edge), "outliers": np.array([outliers]), **vars(used)}

    chosen = kept.once("chosen", choose)
    kept.forget(LOOKED_FOLDER)
    if finer is None and (chosen["view"] == NO_PHOTO).all():
        told = f"of {len(views)} photographs, none shows a triangle whole, outside of masks and with nothing in front"
        emit(Warned(f"{surface.path}: {told}: all of it has the colours of the mesh"))
    atlas, region = lay_out(mesh, views, chosen["view"], beyond, settings.size, region)
    used = OneLight.restored(chosen)
    levels = kept.once("levels", lambda: asdict(level(mesh.faces, atlas.view, atlas.places, beyond, photos, used)))
    return TexturedMesh(
        PaintInput(mesh, atlas, photos, used, SeamCorrections(**levels)), region, texel, chosen["outliers"].item()
    )


def kept_mesh(kept: TextureCache, make: Callable[[], Mesh]) -> Mesh:
    """The mesh that `make` returns, or the one that was kept."""

    def arrays() -> Arrays:
        mesh = make()
        return {name: value for name, value in vars(mesh).items() if isinstance(value, np.ndarray)}

    found = kept.once("mesh", arrays)
    return Mesh(found["vertices"], found["faces"], found.get("colors"))


def coarser(
    subject: MeshWithPhotos, settings: TextureSettings, budget_bytes: int, fine: TexturedMesh, kept: TextureCache
) -> Iterator[TexturedMesh]:
    """Levels of detail: texels twice as large each, a quarter of the triangles, and regions of four tiles each."""
    mesh, depth, level = fine.paint.mesh, fine.region.depth, 0
    while depth > 0:
        depth, level = max(0, depth - 2), level + 1
        texel = fine.texel * 2**level * (subject.frame.metres or 1.0)
        fewer = max(MIN_LEVEL_TRIANGLES, len(fine.paint.mesh.faces) // 4**level)
        less = replace(settings, texel=texel, triangles=fewer)
        made = textured(subject, less, budget_bytes, kept.of(level), mesh, fine.region.cut(depth), fine.paint.light)
        mesh = made.paint.mesh
        yield made


def refuse_foreign(out: Path) -> None:
    """OSError unless a folder is to be made, is empty, or has a textured mesh and nothing else: it will be replaced."""
    if out.exists() and not out.is_dir():
        raise OSError(errno.ENOTDIR, "a file; name a folder", str(out))
    refuse_own(out)
    names = {path.name for path in out.iterdir()} if out.exists() else set()
    if names and TEXTURE_RECORD not in names:
        raise OSError(errno.ENOTEMPTY, f"not empty and without {TEXTURE_RECORD}; name another", str(out))
    if other := sorted(name for name in names - {TEXTURE_RECORD, TILES_FOLDER} if not name.startswith(TEXTURED_NAME)):
        raise OSError(
            errno.ENOTEMPTY, f"has files that are not of a textured mesh: {few(other)}; name another", str(out)
        )


def local_mesh(surface: SurfaceFile, frame: Frame) -> Mesh:
    """A mesh in the local frame."""
    vertices = np.empty((len(surface), 3), np.float32)
    for at in range(0, len(surface), 1 << 20):
        part = slice(at, at + (1 << 20))
        vertices[part] = frame.to_local(surface.vertices(part))
    faces, colors = np.asarray(surface.faces, np.int32), None
    names = ("red", "green", "blue")
    if set(names) <= set(surface.rows.dtype.names or ()):
        colors = np.stack([surface.rows[name] for name in names], axis=1).astype(np.uint8)
    else:
        emit(Warned(f"{surface.path}: its vertices have no colours; what no photograph shows becomes grey"))
    good = np.isfinite(vertices).all(1)
    if not good.all():  # no face has such a vertex, see `read_surface`
        vertices, colors = vertices[good], None if colors is None else colors[good]
        faces = (np.cumsum(good) - 1).astype(np.int32)[faces]
    return Mesh(vertices, faces, colors)


def reduced(views: Sequence[View], sizes: np.ndarray, texel: float) -> list[View]:
    """Views whose pixels are no smaller on the surface than a texel."""
    found = []
    for view, size in zip(views, sizes.tolist(), strict=True):
        camera = view.camera
        by = min(1.0, size / texel) if np.isfinite(size) else 1.0
        camera = camera.resized(max(1, round(by * camera.width)), max(1, round(by * camera.height)))
        found.append(replace(view, camera=camera))
    return found


def prepared(mesh: Mesh, settings: TextureSettings, texel: float) -> Mesh:
    """The mesh with as many triangles as wanted, none of them too large; `texel` in local units."""
    area = float(areas_of(mesh.vertices, mesh.faces).sum())
    wanted = (
        settings.triangles
        if settings.triangles != "auto"
        else max(MIN_LEVEL_TRIANGLES, int(area / texel**2 / TEXELS_PER_TRIANGLE))
    )
    if wanted < len(mesh.faces):
        emit(Progress("simplifying", 0, 1))
        mesh = simplify_to(mesh, wanted)
        emit(Progress("simplifying", 1, 1))
    edge = (area / max(wanted, 1) * 4 / 3**0.5) ** 0.5
    return with_short_edges(mesh, min(max(MAX_EDGE_TEXELS * texel, MAX_EDGE_RATIO * edge), settings.size / 4 * texel))


def look_at_all(
    mesh: Mesh,
    photos: PrefetchedPhotos,
    longest: float,
    kept: TextureCache = TextureCache(),
    light: OneLight | None = None,
) -> tuple[Candidates, OneLight, int]:
    """What can be chosen from, the light of the photographs, and how many photographs of a triangle were refused."""
    pieces = MeshClusters(mesh)

    def show(number: int, picture: np.ndarray, keep: np.ndarray | None) -> TriangleVisibility | None:
        camera = photos.views[number].camera
        part, rows = pieces.in_view(camera)
        if not len(rows):
            return None
        shown = sight(part, camera, picture, keep, longest)
        return replace(shown, faces=rows[shown.faces])

    return candidates_of(len(mesh.faces), photos, show, kept, light)


def lay_out(
    mesh: Mesh, views: Sequence[View], chosen: np.ndarray, beyond: np.ndarray, size: int, region: Region | None = None
) -> tuple[Atlas, Region]:
    """The atlas of triangles with a photograph each, and the regions of its tiles.

    Args:
        mesh: The mesh.
        views: The photographs.
        chosen: (F,) photograph of each triangle.
        beyond: (F, 3) triangles beyond the edges.
        size: Of a page.
        region: Of the tiles, where it is known.
    """
    places = np.zeros((len(mesh.faces), 3, 2), np.float32)
    for number, rows in by_photograph(chosen):
        corners = mesh.vertices[mesh.faces[rows]].reshape(-1, 3)
        places[rows] = project(corners, views[number].camera)[:, :2].reshape(-1, 3, 2)
    where = middles(mesh)
    region = region or divide(where, texels_of(chosen, places), MAX_FILLED_SHARE * size**2)
    return make_atlas(chosen, places, region.of(where), beyond, size), region
