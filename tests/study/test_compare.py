import math

import pytest

from surfkit.core.check import BadInput
from surfkit.study.ablation import Row, Table
from surfkit.study.recipes.ablations import COARSE_BASELINE
from surfkit.study.row_comparison import compare, deviation, difference, figures

TABLE = Table(
    "small",
    "",
    COARSE_BASELINE,
    (
        Row("base", paper={"psnr": 21.12, "points": 9.54e6}),
        Row("more", {"seed": 5}, kept=False, paper={"psnr": 22.24, "f1": 0.4}),
        Row("most"),
    ),
)


def run(psnr: float, points: int = 100) -> dict[str, float]:
    return {"psnr": psnr, "ssim": 0.5, "points": points, "seconds": 60.0, "cpu_seconds": 90.0}


def test_what_is_no_finite_number_is_refused():
    metrics = {"images": {"psnr": math.nan, "ssim": 0.5}, "seconds": 1.0, "cpu_seconds": 1.0, "points": 3}
    with pytest.raises(BadInput, match="psnr is nan, not a finite number"):
        figures(metrics)


def test_a_paired_difference_by_hand():
    here = {0: run(22.0, 110), 1: run(23.0, 130), 2: run(21.0, 120), 7: run(99.0, 1)}
    there = {0: run(21.0, 100), 1: run(21.0, 100), 2: run(21.0, 130), 8: run(0.0, 1)}
    found = difference(here, there)
    # PSNR: +1, +2, 0: mean 1, standard deviation 1; points: +10, +30, -10: mean 10, standard deviation 20
    assert found["psnr"] == pytest.approx({"mean": 1.0, "standard_error": 3**-0.5, "seeds": 3, "base": 21.0})
    assert found["points"] == pytest.approx({"mean": 10.0, "standard_error": 20 * 3**-0.5, "seeds": 3, "base": 110.0})
    assert found["ssim"]["mean"] == found["ssim"]["standard_error"] == 0


def test_one_seed_has_no_error_and_none_no_difference():
    assert difference({0: run(22.0)}, {0: run(21.0)})["psnr"] == {
        "mean": 1.0, "standard_error": None, "seeds": 1, "base": 21.0
    }  # fmt: skip
    assert difference({0: run(22.0)}, {1: run(21.0)}) == {}
    assert deviation([4.0]) is None and deviation([1.0, 3.0]) == pytest.approx(2**0.5)


def test_numbers_that_not_all_runs_have_are_left_out():
    some, other = run(22.0) | {"f1": 0.5}, run(21.0)
    (row, *_) = compare(TABLE, {"base": {0: some, 1: other}})
    assert "f1" not in row["mean"] and row["mean"]["psnr"] == 21.5
    assert "f1" not in difference({0: some}, {0: other}) and difference({0: some}, {0: some})["f1"]["base"] == 0.5


def test_rows_are_compared_with_the_kept_one():
    base, more, most = compare(TABLE, {"base": {0: run(20.0), 1: run(22.0)}, "most": {0: run(23.0)}})
    assert base["mean"]["psnr"] == 21 and base["sd"]["psnr"] == pytest.approx(2**0.5) and base["difference"] == {}
    assert more["mean"] == {} and more["difference"] == {} and more["change"] == {"seed": 5}
    assert (base["built_on"], more["built_on"], most["built_on"]) == (None, "base", "base")
    assert most["difference"]["psnr"]["mean"] == 3 and most["difference"]["psnr"]["seeds"] == 1
    assert more["paper_difference"] == {"psnr": 1.12} and most["paper_difference"] == {}
    assert [row["number"] for row in (base, more, most)] == [1, 2, 3]


def test_figures_are_found_in_the_metrics():
    metrics = {"images": {"psnr": 1.0, "ssim": 0.2, "per_image": {}}, "points": 3, "seconds": 4.0, "cpu_seconds": 5.0}
    plain = {"psnr": 1.0, "ssim": 0.2, "points": 3, "seconds": 4.0, "cpu_seconds": 5.0}
    assert figures(metrics) == plain
    sizes = {"fps": 6.0, "bytes": 70, "peak_memory_bytes": 80}
    assert figures(metrics | sizes | {"memory_bytes": {}}) == plain | sizes
    geometry = {"f1": 0.5, "precision": 0.4, "recall": 0.6, "points": {"truth": 9}, "tau": 1.0}
    more = figures(metrics | {"prepare_cpu_seconds": 2.0, "geometry": geometry})
    assert more == plain | {"f1": 0.5, "precision": 0.4, "recall": 0.6, "cpu_seconds": 7.0}
    mesh = {"triangles": 8, "triangles_per_area": 2.5, "boundary_share": 0.25, "components": 2, "non_manifold_edges": 1}
    parts = {"crossing": {"share": 0.125, "measured": 8}, "roughness": {"on_planes": 0.5, "radius": 1.0}}
    told = {"normals": {"median": 5.0, "p90": 30.0}, "roughness": {"on_truth_planes": None}}
    found = figures(metrics | {"geometry": told, "mesh": mesh | parts | {"unit": "m"}})
    wanted = {"crossing_share": 0.125, "roughness": 0.5, "normals_median": 5.0, "normals_p90": 30.0}
    assert found == plain | mesh | wanted, "what is not known is left out"
    with pytest.raises(BadInput, match="crossing"):
        figures(metrics | {"mesh": {"crossing": 3}})
    images = metrics["images"] | {"lpips_alex": 0.3, "lpips_vgg": 0.9}
    assert figures(metrics | {"images": images}) == plain | {"lpips": 0.3}
    with pytest.raises(BadInput, match="seconds"):
        figures({name: value for name, value in metrics.items() if name != "seconds"})


def test_of_a_compressed_model_its_own_quality_size_and_speed_count():
    metrics = {"images": {"psnr": 1.0, "ssim": 0.2}, "points": 3, "seconds": 4.0, "cpu_seconds": 5.0}
    metrics |= {"fps": 6.0, "bytes": 70, "geometry": {"f1": 0.5, "precision": 0.4, "recall": 0.6}}
    small = {"images": {"psnr": 0.9, "ssim": 0.1}, "bytes": 7, "fps_before_and_after": [6.0, 8.0]}
    found = figures(metrics | {"compressed": small}, compressed=True)
    assert found == {
        "psnr": 0.9, "ssim": 0.1, "points": 3, "seconds": 4.0, "cpu_seconds": 5.0, "bytes": 7, "fps": 8.0,
    }, "its F1 is not that of the model before"  # fmt: skip
    geometry, alone = {"f1": 0.3, "precision": 0.2, "recall": 0.4}, {"mesh": {"components": 4}}
    both = figures(metrics | alone | {"compressed": small | {"mesh": {"components": 5}}}, compressed=True)
    assert both["components"] == 5 and "components" not in figures(metrics | alone | {"compressed": small}, True)
    assert figures(metrics | {"compressed": small | {"geometry": geometry}}, compressed=True) == found | geometry
    assert figures(metrics | {"compressed": small})["bytes"] == 70, "a recipe without compression"
    with pytest.raises(BadInput, match="no compressed model"):
        figures(metrics, compressed=True)
