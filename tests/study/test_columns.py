import pytest

from surfkit.core.check import BadInput
from surfkit.study.metric_columns import TABLE_COLUMNS, refuse_unknown_columns, shown_columns


@pytest.mark.parametrize(
    ("name", "value", "spread", "text"),
    [
        ("psnr", 23.456, None, "23.46"),
        ("psnr", 23.456, 0.125, "23.46 ± 0.12"),
        ("f1", 0.4716, 0.001, "0.472 ± 0.001"),
        ("points", 9_540_000, None, "9.54 M"),
        ("points", 124_009, 12.4, "124,009 ± 12"),
        ("seconds", 78 * 60, None, "78.0"),
        ("bytes", 2.26e9, 1e7, "2.26 ± 0.01 GB"),
        ("bytes", 76_014, None, "76.01 kB"),
        ("bytes", 140, None, "140 B"),
        ("fps", 31.25, None, "31.2"),
    ],
)
def test_numbers_have_their_digits_and_units(name, value, spread, text):
    assert TABLE_COLUMNS[name].text(value, spread) == text


@pytest.mark.parametrize(
    ("name", "value", "base", "error", "text"),
    [
        ("psnr", -0.034, 23.0, None, "-0.03"),
        ("ssim", 0.0006, 0.7, 0.0002, "+0.001 ± 0.000"),
        ("points", -11_230_000, 19_300_000, None, "-58.2 %"),
        ("seconds", 6.0, 60.0, 3.0, "+10.0 ± 5.0 %"),
        ("bytes", 5.0, 0.0, None, ""),
    ],
)
def test_differences_are_absolute_or_in_percent(name, value, base, error, text):
    assert TABLE_COLUMNS[name].difference(value, base, error) == text


def test_columns_are_those_that_were_measured_but_lpips_only_if_it_is_named():
    assert shown_columns((), {"psnr", "lpips", "fps", "ssim"}) == ["ssim", "psnr", "fps"]
    assert shown_columns(("lpips", "f1"), {"psnr"}) == ["lpips", "f1"]
    assert shown_columns((), ()) == ["ssim", "psnr", "points"]


def test_names_of_columns_are_checked():
    refuse_unknown_columns(list(TABLE_COLUMNS))
    with pytest.raises(BadInput, match="--columns: .*'time'; known: ssim, psnr, .*, fps"):
        refuse_unknown_columns(["psnr", "time"])
    with pytest.raises(BadInput, match="psnr is there twice"):
        refuse_unknown_columns(["psnr", "ssim", "psnr"])
