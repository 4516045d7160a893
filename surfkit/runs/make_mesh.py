"""From a trained run to its mesh: made, cleaned, written in the frame of the input, and rendered."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from surfkit.core.check import BadInput
from surfkit.core.codec import dump, read_json, read_keys, write_json
from surfkit.core.events import FileWritten, Progress, Warned, emit
from surfkit.core.registry import name_of
from surfkit.evaluate.images.comparison_pictures import write_picture
from surfkit.io.datasets.depth_prior import read_priors
from surfkit.io.datasets.masks import mask_cache
from surfkit.mesh.base import LENGTHS, Mesh, Mesher, MeshInput, require_plain, require_triangles, require_values
from surfkit.mesh.clean import CleaningReport, clean
from surfkit.mesh.closed import UNCHANGED, bodies_of, closed, require_closed
from surfkit.mesh.fusion import forget_spooled
from surfkit.mesh.manifold import apart
from surfkit.mesh.mesh_export import write_mesh
from surfkit.mesh.shade import from_above, shaded, up_of
from surfkit.mesh.simplify import simplified
from surfkit.mesh.stereo import points
from surfkit.mesh.value_colors import by_value, ends_of, words_of
from surfkit.primitives.drawing import drawn_by
from surfkit.primitives.model import DEFAULT_NEAR
from surfkit.raster.api import Maps
from surfkit.raster.base import Rasterizer
from surfkit.runs.folder import Run
from surfkit.runs.mesh_output import MeshOutput
from surfkit.runs.methods.base import Reconstruction
from surfkit.scene.lengths import unit_of
from surfkit.scene.photos import view_photo
from surfkit.scene.scene import Frame, Scene, View
from surfkit.scene.up_direction import up_direction, up_of_views

PICTURE_VIEWS = 4
"""Training views that pictures are made of."""
PICTURE_SIDE_PX = 800
"""Side of a picture, pixels."""
SUFFIXES = (".ply", ".obj", ".mtl", ".glb", ".json")
"""Of files that belong to a mesh."""


def mesh_input(
    run: Run,
    made: Reconstruction,
    scene: Scene,
    rasterizer: Rasterizer,
    budget_bytes: int,
    mesher: Mesher | None = None,
) -> MeshInput:
    """A reconstruction, to be meshed by `mesher`, or written if it is None and there is a mesh already.

    With the depth priors if the mesher needs them and there are any. Where there are no splats, points of the depth
    maps that can be drawn stand for them; where nothing can be drawn, the photographs stand for what is drawn.
    """
    draw = photographs if made.draw is None else made.draw
    if mesher is not None and made.splats is None:
        draw = with_depth(run, draw)
    splats = made.splats.splats if made.splats else points(scene.train if mesher is not None else (), draw)
    masks = mask_cache(scene.train, budget_bytes // 4)
    wanted = mesher is not None and mesher.needs_prior_of(scene.train, scene.frame)
    priors = read_priors(run.data, scene, budget_bytes // 4) if wanted else None
    return MeshInput(
        splats=splats,
        views=scene.train,
        draw=draw,
        rasterizer=drawn_by(made.splats.primitive, rasterizer) if made.splats else rasterizer,
        near=made.splats.near if made.splats else DEFAULT_NEAR,
        frame=scene.frame,
        budget_bytes=budget_bytes,
        generator=torch.Generator().manual_seed(run.recipe.seed),
        scratch=run.out,
        keep=lambda at: None if masks is None else masks[at],
        priors=priors,
        photo=lambda at: view_photo(scene.train[at]),
        draw_of=made.draw_of,
    )


def photographs(view: View) -> Maps:
    """The photograph of a view, as if it were drawn."""
    return Maps(color=view_photo(view).float() / 255)


def with_depth(run: Run, draw: Callable[[View], Maps]) -> Callable[[View], Maps]:
    """The same maps, or BadInput if they have no depth."""

    def maps(view: View) -> Maps:
        found = draw(view)
        if found.alpha is None or found.depth is None or found.median is None:
            raise BadInput(
                f"{run.out}: what its method draws has no alpha, depth and median, so no mesh can be made of it"
            )
        return found

    return maps


def make_mesh(run: Run, mesher: Mesher | Mesh, delivery: MeshOutput, subject: MeshInput, steps: int) -> dict[str, Any]:
    """Make the mesh of a run, write it into the run's folder, and return what mesh.json says.

    Args:
        run: The run.
        mesher: How; or the mesh, where the method of the run has made it.
        delivery: What to write.
        subject: What to mesh.
        steps: Optimisation steps that what is meshed was made with.

    Raises:
        BadInput: There is no surface, or nothing is left of it; or the area lies in another place.
    """
    began, frame = time.perf_counter(), subject.frame
    volume, area = delivery.volume(), delivery.area_of(subject, mesher)
    parts = [part.inside for part in (volume, area) if part is not None]
    forget_spooled(run.out)
    raw = mesher if isinstance(mesher, Mesh) else mesher.mesh(subject)
    facts = plain_facts(maker_of(run, mesher), raw)
    inside = (lambda local: np.all([part(frame.to_input(local)) for part in parts], axis=0)) if parts else None
    least = delivery.clusters, delivery.least_triangles
    mesh, report = clean(raw, *least, inside, delivery.hole_edges, delivery.cluster_gap)
    del raw
    mesh, done = finished(mesh, delivery, subject)
    meshes = levels(mesh, delivery, frame)
    before = delete_meshes(run)
    written = list(write_files(run, meshes, delivery, subject))
    if gone := sorted(before - {path.name for path in written}):
        emit(Warned(f"{', '.join(gone)} of the mesh before {'is' if len(gone) == 1 else 'are'} gone"))
    record = {
        "mesher": None if isinstance(mesher, Mesh) else mesher,
        "delivery": delivery,
        "steps": steps,
        "facts": facts,
        "cleaning": describe(report, subject),
        **({} if area is None else {"area": area.record()}),
        **done,
        "triangles": len(mesh.faces),
        "vertices": len(mesh.vertices),
        "files": [path.name for path in written],
        "crs": frame.crs,
        "offset": list(frame.shift),
        "metres_per_unit": frame.metres,
        "seconds": round(time.perf_counter() - began, 2),
    }
    record["pictures"] = write_pictures(run, mesh, subject)
    write_json(run.mesh_record, record)
    emit(FileWritten(run.mesh_record, "facts of the mesh"))
    return dump(record)


def maker_of(run: Run, mesher: Mesher | Mesh) -> str:
    """What makes the mesh, as the command line has it: mesh:NAME or method:NAME."""
    return f"method:{name_of(run.recipe.method)}" if isinstance(mesher, Mesh) else f"mesh:{name_of(mesher)}"


def plain_facts(maker: str, mesh: Mesh) -> dict[str, Any]:
    """The facts that come with a mesh; BadInput, which names what made it, if it is no mesh, or these or its
    values cannot be written."""
    try:
        require_triangles(mesh)
        facts = {} if mesh.facts is None else mesh.facts
        facts = dict(facts) if isinstance(facts, Mapping) else facts
        if not isinstance(facts, dict):
            raise BadInput(f"facts is a {type(facts).__name__}, not a dict")
        require_plain(facts, "facts")
        require_values(mesh)
    except BadInput as error:
        raise BadInput(f"{maker}: {error}") from error
    return facts


def finished(mesh: Mesh, delivery: MeshOutput, subject: MeshInput) -> tuple[Mesh, dict[str, Any]]:
    """A clean mesh, closed and simplified as is wanted, and what mesh.json says of that.

    It is closed first: what closes it is simplified with it, and simplifying opens nothing.

    Raises:
        BadInput: It cannot be closed.
    """
    done: dict[str, Any] = {}
    frame, closing = subject.frame, None
    if delivery.watertight:
        emit(Progress("closing", 0, 1))
        up = upright(mesh, subject)
        mesh, closing = closed(mesh, up, delivery.clusters, delivery.least_triangles)
        emit(Progress("closing", 1, 1))
        base = None if closing.base is None else float(frame.to_input(closing.base * up) @ up)
        done["closing"] = {"base": base}
    if delivery.triangles is not None or delivery.error is not None:
        emit(Progress("simplifying", 0, 1))
        before, error = len(mesh.faces), delivery.error
        if error is not None:
            error = error * frame.scale if frame.local_metres is None else error / frame.local_metres
        mesh = simplified(mesh, delivery.triangles, error)
        if closing is not None:
            mesh, closing = bodies_of(apart(mesh), closing)
        emit(Progress("simplifying", 1, 1))
        done["simplification"] = {"triangles_before": before, "triangles": len(mesh.faces)}
        if delivery.triangles is not None and len(mesh.faces) > delivery.triangles:
            why = "its parts and holes need them; --cluster-gap 0 and --hole-edges leave fewer of these"
            why = why if delivery.error is None else "fewer would move it farther than --error"
            emit(Warned(f"--triangles {delivery.triangles}: {len(mesh.faces):,} are left, as {why}"))
    if closing is not None:  # of what is written
        done["closing"] = dump(closing) | done["closing"] | {"volume": closing.volume / frame.scale**3}
    return mesh, done


def upright(mesh: Mesh, subject: MeshInput) -> np.ndarray:
    """(3,) the direction that is up: of a map, or as the cameras are held; where these do not tell, as of pictures."""
    if up_of_views(subject.views, subject.frame) is None:
        return up_of(mesh, [view.camera for view in subject.views])
    return up_direction(None, subject.views, subject.frame, np.eye(4)).direction


def levels(mesh: Mesh, delivery: MeshOutput, frame: Frame) -> list[tuple[str, Mesh]]:
    """The meshes to be written, by name: all of it, and with shares of its triangles.

    Raises:
        BadInput: It is to be closed, and one of them would not be.
    """
    meshes = [("mesh", mesh)]
    for at, share in enumerate(delivery.lods, 1):
        less = simplified(mesh, max(1, round(share * len(mesh.faces))))
        meshes.append((f"mesh-lod{at}", bodies_of(apart(less), UNCHANGED)[0] if delivery.watertight else less))
        emit(Progress("simplifying", at, len(delivery.lods)))
    for name, each in meshes if delivery.watertight else ():
        require_closed(each, name)
        if "glb" in delivery.formats:  # which rounds places to 32 bits
            rounded = replace(each, vertices=frame.to_file(each.vertices).astype(np.float32))
            require_closed(rounded, f"{name}.glb")
    return meshes


def describe(report: CleaningReport, subject: MeshInput) -> dict[str, Any]:
    """The report with lengths in units of the data set."""
    return dump(report) | {"longest_boundary": report.longest_boundary / subject.frame.scale}


def delete_meshes(run: Run) -> set[str]:
    """Delete the files of an earlier mesh, its record first, and what was measured of it; their names."""
    run.mesh_record.unlink(missing_ok=True)
    forget_geometry(run)
    there = (*run.out.glob("mesh.*"), *run.out.glob("mesh-lod[0-9]*"))
    found = {path for path in there if path.suffix in SUFFIXES}  # others are not ours
    for path in (*found, *run.mesh_pictures.rglob("*.png")):
        path.unlink(missing_ok=True)
    return {path.name for path in found}


def forget_geometry(run: Run) -> None:
    """Take out of the metrics what was measured of an earlier mesh; the run repeats that of its compressed model."""
    whole, found = replace(run, out=run.out.parent), False
    places = [(run.metrics, "")] + [(whole.metrics, "compressed")] * (whole.compressed == run.out)
    for path, part in places:
        with suppress(BadInput):  # damaged: others say so
            metrics = read_json(path, dict[str, Any]) if path.exists() else {}
            measured = metrics.get(part) if part else metrics
            if isinstance(measured, dict) and {"geometry", "mesh"} & measured.keys():
                found |= "geometry" in measured
                for name in ("geometry", "mesh"):
                    measured.pop(name, None)
                write_json(path, metrics)
    if found:
        emit(Warned("precision, recall and F1 were of the mesh before: `surfkit evaluate` with --gt measures this one"))


def write_files(
    run: Run, meshes: Sequence[tuple[str, Mesh]], delivery: MeshOutput, subject: MeshInput
) -> Iterator[Path]:
    """Write meshes, by name, in all formats, and give the paths."""
    for name, each in meshes:
        kinds = list(dict.fromkeys(delivery.formats))
        for kind in kinds:
            try:
                paths = write_mesh(run.out / f"{name}.{kind}", each, subject.frame)
            except BadInput as error:  # larger than such a file can be: hours of work are not to be lost
                alone = kinds == [kind]
                emit(Warned(f"{error}; {'PLY is written in its place' if alone else 'it is left out'}"))
                kinds += ["ply"] if alone else []
                continue
            for path in paths:
                emit(FileWritten(path, "mesh"))
                yield path


def write_pictures(run: Run, mesh: Mesh, subject: MeshInput) -> dict[str, str]:
    """Write pictures of the mesh: from above, also coloured by each of its values, and beside the renders of a few
    training views. What the colours mean, by the name of the picture.
    """
    count = min(PICTURE_VIEWS, len(subject.views))
    views = [subject.views[(2 * at + 1) * len(subject.views) // (2 * count)] for at in range(count)]
    path, up = run.mesh_pictures / "above.png", upright(mesh, subject)
    write_picture(path, from_above(mesh, up, PICTURE_SIDE_PX))
    emit(FileWritten(path, "picture"))
    told = {}
    for name, values in mesh.values.items():
        path, ends = run.mesh_pictures / f"above-{name}.png", ends_of(name, values)
        write_picture(path, from_above(mesh, up, PICTURE_SIDE_PX, by_value(name, values, ends)))
        if name in LENGTHS:
            ends = ends[0] / subject.frame.scale, ends[1] / subject.frame.scale
        told[path.name] = words_of(name, ends, unit_of(subject.frame))
        emit(FileWritten(path, f"picture, {told[path.name]}"))
    for at, view in enumerate(views):
        camera = view.camera.fitted(PICTURE_SIDE_PX)
        color = subject.draw(view).need("color").clamp(0, 1)
        if camera != view.camera:
            size = (camera.height, camera.width)
            color = torch.nn.functional.interpolate(color[None], size, mode="area")[0]
        path = run.mesh_pictures / f"view-{at + 1}.png"
        write_picture(path, torch.cat([color, shaded(mesh, camera)], dim=2))
        emit(FileWritten(path, "picture"))
    return told


def has_mesh(run: Run, steps: int, own: bool = False) -> bool:
    """Whether the mesh of a recipe is there, made from splats of so many steps; the recipe may want none.

    `own`: the method of the run has made one, whatever the recipe wants.
    """
    if run.recipe.mesh is None and not own:
        return True
    if not run.mesh_record.exists():
        return False
    remedy = "delete it, and the mesh is made again"
    record = read_keys(run.mesh_record, {"files": tuple[str, ...], "steps": int}, remedy)
    there = all((run.out / name).exists() for name in record["files"])
    return there and record["steps"] == steps
