"""The check of formats of splats. It raises AssertionError with a sentence that says what is wrong."""

from __future__ import annotations

import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from surfkit.io.splats.base import SNIFFED_BYTES, Format
from surfkit.io.splats.splat_table import Kind, SplatTable, Tile
from surfkit.scene.scene import Frame
from surfkit.testing.equality import refuses, unchanged

MAX_POSITION_ROUNDING = 0.01
"""A position may be rounded to this share of the size of the scene."""
SURVEY_SHIFT = (500_000.0, 5_600_000.0, 0.0)
"""Of survey coordinates."""


def check_format(form: Format, count: int = 300) -> None:
    """A format writes a file, and nothing beside it, with the same bytes each time; it leaves its input alone, refuses
    NaN, keeps survey coordinates, and says in one line what it rounds. If it reads too: it knows its own files and no
    others, returns the same splats in any order, of the same kind, and refuses what is cut off with BadInput.

    Args:
        form: To check.
        count: Splats of the larger models.
    """
    name = type(form).__name__
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        kinds: tuple[Kind, ...] = ("gaussian", "surfel")
        for kind in kinds:
            for number, degree in ((0, 0), (1, 1), (count, 3)):
                _check_model(form, folder, splat_table(kind, number, degree), f"{name}, {number} splats ({kind})")
        _check_refusals(name, form, folder, splat_table("gaussian", count, 1))
        _check_survey(name, form, folder, splat_table("gaussian", count, 0))


def splat_table(kind: Kind = "gaussian", count: int = 300, degree: int = 1) -> SplatTable:
    """Random splats within a few units of 0, with colours and scales that every format has a place for."""
    draw = torch.Generator().manual_seed(count + degree)
    return SplatTable(
        kind=kind,
        means=4 * torch.rand(count, 3, generator=draw) - 2,
        quats=torch.randn(count, 4, generator=draw),
        log_scales=torch.rand(count, 2 if kind == "surfel" else 3, generator=draw) - 3.0,
        opacity_logits=torch.randn(count, generator=draw),
        sh0=2 * torch.rand(count, 3, generator=draw) - 1,
        sh_rest=0.2 * torch.rand(count, (degree + 1) ** 2 - 1, 3, generator=draw),
    )


def _check_model(form: Format, folder: Path, table: SplatTable, what: str) -> None:
    path = folder / f"{len(list(folder.iterdir()))}" / f"model{form.suffix}"
    path.parent.mkdir()
    with unchanged(f"{what}: write", table=table):
        form.write(path, table, tree=_tree(form, table))
    there = [other.name for other in path.parent.iterdir()]
    assert there == [path.name], f"{what}: wrote {sorted(there)} in place of {path.name}"
    before = _bytes(path)
    form.write(path, table, tree=_tree(form, table))
    assert _bytes(path) == before, f"{what}: the same splats give other bytes"
    told = form.rounding(table)
    assert isinstance(told, str) and "\n" not in told, f"{what}: rounding must be one line of text, not {told!r}"
    if not _reads(form):
        return
    assert form.knows(path, _head(path)), f"{what}: its own file is not known"
    found = form.read(path)
    assert len(found) == len(table), f"{what}: {len(found)} splats came back"
    assert found.sh_degree <= table.sh_degree, f"{what}: spherical harmonics of degree {found.sh_degree} came back"
    if len(table):
        assert found.kind == table.kind, f"{what}: they came back as {found.kind}"
        _check_same(what, table, found)


def _check_same(what: str, table: SplatTable, found: SplatTable) -> None:
    """Every splat came back near its place, with about its colour, opacity, size and rotation."""
    distance, nearest = torch.cdist(table.means.double(), found.means.double()).min(1)
    assert float(distance.max()) <= MAX_POSITION_ROUNDING * 4, (
        f"{what}: a position is {float(distance.max()):.3g} away from where it was"
    )
    back = found.take(nearest)
    columns = [("sh0", table.sh0, back.sh0, 0.2), ("scales", table.log_scales, back.log_scales, 0.2)]
    columns += [("opacities", table.opacity_logits.sigmoid(), back.opacity_logits.sigmoid(), 0.05)]
    columns += [("rotations", _rotations(table), _rotations(back), 0.1)]
    for column, before, after, bound in columns:
        worst = float((before - after).abs().max())
        assert worst <= bound, f"{what}: {column} came back {worst:.3g} away from what they were"


def _rotations(table: SplatTable) -> Tensor:
    """(N, 10) products of the components of the quaternions, which are the same for q and -q."""
    quats = torch.nn.functional.normalize(table.quats.float(), dim=1)
    pairs = torch.triu_indices(4, 4)
    return quats[:, pairs[0]] * quats[:, pairs[1]]


def _check_refusals(name: str, form: Format, folder: Path, table: SplatTable) -> None:
    """NaN is not written, and files that are cut off or foreign are not read."""
    path = folder / f"refused{form.suffix}"
    spoilt = table.sh0.clone()
    spoilt[len(table) // 2, 1] = float("nan")
    bad = replace(table, sh0=spoilt)
    refused = refuses(f"{name}.write, for NaN,", lambda: form.write(path, bad, tree=_tree(form, table)))
    assert refused, f"{name}.write takes NaN; call table.refuse_unsound(path)"
    assert not path.exists(), f"{name}.write leaves a file where it refused the splats"
    if not _reads(form) or not form.suffix:
        return
    foreign = folder / "foreign.txt"
    foreign.write_text("These are no splats.\n")
    assert not form.knows(foreign, _head(foreign)), f"{name}.knows a text file"
    form.write(path, table, tree=_tree(form, table))
    whole = path.read_bytes()
    for size in (10, len(whole) // 2 | 1):
        path.write_bytes(whole[:size])
        refused = refuses(f"{name}.read, for a file that is cut off,", lambda: form.read(path))
        assert refused, f"{name}.read takes a file cut off after {size} of {len(whole)} bytes"


def _check_survey(name: str, form: Format, folder: Path, table: SplatTable) -> None:
    """Coordinates of millions come back as they were, or without the shift of the frame."""
    path, frame = folder / f"survey{form.suffix}", Frame(np.array(SURVEY_SHIFT), 1.0, shift=SURVEY_SHIFT)
    far = replace(table, means=table.means.double() + torch.tensor(SURVEY_SHIFT, dtype=torch.float64))
    form.write(path, far, frame, _tree(form, far))
    if not _reads(form):
        return
    found = form.read(path).means.double()
    for known in (far.means, table.means.double()):
        if float(torch.cdist(known - known[0], found - known[0]).min(1).values.max()) <= MAX_POSITION_ROUNDING * 4:
            return
    raise AssertionError(f"{name} loses survey coordinates; write table.file_means(frame)")


def _reads(form: Format) -> bool:
    return type(form).read is not Format.read


def _tree(form: Format, table: SplatTable) -> Tile | None:
    if not form.wants_tree:
        return None
    means = table.means.double().numpy() if len(table) else np.zeros((1, 3))
    return Tile(table, means.min(0), means.max(0))


def _head(path: Path) -> bytes:
    return b"" if path.is_dir() else path.read_bytes()[:SNIFFED_BYTES]


def _bytes(path: Path) -> dict[str, bytes]:
    """Content of a file, or of all files in a folder."""
    if path.is_file():
        return {"": path.read_bytes()}
    return {str(p.relative_to(path)): p.read_bytes() for p in sorted(path.rglob("*")) if p.is_file()}
