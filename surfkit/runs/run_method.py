"""The method of a run: what it is given, what is kept of its result, and what it has cost."""

from __future__ import annotations

import time
import zipfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cache, cached_property
from pathlib import Path
from typing import Any

import numpy as np
import safetensors.torch as safetensors
import torch
from safetensors import SafetensorError

from surfkit.core.check import BadInput
from surfkit.core.codec import dump, read_json, write_json
from surfkit.core.events import Progress, StepDone, emit, say
from surfkit.core.files import replacing
from surfkit.core.hooks import hookimpl
from surfkit.core.memory import peak_memory_bytes
from surfkit.core.registry import name_of, plugins
from surfkit.io.datasets.depth_prior import read_priors
from surfkit.io.datasets.masks import mask_cache
from surfkit.mesh.base import VALUES, Mesh, require_values
from surfkit.primitives.base import Primitive
from surfkit.primitives.drawing import drawn_by
from surfkit.primitives.model import SplatModel
from surfkit.raster.api import Maps, Splats
from surfkit.raster.base import Rasterizer
from surfkit.raster.nvrtc.gpu_memory import peak_gpu_bytes
from surfkit.raster.select import Device, torch_device
from surfkit.runs.command import train_command
from surfkit.runs.context import RunContext
from surfkit.runs.folder import Run, discard_results
from surfkit.runs.methods.base import MethodInput, Reconstruction
from surfkit.runs.photo_light import held_out_response
from surfkit.scene.cache import Cache
from surfkit.scene.photos import photo_cache
from surfkit.scene.scene import Scene, View
from surfkit.train.state import StageState

RESULT = Path("result", "result.json")
"""In the folder of a run, what its method has made; arrays lie beside it."""
BUDGET_PARTS = 8
"""Photographs, masks and depth priors take at most one part each of so many parts of the memory."""


@dataclass(frozen=True)
class ReconstructionRecord:
    """What the run keeps of a reconstruction, as result/result.json has it; arrays lie beside it.

    Attributes:
        made: Without arrays and functions.
        mesh: Facts of its mesh, if there is one.
        primitive: Of its splats, if there are any.
        sh_degree, near: See `SplatModel`.
        draws: Whether it has a `draw` of its own.
    """

    facts: dict[str, Any]
    steps: int
    seconds: float
    cpu_seconds: float
    peak_memory_bytes: int
    mesh: dict[str, Any] | None
    primitive: Primitive | None
    sh_degree: int
    near: float
    draws: bool
    peak_gpu_bytes: int = 0


class LazyPhotos:
    """Photographs and masks of training views, read when the first of them is asked for."""

    def __init__(self, scene: Scene, budget_bytes: int) -> None:
        self.scene, self.budget_bytes = scene, budget_bytes

    @cached_property
    def photos(self) -> Cache[torch.Tensor]:
        """Photographs by position, (3, H, W) uint8."""
        return photo_cache(self.scene.train, self.budget_bytes)

    @cached_property
    def masks(self) -> Cache[torch.Tensor | None] | None:
        """Masks by position, (H, W) bool or None."""
        return mask_cache(self.scene.train, self.budget_bytes)

    def photo(self, at: int) -> torch.Tensor:
        """See `MethodInput.photo`."""
        return self.photos[at]

    def mask(self, at: int) -> torch.Tensor | None:
        """See `MethodInput.mask`."""
        return None if self.masks is None else self.masks[at]

    def close(self) -> None:
        """Read nothing more."""
        for each in ("photos", "masks"):
            if (found := vars(self).pop(each, None)) is not None:
                found.close()


@contextmanager
def method_input(
    ctx: RunContext, device: Device, optimise: Callable[[], Reconstruction] | None = None
) -> Iterator[MethodInput]:
    """Within, there is what the method of a run works with."""
    run, scene, budget = ctx.run, ctx.scene, ctx.caches.bytes()
    method = run.recipe.method
    pictures = LazyPhotos(scene, budget // BUDGET_PARTS)
    priors = None
    if method.needs_prior:
        priors = read_priors(run.data, scene, budget // BUDGET_PARTS, normals=method.needs_normals)
    try:
        yield MethodInput(
            scene=replace(scene, held_out=()),
            photo=pictures.photo,
            mask=pictures.mask,
            priors=priors,
            folder=run.out / "method",
            used={name: getattr(run.recipe, name) for name in method.uses},
            seed=run.recipe.seed,
            device=torch_device(device),
            rasterizer=ctx.rasterizer,
            budget_bytes=budget // 2,
            checkpoint_every=ctx.intervals.checkpoint,
            optimise=optimise if run.recipe.has_stages else None,
        )
    finally:
        pictures.close()
        if priors is not None:
            priors.close()


def is_begun(run: Run) -> bool:
    """Whether a method without stages has begun in the folder."""
    return (run.out / "method").exists()


def reconstruct(run: Run, given: MethodInput) -> Reconstruction:
    """What the method of a run makes of its scene; what is finished, or kept of an interrupted call, is not made again.

    The result of a method with stages lies in their checkpoints, and their cost is in them.
    """
    method = run.recipe.method
    if run.recipe.has_stages:
        return with_drawing(method.reconstruct(given), given.rasterizer)
    if result_path(run).exists():
        return reopened(run, given)
    if is_begun(run):
        say(f"{run.out}: going on with what method:{name_of(method)} has kept")
    discard_results(run, run.pretrain)
    given.folder.mkdir(parents=True, exist_ok=True)
    with clocked(result_path(run).with_name("cost.json")) as cost, steps_shown(name_of(method)):
        made = method.reconstruct(given)
    seconds, cpu_seconds = cost()
    measured: dict[str, Any] = {
        "seconds": seconds,
        "cpu_seconds": cpu_seconds,
        "peak_memory_bytes": peak_memory_bytes(),
        "peak_gpu_bytes": peak_gpu_bytes(),
    }
    made = replace(made, **{name: value for name, value in measured.items() if getattr(made, name) is None})
    keep(run, made)
    return with_drawing(made, given.rasterizer)


def reopened(run: Run, given: MethodInput) -> Reconstruction:
    """The finished reconstruction of a run; a method that draws by itself is asked again when a view is to be drawn."""
    folder, kept = run.out / "result", read_json(result_path(run), ReconstructionRecord)
    mesh = splats = None
    try:
        if kept.mesh is not None:
            with np.load(folder / "mesh.npz") as arrays:
                values = {name: arrays[name] for name in VALUES if name in arrays}
                mesh = Mesh(arrays["vertices"], arrays["faces"], arrays.get("colors"), kept.mesh, values)
        if kept.primitive is not None:
            params = safetensors.load_file(folder / "splats.safetensors")
            splats = SplatModel(kept.primitive, params, kept.sh_degree, kept.near)
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile, SafetensorError) as error:
        raise BadInput(
            f"{folder}: damaged ({' '.join(str(error).split())}); delete it, and `{train_command(run)}` makes it again"
        ) from error

    @cache
    def again() -> Callable[[View], Maps]:
        found = run.recipe.method.reconstruct(given).draw
        if found is None:
            raise BadInput(
                f"{run.out}: method:{name_of(run.recipe.method)} cannot draw any more; train in a new folder"
            )
        return found

    made = Reconstruction(
        mesh=mesh,
        splats=splats,
        draw=(lambda view: again()(view)) if kept.draws else None,
        **{name: getattr(kept, name) for name in ("facts", "steps", "seconds", "cpu_seconds")},
        peak_memory_bytes=kept.peak_memory_bytes,
        peak_gpu_bytes=kept.peak_gpu_bytes,
    )
    return with_drawing(made, given.rasterizer)


def keep(run: Run, made: Reconstruction) -> None:
    """Write a reconstruction into the run folder; result.json last, as it says that all is there.

    Raises:
        BadInput: The method returned what cannot be used.
    """
    folder, name = run.out / "result", name_of(run.recipe.method)
    if made.mesh is None and made.splats is None and made.draw is None:
        raise BadInput(f"method:{name} returned no mesh, no splats and nothing that draws; it must return one of them")
    folder.mkdir(exist_ok=True)
    if made.mesh is not None:
        refuse_unsound(made.mesh, name)
        more: dict[str, Any] = dict(made.mesh.values)
        more |= {} if made.mesh.colors is None else {"colors": made.mesh.colors}
        with replacing(folder / "mesh.npz") as file:
            np.savez(file, vertices=made.mesh.vertices, faces=made.mesh.faces, **more)
    if made.splats is not None:
        params = {key: value.detach().cpu().contiguous() for key, value in made.splats.params.items()}
        with replacing(folder / "splats.safetensors") as file:
            file.write(safetensors.save(params))
    write_json(
        result_path(run),
        ReconstructionRecord(
            facts=dump(dict(made.facts)),
            steps=made.steps,
            seconds=made.seconds or 0.0,
            cpu_seconds=made.cpu_seconds or 0.0,
            peak_memory_bytes=made.peak_memory_bytes or 0,
            peak_gpu_bytes=made.peak_gpu_bytes or 0,
            mesh=None if made.mesh is None else dump(dict(made.mesh.facts)),
            primitive=made.splats.primitive if made.splats else None,
            sh_degree=made.splats.sh_degree if made.splats else 0,
            near=made.splats.near if made.splats else 0.0,
            draws=made.draw is not None,
        ),
    )


def result_path(run: Run) -> Path:
    """What tells that the method of a run has finished."""
    return run.out / RESULT


def refuse_unsound(mesh: Mesh, name: str) -> None:
    """BadInput for arrays of a method's mesh that are not as `Mesh` says."""
    vertices, faces = mesh.vertices, mesh.faces
    said = f"method:{name} returned a mesh"
    if vertices.ndim != 2 or vertices.shape[1] != 3 or vertices.dtype != np.float32:
        raise BadInput(f"{said} with vertices {vertices.shape} {vertices.dtype}; they must be (V, 3) float32")
    if faces.ndim != 2 or faces.shape[1] != 3 or faces.dtype != np.int32:
        raise BadInput(f"{said} with faces {faces.shape} {faces.dtype}; they must be (F, 3) int32")
    if not len(faces):
        raise BadInput(f"{said} without a face")
    if not np.isfinite(vertices).all():
        raise BadInput(f"{said} with vertices that are NaN or Inf")
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise BadInput(f"{said} of {len(vertices)} vertices with a face that names vertex {faces.max()}")
    if (colors := mesh.colors) is not None and (colors.shape != vertices.shape or colors.dtype != np.uint8):
        raise BadInput(f"{said} with colors {colors.shape} {colors.dtype}; they must be (V, 3) uint8")
    try:
        require_values(mesh)
    except BadInput as error:
        raise BadInput(f"method:{name}: {error}") from error


def with_drawing(made: Reconstruction, rasterizer: Rasterizer) -> Reconstruction:
    """The reconstruction with its splats drawn by the rasterizer, where it does not draw by itself."""
    if made.draw is not None or made.splats is None:
        return made
    model = made.splats
    near, draws = model.near, drawn_by(model.primitive, rasterizer)

    @cache
    def there() -> Splats:
        return model.splats.to(rasterizer.where())

    def maps(splats: Splats, view: View, geometry: bool = True) -> Maps:
        return draws.render(splats, view.camera, near, geometry, distortion=False).maps

    def on_cpu(found: Maps) -> Maps:
        return Maps(**{name: value.cpu() for name, value in found.present().items()})

    def of(splats: Splats) -> Callable[[View], Maps]:
        moved = splats.to(rasterizer.where())
        return lambda view: on_cpu(maps(moved, view))

    return replace(
        made,
        draw=lambda view: on_cpu(maps(there(), view)),
        draw_there=lambda view: maps(there(), view),
        draw_color=lambda view: maps(there(), view, geometry=False),
        draw_of=of,
    )


def splats_of(run: Run, made: Reconstruction) -> SplatModel:
    """The splats of a reconstruction.

    Raises:
        BadInput: It has none.
    """
    if made.splats is None:
        name = name_of(run.recipe.method)
        raise BadInput(f"{run.out}: method:{name} makes no splats, so there are no points to write; see {run.mesh}")
    return made.splats


def refuse_not_drawn(run: Run) -> None:
    """BadInput if what a run has made cannot draw pictures."""
    if not is_drawn(run):
        raise BadInput(
            f"{run.out}: {draws_nothing(run)}, so photographs cannot be compared with any; to measure its mesh, leave "
            "out --seen, --seams and --lod"
        )


def is_drawn(run: Run) -> bool:
    """Whether what a run has made can draw pictures; so is what is not made yet."""
    path = result_path(run)
    kept = read_json(path, ReconstructionRecord) if path.exists() else None
    return kept is None or kept.primitive is not None or kept.draws


def draws_nothing(run: Run) -> str:
    """What is said of a run whose method draws no pictures."""
    return f"method:{name_of(run.recipe.method)} does not draw pictures"


def not_drawn(run: Run) -> dict[str, Any]:
    """What stands in the metrics in the place of measurements on photographs."""
    return {"images": {"psnr": None, "ssim": None, "per_image": {}, "not_measured": draws_nothing(run)}, "fps": None}


def refuse_mesher(out: Path) -> None:
    """BadInput if the mesh of the run in a folder was made by its method, so that a mesher has nothing to do."""
    path = out / RESULT
    if path.exists() and read_json(path, ReconstructionRecord).mesh is not None:
        raise BadInput(f"{out}: the method of the run made its mesh; leave out mesh:NAME and --mesh.*")


def optimised(run: Run, state: StageState) -> Reconstruction:
    """The reconstruction that the stages of a recipe have come to."""
    last = run.last
    return Reconstruction(
        splats=SplatModel(last.primitive, last.stage.finished(state), state.sh_degree, last.stage.near),
        steps=sum(stage.stage.steps for stage in run.stages),
        last_steps=state.index,
        seconds=state.seconds,
        cpu_seconds=state.cpu_seconds,
        peak_memory_bytes=state.peak_memory_bytes,
        peak_gpu_bytes=state.peak_gpu_bytes,
        respond=held_out_response(run, last),
    )


@contextmanager
def clocked(path: Path) -> Iterator[Callable[[], tuple[float, float]]]:
    """Within, seconds and CPU seconds are counted on from those that a file has, which gets the new sum at the end."""
    before = read_json(path, tuple[float, float]) if path.exists() else (0.0, 0.0)
    began = time.perf_counter(), time.process_time()

    def cost() -> tuple[float, float]:
        return before[0] + time.perf_counter() - began[0], before[1] + time.process_time() - began[1]

    try:
        yield cost
    finally:
        write_json(path, cost())


@contextmanager
def steps_shown(name: str) -> Iterator[None]:
    """Within, optimisation steps are shown as progress of the method."""
    shown = _Steps(name)
    plugins().register(shown, "steps of the method")
    try:
        yield
    finally:
        plugins().unregister(shown)


class _Steps:
    def __init__(self, name: str) -> None:
        self.name = name

    @hookimpl
    def surfkit_event(self, event: Any) -> None:
        if isinstance(event, StepDone):
            emit(Progress(f"steps of {self.name}", event.index, event.steps))
