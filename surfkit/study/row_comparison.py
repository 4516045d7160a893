"""What was measured of each row, against the row it is built on and against what was published."""

from __future__ import annotations

import math
import statistics
from collections.abc import Collection, Mapping
from typing import Any

from surfkit.core.check import BadInput
from surfkit.core.codec import dump, load
from surfkit.study.ablation import Row, Table, built_on
from surfkit.study.metric_columns import TABLE_COLUMNS

MESH_METRICS = ("triangles", "triangles_per_area", "boundary_share", "components", "non_manifold_edges")
"""What stands in metrics.json under "mesh" by the name of its column."""
CHAMFER_METRICS = {"accuracy": "accuracy", "completeness": "completeness", "chamfer": "overall"}
"""What stands in metrics.json under "geometry", "chamfer_dtu", by the name of its column."""
Figures = Mapping[str, float]
"""Numbers of a run, by the names in `TABLE_COLUMNS`."""


def figures(metrics: Mapping[str, Any], compressed: bool = False) -> dict[str, float]:
    """The numbers that are compared, out of the metrics of a run; depth maps made for it are part of its CPU time.

    Precision, recall, F1 and angles between normals are there where its mesh was compared with the truth, what is known
    of the mesh by itself where that was measured, PSNR and SSIM where its method draws pictures, points where it makes
    some.

    Args:
        metrics: Of the run.
        compressed: Quality, size and frames per second are those of its compressed model.

    Raises:
        BadInput: Some are not there, or no numbers.
    """
    images = load(dict[str, Any], metrics.get("images"), "images")
    geometry = load(dict[str, Any], metrics.get("geometry") or {}, "geometry")
    mesh = load(dict[str, Any], metrics.get("mesh") or {}, "mesh")
    known = dict(metrics)
    if compressed:
        small = load(dict[str, Any] | None, metrics.get("compressed"), "compressed")
        if small is None:
            raise BadInput("there is no compressed model, which the recipe wants; the notes in run.json say why")
        images = load(dict[str, Any], small.get("images"), "compressed.images")
        geometry = load(dict[str, Any], small.get("geometry") or {}, "compressed.geometry")
        mesh = load(dict[str, Any], small.get("mesh") or {}, "compressed.mesh")
        both = load(tuple[float | None, float | None] | None, small.get("fps_before_and_after"), "compressed.fps")
        known |= {"bytes": small.get("bytes"), "fps": both and both[1]}
    known |= surface_figures(geometry, mesh)
    known |= {name: images.get(name) for name in ("psnr", "ssim", "psnr_aligned", "ssim_aligned")}
    known["lpips"] = images.get("lpips_alex")  # AlexNet, as in CityGaussianV2's released code
    needed = {"seconds", "cpu_seconds"}
    if "not_measured" not in images and images.get("per_image") != {}:  # {}: no photograph was held out
        needed |= {"psnr", "ssim"}
    needed |= set() if "points" in known and known["points"] is None else {"points"}
    wanted = [name for name in TABLE_COLUMNS if name in needed or known.get(name) is not None]
    found = {name: load(int if name == "points" else float, known.get(name), name) for name in wanted}
    for name, value in found.items():
        if not math.isfinite(value):
            raise BadInput(f"{name} is {value}, not a finite number")
    made = load(float, metrics.get("prepare_cpu_seconds") or 0.0, "prepare_cpu_seconds")
    return found | {"cpu_seconds": found["cpu_seconds"] + made}


def surface_figures(geometry: Mapping[str, Any], mesh: Mapping[str, Any]) -> dict[str, Any]:
    """The numbers of a surface that are compared, None where they are not known.

    Args:
        geometry: What metrics.json says of a comparison with the truth; may be empty.
        mesh: What it says of the mesh by itself; may be empty.

    Raises:
        BadInput: A part is not what it should be.
    """

    def part(found: Mapping[str, Any], name: str) -> dict[str, Any]:
        return load(dict[str, Any], found.get(name) or {}, name)

    return {
        **{name: geometry.get(name) for name in ("precision", "recall", "f1")},
        **{name: part(geometry, "chamfer_dtu").get(told) for name, told in CHAMFER_METRICS.items()},
        **{f"normals_{name}": part(geometry, "normals").get(name) for name in ("median", "p90")},
        "roughness_on_truth": part(geometry, "roughness").get("on_truth_planes"),
        **{name: mesh.get(name) for name in MESH_METRICS},
        "crossing_share": part(mesh, "crossing").get("share"),
        "roughness": part(mesh, "roughness").get("on_planes"),
    }


def compare(table: Table, measured: Mapping[str, Mapping[int, Figures]]) -> list[dict[str, Any]]:
    """Plain data of every row of the table: means, deviations and differences.

    Args:
        table: The rows.
        measured: Numbers of each finished run, by label and seed.
    """
    below, rows = built_on(table), {row.label: row for row in table.rows}
    return [compared(at, row, rows.get(below[row.label] or ""), measured) for at, row in enumerate(table.rows, 1)]


def compared(at: int, row: Row, base: Row | None, measured: Mapping[str, Mapping[int, Figures]]) -> dict[str, Any]:
    """Plain data of a row with the number `at`, against the row that it is built on, if any."""
    here = measured.get(row.label, {})
    there = measured.get(base.label, {}) if base else {}
    columns = {name: [run[name] for run in here.values()] for name in _known(here.values())}
    return {
        "number": at,
        "label": row.label,
        "group": row.group,
        "built_on": base.label if base else None,
        "kept": row.kept,
        "given_up": row.is_given_up,
        "own_recipe": row.recipe is not None,
        "change": {path: dump(value) for path, value in row.change.items()},
        "mean": {name: statistics.fmean(values) for name, values in columns.items()},
        "sd": {name: deviation(values) for name, values in columns.items()},
        "difference": difference(here, there),
        "paper": dict(row.paper),
        "paper_difference": {
            # as many digits as were printed: a difference of floats has more
            name: round(value - base.paper[name], 6)
            for name, value in row.paper.items()
            if base and name in base.paper
        },
    }


def difference(here: Mapping[int, Figures], there: Mapping[int, Figures]) -> dict[str, dict[str, Any]]:
    """By name, mean and standard error of the differences between runs with the same seed, how many these are, and the
    mean that they are to; {} if no seed is in both."""
    seeds = [seed for seed in here if seed in there]
    found = {}
    for name in _known([*(here[seed] for seed in seeds), *(there[seed] for seed in seeds)]):
        pairs = [here[seed][name] - there[seed][name] for seed in seeds]
        spread = deviation(pairs)
        found[name] = {
            "mean": statistics.fmean(pairs),
            "standard_error": None if spread is None else spread / math.sqrt(len(pairs)),
            "seeds": len(pairs),
            "base": statistics.fmean(there[seed][name] for seed in seeds),
        }
    return found


def _known(runs: Collection[Figures]) -> list[str]:
    """Names that all of some runs have a number for."""
    return [name for name in TABLE_COLUMNS if runs and all(name in run for run in runs)]


def deviation(values: list[float]) -> float | None:
    """The standard deviation of the population that the values are drawn from; None for a single one."""
    return statistics.stdev(values) if len(values) > 1 else None
