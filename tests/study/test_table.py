"""What a table looks like: on a terminal, in Markdown, LaTeX and CSV."""

import csv
import io
import re

import pytest
from rich.console import Console

from surfkit.core.check import BadInput
from surfkit.study.ablation import Row, Table
from surfkit.study.latex import escape, latex
from surfkit.study.recipes.ablations import COARSE_BASELINE
from surfkit.study.row_comparison import compare
from surfkit.study.runs_csv import comma_separated
from surfkit.study.table_text import best_rows, columns_of, distinct_names, drawing, failures, lines, markdown

TABLE = Table(
    "looks",
    "Rows of two parts, 50% & more",
    COARSE_BASELINE,
    (
        Row("base", group="First_part", paper={"psnr": 21.12, "points": 9.54e6}),
        Row("+ more", {"seed": 5}, paper={"psnr": 22.24, "points": 9.51e6}),
        Row("+ aside", {"seed": 6}, kept=False, paper={"psnr": 30.0}),
        Row("other | kind", recipe=COARSE_BASELINE, kept=False, on="base", group="Second part"),
        Row("last", {"seed": 8}),
    ),
)
PSNR = {"base": 20.0, "+ more": 21.004, "+ aside": 25.0, "other | kind": 19.0, "last": 19.0}


def report_of(columns=(), others=(), failed=None, first="/data/first_town"):
    """A finished table with seeds 0 and 1: PSNR as above and 1 dB more."""

    def entry(path, more):
        runs = {
            label: {
                seed: {"psnr": psnr + seed + more, "points": 1000, "seconds": 60.0, "cpu_seconds": 90.0}
                for seed in (0, 1)
            }
            for label, psnr in PSNR.items()
        }
        rows = [
            row
            | {
                "runs": [{"seed": s, "folder": f"runs/{s}", **one} for s, one in runs[row["label"]].items()],
                "failed": failed if row["label"] == "last" else None,
            }
            for row in compare(TABLE, runs)
        ]
        return {"data": {"path": path}, "truth": None, "rows": rows, "notes": []}

    entries = [entry(first, 0.0), *(entry(f"/data/{name}", 1.0) for name in others)]
    known = {"table": "looks", "about": TABLE.about, "steps": 300, "max_points": None, "seeds": 2}
    return known | {"columns": list(columns), "data_sets": entries}


def printed(report, running=None, width=170):
    out = io.StringIO()
    Console(file=out, width=width).print(drawing(report, running))
    return out.getvalue()


def test_the_best_of_each_part_among_the_kept():
    rows = report_of()["data_sets"][0]["rows"]
    assert best_rows(rows, "psnr") == {1}, "not the row that was given up, and none where all are as good"
    assert best_rows(rows, "points") == set() and best_rows(rows, "f1") == set()
    rows[4]["mean"]["psnr"] = 19.504  # written as 19.50, like the other
    assert best_rows(rows, "psnr") == {1}
    rows[4]["mean"]["psnr"] = 19.6
    assert best_rows(rows, "psnr") == {1, 4}
    for at, seconds in ((0, 60.0), (1, 90.0)):
        rows[at]["mean"]["seconds"] = seconds
    assert best_rows(rows, "seconds") == {0}, "less time is better"


def test_columns_that_were_measured_or_else_published():
    report = report_of()
    assert columns_of(report) == ["psnr", "points", "seconds", "cpu_seconds"]
    for row in report["data_sets"][0]["rows"]:
        row["mean"] = {}
    assert columns_of(report) == ["psnr", "points"]
    assert columns_of(report_of(["cpu_seconds", "psnr"])) == ["cpu_seconds", "psnr"]


def test_lines_name_the_row_that_each_is_compared_with():
    head, rows = lines(report_of(["psnr"]))
    assert head == ["", "row", "on", "seeds", "PSNR", "paper: PSNR"]
    assert rows[1] == ["2", "+ more", "1", "2/2", "21.50 ± 0.71 (+1.00 ± 0.00)", "22.24 (+1.12)"]
    assert [row[2] for row in rows] == ["", "1", "2", "1", "2"]
    assert [row[1] for row in rows] == ["base", "+ more", "(+ aside)", "other | kind", "last"]


def test_several_data_sets_stand_side_by_side():
    report = report_of(["psnr"], others=["village"])
    head, rows = lines(report)
    assert head[3:] == ["seeds", "PSNR first_town", "PSNR village", "paper: PSNR"]
    assert rows[0][3:] == ["2/2, 2/2", "20.50 ± 0.71", "21.50 ± 0.71", "21.12"]
    text = printed(report)
    assert "first_town" in text and "village" in text and text.count("22.24") == 1, "published figures stand there once"
    tex = latex(report)
    assert r"\multicolumn{1}{c}{first\_town} & \multicolumn{1}{c}{village} & \multicolumn{1}{c}{published} \\" in tex
    assert r"\cmidrule(lr){2-2} \cmidrule(lr){3-3} \cmidrule(lr){4-4}" in tex
    report["data_sets"][1]["rows"][4]["failed"] = "no"
    assert failures(report) == ["last, village: failed: no"]
    assert [line["data"] for line in csv.DictReader(io.StringIO(comma_separated(report)))] == ["first_town"] * 10 + [
        "village"
    ] * 10


def test_data_sets_in_folders_of_one_name_are_told_apart():
    report = report_of(first="/data/north/dense", others=["south/dense"], failed="no disk")
    assert lines(report)[0][4:6] == ["PSNR north/dense", "points north/dense"]
    assert "PSNR south/dense" in markdown(report) and "Data: north/dense, south/dense" in markdown(report)
    assert "last, south/dense: failed" in "".join(failures(report))
    assert "south/dense" in latex(report) and "south/dense" in printed(report, width=300)
    assert {row["data"] for row in csv.DictReader(io.StringIO(comma_separated(report)))} == {
        "north/dense",
        "south/dense",
    }
    assert distinct_names(["/a/x", "/a/y"]) == ["x", "y"] and distinct_names(["/x", "/a/x"]) == ["/x", "a/x"]


def test_a_terminal_marks_the_running_row_and_shows_what_is_published_below():
    text = printed(report_of(["psnr", "points"]), running="+ more")
    assert "> + more" in text and "First_part" in text and "(+ aside)" in text
    (number, change, paper) = (line.split() for line in text.splitlines()[4:7])
    assert number[:8] == ["2", ">", "+", "more", "1", "2/2", "21.50", "±"]
    assert change == ["+1.00", "±", "0.00", "+0.0", "±", "0.0", "%"] and paper[:2] == ["22.24", "+1.12"]
    labels = {label.plain: str(label.style) for label in drawing(report_of()).columns[1]._cells if label.plain}
    assert labels["(+ aside)"] == "dim" and labels["+ more"] == "" and labels["First_part"] == "italic"


def test_markdown_has_headings_of_parts_and_bold_numbers():
    page = markdown(report_of(["psnr"], failed="too bad"))
    rows = [line for line in page.splitlines() if line.startswith("|")]
    assert rows[2] == "|  | *First_part* |  |  |  |  |"
    assert rows[4] == "| 2 | + more | 1 | 2/2 | **21.50 ± 0.71** (+1.00 ± 0.00) | 22.24 (+1.12) |"
    assert "other \\| kind" in rows[7] and "- last: failed: too bad" in page
    assert len({line.replace("\\|", "").count("|") for line in rows}) == 1


@pytest.mark.parametrize("others", [(), ("village", "big & small")])
def test_latex_is_balanced_and_its_rows_are_as_long_as_the_table_is_wide(others):
    tex = latex(report_of(others=others))
    begun, ended = re.findall(r"\\begin{(\w+)}", tex), re.findall(r"\\end{(\w+)}", tex)
    assert begun == ended[::-1] == ["table", "adjustbox", "tabular"]
    plain = re.sub(r"\\[\\{}&%$#_]", "", tex)
    assert plain.count("{") == plain.count("}") and plain.count("$") % 2 == 0
    width = len(re.search(r"\\begin{tabular}{(l r*)}".replace(" ", ""), tex)[1])
    body = tex[tex.index("\\toprule") : tex.index("\\bottomrule")]
    assert body.count("\\midrule") == 2, "below the head, and between the two parts"
    for line in body.splitlines():
        if line.endswith("\\\\"):
            spans = re.findall(r"\\multicolumn{(\d+)}", line)
            assert len(re.findall(r"(?<!\\)&", line)) + 1 + sum(int(n) - 1 for n in spans) == width, line
    assert not re.search(r"(?<!\\)[%#_](?!.*In the preamble)", tex.split("\n", 1)[1]), "special letters are escaped"


def test_latex_has_best_numbers_bold_and_given_up_rows_grey():
    tex = latex(report_of(["psnr", "points"]))
    assert "\n+ more & \\textbf{21.50 $\\pm$ 0.71} & 1,000 $\\pm$ 0 & 22.24 & 9.51\\,M \\\\\n" in tex
    assert "\n\\rowcolor{gray!20} + aside & 25.50" in tex and "\\rowcolor{gray!20} other" not in tex
    assert "\\textit{First\\_part}" in tex and "50\\% \\& more" in tex and "\\label{tab:looks}" in tex
    assert "PSNR$\\uparrow$ & points$\\downarrow$" in tex
    told = "Grey rows were tried and not kept. Numbers are means over the seeds $\\pm$ standard deviation."
    assert f"{{\\footnotesize Bold is the best number of its part of the table. {told}}}\n\\end{{table}}" in tex
    assert escape(r"a_b \ {x} ~ ^ <2 × 3>") == (
        r"a\_b \textbackslash{} \{x\} \textasciitilde{} \textasciicircum{} \textless{}2 $\times$ 3\textgreater{}"
    )


def test_latex_takes_what_users_name_their_rows():
    assert escape("[1] ours*") == "{[}1] ours{*}", r"\\[1] would be a length, \\* a command"
    assert escape("α ≥ 0.5, λ → Σ") == r"$\alpha$ $\geq$ 0.5, $\lambda$ $\rightarrow$ $\Sigma$"
    tex = latex(report_of() | {"table": "50% of #1", "about": ""})
    assert "\\label{tab:50-of-1}" in tex and "\\caption{Data: first\\_town;" in tex
    with pytest.raises(BadInput, match="one line"):
        Row("two\nlines")


def test_csv_has_a_line_for_each_run_with_plain_numbers():
    report = report_of()
    report["data_sets"][0]["rows"][4] |= {"runs": [], "failed": 'seed 0: no, "never"'}
    found = list(csv.DictReader(io.StringIO(comma_separated(report))))
    assert len(found) == 9
    first = found[2]
    assert (first["row"], first["built_on"], first["kept"], first["seed"]) == ("+ more", "base", "true", "0")
    assert float(first["psnr"]) == 21.004 and first["f1"] == "" and float(first["seconds"]) == 60
    assert found[-1]["failed"] == 'seed 0: no, "never"' and found[-1]["psnr"] == "" == found[-1]["seed"]
