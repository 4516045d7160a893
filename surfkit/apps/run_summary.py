"""What a finished run shows on the screen."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from surfkit.cli.console_table import print_table, tell
from surfkit.core.check import BadInput
from surfkit.core.codec import read_json
from surfkit.runs.folder import Run

LPIPS = {
    "lpips_vgg": "LPIPS VGG",
    "lpips_vgg_unscaled": "LPIPS VGG, as 3DGS",
    "lpips_alex": "LPIPS AlexNet",
    "lpips_alex_unscaled": "LPIPS AlexNet, [0, 1]",
}
"""Names in metrics.json, and on the screen."""

ALIGNED = {
    "psnr_aligned": ("PSNR", 2),
    "ssim_aligned": ("SSIM", 3),
    "lpips_vgg_aligned": ("LPIPS VGG", 3),
    "lpips_alex_aligned": ("LPIPS AlexNet", 3),
}
"""The same of aligned colours, with digits."""

LENGTH_UNITS = {"m": "metre", "unit": "unit"}
"""Of lengths of a mesh in metrics.json."""


def show(run: Run, metrics: dict[str, Any]) -> None:
    """Print a table of the metrics, and the paths of what was written.

    Raises:
        BadInput: An earlier process left the metrics, and they are damaged.
    """
    with refuse_damaged(run.metrics, "damaged; delete it, and the surfkit train command of the run measures again"):
        rows = result_rows(metrics)
    if "geometry" in metrics:
        remedy = "delete that part of it, and measure again with surfkit evaluate --gt"
        with refuse_damaged(run.metrics, f"geometry is damaged; {remedy}"):
            rows += geometry_rows(metrics["geometry"])
    if "mesh" in metrics:
        with refuse_damaged(run.metrics, "mesh is damaged; delete that part of it, and give surfkit evaluate again"):
            rows += quality_rows(metrics["mesh"])
    print_table(("metric", "value"), rows)
    print()
    if run.mesh_record.exists():
        with refuse_damaged(run.mesh_record, "damaged; delete it, and surfkit mesh makes the mesh again"):
            print_table(("mesh", "value"), mesh_rows(read_json(run.mesh_record, dict[str, Any])))
        print()
    if "compressed" in metrics and run.compressed_record.exists():
        record = read_json(run.compressed_record, dict[str, Any])
        print_table(("compressed", "before", "after"), compressed_rows(record, metrics))
        print()
    written = [("metrics", run.metrics), *[("points", run.cloud)] * run.cloud.exists()]
    if run.mesh_record.exists():  # without it, what is there is of an earlier model
        meshes = sorted(path for path in run.out.glob("mesh.*") if path.suffix in (".ply", ".obj", ".glb"))
        written += [("mesh", path) for path in meshes]
        written += [("picture of the mesh", path) for path in sorted(run.mesh_pictures.glob("*.png"))]
    written += [("levels of detail", run.lod_record)] * run.lod_record.exists()
    written += [("compressed model", run.compressed_model)] * run.compressed_record.exists()
    pictures = sorted(run.pictures.rglob("*.png")) if run.pictures.exists() else []
    written += [("picture", path) for path in pictures[:8]]
    print_table(("written", "path"), [(what, str(path)) for what, path in written])
    if len(pictures) > 8:
        tell(f"... and {len(pictures) - 8} more pictures in {run.pictures}")


def what_next(run: Run) -> str:
    """The commands that one would give after training, on one line."""
    mesh = (
        f"`{run.to_paste('maps')}` draws maps of its mesh"
        if run.mesh_record.exists()
        else f"`{run.to_paste('mesh')} mesh:tsdf` makes its mesh"
    )
    smaller = f"; `{run.to_paste('compress')}` makes the model smaller" if run.cloud.exists() else ""
    return f"next: `{run.to_paste('view')}` shows it in a browser; {mesh}{smaller}"


def show_geometry(out: Path, measured: dict[str, Any], images: dict[str, Any]) -> None:
    """Print tables of how close a surface is to the truth, in all and by class, of the mesh by itself, and the paths of
    what was written.

    Args:
        out: Folder of metrics.json.
        measured: What it says of the geometry, and of the mesh if it is one.
        images: Figures of parts of held-out photographs that were measured with it.
    """
    found = measured["geometry"]
    print_table(("geometry", "value"), [*geometry_rows(found), *zone_rows(images)])
    if "mesh" in measured:
        print()
        print_table(("mesh", "value"), quality_rows(measured["mesh"]))
    print()
    if "classes" in found:
        print_table(("class", "P", "R", "F1", "truth"), class_rows(found["classes"]))
        print()
    ways = found["alignments"]
    rows = [
        (
            way,
            f"{one['precision']:.3f}",
            f"{one['recall']:.3f}",
            f"{one['f1']:.3f}",
            f"{one['scale'] - 1:+.4%}",
            f"{one['moved']:.3g}",
            f"{one['turned_degrees']:.3g}",
            "-" if one["residual"] is None else f"{one['residual']:.3g}",
        )
        for way, one in ways.items()
        if one is not None
    ]
    print_table(("alignment", "P", "R", "F1", "size", "moved", "degrees", "residual"), rows)
    print()
    written = [out / "metrics.json", *sorted(path for path in (out / "geometry").iterdir() if path.is_file())]
    print_table(("written",), [(str(path),) for path in written])


@contextmanager
def refuse_damaged(path: Path, complaint: str) -> Iterator[None]:
    """Within, values of a file that are not what they should be are BadInput, with a complaint."""
    try:
        yield
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise BadInput(f"{path}: {complaint}") from error


def result_rows(metrics: dict[str, Any]) -> list[tuple[str, str]]:
    """What metrics.json says of a run, without the geometry."""
    images = metrics["images"]
    rows = [] if "not_measured" in images else [("views held out", _held_out(len(images["per_image"])))]
    if images["psnr"] is not None:
        rows += [("PSNR", f"{images['psnr']:.2f} dB"), ("SSIM", f"{images['ssim']:.3f}")]
        rows += [(label, f"{images[name]:.3f}") for name, label in LPIPS.items() if name in images]
    if images.get("psnr_aligned") is not None:
        aligned = ", ".join(
            f"{label} {images[name]:.{digits}f}" for name, (label, digits) in ALIGNED.items() if name in images
        )
        rows.append(("colours aligned", f"{aligned} (right halves, aligned on left ones)"))
    if lacking := images.get("not_measured"):
        rows.append(("photographs", f"not measured: {lacking}"))
    if lacking := images.get("lpips_not_measured"):
        rows.append(("LPIPS", f"not measured: {lacking}"))
    rows += before_rows(metrics)
    rows += zone_rows(images)
    rows += [
        *([] if metrics["points"] is None else [("points", f"{metrics['points']:,}")]),
        *([("steps", f"{metrics['steps']:,}")] if metrics["steps"] else []),
        ("training", f"{metrics['seconds']:.0f} s ({metrics['cpu_seconds']:.0f} s of CPU time)"),
    ]
    if metrics.get("prepare_cpu_seconds") is not None:
        rows.append(("depth maps", f"{metrics['prepare_cpu_seconds']:.0f} s of CPU time"))
    if metrics.get("peak_memory_bytes"):
        rows.append(("peak memory", f"{metrics['peak_memory_bytes'] / 1e6:.0f} MB"))
    if metrics.get("peak_gpu_bytes"):
        rows.append(("peak GPU memory", f"{metrics['peak_gpu_bytes'] / 1e6:.0f} MB"))
    if metrics.get("fps"):
        rows.append(("frames a second", f"{metrics['fps']:.1f}"))
    return rows


def _held_out(count: int) -> str:
    return f"{count}, which training has not seen" if count else "none, so nothing to measure with"


def before_rows(metrics: dict[str, Any]) -> list[tuple[str, str]]:
    """What metrics.json says of the models before the refinements of a run."""
    rows = []
    for name, one in metrics.get("before", {}).items():
        if one["psnr"] is not None:
            found = f"PSNR {one['psnr']:.2f} dB, SSIM {one['ssim']:.3f}, {one['points']:,} points"
            rows.append((f"before {name}", found))
    return rows


def mesh_rows(record: dict[str, Any]) -> list[tuple[str, str]]:
    """What mesh.json says of a mesh: its size, and whatever facts its mesher gives."""
    cleaning, facts = record["cleaning"], record.get("facts", record.get("lengths", {}))  # so called by older versions
    return [
        ("triangles", f"{record.get('triangles', cleaning['triangles']):,}"),
        ("vertices", f"{record.get('vertices', cleaning['vertices']):,}"),
        ("clusters kept", f"{cleaning['clusters_kept']:,} of {cleaning['clusters']:,}"),
        (
            "edges of holes and rims",
            f"{cleaning['boundary_share']:.1%} of all edges, in {cleaning['boundaries']:,} loops",
        ),
        *([("holes filled", f"{cleaning['holes_closed']:,}")] if cleaning["holes_closed"] else []),
        *([("within", record["area"]["file"])] if "area" in record else []),
        *_finishing_rows(record),
        *(
            (in_words(name.replace("_", " ")), in_words(value))
            for name, value in facts.items()
            if facts.get(f"{name}_m") != value  # in metres as well, where the unit is known
        ),
        ("seconds", f"{record['seconds']:.1f}"),
    ]


def _finishing_rows(record: dict[str, Any]) -> list[tuple[str, str]]:
    """What was done to a mesh after it was cleaned."""
    rows = []
    if closing := record.get("closing"):
        holes, skirts, dropped = (f"{closing[name]:,}" for name in ("holes", "skirts", "dropped"))
        rows.append(("closed", f"{holes} holes filled, {skirts} parts on a base, {dropped} loose parts left out"))
        if "bodies" in closing:  # not in those of earlier versions
            rows.append(("bodies", f"{closing['bodies']:,}"))
    if simplification := record.get("simplification"):
        rows.append(("simplified from", f"{simplification['triangles_before']:,} triangles"))
    return rows


def compressed_rows(record: dict[str, Any], metrics: dict[str, Any] | None) -> list[tuple[str, str, str]]:
    """What became of size, quality and speed by compression: of the float32 PLY, and of the compressed model."""
    before, after = record["ply_bytes"], record["bytes"]
    size = "-" if before is None else f"{before / 1e6:.2f} MB"
    share = "" if before is None else f", {before / after:.1f} times smaller"
    rows = [("size", size, f"{after / 1e6:.2f} MB{share}"), ("a point", "", f"{after / record['points']:.1f} bytes")]
    if not metrics:
        return rows
    small, own = metrics["compressed"], metrics["images"]
    for name, label, digits in (("psnr", "PSNR", 3), ("ssim", "SSIM", 4)):
        if own.get(name) is not None and name in small["images"]:
            change = small["images"][name] - own[name]
            rows.append(
                (label, f"{own[name]:.{digits}f}", f"{small['images'][name]:.{digits}f} ({change:+.{digits}f})")
            )
    if both := small.get("fps_before_and_after"):
        rows.append(("frames a second", f"{both[0]:.1f}", f"{both[1]:.1f}"))
    surfaces = [each.get("geometry") or {} for each in (metrics, small)]
    own_f1, f1 = (each.get("f1") for each in surfaces)
    if (
        own_f1 is not None
        and f1 is not None
        and all(surfaces[0].get(name) == surfaces[1].get(name) for name in ("truth", "tau"))
    ):
        rows.append(("F1", f"{own_f1:.4f}", f"{f1:.4f} ({f1 - own_f1:+.4f})"))
    return rows


def lod_rows(record: dict[str, Any]) -> list[tuple[str, str]]:
    """What lod.json says of levels of detail: the points of each."""
    return [(str(number), f"{count:,}") for number, count in enumerate(record["points"])]


def show_levels(found: dict[str, Any]) -> None:
    """Print what metrics.json says of levels of detail: each one for all views, and blocks selected for each view."""
    rows = [(f"{number}", one) for number, one in enumerate(found["levels"])]
    rows.append((f"selected, {found['pixels']:g} px", found["selected"]))
    print()
    print_table(
        ("level of detail", "points", "MB", "FPS", "PSNR", "SSIM"),
        [
            (
                name,
                f"{one['points']:,}",
                f"{one['bytes'] / 1e6:.2f}",
                "-" if one["fps"] is None else f"{one['fps']:.1f}",
                "-" if one["psnr"] is None else f"{one['psnr']:.2f}",
                "-" if one["ssim"] is None else f"{one['ssim']:.3f}",
            )
            for name, one in rows
        ],
    )


def in_words(value: Any) -> str:
    """A plain value for a table: on one line, and short."""
    if isinstance(value, float):
        return f"{value:.6g}"
    printable = isinstance(value, str) and value.isprintable()
    text = value if printable else json.dumps(value)
    return text if len(text) <= 60 else f"{text[:57]}..."


def zone_rows(images: dict[str, Any]) -> list[tuple[str, str]]:
    """What metrics.json says of parts of the held-out photographs."""
    seen, seams = images.get("seen"), images.get("seams")
    parts = [(f"PSNR seen by {number}+", one) for number, one in (seen["by_views"] if seen else {}).items()]
    for name in ("near", "elsewhere"):
        if seams and name in seams:
            where = f"within {seams['distance']} of block borders" if name == "near" else "elsewhere"
            parts.append((f"PSNR {where}", seams[name]))
    return [
        (label, ("-" if one["psnr"] is None else f"{one['psnr']:.2f} dB") + f" over {one['share']:.1%} of the pixels")
        for label, one in parts
    ]


def class_rows(classes: dict[str, Any]) -> list[tuple[str, ...]]:
    """What metrics.json says of the classes of the geometry, and the share of the truth that each is."""
    rows = []
    for group in ("surface", "views", "edges", "seams"):
        found = classes.get(group, {})
        total = max(1, sum(one["points"]["truth"] for one in found.values()))
        for name, one in found.items():
            figures = ("-" if one[key] is None else f"{one[key]:.3f}" for key in ("precision", "recall", "f1"))
            rows.append((f"{group}: {name}", *figures, f"{one['points']['truth'] / total:.1%}"))
    return rows


def geometry_rows(found: dict[str, Any]) -> list[tuple[str, str]]:
    """What metrics.json says of the geometry, for people."""

    def figure(name: str) -> str:
        error = found[f"{name}_std"]
        return f"{found[name]:.4f}" + ("" if error is None else f" +- {error:.4f}")

    crop = found["crop"]
    where = "all" if crop is None else f"area {crop['area']:.4g}, heights {crop['low']:.4g} to {crop['high']:.4g}"
    rows = [(label, figure(label.lower())) for label in ("Precision", "Recall", "F1")]
    rows += [("tau", f"{found['tau']:.3g} ({found['tau_from']})"), ("crop volume", where)]
    rows += [("within", found["area"]["file"])] if found.get("area") else []
    if outside := found.get("outside"):  # not in metrics of older versions
        shares = ", ".join(f"{share:.1%} {name}" for name, share in outside.items())
        rows.append(("outside of it", f"{shares}: not measured"))
    for label, name in (("chamfer", "chamfer"), ("chamfer, as DTU", "chamfer_dtu")):
        values = [found[name][part] for part in ("accuracy", "completeness", "overall")]
        texts = ["-" if value is None else f"{value:.3g}" for value in values]
        rows.append((label, f"{texts[0]} accuracy, {texts[1]} completeness, {texts[2]} overall"))
    if angles := found.get("normals"):  # of a mesh; not in metrics of older versions
        rows.append(("normals", _angles(angles)))
    if (rough := found.get("roughness")) and rough["on_truth_planes"] is not None:
        where = f"at {rough['places']:,} places where the truth is plane"
        rows.append(("roughness", f"{rough['on_truth_planes']:.3g}, {where}"))
    counts = found["points"]
    return [*rows, ("points compared", f"{counts['reconstruction']:,} with {counts['truth']:,} of the truth")]


def _angles(found: dict[str, Any]) -> str:
    if found["median"] is None:
        return f"not measured: {found['points']} points are right"
    return f"half of them within {found['median']:.1f} degrees of those of the truth, 90 % within {found['p90']:.1f}"


def quality_rows(found: dict[str, Any]) -> list[tuple[str, str]]:
    """What metrics.json says of a mesh by itself, for people."""
    unit, crossing, rough = found["unit"], found["crossing"], found["roughness"]
    part = "all triangles"
    if crossing["boxes"] is not None:
        part = f"those in {crossing['boxes']} cubes of {crossing['side']:.3g} {unit}"
    share = "-" if crossing["share"] is None else f"{crossing['share']:.3%}"
    planes = "not measured: no part of it is a plane"
    if rough["on_planes"] is not None:
        size = f"in balls of {rough['radius']:.3g} {unit}"
        planes = f"{rough['on_planes']:.3g} {unit} {size}; {rough['planes']:.0%} of the area is planes"
    return [
        ("triangles", f"{found['triangles']:,}, {found['triangles_per_area']:,.4g} per square {LENGTH_UNITS[unit]}"),
        ("boundary edges", f"{found['boundary_share']:.2%} of {found['edges']:,}"),
        ("connected parts", f"{found['components']:,}"),
        ("non-manifold edges", f"{found['non_manifold_edges']:,}"),
        ("crossing triangles", f"{share} of {crossing['measured']:,}: {part}"),
        ("roughness on planes", planes),
    ]
