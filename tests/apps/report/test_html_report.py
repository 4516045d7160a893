"""`surfkit report`: one file that is well-formed, loads nothing, shows all text as text, and is the same every time."""

import base64
import hashlib
import io
import json
import re

import numpy as np
import pytest
from html_pages import COLORS, HEIGHT, WIDTH, Reader, full_run, journal, plain_run, steps, table, write
from PIL import Image

from surfkit.apps.report import gallery
from surfkit.apps.report.elements import EmbeddedPicture
from surfkit.apps.report.report_page import ReportOptions, html, page_of
from surfkit.cli import main
from surfkit.core.check import BadInput

HOSTILE = (
    "<script>alert(1)</script>",
    '"><img src=x onerror=alert(1)>',
    "'</style><svg onload=alert(1)>&amp;{{ 1357*2468 }}",
)


def page(*folders, **options):
    """The text of a report, and what a parser finds in it."""
    text = html(page_of(folders, ReportOptions(**options)))
    return text, Reader(text)


def rows_of(text, caption):
    """Texts of the cells of a table, row by row, with those of the head."""
    body = re.search(rf'<table[^>]*aria-label="{re.escape(caption)}[^"]*">(.*?)</table>', text, re.DOTALL)[1]
    return [
        [" ".join(Reader(cell).text().split()) for cell in re.findall(r"<t[hd]\b[^>]*>.*?</t[hd]>", row, re.DOTALL)]
        for row in re.findall(r"<tr\b.*?</tr>", body, re.DOTALL)
    ]


@pytest.fixture
def run(tmp_path):
    return full_run(tmp_path / "run")


def test_loads_nothing(run):
    text, found = page(run)
    for name in ("src", "href", "srcset", "action", "data", "poster", "xlink:href"):
        assert all(value.startswith(("#", "data:")) for value in found.values(name)), name
    assert len(found.values("src", "img")) > 10
    assert "http:" not in text and "https:" not in text and "url(" not in text and "@import" not in text
    assert not {"iframe", "object", "embed", "base", "form", "video", "use"} & set(found.tags)


def test_policy_allows_the_one_script_alone(run):
    text, found = page(run)
    assert found.tags.count("script") == 1
    script = re.search(r"<script>(.*?)</script>", text, re.DOTALL)[1]
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    policy = next(value for value in found.values("content", "meta") if "default-src" in value)
    assert "default-src 'none'" in policy and f"script-src 'sha256-{digest}'" in policy
    assert not [name for _, name, _ in found.attributes if name.startswith("on")]
    assert "'unsafe-eval'" not in policy and "script-src 'unsafe-inline'" not in policy
    assert text.index("Content-Security-Policy") < text.index("<script>")


@pytest.mark.parametrize("text", HOSTILE)
def test_hostile_texts_are_shown_as_text(tmp_path, text):
    folder = text.replace("/", "-")
    photos = [f"{name}.jpg".replace("/", "-") for name in ("plain", text)]
    _, plain = page(full_run(tmp_path / "a" / "plain"), plain_run(tmp_path / "a" / "other", photos[:1]))
    _, found = page(full_run(tmp_path / "b" / folder, text), plain_run(tmp_path / "b" / "other", photos[1:]))
    assert found.tags == plain.tags, "a text has become an element"
    names = [[(tag, name) for tag, name, _ in one.attributes] for one in (found, plain)]
    assert names[0] == names[1], "a text has become an attribute"
    shown = found.text()
    assert shown.count(text) > 25, "the text as it was written, in every place that has some"
    assert shown.count(folder) > 5 and photos[1] in shown
    assert "3349076" not in re.findall(r"\d+", shown), "a text is no template"


@pytest.mark.parametrize("text", HOSTILE)
def test_hostile_texts_of_a_table(tmp_path, text):
    _, plain = page(table(tmp_path / "a", ["one", "two", "three"]))
    _, found = page(table(tmp_path / "b", [text, f"{text}2", f"{text}3"], text))
    assert found.tags == plain.tags
    assert [name for _, name, _ in found.attributes] == [name for _, name, _ in plain.attributes]
    assert found.text().count(text) > 25


def test_hostile_names_reach_the_script_as_data(tmp_path):
    """What the script reads of a chart is JSON of numbers; labels of layers are attributes."""
    folder = '"><img onerror=x>'
    _, found = page(full_run(tmp_path / folder, folder), plain_run(tmp_path / "other"))
    for data in found.values("data-chart"):
        assert set(json.loads(data)) == {"right", "label", "steps", "lines"}
    assert any(folder in label for label in found.values("data-label", "div"))


def test_ids_are_there_once_and_links_lead_to_them(tmp_path):
    for folders in ([full_run(tmp_path / "a"), full_run(tmp_path / "b")], [table(tmp_path / "t", ["x", "y", "z"])]):
        _, found = page(*folders)
        ids = found.values("id")
        assert len(ids) == len(set(ids))
        links = [link[1:] for link in found.values("href", "a")]
        assert len(links) > 12 and set(links) <= set(ids)


def test_is_the_same_every_time(run):
    assert page(run)[0] == page(run)[0]


def test_headings_go_down_in_steps_of_one(tmp_path):
    _, found = page(full_run(tmp_path / "a"), full_run(tmp_path / "b"))
    levels = [int(tag[1]) for tag in found.tags if re.fullmatch("h[1-6]", tag)]
    assert levels[0] == 1 and levels.count(1) == 1 and levels.count(2) > 8
    assert all(below <= above + 1 for above, below in zip(levels, levels[1:], strict=False))


def test_everything_is_shown(run):
    text, found = page(run)
    titles = ["Results", "Notes", "Held-out", "Mesh", "Geometry", "Curves", "Time and", "Blocks", "Compressed"]
    heads = re.findall(r"<h2>(.*?)</h2>", text)
    assert [head for head, title in zip(heads, titles, strict=False) if head.startswith(title)] == heads[:9]
    assert heads[9:] == ["Configuration", "Provenance"]
    assert ["block 0", "40 s", "5", "105", "1 GB"] in rows_of(text, "Time and memory by stage")
    assert rows_of(text, "Blocks")[1] == ["0", "plain", "2", "5", "2", "\N{EN DASH}", "plain; plain"]
    assert rows_of(text, "Compressed")[1] == [
        "run", "plain", "10 B", "25.0%", "19.00 -1.00", "0.400 -0.100", "\N{EN DASH}", "10.0 +1.0",
    ]  # fmt: skip
    alone = rows_of(text, "The mesh by itself")
    assert ["share of edges with one triangle", "25.00%"] in alone and ["triangles per square unit", "9.5"] in alone
    assert ["share of triangles that cross others", "1.250%"] in alone
    assert ["angle between normals, 90 % quantile, degrees", "45.6"] in rows_of(text, "Mesh against the truth")
    assert ["roughness where the truth is plane", "0.078"] in rows_of(text, "Mesh against the truth")
    assert found.tags.count("input") == len(found.values("data-chart")) + 3, "a slider for each chart and comparison"
    assert all(label for label in found.values("aria-label", "input"))
    assert len(found.values("alt", "img")) == found.tags.count("img") and all(found.values("alt", "img"))


def test_differing_settings_alone_are_compared(tmp_path):
    first = plain_run(tmp_path / "one", seed=0, mesh={"use": "tsdf", "voxel": 1.0}, same=5)
    second = plain_run(tmp_path / "two", seed=1, mesh={"use": "tetra"}, same=5)
    text, _ = page(first, second)
    assert rows_of(text, "Settings that differ") == [
        ["setting", "one", "two"],
        ["seed", "0", "1"],
        ["mesh.use", "tsdf", "tetra"],
        ["mesh.voxel", "1.0", "\N{EN DASH}"],
    ]
    assert ["same", "5"] in rows_of(text, "Settings of one")
    text, _ = page(first, plain_run(tmp_path / "three", seed=0, mesh={"use": "tsdf", "voxel": 1.0}, same=5))
    assert "All settings of the runs are equal." in text


def test_results_have_differences_to_the_first(tmp_path):
    text, _ = page(plain_run(tmp_path / "one"), plain_run(tmp_path / "two", psnr=21.5))
    head, first, second = rows_of(text, "Figures of the runs")
    assert (head[:2], first[:2], second[:2]) == (["run", "PSNR, dB"], ["one", "20.00"], ["two", "21.50 +1.50"])
    assert second[2] == "0.500 0.000", "no difference has no sign"


def test_pictures_are_cut_and_chosen(tmp_path):
    """Worst, median and best view; each part of the picture under its own label."""
    run = plain_run(tmp_path / "run", tuple(f"{name}.jpg" for name in "abcdefg"))
    text, _ = page(run)
    shown = re.findall(r"<h3>(.\.jpg) \((.*?)\)</h3>", text)
    assert shown == [("a.jpg", "lowest PSNR"), ("d.jpg", "median PSNR"), ("g.jpg", "highest PSNR")]
    image = r'<img src="data:image/webp;base64,(.*?)" width="(\d+)" height="(\d+)"'
    layer = rf'data-label="(.*?)">\s*{image}'
    found = re.findall(layer, text)
    assert [name for name, *_ in found][:4] == ["photograph", "render, 20.00 dB", "photograph", "render, 23.00 dB"]
    figure = rf'<figure class="picture">\s*{image}.*?<figcaption>(.*?)<'
    found += [(name, *rest) for *rest, name in re.findall(figure, text)]
    assert len(found) == 12
    for name, data, width, height in found:
        pixels = np.asarray(Image.open(io.BytesIO(base64.b64decode(data))).convert("RGB")).reshape(-1, 3)
        assert (int(width), int(height)) == (WIDTH, HEIGHT)
        assert abs(np.median(pixels, 0) - COLORS[name.partition(",")[0]]).max() < 16, name


@pytest.mark.parametrize(("views", "names"), [(0, ""), (1, "b"), (2, "ac"), (3, "abc"), (9, "abc")])
def test_number_of_views(tmp_path, views, names):
    text, _ = page(plain_run(tmp_path / "run"), views=views)
    assert re.findall(r"<h3>(.)\.jpg", text) == list(names)
    assert "Figures of all 3 held-out views" in text


def test_pictures_of_unknown_size_are_shown_whole(tmp_path):
    run = plain_run(tmp_path / "run")
    (run / "cameras.json").unlink()
    text, found = page(run)
    assert found.values("width", "img") == [str(4 * WIDTH)] * 3 and 'class="compare"' not in text


def test_without_pictures(run):
    text, found = page(run, with_pictures=False)
    assert "img" not in found.tags and "Figures of all 2 held-out views" in text and len(found.values("data-chart")) > 3


def test_pictures_keep_to_the_budget(tmp_path):
    noise = np.random.default_rng(0).integers(0, 256, (100, 1000, 3), np.uint8)
    Image.fromarray(noise).save(tmp_path / "noise.png")
    picture = EmbeddedPicture(tmp_path / "noise.png", "noise")
    sizes = [(one := gallery.encode(picture, side)).width for side in gallery.LONGEST_SIDES_PX]
    assert sizes == [1000, 960, 720, 540, 400]
    budget = len(gallery.encode(picture, 720).uri)
    assert gallery.encode_all([picture], budget)[picture].width == 720
    assert gallery.encode_all([picture, picture], budget - 1)[picture].width == 540
    with pytest.raises(BadInput, match="1 pictures .* MB .*400.*--views"):
        gallery.encode_all([picture], len(one.uri) - 1)


def test_each_note_is_stated_once_with_the_runs_that_have_it(tmp_path):
    noted = {"a": ["of all", "of a and b"], "b": ["of all", "of a and b", "of b"], "c": ["of all", "of c and d"]}
    noted |= {"d": ["of all but e", "of c and d", "of all"], "e": ["of all"]}
    for name, texts in noted.items():
        out = plain_run(tmp_path / name)
        write(out / "run.json", {"notes": texts + ["of all but e"] * (name in "abc")})
    text, _ = page(*(tmp_path / name for name in noted))
    part = re.search(r"<h2>Notes.*?<h2>", text, re.DOTALL)[0]
    shown = re.findall(r"<h3[^>]*>(.*?)</h3>|<li>(.*?)</li>", part, re.DOTALL)
    assert ["".join(each).strip() for each in shown] == [
        *("All runs", "of all"),
        *("All runs but e", "of all but e"),
        *("a; b", "of a and b"),
        *("c; d", "of c and d"),
        *("b", "of b"),
    ]


def test_a_run_that_has_hardly_begun(tmp_path):
    write(tmp_path / "recipe.json", {"about": "x"})
    write(tmp_path / "run.json", {"notes": ["a photograph was left out"]})
    text, found = page(tmp_path)
    assert "The run is not finished" in text and "a photograph was left out" in found.text()
    journal(tmp_path / "events.jsonl", steps(4)[:-2])
    _, found = page(tmp_path)
    assert len(found.values("data-chart")) == 4  # sum of losses, points, memory, each loss


def test_values_of_a_wrong_kind_are_left_out(run, monkeypatch):
    """Whatever stands in the place of a value, the page is made."""
    monkeypatch.setattr("surfkit.apps.report.svg_charts._drawing", lambda *_: "")
    for name in ("run.json", "metrics.json", "mesh.json", "compressed/compressed.json", "blocks/plan.json"):
        whole = (run / name).read_text()
        for odd in (None, "x", [1, [2]], {"a": {"b": []}}, -1e308):
            for wrong in replaced(json.loads(whole), odd):
                (run / name).write_text(json.dumps(wrong))
                page_of([run], ReportOptions(with_pictures=False))
        (run / name).write_text(whole)


def replaced(value, odd):
    """The value with each of its first two levels replaced in turn, then each of its leaves."""
    for key, inner in value.items() if isinstance(value, dict) else ():
        yield value | {key: odd}
        for changed in replaced(inner, odd):
            yield value | {key: changed}


def test_table(tmp_path):
    folder = table(tmp_path / "t", ["base", "tried", "better", "broken"], "why")
    text, found = page(folder)
    rows = rows_of(text, "Means over the seeds")
    assert [row[0] for row in rows] == ["row", "1. base", "2. (tried)", "3. better", "4. broken failed: why"]
    assert rows[0][2] == "PSNR, dB" and rows[0][3] == "why", "quantities of packages are shown, too"
    assert [row[2] for row in rows[1:]] == [
        "20.00 ± 0.05", "21.00 ± 0.05 +1.00 ± 0.10", "22.00 ± 0.05 +1.00 ± 0.10", "\N{EN DASH}",
    ]  # fmt: skip
    assert rows_of(text, "Published")[2] == ["2. tried", "25.00 +1.00"]
    assert [row[2] for row in rows_of(text, "What each row changes")[1:]] == [
        "why = why", "why = why", "a recipe of its own; why = why", "why = why",
    ]  # fmt: skip
    assert "1. base, 20.00 dB" in found.values("data-label") and "3. better, 24.00 dB" in found.values("data-label")
    assert 'href="#provenance-1"' in text and 'id="provenance-3"' in text


def test_a_table_of_several_data_sets(tmp_path):
    folder = table(tmp_path / "t", ["base", "better", "broken"])
    report = json.loads((folder / "ablation.json").read_text())
    other = json.loads(json.dumps(report["data_sets"][0]))
    other["data"]["path"], other["rows"][0]["mean"]["psnr"] = "/data/other", 30.0
    write(folder / "ablation.json", report | {"data_sets": [report["data_sets"][0], other]})
    text, _ = page(folder)
    assert rows_of(text, "plain: Means over the seeds")[1][2] == "20.00 ± 0.05"
    assert rows_of(text, "other: Means over the seeds")[1][2] == "30.00 ± 0.05"
    assert "2. better, other" in text


def test_a_table_reads_no_folder_outside_of_it(tmp_path):
    plain_run(tmp_path / "secret")
    folder = table(tmp_path / "t", ["one", "two"])
    report = json.loads((folder / "ablation.json").read_text())
    report["data_sets"][0]["rows"][0]["runs"][0]["folder"] = "../secret"
    write(folder / "ablation.json", report)
    text, _ = page(folder)
    assert "secret" not in text and "Held-out" not in text


def test_command(run, capsys):
    assert main(["report", str(run)]) == 0
    size = (run / "report.html").stat().st_size
    assert f"{size / 1e6:.2f} MB" in capsys.readouterr().out
    assert main(["report", str(run), "--no-pictures", "--out", str(run / "small.html")]) == 0
    assert (run / "small.html").stat().st_size < size


def test_wrong_words_are_one_line(tmp_path, capsys):
    run, folder = plain_run(tmp_path / "run"), table(tmp_path / "t", ["a", "b"])
    (tmp_path / "empty").mkdir()
    half = tmp_path / "half"
    write(half / "recipe.json", {})
    broken = plain_run(tmp_path / "broken")
    (broken / "pictures" / "a.jpg.png").write_text("no picture")
    cases = {
        (str(tmp_path / "empty"),): "neither a run folder (recipe.json, run.json) nor a table",
        (str(tmp_path / "nowhere"),): "neither a run folder",
        (str(half),): "no run folder",
        (str(run), str(folder)): "a table is reported alone",
        (str(run), str(run)): "is named twice",
        (): "name one or more run folders",
        (str(run), "--views", "-1"): "--views -1: give 0 or more",
        (str(run), "--out", str(tmp_path)): "a folder; name a file",
        (str(broken),): "cannot be read as a picture",
    }
    for words, message in cases.items():
        assert main(["report", *words]) == 2, words
        told = capsys.readouterr().err.strip()
        assert message in told and "\n" not in told, told


def test_runs_of_other_data(tmp_path):
    text, _ = page(plain_run(tmp_path / "one", ("a.jpg",)), plain_run(tmp_path / "two", ("b.jpg",)))
    assert "The runs have no held-out photograph in common" in text
    assert "may not compare" not in text


def test_figures_of_other_photographs_of_the_same_names_are_told(tmp_path):
    folders = [plain_run(tmp_path / name) for name in ("one", "two")]
    for folder, data in zip(
        folders, ({"path": "/a", "scale": 4, "priors": 1}, {"path": "/b", "scale": 4}), strict=True
    ):
        record = json.loads((folder / "run.json").read_text())
        write(folder / "run.json", record | {"data": data})
    assert "or read them otherwise: data.path. Their figures may not compare." in page(*folders)[0]


def test_surfaces_that_were_compared_otherwise_are_told(tmp_path):
    folders = [plain_run(tmp_path / name) for name in ("one", "two", "three")]
    for folder, tau in zip(folders, (0.5, 0.25, None), strict=True):
        if tau is not None:
            known = json.loads((folder / "metrics.json").read_text())
            same = {"f1": 0.5, "truth": "/scan.ply", "align": "rigid", "crop": {"from": "auto"}}
            write(folder / "metrics.json", known | {"geometry": same | {"tau": tau}})
    assert "compared with the truth in several ways: tau: 0.25, 0.5. Their figures" in page(*folders)[0]
    assert "in several ways" not in page(folders[0], folders[2])[0], "only one has a truth"


def test_runs_of_one_name_are_told_apart(tmp_path):
    text, _ = page(plain_run(tmp_path / "x" / "run"), plain_run(tmp_path / "y" / "run"))
    assert f"{tmp_path}/x/run, {tmp_path}/y/run" in text
