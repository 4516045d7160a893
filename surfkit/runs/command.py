"""Commands that go on with a run or make what it lacks, from what lies in its folder."""

from __future__ import annotations

import shlex
from collections.abc import Iterator
from dataclasses import fields, is_dataclass
from typing import Any

from surfkit.core.check import BadInput
from surfkit.core.registry import Component, name_of
from surfkit.io.datasets.data import ReadSettings
from surfkit.runs.folder import Run


def train_command(run: Run) -> str:
    """The `surfkit train` command that finishes a run, to be pasted; it names the recipe in the run folder."""
    words = [f"recipe:{run.out / 'recipe.json'}", "--data", str(run.data.path), "--out", str(run.out)]
    for field in fields(ReadSettings):
        value = getattr(run.data, field.name)
        if field.name != "test_every" and value != field.default:  # what is held out, the folder tells as well
            words += _words(field.name, value)
    return shlex.join(["surfkit", "train", *words])


def _words(name: str, value: Any) -> Iterator[str]:
    """The words that set a field of the command line, or one inside of it."""
    name = name.replace("_", "-")
    if isinstance(value, Component) and is_dataclass(value):
        yield f"{name}:{name_of(value)}"
        for field in fields(value):
            if (inner := getattr(value, field.name)) != field.default:
                yield from _words(f"{name}.{field.name}", inner)
    elif isinstance(value, bool):
        yield f"--{name}" if value else f"--{name.rpartition('.')[0]}.no-{name.rpartition('.')[2]}"
    else:
        yield f"--{name}"
        yield str(value).removesuffix(".0") if isinstance(value, float) else str(value)


def refuse_no_mesh(run: Run) -> None:
    """BadInput if a run has no mesh of its model."""
    is_run = (run.out / "recipe.json").exists()  # and not the compressed model in one
    if is_run and not run.metrics.exists() and not (run.mesh.exists() and run.mesh_record.exists()):
        raise BadInput(f"{run.out}: no {run.mesh.name}, as the run is not finished; `{train_command(run)}` finishes it")
    if not run.mesh.exists():
        raise BadInput(f"{run.out}: no {run.mesh.name} in it; make it with surfkit mesh, or name a file")
    if not run.mesh_record.exists():
        raise BadInput(
            f"{run.mesh}: without {run.mesh_record.name} it is of an earlier model, or half made; make it with "
            "surfkit mesh, or name the file"
        )
