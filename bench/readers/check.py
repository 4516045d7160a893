"""Whether the programs of others read what surfkit exports, and surfkit what they write.

    cd bench/readers && npm ci --ignore-scripts && cd ../.. && pip install gaussforge
    python bench/readers/check.py RUN/point_cloud.ply                   # exports every format first
    python bench/readers/check.py RUN/point_cloud.ply --pictures RUN    # and draws it in web viewers

One line for each file and program: the largest error as a share of what the specification of the format allows (above
1 they disagree), and whether surfkit's own reader gets the same. Exit status 1 if anything disagrees, 2 if Node.js, its
packages or Chromium are missing; a Python package or a validator that is missing is told. The figures go to
bench/results/readers.json, the pictures to the folder of the exports.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable
from dataclasses import asdict, dataclass, fields
from pathlib import Path

import numpy as np

sys.path[:0] = [str(Path(__file__).parent), str(Path(__file__).parents[1])]
import programs  # noqa: E402
import splat_columns as tables  # noqa: E402
from machine import save  # noqa: E402
from programs import Missing  # noqa: E402
from splat_columns import Bounds, Splats, difference, precision, read_ply, representable  # noqa: E402

from surfkit.core.check import BadInput  # noqa: E402
from surfkit.io.splats.splat_files import read_splat_file  # noqa: E402

Z_UP = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
"""What programs turn the content of a tile by: y up, as glTF has it, becomes z up."""

FEW = 2_000
"""Splats of the files that splat-transform compresses as SOG: on a CPU it takes minutes for more."""


@dataclass(frozen=True)
class Row:
    """One program and one file.

    Attributes:
        is_right: None if the program is not installed, or draws no such files.
        worst: The largest error as a share of what is allowed, or None where positions or messages were looked at.
    """

    file: str
    program: str
    is_right: bool | None
    worst: float | None
    note: str


def form_of(path: Path) -> str:
    """The format by the name of a file."""
    names = {".compressed.ply": "compressed-ply", ".splat": "splat", ".spz": "spz", ".sog": "sog", ".ply": "ply"}
    return next((form for suffix, form in names.items() if path.name.endswith(suffix)), "gltf")


def ours(path: Path) -> Splats:
    """What surfkit's own reader gets, with the thickness that surfels have in files."""
    table = read_splat_file(path)
    columns = (table.means, table.ellipsoid_log_scales(), table.quats)
    rest = table.sh_rest.transpose(1, 2).flatten(1)
    alpha = tables.sigmoid(table.opacity_logits.numpy())
    got = tables.made(*(c.double().numpy() for c in columns), alpha, table.sh0.numpy(), rest.numpy())
    return tables.turned(got) if programs.is_as_in_ply(path) else got


SAME = Bounds(1e-4, np.array([1e-4, 1e-4, 1.5]), 0.009, 0.51 / 255, 1e-4, 1e-5)
"""Two readers of the same bytes: rounding of float32; surfels get their third scale anew; .splat has two formulas for
rotations, of 127.5 and of 128 steps; the bytes 0 and 255 of opacities stand for what is nearest, not for 0 and 1."""


def compared(path: Path, program: str, reference: Splats, read: Callable[[Path], Splats]) -> Row:
    """A row for a reader that gives all attributes."""
    form = form_of(path)
    try:
        got = read(path)
        shares = difference(representable(reference, form), got, precision(form, path, reference))
        if reference.rest.shape[1] and not got.rest.shape[1] and form != "splat":
            raise ValueError("spherical harmonics are lost")
        worst = max(shares, key=shares.get)
        own = difference(ours(path), got, SAME)
        differs = max(own, key=own.get)
        is_same = own[differs] <= 1
        note = f"{len(got):,} splats; {worst}" + ("" if is_same else f"; surfkit's reader differs in {differs}: {own}")
        return Row(path.name, program, shares[worst] <= 1 and is_same, shares[worst], note)
    except (Missing, ValueError, BadInput, OSError, KeyError) as error:
        return failed(path, program, error)


def failed(path: Path, program: str, error: Exception) -> Row:
    """A row for a program that is missing or refuses a file."""
    said = str(error) if isinstance(error, Missing | ValueError) else f"{type(error).__name__}: {error}"
    return Row(path.name, program, None if isinstance(error, Missing) else False, None, said[:240])


def placed(path: Path, program: str, reference: Splats, read: Callable[[Path], np.ndarray]) -> Row:
    """A row for a program that reads positions; a glTF's are those after the matrix of its node."""
    try:
        got = read(path)
        wanted = reference.means
        if path.suffix == ".glb":
            matrix = np.array(programs.three(path)[1]["matrix"]).reshape(4, 4).T
            wanted = wanted @ matrix[:3, :3].T + matrix[:3, 3]
        if got.shape != wanted.shape:
            raise ValueError(f"{len(got):,} points; the reference has {len(wanted):,}")
        share = float(np.abs(got - wanted).max() / (2e-6 * max(1.0, np.abs(wanted).max())))
        return Row(path.name, program, share <= 1, share, f"{len(got):,} points; positions")
    except (Missing, ValueError, OSError, ImportError) as error:
        return failed(path, program, error)


def validated(path: Path, program: str, read: Callable[[Path], list[dict]]) -> Row:
    """A row for a validator: errors and warnings count, notices are told."""
    try:
        messages = read(path)
        bad = [m for m in messages if str(m.get("level", m.get("severity"))).lower() in ("error", "warning")]
        told = "; ".join(sorted({f"{m.get('code', m.get('type'))}: {m['message']}" for m in bad or messages}))
        return Row(path.name, program, not bad, None, f"{len(bad)} errors and warnings. {told}"[:300])
    except (Missing, ValueError, OSError) as error:
        return failed(path, program, error)


def gltf_compared(path: Path, reference: Splats) -> Row:
    """All attributes of a GLB as three.js reads them, in the axes of its primitive, and the extensions it names."""
    program = "three.js"
    try:
        got, said = programs.three(path)
        matrix = np.array(said["matrix"]).reshape(4, 4).T
        packed = bool(said.get("spz"))
        got = tables.replace(got, means=got.means + np.linalg.inv(matrix[:3, :3]) @ matrix[:3, 3])
        bounds, wanted = precision("gltf", path, reference), reference
        if packed:
            wanted = representable(reference, "spz")
            bounds = tables.spz_bounds(said["spz_head"], reference)
        shares = difference(wanted, got, bounds)
        worst = max(shares, key=shares.get)
        lacks = [
            name
            for name in ("KHR_gaussian_splatting", *(["KHR_gaussian_splatting_compression_spz_2"] * packed))
            if name not in said["used"]
        ]
        is_turn = np.allclose(matrix[:3, :3] @ matrix[:3, :3].T, np.eye(3)) and np.linalg.det(matrix[:3, :3]) > 0
        faults = [f"extensionsUsed lacks {name}" for name in lacks] + ["the node's matrix is no rotation"] * (
            not is_turn
        )
        note = "; ".join([f"{len(got):,} splats; {worst}", *faults])
        return Row(path.name, program, shares[worst] <= 1 and not faults, shares[worst], note)
    except (Missing, ValueError, OSError, KeyError) as error:
        return failed(path, program, error)


def leaves(tile: dict) -> list[dict]:
    """The tiles of full detail below a tile of tileset.json."""
    children = tile.get("children", [])
    return [leaf for child in children for leaf in leaves(child)] if children else [tile]


def tiles_compared(folder: Path, reference: Splats) -> Row:
    """All attributes of the tiles of full detail, and that each box contains the splats of its tile."""
    program = "three.js"
    try:
        tiles = [
            tile for tile in leaves(json.loads((folder / "tileset.json").read_text())["root"]) if "content" in tile
        ]
        parts, digits, faults = [], [], []
        for tile in tiles:
            got, said = programs.three(folder / tile["content"]["uri"])
            matrix = np.array(said["matrix"]).reshape(4, 4).T
            if not np.allclose(Z_UP @ matrix[:3, :3], np.eye(3), atol=1e-9):
                faults.append(f"{tile['content']['uri']}: its node does not turn z up to y up")
            parts.append(tables.replace(got, means=got.means + np.linalg.inv(matrix[:3, :3]) @ matrix[:3, 3]))
            digits.append(said["spz_head"] if said.get("spz") else None)
            box = np.array(tile["boundingVolume"]["box"]).reshape(4, 3)
            if (np.abs((parts[-1].means - box[0]) @ np.linalg.inv(box[1:])) > 1 + 1e-6).any():
                faults.append(f"{tile['content']['uri']}: splats outside of its box")
        got = Splats(*(np.concatenate([getattr(p, f.name) for p in parts]) for f in fields(Splats)))
        bounds, wanted = precision("gltf", folder, reference), reference
        if all(digits):
            coarse = min(digits, key=lambda head: head["fractional_bits"])
            bounds, wanted = tables.spz_bounds(coarse, reference), representable(reference, "spz")
        shares = difference(wanted, got, bounds)
        worst = max(shares, key=shares.get)
        note = "; ".join([f"{len(got):,} splats in {len(tiles)} tiles; {worst}", *faults])[:300]
        return Row(folder.name, program, shares[worst] <= 1 and not faults, shares[worst], note)
    except (Missing, ValueError, OSError, KeyError) as error:
        return failed(folder, program, error)


def read_by_others(folder: Path, reference: Splats) -> list[Row]:
    """What programs of others make of the files that surfkit wrote."""
    rows = []
    for path in sorted(folder.glob("model.*")):
        form = form_of(path)
        if path.suffix in (".glb", ".gltf"):
            rows.append(validated(path, "glTF-Validator", lambda p: programs.gltf_messages(p)[str(p)]))
            rows.append(gltf_compared(path, reference))
            if ".spz" not in path.name:
                rows.append(placed(path, "trimesh", reference, programs.trimesh_points))
        elif path.suffix in (".ply", ".splat", ".spz", ".sog"):
            rows.append(compared(path, "splat-transform", reference, programs.splat_transform))
            if form != "splat" and reference.rest.shape[1]:
                rows.append(compared(path, "gaussforge", reference, programs.gaussforge))
            if form == "spz":
                rows.append(compared(path, "spz library", reference, programs.spz_library))
            if form == "ply":
                rows.append(placed(path, "trimesh", reference, programs.trimesh_points))
                rows.append(placed(path, "Open3D", reference, programs.open3d_points))
        elif (path / "tileset.json").is_file():
            rows.append(validated(path, "3d-tiles-validator", lambda p: programs.tiles_messages(p / "tileset.json")))
            rows.append(tiles_compared(path, reference))
    return rows


def meshes_read(run: Path) -> list[Row]:
    """Whether trimesh and Open3D find the same triangles in each file of the mesh of a run, wherever its origin is."""
    rows, first = [], None
    for path in sorted(run.glob("mesh.*"), key=lambda path: path.suffix != ".ply"):
        if path.suffix not in (".ply", ".obj", ".glb"):
            continue
        for program, read in (("trimesh", programs.trimesh_triangles), ("Open3D", programs.open3d_triangles)):
            try:
                corners = read(path)
                size = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
                found = (len(corners), float(size.sum()), np.sort(np.ptp(corners.reshape(-1, 3), axis=0)))
                first = first or found
                is_same = found[0] == first[0] and np.allclose(found[1], first[1], rtol=1e-4)
                is_same = is_same and np.allclose(found[2], first[2], rtol=1e-4)
                rows.append(
                    Row(path.name, program, bool(is_same), None, f"{found[0]:,} triangles; number, area, extents")
                )
            except (Missing, ValueError, OSError, ImportError) as error:
                rows.append(failed(path, program, error))
        if path.suffix == ".glb":
            rows.append(validated(path, "glTF-Validator", lambda p: programs.gltf_messages(p)[str(p)]))
    return rows


def written_by_others(model: Path, folder: Path, reference: Splats) -> list[Row]:
    """What surfkit makes of files that programs of others wrote from the same PLY file."""
    few = folder / "few.ply"
    write_few(model, few)
    rows = []
    for name, source, options in (
        ("theirs.compressed.ply", model, ()), ("theirs.v3.same.spz", model, ("--spz-version", "3")),
        ("theirs.v4.same.spz", model, ("--spz-version", "4")), ("theirs.sog", few, ()), ("theirs.ply", model, ()),
    ):  # fmt: skip
        out = folder / name
        try:
            programs.write_by_splat_transform(source, out, *options)
            rows.append(agreed(out, "by splat-transform", programs.splat_transform))
        except (Missing, ValueError) as error:
            rows.append(failed(out, "by splat-transform", error))
    for name, source, read in (
        ("forge.splat", model, programs.splat_transform), ("forge.compressed.ply", model, programs.gaussforge),
        ("forge.same.spz", model, programs.gaussforge), ("forge.sog", few, programs.gaussforge),
    ):  # fmt: skip
        out = folder / name
        try:
            programs.write_by_gaussforge(source, out)
            rows.append(agreed(out, "by gaussforge", read))
        except (Missing, ValueError) as error:
            rows.append(failed(out, "by gaussforge", error))
    for version in (2, 3, 4):
        out = folder / f"theirs.v{version}.spz"
        try:
            programs.write_by_spz_library(reference, out, version)
            rows.append(agreed(out, "by spz library", programs.spz_library))
        except (Missing, ValueError) as error:
            rows.append(failed(out, "by spz library", error))
    return rows


def agreed(path: Path, program: str, read: Callable[[Path], Splats]) -> Row:
    """Whether surfkit reads a file as the program that wrote it does."""
    try:
        theirs = read(path)
        shares = difference(ours(path), theirs, SAME)
        worst = max(shares, key=shares.get)
        return Row(
            path.name,
            program,
            shares[worst] <= 1,
            shares[worst],
            f"{len(theirs):,} splats; surfkit against it; {worst}",
        )
    except (Missing, ValueError, BadInput, OSError, KeyError) as error:
        return failed(path, program, error)


def write_few(model: Path, out: Path) -> None:
    """The first splats of a PLY file, byte for byte."""
    rows = tables.elements(model)["vertex"]
    head = model.read_bytes().partition(b"end_header\n")[0].decode()
    short = "\n".join(
        f"element vertex {min(FEW, len(rows))}" if w.startswith("element vertex") else w for w in head.splitlines()
    )
    out.write_bytes(short.encode() + b"\nend_header\n" + rows[:FEW].tobytes())


def table_of(rows: list[Row]) -> str:
    """The rows as text."""
    lines = [f"{'file':24}{'program':22}{'':7}{'share':>8}  note"]
    for row in rows:
        share = "" if row.worst is None else f"{row.worst:8.3f}"
        state = {True: "ok", False: "FAULT", None: "n/a"}[row.is_right]
        lines.append(f"{row.file:24}{row.program:22}{state:7}{share:>8}  {row.note}")
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("model", type=Path, help="PLY file of a trained model")
    parser.add_argument("--folder", type=Path, default=None, help="of the exports; beside the model by default")
    parser.add_argument("--exported", action="store_true", help="the files are there; do not export again")
    parser.add_argument("--meshes", type=Path, default=None, metavar="RUN", help="read the mesh files of RUN too")
    parser.add_argument(
        "--pictures",
        type=Path,
        default=None,
        metavar="RUN",
        help="draw the files in web viewers from a held-out camera of RUN",
    )
    options = parser.parse_args()
    try:
        programs.find_node()
        if options.pictures:
            programs.find_chromium()
    except Missing as error:
        print(error, file=sys.stderr)
        sys.exit(2)
    folder = options.folder or options.model.parent / "exports"
    if not options.exported:
        from export import write_all

        write_all(options.model, folder)
    reference = read_ply(options.model)
    rows = read_by_others(folder, reference) + written_by_others(options.model, folder, reference)
    if options.meshes:
        rows += meshes_read(options.meshes)
    if options.pictures:
        from pictures import drawn

        rows += drawn(folder, options.pictures)
    print(table_of(rows))
    print(f"wrote {save('readers', {'splats': len(reference), 'rows': [asdict(row) for row in rows]})}")
    counts = {state: sum(row.is_right is state for row in rows) for state in (True, False, None)}
    print(f"{counts[True]} right, {counts[False]} faults, {counts[None]} not checked")
    sys.exit(1 if counts[False] else 0)


if __name__ == "__main__":
    main()
