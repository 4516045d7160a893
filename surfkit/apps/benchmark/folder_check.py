"""What a folder lacks for a benchmark: everything at once, before anything is trained."""

from __future__ import annotations

import os
import shlex
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from surfkit.apps.benchmark.data_record import pictures_in
from surfkit.apps.benchmark.protocol import BenchmarkScene, Contender, Protocol
from surfkit.apps.benchmark.truths import Count, Needed
from surfkit.core.check import BadInput, collecting, few
from surfkit.core.codec import dump
from surfkit.core.registry import name_of
from surfkit.evaluate.geometry.surface_file import read_surface
from surfkit.io.datasets.data import Data
from surfkit.io.datasets.depth_files import DEPTH_FOLDER, read_record
from surfkit.io.datasets.depth_prior import prior_files
from surfkit.io.datasets.read import read
from surfkit.runs.folder import Run
from surfkit.runs.recipe import complete
from surfkit.scene.jpeg import EOI_MARKER
from surfkit.scene.photos import photo_size
from surfkit.scene.scene import Scene
from surfkit.study.perceptual import refuse_unmeasurable

TAIL_BYTES = 1 << 16
"""Of a picture, in which its end must be."""


@dataclass(frozen=True)
class Finding:
    """Something that is not as the protocol has it.

    Attributes:
        scene: Name, or "" for all.
        place: File or folder.
        what: Is wrong with it.
        remedy: What to do, or where it comes from.
    """

    scene: str
    place: str
    what: str
    remedy: str = ""

    @property
    def text(self) -> str:
        """On one line."""
        return ": ".join(filter(None, (self.scene, self.place, self.what))) + (
            f"; {self.remedy}" if self.remedy else ""
        )


def look(
    protocol: Protocol, root: Path, scenes: Sequence[BenchmarkScene], contenders: Sequence[Contender]
) -> list[Finding]:
    """Everything that is missing, or is not what it should be, for some scenes and rows."""
    if not root.is_dir():
        what = "a file, not a folder" if root.exists() else "no such folder"
        return [Finding("", str(root), what, "name with --root the one that has the data of the benchmark")]
    found: list[Finding] = []
    for scene in scenes:
        found += _of_scene(protocol, root, scene, contenders)
    return list(dict.fromkeys(found))


def _of_scene(
    protocol: Protocol, root: Path, scene: BenchmarkScene, contenders: Sequence[Contender]
) -> Iterator[Finding]:
    """What one scene lacks. What rests on files that are not there is not looked at."""
    deeper = _one_level_deeper(root, scene)
    lacking = {each.path: list(_faults(root, each, deeper)) for each in (*scene.needed, *scene.truth.needed())}
    for needed in (*scene.needed, *scene.truth.needed()):
        source = protocol.sources[needed.source]
        for what in lacking[needed.path]:
            yield Finding(scene.name, str(root / needed.path), what, f"it is the {needed.what}, from {source}")
    if not any(lacking[each.path] for each in scene.truth.needed()):
        try:
            scene.truth.check(root)
        except BadInput as error:
            yield Finding(scene.name, "", str(error))
    if any(lacking[each.path] for each in scene.needed):
        return
    data = scene.data(root)
    try:
        with collecting() as faults:
            view_source = read(data)
    except BadInput as error:
        yield from (Finding(scene.name, "", str(fault)) for fault in dict.fromkeys(map(str, [*faults, error])))
        return
    if faults:
        yield from (Finding(scene.name, "", str(fault)) for fault in faults)
        return
    yield from _of_photographs(protocol, scene, data, view_source)
    yield from _of_depth(protocol, scene, contenders, data, view_source)


def _one_level_deeper(root: Path, scene: BenchmarkScene) -> Path | None:
    """The folder in the root that has most of what the root lacks, as where an archive was unpacked.

    Where the files of a scene lie in no folder of its name, one that lacks some of them is another scene.
    """
    missing = [each.path for each in (*scene.needed, *scene.truth.needed()) if not (root / each.path).exists()]
    found = {sub: sum(os.path.exists(sub / path) for path in missing) for sub in sorted(root.iterdir())}
    best = max(found, key=lambda sub: found[sub], default=None)
    least = len(missing) if scene.folder == "." else 1
    return best if best is not None and found[best] >= max(1, least) else None


def _faults(root: Path, needed: Needed, deeper: Path | None) -> Iterator[str]:
    """What is wrong with one file or folder; `deeper` is where what is missing may be."""
    path = root / needed.path
    if not path.exists():
        if deeper is None or not os.path.exists(deeper / needed.path):
            yield "missing"
        else:
            yield f"missing, but {deeper / needed.path} is there: move it, or name {deeper} with --root"
    elif needed.pictures is not None:
        yield from _of_pictures(path, needed)
    elif needed.points is not None or needed.faces is not None:
        try:
            surface = read_surface(path)
        except BadInput as error:
            yield f"cannot be used: {error}"
            return
        counts = ((len(surface), needed.points, "points"), (_faces(surface.faces), needed.faces, "faces"))
        yield from (text for count, wanted, what in counts if (text := _wrong(count, wanted, what)))
    elif path.is_file() and path.stat().st_size == 0:
        yield "empty"


def _faces(faces: object) -> int:
    return 0 if faces is None else len(faces)  # type: ignore[arg-type]


def _of_pictures(folder: Path, needed: Needed) -> Iterator[str]:
    """What is wrong with a folder of pictures: their number, and their sizes."""
    if not folder.is_dir():
        yield "a file, where there must be a folder"
        return
    pictures = pictures_in(folder)
    if text := _wrong(len(pictures), needed.pictures, "pictures"):
        yield text
    small, damaged = [], []
    for path in pictures if needed.longest else ():
        try:
            if max(photo_size(path)) < (needed.longest or 0):
                small.append(path.name)
            if not has_end(path):
                damaged.append(path.name)
        except BadInput:
            damaged.append(path.name)
    if small:
        yield f"smaller than {needed.longest} px: {len(small)} of {len(pictures)}, {few(small)}"
    if damaged:
        yield f"cannot be read, or end too early: {len(damaged)} of {len(pictures)}, {few(damaged)}"


def has_end(path: Path) -> bool:
    """Whether a PNG or JPEG file has its end; others are not looked at. What cameras write behind it may follow."""
    end = {".png": b"IEND", ".jpg": EOI_MARKER, ".jpeg": EOI_MARKER}.get(path.suffix.lower())
    with path.open("rb") as file:
        file.seek(max(0, path.stat().st_size - TAIL_BYTES))
        return end is None or end in file.read()


def _wrong(count: int, wanted: Count | None, what: str) -> str | None:
    """A line where a number is not what it must be."""
    if wanted is None:
        return None
    least, most = wanted
    if count >= least and (most is None or count <= most):
        return None
    told = f"{least:,}" if least == most else f"{least:,} or more" if most is None else f"{least:,} to {most:,}"
    return f"{count:,} {what.removesuffix('s') if count == 1 else what}, where there must be {told}"


def _of_photographs(protocol: Protocol, scene: BenchmarkScene, data: Data, read_scene: Scene) -> Iterator[Finding]:
    """What is wrong with the photographs that training and test get."""
    if text := _wrong(len(read_scene.train), scene.training, "training photographs"):
        yield Finding(scene.name, str(data.path), text, "take the data of the benchmark as they are handed out")
    if "psnr" in protocol.columns and not read_scene.held_out:
        yield Finding(scene.name, str(data.path), "no test photographs")
    if "lpips" in protocol.columns and read_scene.held_out:
        try:
            refuse_unmeasurable(read_scene.held_out)
        except BadInput as error:
            told = str(error).removeprefix("--columns lpips: ").removesuffix(", or leave lpips out")
            yield Finding("", "LPIPS", told)


def _of_depth(
    protocol: Protocol, scene: BenchmarkScene, contenders: Sequence[Contender], data: Data, read_scene: Scene
) -> Iterator[Finding]:
    """What is wrong with the depth maps that rows learn from and do not make themselves."""
    wanting = []
    for each in contenders:
        recipe = complete(protocol.recipe(each, scene))
        if recipe.depth is None and Run(Path(), recipe, data).wants_priors:
            wanting.append(each.label)
    if not wanting:
        return
    place, rows = str(data.path / DEPTH_FOLDER), ", ".join(wanting)
    if protocol.estimator is None:
        yield Finding(scene.name, place, f"{rows} learn from depth maps, which this protocol has none of")
        return
    files, size = prior_files(data, read_scene), max(max(v.camera.width, v.camera.height) for v in read_scene.train)
    missing = [v.name for v in read_scene.train if v.name not in files or not files[v.name].path.exists()]
    make = depth_command(protocol, data)
    if missing:
        what = f"{len(missing)} of {len(read_scene.train)} depth maps are missing, for {rows}: {few(missing)}"
        yield Finding(scene.name, place, what, f"make them: {make}")
        return
    made = read_record(data.path)
    if made.get("estimator") != dump(protocol.estimator) or made.get("longest") != size:
        told = f"not made by {name_of(protocol.estimator)} as the protocol has it, from photographs of {size} px"
        yield Finding(scene.name, place, told, f"make them again: {make} --again")


def depth_command(protocol: Protocol, data: Data) -> str:
    """Which command makes the depth maps of a scene."""
    assert protocol.estimator is not None, "a protocol without depth maps makes none"
    words = ["surfkit", "prepare", "depth", str(data.path), f"estimator:{name_of(protocol.estimator)}"]
    for name, value in dump(protocol.estimator).items():
        if name != "use" and value != dump(type(protocol.estimator)()).get(name):
            words += [f"--estimator.{name}", str(value)]
    words += ["--longest", str(data.longest)] if data.longest else []
    return shlex.join(words)
