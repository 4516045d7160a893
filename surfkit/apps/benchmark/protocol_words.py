"""A protocol in words."""

from __future__ import annotations

from collections.abc import Iterator

from surfkit.apps.benchmark.protocol import BenchmarkScene, Contender, Protocol
from surfkit.core.codec import dump
from surfkit.core.registry import name_of
from surfkit.study.metric_columns import TABLE_COLUMNS


def description(protocol: Protocol) -> Iterator[str]:
    """Everything that is fixed, a line each."""
    yield f"{protocol.tag}: {protocol.about}; digest of the declaration {protocol.digest}"
    yield from protocol.rules
    yield f"measured: {', '.join(TABLE_COLUMNS[name].head for name in protocol.columns)}"
    if protocol.estimator is not None:
        settings = ", ".join(f"{name} {it}" for name, it in dump(protocol.estimator).items() if name != "use" and it)
        yield f"depth maps, where a recipe learns from some: {name_of(protocol.estimator)} ({settings})"
    for each in protocol.contenders:
        yield _row(protocol, each)
    for scene in protocol.scenes:
        yield from _scene(scene)
    yield from (f"from {key}: {told}" for key, told in protocol.sources.items())


def _row(protocol: Protocol, contender: Contender) -> str:
    recipe = contender.recipe
    names = f"recipe:{recipe}" if isinstance(recipe, str) else ", ".join(f"recipe:{name}" for name in recipe.values())
    steps = contender.steps or protocol.steps
    length = f", {steps:,} steps" if steps else ", the steps of the recipe"
    return f"row {contender.label}: {names}{length}{'' if contender.by_default else '; only where it is named'}"


def _scene(scene: BenchmarkScene) -> Iterator[str]:
    reading, usual = dump(scene.reading), dump(type(scene.reading)())
    read = ", ".join(f"{name} {_plain(it)}" for name, it in reading.items() if it != usual[name])
    yield f"scene {scene.name}, folder {scene.folder}: read with {read}; {scene.truth.words()}"
    for needed in (*scene.needed, *scene.truth.needed()):
        counts = ((needed.pictures, "pictures"), (needed.points, "points"), (needed.faces, "faces"))
        told = "".join(f", {_count(count)} {what}" for count, what in counts if count is not None)
        yield f"scene {scene.name} needs {needed.path}: {needed.what}{told}; from {needed.source}"
    if scene.training is not None:
        yield f"scene {scene.name} has {_count(scene.training)} training photographs"


def _plain(value: object) -> str:
    return str(value["use"]) if isinstance(value, dict) else str(value)


def _count(count: tuple[int, int | None]) -> str:
    least, most = count
    return f"{least:,}" if least == most else f"{least:,} or more" if most is None else f"{least:,} to {most:,}"
