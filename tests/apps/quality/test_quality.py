"""The quality report of a simulated survey: its figures, its HTML and its PDF as others read them."""

import io
import re
import sys
from dataclasses import replace
from datetime import timedelta
from html.parser import HTMLParser
from typing import Any

import numpy as np
import pytest
from flight import FOCAL, HEIGHT, WIDTH
from needs import needs
from PIL import Image
from surveys import CONTROL, OFFSET, prepared

from surfkit.apps.quality import report
from surfkit.apps.quality.document import Figure, Paragraph, Row, Table
from surfkit.apps.quality.figures import round_length
from surfkit.apps.quality.pdf_writer import pdf
from surfkit.apps.quality.photo_overlap import Ground, ground_of, ground_of_points, overlap
from surfkit.apps.quality.report import document_of
from surfkit.apps.quality.sections.calibration import radial_distortion
from surfkit.apps.quality.sections.maps_section import covered, surface
from surfkit.apps.quality.sections.residuals import control, positions
from surfkit.apps.quality.sections.summary import (
    Findings,
    focal_warnings,
    ground_sampling_distance,
    meaning,
    warnings,
)
from surfkit.apps.quality.sections.tie_point_section import MIN_CELL_OBSERVATIONS, errors_of, mean_residuals
from surfkit.apps.quality.sparse_model import SparseModel
from surfkit.apps.quality.survey import open_survey
from surfkit.apps.sfm.engine import load_engine
from surfkit.cli import main
from surfkit.core.codec import read_json, write_json


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    """A prepared scene, which no test changes."""
    folder = tmp_path_factory.mktemp("survey") / "Quarry & hill"
    prepared(folder)
    return folder


@pytest.fixture(scope="module")
def survey(scene):
    return open_survey(scene)


@pytest.fixture(scope="module")
def document(survey):
    return document_of(survey)


def table(section, title):
    return next(element for element in section.elements if isinstance(element, Table) and element.title == title)


def texts(section, kind):
    return [part.text for part in section.elements if isinstance(part, Paragraph) and part.kind == kind]


class Page(HTMLParser):
    """Elements that are closed in order, addresses, and text."""

    def __init__(self, text):
        super().__init__(convert_charrefs=True)
        self.open, self.addresses, self.ids, self.words, self.tags = [], [], [], [], []
        self.feed(text)
        assert not self.open

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        self.addresses += [value for name, value in attrs if name in ("src", "href", "srcset", "action")]
        self.ids += [value for name, value in attrs if name == "id"]
        if tag not in ("meta", "img", "link", "br"):
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.words.append(data)


def test_html_is_whole_and_loads_nothing(scene, tmp_path, capsys):
    out = tmp_path / "report.html"
    assert main(["quality", str(scene), "--out", str(out), "--no-pdf"]) == 0
    page = Page(out.read_text(encoding="utf-8"))
    assert [path.name for path in tmp_path.iterdir()] == ["report.html"] and "report.html" in capsys.readouterr().out
    assert all(address.startswith(("data:image/", "#")) for address in page.addresses)
    assert {address[1:] for address in page.addresses if address[0] == "#"} == {name for name in page.ids}
    assert page.tags.count("img") >= 8 and "script" not in page.tags and "b" not in page.tags
    said = " ".join(" ".join(page.words).split())
    for words in (
        "Quarry & hill",
        "2024-05-02 to 2024-05-03",
        "30 of 32 (93.8 %)",
        "EPSG:32633",
        "check points 1 0.120 0.050 0.330",
        "off by 13 cm in plan and 33 cm in height",
        "<b>dark.jpg 12 features, 100 are needed",
        "2 of 32 photographs are not used",
        "There are no maps.",
        "No volumes were measured",
        "Acme <One>",
    ):
        assert words in said, words


def test_pdf_is_read_by_others_and_says_the_same(scene, document, tmp_path, monkeypatch):
    needs("reportlab")
    reader = needs("pypdf")
    monkeypatch.setattr(report, "document_of", lambda _: document)
    assert main(["quality", str(scene), "--out", str(tmp_path / "one.html")]) == 0
    content = (tmp_path / "one.pdf").read_bytes()
    assert content == pdf(document) and len(content) < 10e6
    made = reader.PdfReader(io.BytesIO(content)).metadata.creation_date
    written = (scene / "report.json").stat().st_mtime
    assert made.utcoffset() == timedelta(0) and 0 <= written - made.timestamp() < 1, "when its results were written"
    assert pdf(replace(document, moment=document.moment + timedelta(1))) != content
    pages = reader.PdfReader(io.BytesIO(content)).pages
    first = " ".join(pages[0].extract_text().split())
    for words in ("Quality report", "Quarry & hill", "2024-05-02 to 2024-05-03", "30 of 32", "EPSG:32633", "page 1"):
        assert words in first, words
    width, height = (float(side) / 72 * 25.4 for side in pages[0].mediabox[2:])
    assert (round(width), round(height)) == (210, 297)
    whole = " ".join(" ".join(page.extract_text() for page in pages).split())
    assert "Contents" in whole and f"page {len(pages)}" in whole and "029.jpg" in whole and "<b>dark.jpg" in whole
    assert "Camera calibration" in [entry["/Title"] for entry in reader.PdfReader(io.BytesIO(content)).outline]


def test_without_reportlab_there_is_html_and_a_word_on_the_pdf(scene, document, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(report, "document_of", lambda _: document)
    monkeypatch.setitem(sys.modules, "reportlab", None)
    assert main(["quality", str(scene), "--out", str(tmp_path / "a.html")]) == 0
    assert "surfkit[report]" in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["a.html"]


def test_overlap_is_that_of_every_cell_and_photograph_by_itself(survey):
    ground = Ground(np.full((5, 6), OFFSET[2]), (OFFSET[0] - 90, OFFSET[1] - 80, OFFSET[0] + 90, OFFSET[1] + 70), "")
    ground.heights[2, 3] = np.nan
    found = overlap(survey, ground)
    model = load_engine().Reconstruction(survey.data.path / "sparse/0")
    focal = model.cameras[1].params[0]
    for row in range(5):
        for column in range(6):
            if (row, column) == (2, 3):
                assert np.isnan(found[row, column])
                continue
            place, seen = np.array([-90 + (column + 0.5) * 30, 70 - (row + 0.5) * 30, 0.0]), 0
            for image in model.images.values():
                pose = image.cam_from_world().matrix()
                x, y, z = pose[:, :3] @ place + pose[:, 3]
                u, v = focal * x / z + WIDTH / 2, focal * y / z + HEIGHT / 2
                seen += z > 0 and 0 <= u < WIDTH and 0 <= v < HEIGHT
            assert found[row, column] == seen
    assert np.nanmin(found) < np.nanmax(found)


def test_the_ground_of_points_has_their_median_heights():
    xy = np.random.default_rng(0).uniform(0, 100, (4000, 2))
    ground = ground_of_points(np.column_stack([xy, 3 + 0.1 * xy[:, 0]]))
    places = ground.places()
    assert np.isfinite(ground.heights).mean() > 0.9
    assert np.nanmax(np.abs(places[..., 2] - 3 - 0.1 * places[..., 0])) < 0.1 * 3.5 * 3.2, (
        "cells hold 4 points on average"
    )


def test_means_of_residuals_by_place_and_photograph(survey):
    model = survey.tie_points
    middles, means, counts = mean_residuals(model, 1)
    sums, number = {}, {}
    for (x, y), residual in zip(model.xy, model.residuals, strict=True):
        cell = min(max(int(y // 20), 0), 11), min(max(int(x // 20), 0), 15)  # noise moves some out of the picture
        sums[cell], number[cell] = sums.get(cell, 0) + residual, number.get(cell, 0) + 1
    assert means.shape == (12, 16, 2) and middles[0, 0].tolist() == [10, 10] and counts.sum() == len(model.xy)
    for cell, count in number.items():
        assert counts[cell] == count
        assert count < MIN_CELL_OBSERVATIONS or np.allclose(means[cell], sums[cell] / count)
    assert np.isclose(errors_of(model)[4], model.errors[model.photo == 4].mean())


def test_residuals_are_those_of_colmap(survey):
    model = load_engine().Reconstruction(survey.calibrated)
    mean = np.mean([point.error for point in model.points3D.values()])
    own = survey.tie_points
    assert np.isclose(np.mean(np.bincount(own.point, own.errors) / own.track_lengths), mean)
    assert own.track_lengths.sum() == model.compute_num_observations()


def test_the_lens_is_the_calibrated_one_and_its_curve_that_of_its_formula(survey):
    focal, _, _, bend = survey.model_facts["cameras"][0]["params"]
    camera = survey.tie_points.cameras[1]
    assert survey.calibrated.parent.name == "models" and camera.params.tolist() == [focal, 160, 120, bend]
    camera = load_engine().Camera(model="SIMPLE_RADIAL", width=WIDTH, height=HEIGHT, params=[FOCAL, 160, 120, 0.1])
    radii, moved = radial_distortion(camera)
    straight = (radii - moved) / FOCAL
    assert np.allclose(radii, FOCAL * straight * (1 + 0.1 * straight**2)) and radii[-1] == 200 and moved[-1] > 5


def test_the_model_that_was_adjusted_to_control_points_is_the_calibrated_one(tmp_path):
    prepared(tmp_path)
    (tmp_path / "prepare/models").rename(tmp_path / "prepare/controlled")
    assert open_survey(tmp_path).calibrated == tmp_path / "prepare/controlled/0"


def test_positions_that_took_part_beside_control_points_are_told(survey):
    facts = {"kept": True, "positions": 12, "positions_offset_m": [-0.327, -0.109, 7.812]}
    for adjustment, words in (
        ({}, "photographs were not used"),
        ({**facts, "kept": False}, "photographs were not used"),
        (facts, "Positions of 12 photographs are part of its adjustment too.*-0.33 -0.11 \\+7.81 m"),
    ):
        model = {**survey.model_facts, "ground_control": {**CONTROL, "adjustment": adjustment}}
        (told,) = texts(positions(replace(survey, prepared={**survey.prepared, "models": [model]})), "missing")
        assert re.search(words, told), told


def test_a_model_of_other_lenses_is_not_taken_for_the_calibrated_one(survey):
    told = {**survey.prepared, "models": [{"cameras": [{"model": "RADIAL", "params": [1, 2, 3, 4, 5]}]}]}
    other = replace(survey, prepared=told)
    assert other.calibrated is None and other.tie_points.cameras[1].model.name == "PINHOLE"


def test_the_ground_sampling_distance_is_height_by_focal_length(survey):
    nadir = 60 / FOCAL
    assert nadir < ground_sampling_distance(survey) < 1.25 * nadir, "every second one looks 35 degrees off"


def test_the_first_page_tells_that_heights_depend_on_exif(survey):
    lens = {"exif": 2311.2, "photographs_alone": 2842.0, "final": 2323.9, "photographs": 18, "held": True}
    weighed = {"focal_lengths_px": [lens], "cameras_above_ground_m": 38.9, "cameras_above_start_m": 39.9}
    for facts, count in ((weighed, 2), (weighed | {"focal_lengths_px": []}, 0),
                         (weighed | {"focal_lengths_px": [], "cameras_above_start_m": 30.0}, 1)):  # fmt: skip
        models = [{**survey.prepared["models"][0], "weighed": facts}]
        said = focal_warnings(replace(survey, prepared={**survey.prepared, "models": models}))
        assert len(said) == count
        assert not count or "38.9 m above the ground" in said[-1]


def test_the_first_page_says_by_how_much_positions_contradict(survey):
    def said(left_out):
        models = [{**survey.prepared["models"][0], "georeference": {"left_out": left_out}}]
        found = replace(survey, prepared={**survey.prepared, "models": models})
        return " ".join(warnings(Findings(found, None, None), None))

    assert "contradict" not in said({})
    assert "1 position of a photograph contradicts the others by 3.1 m and was left out." in said({"a.jpg": 3.1})
    assert "2 positions of photographs contradict the others by 3.1 to 1,250.0 m" in said({"a": 1250, "b": 3.1})
    assert "contradicts the others and was left out." in said({"a.jpg": None})


def test_control_points_are_listed_with_their_photographs(survey):
    section = control(survey)
    rows = {row[0]: row[1:] for row in table(section, "Residuals, m").rows}
    assert rows["A1"] == ("control", "0.010", "-0.020", "0.030", "0.037", "2", "0.50"), "without the wrong mark"
    assert rows["B1"] == ("check", "0.120", "-0.050", "0.330", "0.355", "1", "1.00")
    assert table(section, "Marks left out").rows == (("A1", "c.jpg", "13.0"),)
    sums = {row[0]: row[1:] for row in table(section, "Control and check points, m").rows}
    assert sums["control, mean"] == ("0.000", "0.000", "0.003", "3")
    assert sums["control, RMS"] == ("0.008", "0.016", "0.025", "3")
    assert any(isinstance(element, Figure) for element in section.elements)
    facts = {**CONTROL, "left_out": ["A9"], "marks": {"A1": {}}, "residuals_m": {**CONTROL["residuals_m"], "X": None}}
    models = [{**survey.prepared["models"][0], "ground_control": facts}]
    other = replace(survey, prepared={**survey.prepared, "models": models, "settings": {"gcp": "gone.txt"}})
    section = control(other)
    assert len(table(section, "Residuals, m").rows) == 4 and "gone.txt: no such file" in texts(section, "missing")[0]


def test_maps_are_measured_and_drawn(survey, tmp_path):
    rasterio = needs("rasterio")
    heights = np.full((40, 60), 100.0, np.float32)
    heights[:, 50:] = heights[10:12, 10:20] = np.nan
    where = rasterio.transform.from_origin(OFFSET[0], OFFSET[1], 0.5, 0.5)
    facts = dict(driver="GTiff", width=60, height=40, count=1, dtype="float32", nodata=np.nan, transform=where)
    for name, values in (("dsm.tif", heights + np.arange(60)), ("precision.tif", heights / 1000)):
        with rasterio.open(tmp_path / name, "w", **facts) as file:
            file.write(values.astype(np.float32), 1)
    polygon = {"name": "heap", "base": "lowest", "area": 10.0, "fill": 5.5, "cut": 0.25, "net": 5.25}
    maps = {"gsd": 0.5, "size": [60, 40], "covered": 0.825, "heights": [100.0, 149.0]}
    maps |= {"files": ["dsm.tif", "precision.tif"], "volumes": {"polygons": [polygon]}}
    mapped = replace(survey, maps=maps, maps_folder=tmp_path)
    section = surface(mapped)
    rows = dict(table(section, "Heights").rows)
    assert rows["holes"].startswith("1.0 %") and rows["heights"].startswith("100.00 to 149.00 m")
    assert table(section, "Volumes").rows == (("heap", "lowest", "10.00", "5.50", "0.25", "5.25"),)
    assert "median 0.100, 90 % below 0.100 m" in texts(section, "plain")[0]
    of_all = replace(mapped, maps=maps | {"precision": {"median": 0.05, "percentile_90": 0.3}})
    assert "median 0.050, 90 % below 0.300 m" in texts(surface(of_all), "plain")[0], (
        "of all cells, not of the picture's"
    )
    assert [part.title for part in section.elements if isinstance(part, Figure)][0] == "Surface model"
    assert ground_of(mapped).source == "the surface model"
    assert covered(mapped, None) == "495 m²"


def test_what_is_resolved_is_what_the_coarser_of_photographs_and_maps_is(survey):
    assert "4 cm (two pixels)" in meaning(replace(survey, maps={}), 0.02)
    assert "16 cm (two cells of the maps)" in meaning(replace(survey, maps={"gsd": 0.08}), 0.02)
    assert "two pixels" in meaning(replace(survey, maps={"gsd": 0.02}), 0.02)


def test_a_data_set_that_tells_little_says_what_is_missing(survey):
    cloud = replace(survey.scene.cloud, drawn=True)
    frame = replace(survey.scene.frame, crs=None, metres=None)
    bare = replace(survey, scene=replace(survey.scene, cloud=cloud, frame=frame), prepared={}, photos=())
    bare.__dict__["tie_points"] = None
    document = document_of(bare)
    by_title = {section.title: section for section in document.sections}
    assert "Appendix: photographs" not in by_title
    for title in ("Summary", "Overlap", "Camera positions", "Control and check points", "Camera calibration"):
        assert texts(by_title[title], "missing"), title
    for title in ("Tie points", "Surface", "Held-out photographs", "Processing"):
        assert texts(by_title[title], "missing"), title


def test_figures_are_pictures_of_their_size(document):
    figures = []
    for section in document.sections:
        for part in section.elements:
            figures += part.figures if isinstance(part, Row) else [part] if isinstance(part, Figure) else []
    for figure in figures:
        assert Image.open(io.BytesIO(figure.picture)).size == figure.size and 0.3 < figure.share <= 1
    assert sum(len(figure.picture) for figure in figures) < 3e6


@pytest.mark.parametrize("most, length", [(7.3, 5), (10, 10), (0.19, 0.1), (2.0, 2), (49.9, 20)])
def test_scale_bars_have_round_lengths(most, length):
    assert np.isclose(round_length(most), length)


def test_models_without_observations_are_read():
    model = load_engine().Reconstruction()
    assert SparseModel.of(model).xyz.shape == (0, 3)


def test_bad_input_is_one_line_and_writes_nothing(scene, tmp_path, capsys):
    def said(*words):
        assert main(["quality", *map(str, words)]) == 2
        (line,) = capsys.readouterr().err.splitlines()
        return line

    empty = tmp_path / "empty"
    empty.mkdir()
    assert "no such folder" in said(tmp_path / "nothing")
    assert "no delivery (make.json), no run" in said(empty)
    assert "a file; name a delivery" in said(scene / "report.json")
    assert "ends with .html" in said(scene, "--out", tmp_path / "a.pdf")
    assert "a folder; name a file" in said(scene, "--out", empty)
    write_json(empty / "recipe.json", {"what": 1})
    assert "recipe.json" in said(empty)
    assert sorted(path.name for path in tmp_path.rglob("*")) == ["empty", "recipe.json"]
    assert not list(scene.glob("quality*")) and read_json(scene / "report.json", dict[str, Any])["photographs"] == 32
