"""What is damaged, and the commands that are given to it."""

from __future__ import annotations

import os
import shutil
import signal
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from . import programs, splats
from .data import arrays, blender, colmap, lenses, matrixcity, nerfstudio, odm, pictures

OUTPUT, MEMORY = "the output", "the memory"
"""What is damaged beside files, and settings, which begin with --."""
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


def run_folder(here: Path, words: str = TRAIN, stop: str | None = None) -> None:
    """A run that is finished, or stopped after the first step of a stage, such as "pretrain" or "block 1"."""
    from surfkit.cli import main
    from surfkit.runs import run_stage as stage

    colmap(here)
    display = stage.TrainingDisplay

    class Stopping(display):
        def show(self, done: Any) -> None:
            if self.stage == stop:
                os.kill(os.getpid(), signal.SIGTERM)

    stage.TrainingDisplay = Stopping
    try:
        status = main(words.replace("--steps 2", "--steps 2 --checkpoint-every 1").format(here=here).split())
    finally:
        stage.TrainingDisplay = display
    assert status == (130 if stop else 0), status


def compared(here: Path) -> None:
    """A finished run, and what its mesh is compared with and in."""
    from surfkit.evaluate.geometry.transform import write_transform
    from surfkit.scene.crop import box, write_crop

    run_folder(here)
    shutil.copy(here / "out" / "mesh.ply", here / "truth.ply")
    write_crop(here / "crop.json", box((-50.0, -50.0, -50.0, 50.0, 50.0, 50.0)))
    write_transform(here / "frame.json", np.eye(4))


def recipe_file(here: Path) -> None:
    """A recipe, and a copy of it: each may be put in the place of the other."""
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
PREPARE = "prepare depth {here}/data --device cpu estimator:plane-sweep --estimator.window 3 --estimator.max-planes 16"
TETRA = "mesh {here}/out mesh:tetra --device cpu"
READING = ("--longest", "--scale", "--test-every", "--metres-per-unit")
SWEEP = tuple(
    f"--estimator.{name}"
    for name in (
        "longest", "neighbours", "angle", "visible", "step-px", "max-planes", "margin", "window", "step-cost",
        "jump-cost", "tolerance", "edge", "agree",
    )
)  # fmt: skip
STEREO = "prepare depth {here}/data --device cpu estimator:patch-match --estimator.rounds 1"
PATCHES = tuple(
    f"--estimator.{name}"
    for name in (
        "longest", "scale", "neighbours", "angle", "best", "window", "spread", "smoothness", "brightness", "passes",
        "consistency", "rounds", "coarsest", "tolerance-px", "agree",
    )
)  # fmt: skip
SURFACE = f"train recipe:surface --steps 2 {SMALL} --data {{here}}/data --out {{here}}/out"
DELIVERY = ("--lods", "--clusters", "--least-triangles", "--memory", "--metres-per-unit", "--crop-box 0 0 0 1 1")
EXPORTS = (".ply", ".compressed.ply", ".glb", ".sog", ".splat", ".spz", ".surfkit")


def exports(name: str) -> Target:
    """A file of splats of a format, written in all others."""

    def make(here: Path) -> None:
        splats.write_model(here / "data", name)

    found = next(suffix for key, suffix in SUFFIXES.items() if name.startswith(key))
    words = tuple(f"export {{here}}/data/model{found} --out {{here}}/out/model{suffix}" for suffix in EXPORTS)
    return Target(make, words, ("data/model*",))


SUFFIXES = {
    "compressed-ply": ".compressed.ply",
    "gltf": ".glb",
    "ply": ".ply",
    "sog": ".sog",
    "splat": ".splat",
    "spz": ".spz",
    "surfkit": ".surfkit",
}
TARGETS = {
    **{f"splats-{name}": exports(name) for name in splats.FORMATS},
    "colmap-text": Target(colmap, (TRAIN, DEEP), MODEL),
    "colmap-binary": Target(lambda here: colmap(here, binary=True), (TRAIN, DEEP), MODEL),
    "photographs": Target(colmap, (TRAIN,), ("data/images/*",)),
    "surface": Target(colmap, (SURFACE,), ("data/images/*", *MODEL)),
    "lenses-and-masks": Target(
        lenses, (TRAIN, DEEP), ("data/masks/*", "data/images/*1.png", "data/sparse/0/cameras.txt")
    ),
    "depth-arrays": Target(arrays, (DEEP,), ("data/estimated_depths/*",)),
    "depth-pictures": Target(pictures, (DEEP,), ("data/sparse/0/depth_params.json", "data/depths/*")),
    "nerfstudio": Target(nerfstudio, (DEEP,), ("data/*.json", "data/*.json", "data/*.ply", "data/depth/*1.png")),
    "points-as-text": Target(lambda here: nerfstudio(here, text=True), (TRAIN,), ("data/*.ply",)),
    "blender": Target(blender, (TRAIN,), ("data/*.json",)),
    "matrixcity": Target(matrixcity, (TRAIN,), ("data/*/*/*.json",)),
    "odm": Target(odm, (TRAIN, DEEP), ("data/opensfm/*",)),
    "bundler": Target(programs.bundler, (TRAIN, DEEP), ("data/bundle.out", "data/bundle.out", "data/list.txt")),
    "metashape": Target(programs.metashape, (TRAIN,), ("data/cameras.xml",)),
    "openmvg": Target(programs.openmvg, (TRAIN, DEEP), ("data/sfm_data.json",)),
    "pix4d": Target(programs.pix4d, (TRAIN,), ("data/params/*",)),
    "realitycapture": Target(programs.realitycapture, (TRAIN,), ("data/cameras.csv",)),
    "recipe": Target(recipe_file, (TRAIN.replace("recipe:2dgs", "recipe:{here}/r.json"),), ("r.json",)),
    "run": Target(run_folder, COMMANDS, ("out/*", "out/*", "out/pretrain/*", "out/pretrain/*")),
    "stopped-run": Target(lambda here: run_folder(here, stop="pretrain"), COMMANDS[::3], ("out/*", "out/pretrain/*")),
    "blocks": Target(
        lambda here: run_folder(here, BLOCKS, "block 1"),
        (BLOCKS, COMMANDS[0], "train-block {here}/out 1 --device cpu --cache 1MB"),
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
    "numbers-stereo": Target(colmap, (STEREO,), (), (*PATCHES, *READING)),
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
