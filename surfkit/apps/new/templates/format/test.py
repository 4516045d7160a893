import pytest
from surfkit.plugin import BadInput
from surfkit.testing import check
from surfkit.testing.format_checks import splat_table

from new_plugin.new_part import NewPart


def test_it_keeps_the_contract_of_its_kind():
    check(NewPart())


def test_the_lines_of_a_file(tmp_path):
    table = splat_table(count=50)
    NewPart(least=0.5).write(tmp_path / "points.xyz", table)
    lines = (tmp_path / "points.xyz").read_text().splitlines()
    kept = table.means[table.opacity_logits >= 0].tolist()
    assert len(lines) == len(kept)
    x, y, z, *color = lines[0].split()
    assert [float(x), float(y), float(z)] == pytest.approx(kept[0])
    assert all(0 <= int(value) <= 255 for value in color)


def test_it_refuses_to_leave_out_everything():
    with pytest.raises(BadInput, match="below 1"):
        NewPart(least=1)
