"""Runs the command line on damaged files, thousands of times, and tells what it must not do.

    python bench/fuzz.py [--cases 10000] [--targets colmap run ...] [--seed 0] [--out fuzz.json]

Every case copies a small data set or run folder, damages one to three places in it (`damage.py`), and gives a command
to `surfkit.cli.main` in this process. Whatever is damaged, the command must end within seconds with an exit status of
its own and at most one line of complaint: no exception, no warning of a library, no write outside the run folder, no
allocation after a number in a header. Settings, the output and the memory of a command are damaged likewise: numbers
that make no sense, a reader that has ended, memory that gives out. The cases run in processes of their own, so that a
crash and an endless loop are found too. Exits 1 if anything was found.
"""

from __future__ import annotations

import argparse
import contextlib
import inspect
import io
import json
import math
import os
import resource
import shutil
import signal
import sys
import tempfile
import time
import traceback
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from damage import NUMBERS, OUTPUTS, Damage, apply, damages

SECONDS = 20
"""Within which a command must end."""
GROWTH = 3 << 30
"""Bytes of address space that a command may add."""
HELD = 400 << 20
"""Bytes of memory that a case may add to the most that was held before."""
CHUNK = 100
"""Cases in one process."""
WRITES = {"open", "os.mkdir", "os.rename", "os.remove", "os.rmdir", "os.link", "os.symlink", "os.truncate", "os.chmod"}
FLAGS = os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_APPEND
WRITTEN = ("out", "data/undistorted", "data/estimated_depths")
"""Where commands may write, below the folder of a case."""
OUTPUT, MEMORY = "the output", "the memory"
"""What is damaged beside files, and settings, which begin with --."""
MOST_CALLS = 100_000
"""Calls of functions of surfkit that a command makes at most before memory gives out, where it is damaged."""
GUARD = tuple(str(Path(__file__).parents[1] / "surfkit" / "cli" / name) for name in ("__init__.py", "streams.py"))
"""Where errors become lines: memory does not give out in there."""
SMALL = "--device cpu --pictures-every 1 --primitive.sh-degree 1 --cache 1MB"
TRAIN = f"train recipe:2dgs --steps 2 {SMALL} --data {{here}}/data --out {{here}}/out"
DEEP = f"train recipe:citygs2-coarse --steps 2 {SMALL} --data {{here}}/data --out {{here}}/out"


@dataclass(frozen=True)
class Target:
    """What is damaged, and what is run on it.

    Attributes:
        make: Fills the folder of the case.
        words: Command lines, taken in turns.
        files: Patterns of what is damaged, below the folder.
        others: What else is: settings, the output, the memory.
    """

    make: Callable[[Path], None]
    words: tuple[str, ...]
    files: tuple[str, ...]
    others: tuple[str, ...] = ()


def truth() -> Any:
    """A scene of six photographs."""
    from surfkit.scene.synthetic import Flight, photograph

    return photograph(Flight(views=6, width=24, height=18, points=60, test_every=3))


def colmap(here: Path, binary: bool = False, tracks: bool = True) -> Any:
    from surfkit.scene.synthetic import write_colmap

    made = truth()
    write_colmap(here / "data", made, binary=binary, tracks=tracks)
    return made


def lenses(here: Path) -> None:
    """A distorted camera and masks."""
    from PIL import Image

    made = colmap(here)
    path = here / "data" / "sparse" / "0" / "cameras.txt"
    words = path.read_text().split()
    path.write_text(" ".join([words[0], "OPENCV", *words[2:], "-0.05", "0.01", "0.001", "0"]) + "\n")
    for view in made.scene.train:
        mask = np.full((18, 24), 255, np.uint8)
        mask[4:9, 5:12] = 0
        (here / "data" / "masks").mkdir(exist_ok=True)
        Image.fromarray(mask).save(here / "data" / "masks" / view.name)


def inverse(made: Any, name: str) -> np.ndarray:
    """(H, W) inverse depth, input units."""
    depth = made.exact[name].depth.numpy() / made.scene.frame.scale
    return np.where(depth > 0, 1 / np.maximum(depth, 1e-9), 0)


def arrays(here: Path) -> None:
    """Depth priors of surfkit and CityGaussianV2."""
    from surfkit.scene.depth_files import write_map, write_record

    made = colmap(here)
    for view in made.scene.train:
        values = inverse(made, view.name)
        write_map(here / "data", view.name, values * 3 + 0.1, np.ones_like(values))
    write_record(here / "data", {"aligned": False, "matched": [view.name for view in made.scene.held_out]})


def pictures(here: Path) -> None:
    """Depth priors of hierarchical 3DGS."""
    from PIL import Image

    made, params = colmap(here), {}
    (here / "data" / "depths").mkdir()
    for view in made.scene.train:
        values = inverse(made, view.name)
        scale = float(values.max())
        params[Path(view.name).stem] = {"scale": scale * 1.01, "offset": 0.0}
        stored = np.where(values > 0, values / (scale * 1.01) * 65536, 0)
        Image.fromarray(stored.astype(np.uint16)).save(here / "data" / "depths" / view.name)
    (here / "data" / "sparse" / "0" / "depth_params.json").write_text(json.dumps(params))


def frames(made: Any, views: Any, prefix: str) -> list[dict[str, Any]]:
    flip = np.diag([1.0, -1.0, -1.0, 1.0])
    poses = [np.linalg.inv(made.scene.frame.input_pose(view.camera.world_to_camera)) @ flip for view in views]
    return [
        {"file_path": f"{prefix}{v.name}", "transform_matrix": p.tolist()} for v, p in zip(views, poses, strict=True)
    ]


def sparse(made: Any, path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Write the sparse points, in the input frame; positions and colours."""
    from surfkit.scene.ply import write_points

    xyz, rgb = made.scene.frame.to_input(made.scene.cloud.xyz.numpy()), made.scene.cloud.rgb.numpy()
    write_points(path, xyz, rgb)
    return xyz, rgb


def nerfstudio(here: Path, text: bool = False) -> None:
    from PIL import Image

    made, data = colmap(here), here / "data"
    shutil.rmtree(data / "sparse")
    views = [*made.scene.train, *made.scene.held_out]
    lens = views[0].camera
    listed = frames(made, views, "./images/")
    (data / "depth").mkdir()
    for frame, view in zip(listed, views, strict=True):
        depth = made.exact[view.name].depth.numpy() / made.scene.frame.scale
        Image.fromarray((depth * 1000).astype(np.uint16)).save(data / "depth" / view.name)
        frame["depth_file_path"] = f"depth/{view.name}"
    names = {"w": lens.width, "h": lens.height, "fl_x": lens.fx, "fl_y": lens.fy, "cx": lens.cx, "cy": lens.cy}
    held = [f"./images/{view.name}" for view in made.scene.held_out]
    contents = {**names, "camera_model": "OPENCV", "ply_file_path": "p.ply", "frames": listed, "test_filenames": held}
    (data / "transforms.json").write_text(json.dumps(contents))
    xyz, rgb = sparse(made, data / "p.ply")
    if text:
        head = [f"property float {axis}" for axis in "xyz"] + [f"property uchar {c}" for c in ("red", "green", "blue")]
        rows = [" ".join(map(str, [*a, *b])) for a, b in zip(xyz.tolist(), rgb.tolist(), strict=True)]
        lines = ["ply", "format ascii 1.0", f"element vertex {len(xyz)}", *head, "end_header", *rows, ""]
        (data / "p.ply").write_text("\n".join(lines))


def blender(here: Path) -> None:
    made, data = colmap(here), here / "data"
    shutil.rmtree(data / "sparse")
    angle = 2 * math.atan(12 / made.scene.train[0].camera.fx)
    for part, views in {"train": made.scene.train, "test": made.scene.held_out}.items():
        contents = {"camera_angle_x": angle, "frames": frames(made, views, "./images/")}
        (data / f"transforms_{part}.json").write_text(json.dumps(contents))
    sparse(made, data / "points3d.ply")


def matrixcity(here: Path) -> None:
    made, data = colmap(here), here / "data"
    shutil.rmtree(data / "sparse")
    angle = 2 * math.atan(12 / made.scene.train[0].camera.fx)
    for part, views in {"train": made.scene.train, "test": made.scene.held_out}.items():
        listed = frames(made, views, "")
        for at, (frame, view) in enumerate(zip(listed, views, strict=True)):
            del frame["file_path"]
            frame |= {"frame_index": at, "rot_mat": frame.pop("transform_matrix")}
            (data / part / "block_A").mkdir(parents=True, exist_ok=True)
            shutil.move(data / "images" / view.name, data / part / "block_A" / f"{at:04}.png")
        text = json.dumps({"camera_angle_x": angle, "frames": listed})
        (data / part / "block_A" / "transforms.json").write_text(text)
    sparse(made, data / "points3d.ply")


def odm(here: Path) -> None:
    from scipy.spatial.transform import Rotation

    made, data = colmap(here), here / "data"
    shutil.rmtree(data / "sparse")
    lens = made.scene.train[0].camera
    camera = {
        "projection_type": "brown", "width": 24, "height": 18, "focal_x": lens.fx / 24, "focal_y": lens.fy / 24,
        "c_x": (lens.cx - 12) / 24, "c_y": (lens.cy - 9) / 24, "k1": 0.0, "k2": 0.0, "p1": 0.0, "p2": 0.0, "k3": 0.0,
    }  # fmt: skip
    shots = {}
    for view in [*made.scene.train, *made.scene.held_out]:
        pose = made.scene.frame.input_pose(view.camera.world_to_camera)
        turn = Rotation.from_matrix(pose[:3, :3]).as_rotvec().tolist()
        shots[view.name] = {"rotation": turn, "translation": pose[:3, 3].tolist(), "camera": "c"}
    xyz = made.scene.frame.to_input(made.scene.cloud.xyz.numpy()).tolist()
    rows = zip(xyz, made.scene.cloud.rgb.tolist(), strict=True)
    points = {str(at): {"coordinates": a, "color": b} for at, (a, b) in enumerate(rows)}
    (data / "opensfm").mkdir()
    model = [{"cameras": {"c": camera}, "shots": shots, "points": points}]
    (data / "opensfm" / "reconstruction.json").write_text(json.dumps(model))


def run_folder(here: Path, words: str = TRAIN, stop: str | None = None) -> None:
    """A run that is finished, or stopped after the first step of a stage, such as "pretrain" or "block 1"."""
    from surfkit import optimise
    from surfkit.cli import main

    colmap(here)
    display = optimise.Display

    class Stopping(display):
        def show(self, done: Any) -> None:
            if self.stage == stop:
                os.kill(os.getpid(), signal.SIGTERM)

    optimise.Display = Stopping
    try:
        status = main(words.replace("--steps 2", "--steps 2 --checkpoint-every 1").format(here=here).split())
    finally:
        optimise.Display = display
    assert status == (130 if stop else 0), status


def compared(here: Path) -> None:
    """A finished run, and what its mesh is compared with and in."""
    from surfkit.evaluate.transform import write_transform
    from surfkit.scene.crop import box, write_crop

    run_folder(here)
    shutil.copy(here / "out" / "mesh.ply", here / "truth.ply")
    write_crop(here / "crop.json", box((-50.0, -50.0, -50.0, 50.0, 50.0, 50.0)))
    write_transform(here / "frame.json", np.eye(4))


def recipe_file(here: Path) -> None:
    from surfkit.cli.recipes import recipes
    from surfkit.core.codec import write_json

    colmap(here)
    write_json(here / "r.json", recipes()["citygs2-coarse"])
    shutil.copy(here / "r.json", here / "s.json")


MODEL = ("data/sparse/0/*",)
BLOCKS = f"{TRAIN} partition:quantile-grid --partition.blocks 2 1 assign:picture-share"
COMMANDS = ("status {here}/out --json", "export {here}/out", "evaluate {here}/out --device cpu", TRAIN)
GT = "evaluate {here}/out --gt {here}/truth.ply --tau 0.5 --draws 1"
CROPPED = f"{GT} --crop {{here}}/crop.json --transform {{here}}/frame.json"
PREPARE = "prepare depth {here}/data --device cpu --estimator.window 3 --estimator.max-planes 16"
TETRA = "mesh {here}/out mesh:tetra --device cpu"
READING = ("--longest", "--scale", "--test-every", "--metres-per-unit")
SWEEP = tuple(
    f"--estimator.{name}"
    for name in (
        "longest", "neighbours", "angle", "visible", "step-px", "max-planes", "margin", "window", "step-cost",
        "jump-cost", "tolerance", "edge", "agree",
    )
)  # fmt: skip
DELIVERY = ("--lods", "--clusters", "--least-triangles", "--memory", "--metres-per-unit", "--crop-box 0 0 0 1 1")
TARGETS = {
    "colmap-text": Target(colmap, (TRAIN, DEEP), MODEL),
    "colmap-binary": Target(lambda here: colmap(here, binary=True), (TRAIN, DEEP), MODEL),
    "photographs": Target(colmap, (TRAIN,), ("data/images/*",)),
    "lenses-and-masks": Target(lenses, (TRAIN,), ("data/masks/*", "data/images/*1.png", "data/sparse/0/cameras.txt")),
    "depth-arrays": Target(arrays, (DEEP,), ("data/estimated_depths/*",)),
    "depth-pictures": Target(pictures, (DEEP,), ("data/sparse/0/depth_params.json", "data/depths/*")),
    "nerfstudio": Target(nerfstudio, (DEEP,), ("data/*.json", "data/*.json", "data/*.ply", "data/depth/*1.png")),
    "points-as-text": Target(lambda here: nerfstudio(here, text=True), (TRAIN,), ("data/*.ply",)),
    "blender": Target(blender, (TRAIN,), ("data/*.json",)),
    "matrixcity": Target(matrixcity, (TRAIN,), ("data/*/*/*.json",)),
    "odm": Target(odm, (TRAIN,), ("data/opensfm/*",)),
    "recipe": Target(recipe_file, (TRAIN.replace("recipe:2dgs", "recipe:{here}/r.json"),), ("r.json",)),
    "run": Target(run_folder, COMMANDS, ("out/*", "out/*", "out/pretrain/*", "out/pretrain/*")),
    "stopped-run": Target(lambda here: run_folder(here, stop="pretrain"), COMMANDS[::3], ("out/*", "out/pretrain/*")),
    "blocks": Target(
        lambda here: run_folder(here, BLOCKS, "block 1"),
        (BLOCKS, COMMANDS[0], "tune {here}/out 1 --device cpu --cache 1MB"),
        ("out/blocks/*.json", "out/blocks/*.json", "out/blocks/0*/*", "out/blocks/0*/tune/*"),
    ),
    "comparison": Target(
        compared,
        (CROPPED, CROPPED, "mesh {here}/out --device cpu --crop {here}/crop.json"),
        ("crop.json", "crop.json", "frame.json", "truth.ply", "out/m*.json", "out/mesh.ply"),
    ),
    "outputs": Target(
        run_folder,
        ("recipes", "components --markdown", "status {here}/out", "doctor {here}/data --probe 0", *COMMANDS[1:]),
        (),
        (OUTPUT,),
    ),
    "memory": Target(
        compared, (f"{GT} --crop none", PREPARE, TETRA, *COMMANDS, "doctor {here}/data --probe 0"), (), (MEMORY,)
    ),
    "numbers-evaluate": Target(
        compared,
        (f"{GT} --crop none", GT),
        (),
        tuple(f"--{name}" for name in ("samples tau voxel visible radius far seed".split())),
    ),
    "numbers-prepare": Target(colmap, (PREPARE,), (), (*SWEEP, *READING)),
    "numbers-mesh": Target(
        run_folder,
        ("mesh {here}/out --device cpu",),
        (),
        (*DELIVERY, *(f"--mesh.{name}" for name in ("voxel", "truncation", "depth-limit", "least-views"))),
    ),
    "numbers-tetra": Target(
        run_folder,
        (TETRA,),
        (),
        (
            *DELIVERY,
            *(f"--mesh.{name}" for name in "reach thickness faint level bisections agree min-views longest".split()),
        ),
    ),
    "numbers-train": Target(
        colmap,
        (TRAIN,),
        (),
        (*READING, "--steps", "--pretrain.steps", "--seed", "--checkpoint-every", "--pictures-every", "--cache"),
    ),
    "numbers-doctor": Target(
        colmap, ("doctor {here}/data --probe 0",), (), ("--steps", "--points", "--cache", *READING)
    ),
}
"""By name."""


class Watch:
    """Notes what this process writes outside some folders, while it is asked to."""

    def __init__(self) -> None:
        self.allowed: tuple[str, ...] | None = None
        self.found: list[str] = []
        sys.addaudithook(self.see)

    def see(self, event: str, args: tuple) -> None:
        """See what Python is about to do."""
        if self.allowed is None or event not in WRITES:
            return
        if event == "open" and not (isinstance(args[2], int) and args[2] & FLAGS):
            return
        for name in args[:2] if event in ("os.rename", "os.link", "os.symlink") else args[:1]:
            if isinstance(name, (str, bytes, os.PathLike)):
                below = args[-1] if event in ("os.remove", "os.rmdir") and args[-1] >= 0 else None  # an open folder
                base = "" if below is None else os.readlink(f"/proc/self/fd/{below}")
                path = os.path.realpath(os.path.join(base, os.fsdecode(name)))
                if not path.startswith(self.allowed) and "__pycache__" not in path and not path.startswith("/dev/"):
                    self.found.append(f"{event} {path}")


@dataclass
class Finding:
    """Something that must not happen: what, and the first case that led to it."""

    what: str
    target: str
    words: str
    damages: list[Any]
    said: str
    times: int = 1


class Fuzz:
    """Makes cases of one target in a folder of its own."""

    watch: Watch | None = None

    def __init__(self, name: str, folder: Path) -> None:
        Fuzz.watch = Fuzz.watch or Watch()
        self.name, self.target, self.here, self.whole = name, TARGETS[name], folder / "case", folder / "whole"
        self.target.make(self.here)  # in its place: a run folder knows where its data are
        shutil.move(self.here, self.whole)
        found = [path for pattern in self.target.files for path in sorted(self.whole.glob(pattern)) if path.is_file()]
        self.files = [*(path.relative_to(self.whole).as_posix() for path in found), *self.target.others]
        self.turn = 0
        self.commands: dict[tuple[str, ...], Any] = {}

    def case(self, given: list[Damage], words: str | None = None) -> Finding | None:
        """What is wrong with how a command takes damage."""
        words = words or self.target.words[self.turn % len(self.target.words)]
        self.turn += 1
        shutil.rmtree(self.here, ignore_errors=True)
        shutil.copytree(self.whole, self.here)
        for damage in given:
            apply(damage, self.here)
            if damage.file.startswith("--"):
                words += f" {damage.file} {NUMBERS[damage.what % len(NUMBERS)]}"
        others = {damage.file: damage for damage in given if damage.file in (OUTPUT, MEMORY)}
        what, said = self.judged(words.format(here=self.here).split(), others)
        return None if what is None else Finding(what, self.name, words, [asdict(d) for d in given], said[-1500:])

    def judged(self, words: list[str], others: dict[str, Damage]) -> tuple[str | None, str]:
        """What is wrong with how a command ends, if anything is, and what it said; `others` are damages of no file."""
        import surfkit
        from surfkit.cli import main, parse

        before, held, out = self.state(), peak(), io.StringIO()
        self.watch.found.clear()
        self.watch.allowed = (
            *(f"{self.here}/{place}" for place in WRITTEN),
            f"{tempfile.gettempdir()}/surfkit-doctor-",
        )
        start = time.monotonic()
        try:
            with (
                damaged_output(others.get(OUTPUT), out) as to,
                contextlib.redirect_stdout(to),
                contextlib.redirect_stderr(out),
                limited(),
                self.remembered(parse),
                giving_out(others.get(MEMORY)),
            ):
                status = main(words)
        except BaseException as error:
            ours = f"{Path(surfkit.__file__).parent}{os.sep}"  # not every folder of this name: a clone may have it
            where = [f for f in traceback.extract_tb(error.__traceback__) if f.filename.startswith(ours)][-1]
            place = f"{Path(where.filename).name} {where.name}"
            return f"{type(error).__name__} in {place}", out.getvalue() + traceback.format_exc()
        finally:
            self.watch.allowed = None
        said, seconds = out.getvalue(), time.monotonic() - start
        if status == 141 and OUTPUT in others:
            status = 0
        if MEMORY in others:
            said = said.replace("out of memory", "")
        return self.complaint(status, said, seconds, peak() - held, before), out.getvalue()

    @contextlib.contextmanager
    def remembered(self, module: Any) -> Iterator[None]:
        """Within, the same words are parsed only once, and the disk is not waited for: both take longest."""
        parse, fsync = module.parse, os.fsync

        def once(command: type, argv: list[str], prog: str) -> Any:
            key = (prog, *argv)
            if key not in self.commands or "r.json" in self.files:
                self.commands[key] = parse(command, argv, prog)
            return self.commands[key]

        module.parse, os.fsync = once, lambda file: None
        try:
            yield
        finally:
            module.parse, os.fsync = parse, fsync

    def complaint(self, status: int, said: str, seconds: float, grown: int, before: dict) -> str | None:
        """What is wrong with an exit status, what was said, what was taken and what was changed."""
        lines = said.strip().splitlines()
        if status not in (0, 1, 2, 3):
            return f"exit status {status}"
        own = lines and (lines[-1].startswith("surfkit: ") or any(line.startswith("error: ") for line in lines))
        if status in (1, 2) and not own:
            return f"exit status {status} without a line of its own at the end"
        for word in ("Traceback", "Warning:", "bad_alloc", "out of memory", "gets no more events"):
            if line := next((line for line in lines if word in line), None):
                return f"said {line.replace(str(self.here), '')[:200]!r}"
        if self.watch.found or self.state() != before:
            return f"wrote outside the run folder: {self.watch.found[:1]}"
        if grown > HELD:
            return f"took {grown >> 20} MiB"
        return f"took {seconds:.0f} s" if seconds > SECONDS else None

    def state(self) -> dict[str, tuple[int, int]]:
        """Size and time of every file that is not to be changed."""
        found = {}
        for path in self.here.rglob("*"):
            name = path.relative_to(self.here).as_posix()
            if not name.startswith(WRITTEN) and path.is_file():
                found[name] = (path.stat().st_size, path.stat().st_mtime_ns)
        return found


def peak() -> int:
    """Most memory held so far."""
    from surfkit.core.memory import peak_memory_bytes

    return peak_memory_bytes()


@contextlib.contextmanager
def damaged_output(damage: Damage | None, sound: io.StringIO) -> Iterator[Any]:
    """What stands for stdout: a file that takes nothing, or nothing at all."""
    kind = None if damage is None else OUTPUTS[damage.what % len(OUTPUTS)]
    if kind in (None, "closed"):
        yield sound if kind is None else None
        return
    if kind == "full":
        file = open("/dev/full", "w")
    else:
        reader, writer = os.pipe()
        os.close(reader)
        file = open(writer, "w")
    try:
        yield file
    finally:
        with contextlib.suppress(OSError):
            file.close()


@contextlib.contextmanager
def giving_out(damage: Damage | None) -> Iterator[None]:
    """Within, one of the calls of surfkit's functions fails for want of memory, as Python, numpy and torch say it."""
    if damage is None:
        yield
        return
    errors = (MemoryError(), RuntimeError("DefaultCPUAllocator: can't allocate memory: you tried to allocate 8 bytes"))
    left = int(MOST_CALLS**damage.at)

    def called(frame: Any, event: str, argument: object) -> None:
        nonlocal left
        code = frame.f_code
        ours = "/surfkit/" in code.co_filename and not code.co_filename.startswith(GUARD)
        if ours and not code.co_flags & inspect.CO_GENERATOR:  # which are also called to be closed
            left -= 1
            if left == 0:
                sys.settrace(None)
                raise errors[damage.what % 2]

    sys.settrace(called)
    try:
        yield
    finally:
        sys.settrace(None)


@contextlib.contextmanager
def limited() -> Iterator[None]:
    """Within, time and address space are bounded."""

    def late(number: int, frame: object) -> None:
        raise TimeoutError(f"no end after {SECONDS} s")

    pages = int(Path("/proc/self/statm").read_text().split()[0])
    soft, hard = resource.getrlimit(resource.RLIMIT_AS)
    handler = signal.signal(signal.SIGALRM, late)
    signal.alarm(SECONDS)
    resource.setrlimit(resource.RLIMIT_AS, (pages * resource.getpagesize() + GROWTH, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, (soft, hard))
        signal.alarm(0)
        signal.signal(signal.SIGALRM, handler)


def explore(name: str, folder: Path, cases: int, seed: int, log: Path) -> None:
    """Make cases, and write down each before it is run and what was found; done in a process of its own."""
    from hypothesis import HealthCheck, Phase, given, settings
    from hypothesis import seed as seeded

    fuzz = Fuzz(name, folder)
    if clean := fuzz.case([]):
        raise SystemExit(f"{name}: without any damage: {clean}")
    if not fuzz.files:
        raise SystemExit(f"{name}: no files to damage")

    @seeded(seed)
    @settings(
        max_examples=cases,
        deadline=None,
        database=None,
        phases=[Phase.generate],
        suppress_health_check=list(HealthCheck),
    )
    @given(damages(fuzz.files))
    def explored(listed: list[Damage]) -> None:
        with log.open("a") as file:
            file.write(json.dumps({"case": [asdict(damage) for damage in listed]}) + "\n")
            file.flush()
            if found := fuzz.case(listed):
                file.write(json.dumps({"found": asdict(found)}) + "\n")

    explored()
    with log.open("a") as file:
        file.write(json.dumps({"done": True}) + "\n")


def chunk(name: str, cases: int, seed: int) -> tuple[int, list[Finding]]:
    """Cases in a process of their own: how many, and what was found."""
    with tempfile.TemporaryDirectory() as folder:
        log = Path(folder) / "log"
        log.touch()
        pid = os.fork()
        if pid == 0:
            status = 70
            try:
                quiet = os.open(os.devnull, os.O_WRONLY)
                os.dup2(quiet, 2) if not os.environ.get("FUZZ_SHOW") else None
                explore(name, Path(folder), cases, seed, log)
                status = 0
            except BaseException:
                log.write_text(log.read_text() + json.dumps({"error": traceback.format_exc()}) + "\n")
            finally:
                os._exit(status)
        moved, size = time.monotonic(), 0
        while os.waitid(os.P_PID, pid, os.WEXITED | os.WNOHANG | os.WNOWAIT) is None:
            if log.stat().st_size != size:
                moved, size = time.monotonic(), log.stat().st_size
            if time.monotonic() - moved > SECONDS + 10:
                os.kill(pid, signal.SIGKILL)
            time.sleep(0.05)
        status = os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])
        rows = [json.loads(line) for line in log.read_text().splitlines()]
    if broken := [row["error"] for row in rows if "error" in row]:
        raise SystemExit(broken[0])
    found = [Finding(**row["found"]) for row in rows if "found" in row]
    made = [row["case"] for row in rows if "case" in row]
    if not rows or "done" not in rows[-1]:
        what = "an endless loop" if status == -signal.SIGKILL else f"the process ended with {status}"
        found.append(Finding(what, name, "", made[-1] if made else [], ""))
    return len(made), found


def main() -> int:
    """Run it."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--cases", type=int, default=10_000)
    parser.add_argument("--targets", nargs="+", default=list(TARGETS), choices=list(TARGETS))
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path)
    chosen = parser.parse_args()
    os.environ.update(OMP_NUM_THREADS="1", OMP_WAIT_POLICY="PASSIVE", SURFKIT_PLUGINS="none")
    import torch.fx.experimental.symbolic_shapes  # noqa: F401  (slow ones, loaded once: processes are forked from here)

    from surfkit import pipeline  # noqa: F401
    from surfkit.cli.recipes import recipes
    from surfkit.scene.capture import library

    recipes(), library()
    found: dict[tuple[str, str], Finding] = {}
    counts = dict.fromkeys(chosen.targets, 0)
    seed, start = chosen.seed * 1_000_003, time.monotonic()
    while sum(counts.values()) < chosen.cases:
        for name in chosen.targets:
            seed += 1
            made, findings = chunk(name, min(CHUNK, chosen.cases), seed)
            counts[name] += made
            for finding in findings:
                key = (finding.what, name)
                if key in found:
                    found[key].times += 1
                else:
                    found[key] = finding
                    print(f"{name}: {finding.what}\n    {finding.damages}\n    {finding.said[-600:]}", flush=True)
        print(f"{sum(counts.values())} cases, {time.monotonic() - start:.0f} s", file=sys.stderr, flush=True)
    report = {"cases": counts, "seconds": round(time.monotonic() - start), "found": [asdict(f) for f in found.values()]}
    for finding in found.values():
        print(f"{finding.times:5} x {finding.target}: {finding.what}")
    print(f"{sum(counts.values())} cases, {len(found)} kinds of findings, {report['seconds']} s")
    if chosen.out:
        chosen.out.write_text(json.dumps(report, indent=2) + "\n")
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(main())
