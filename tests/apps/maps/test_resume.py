"""Maps that are interrupted go on, and come to the same bytes."""

import json
from dataclasses import replace

import numpy as np
import pytest
from interrupted import digests, interrupted_often
from needs import needs
from town import town

from surfkit.apps.maps import contours, orthophoto, photo_regions, surface_model
from surfkit.apps.maps import make_maps as making
from surfkit.apps.maps.make_maps import MeshWithPhotos, make_maps
from surfkit.apps.maps.map_settings import MapSettings
from surfkit.apps.maps.owned_files import NAMES_FILE, UNFINISHED_FOLDER
from surfkit.apps.texture import find_candidates
from surfkit.core.check import BadInput
from surfkit.core.events import Warned
from surfkit.scene.scene import Frame

from .shapes import UTM, heightfield

rasterio = needs("rasterio")
FRAME = Frame(np.array([*UTM, 0.0]), 0.01, 1.0, "EPSG:32633")
SETTINGS = MapSettings(gsd=0.5, tile=24, interval=1.0)


@pytest.fixture
def same_date():
    """GeoPackages with the same date in them."""
    pyogrio = needs("pyogrio")
    pyogrio.set_gdal_config_options({"OGR_CURRENT_DATE": "2026-01-01T00:00:00.000Z"})
    yield
    pyogrio.set_gdal_config_options({"OGR_CURRENT_DATE": None})


def hill(rise, color=True):
    def paint(x, y):
        return np.stack([x % 255, y % 255, (x + y) % 255], 1)

    def height(x, y):
        return 30 + rise * np.sin(x / 7) + 3 * np.cos(y / 5)

    return heightfield(height, UTM, (UTM[0] + 20, UTM[1] + 20), 40, paint if color else None)


def counted(monkeypatch, module, name):
    """The calls of a function of a module, as a list that grows."""
    calls, function = [], getattr(module, name)
    monkeypatch.setattr(module, name, lambda *args, **more: calls.append(name) or function(*args, **more))
    return calls


def test_the_same_bytes_after_an_interruption_anywhere(tmp_path, monkeypatch, same_date):
    needs("laspy"), needs("lazrs")
    here, there = hill(4.0), hill(5.0, color=False)
    make_maps(MeshWithPhotos(here, FRAME), SETTINGS, tmp_path / "whole", there)
    tiles = counted(monkeypatch, surface_model, "drawn_tile")
    lines = counted(monkeypatch, contours, "contour_lines")
    calls = interrupted_often(lambda: make_maps(MeshWithPhotos(here, FRAME), SETTINGS, tmp_path / "parts", there))
    assert calls > 20
    assert digests(tmp_path / "parts") == digests(tmp_path / "whole")
    assert len(tiles) == 2 * 4 and len(lines) == 4, "what is finished is not done again"


def test_colors_of_photographs_too(tmp_path, monkeypatch):
    needs("cv2")
    monkeypatch.setattr(orthophoto, "SIDE", 32)
    monkeypatch.setattr(find_candidates, "PAUSE_S", 0.0)
    monkeypatch.setattr(find_candidates, "SAVE_PAUSE_FACTOR", 0.0)
    (tmp_path / "town").mkdir()
    scene = town(tmp_path / "town")
    subject = MeshWithPhotos(scene.surface, scene.frame, scene.views)
    settings = MapSettings(("orthophoto",), colors="photographs", gsd=0.3, up="z", memory="100MB", tile=48)
    make_maps(subject, settings, tmp_path / "whole")
    looks, squares = counted(monkeypatch, photo_regions, "look"), counted(monkeypatch, orthophoto.Square, "write")
    interrupted_often(lambda: make_maps(subject, settings, tmp_path / "parts"))
    assert digests(tmp_path / "parts") == digests(tmp_path / "whole") and len(looks) == len(scene.views)
    assert len(squares) == 4, "what is finished is not done again"


def stopped(monkeypatch, subject, settings, out):
    """Maps that are interrupted when the surface model is there and the contour lines are not."""
    with monkeypatch.context() as change:
        change.setattr(making, "trace", lambda *_: (_ for _ in ()).throw(KeyboardInterrupt))
        with pytest.raises(KeyboardInterrupt):
            make_maps(subject, settings, out)


@pytest.mark.parametrize("what", ["nothing", "setting", "mesh", "map gone", "map written again"])
def test_only_what_is_the_same_goes_on(tmp_path, monkeypatch, what):
    settings = replace(SETTINGS, products=("contours",))
    surface = hill(4.0)
    stopped(monkeypatch, MeshWithPhotos(surface, FRAME), settings, tmp_path)
    assert (
        (tmp_path / "dsm.tif").exists()
        and (tmp_path / UNFINISHED_FOLDER).is_dir()
        and not (tmp_path / "maps.json").exists()
    )
    if what == "setting":
        settings = replace(settings, gsd=0.25)
    elif what == "mesh":
        surface.rows["z"][7] += 0.01
    elif what == "map gone":
        (tmp_path / "dsm.tif").unlink()
    elif what == "map written again":
        (tmp_path / "dsm.tif").write_bytes((tmp_path / "dsm.tif").read_bytes()[:-1])
    tiles, said = counted(monkeypatch, surface_model, "drawn_tile"), []
    monkeypatch.setattr("surfkit.core.stages.emit", said.append)
    record = make_maps(MeshWithPhotos(surface, FRAME), settings, tmp_path)
    assert bool(tiles) == (what != "nothing")
    anew = [event.text for event in said if isinstance(event, Warned)]
    assert len(anew) == (what in ("setting", "mesh")) and all("other inputs or settings" in text for text in anew)
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted([*record["files"], "maps.json"])
    make_maps(MeshWithPhotos(surface, FRAME), settings, tmp_path / "whole")
    assert digests(tmp_path)["dsm.tif"] == digests(tmp_path / "whole")["dsm.tif"]


def test_a_folder_of_somebody_else_is_left_alone(tmp_path):
    (tmp_path / UNFINISHED_FOLDER).mkdir()
    (tmp_path / UNFINISHED_FOLDER / "novel.txt").write_text("chapter 1")
    with pytest.raises(BadInput, match="not surfkit's"):
        make_maps(MeshWithPhotos(hill(4.0), FRAME), SETTINGS, tmp_path)
    assert (tmp_path / UNFINISHED_FOLDER / "novel.txt").read_text() == "chapter 1"


def files_of(folder):
    return {path.name: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.mark.parametrize("name", ["dsm.tif", "hillshade.tif", "maps.json"])
def test_files_of_another_program_are_not_replaced(tmp_path, name):
    (tmp_path / name).write_text("of another program")
    with pytest.raises(OSError, match=f"did not write, .*: '{name}';"):
        make_maps(MeshWithPhotos(hill(4.0), FRAME), SETTINGS, tmp_path)
    assert files_of(tmp_path) == {name: b"of another program"}


def test_beside_our_maps_too(tmp_path, monkeypatch):
    """Maps that are made again, also smaller ones, or after an interruption, replace and delete ours alone."""
    few, less = replace(SETTINGS, products=("contours",)), replace(SETTINGS, products=())
    make_maps(MeshWithPhotos(hill(4.0), FRAME), few, tmp_path)
    (tmp_path / "hillshade.tif").write_text("of another program")
    (tmp_path / "difference.png").symlink_to("nowhere")
    make_maps(MeshWithPhotos(hill(4.0), FRAME), few, tmp_path)
    stopped(monkeypatch, MeshWithPhotos(hill(4.0), FRAME), few, tmp_path)
    before = files_of(tmp_path)
    for settings, other in ((replace(SETTINGS, products=("hillshade",)), None), (few, hill(3.0))):
        with pytest.raises(OSError, match="did not write, .*: '(hillshade.tif|difference.png)';"):
            make_maps(MeshWithPhotos(hill(4.0), FRAME), settings, tmp_path, other)
    assert files_of(tmp_path) == before
    make_maps(MeshWithPhotos(hill(4.0), FRAME), less, tmp_path)
    left = {path.name for path in tmp_path.iterdir()}
    assert left == {"dsm.tif", "maps.json", "hillshade.tif", "difference.png"}
    assert (tmp_path / "hillshade.tif").read_text() == "of another program"


def test_what_a_version_before_left_of_an_interruption_is_ours(tmp_path, monkeypatch):
    stopped(monkeypatch, MeshWithPhotos(hill(4.0), FRAME), replace(SETTINGS, products=("contours",)), tmp_path)
    (tmp_path / UNFINISHED_FOLDER / NAMES_FILE).unlink()
    make_maps(MeshWithPhotos(hill(4.0), FRAME), SETTINGS, tmp_path)
    assert (tmp_path / "maps.json").exists()


def test_maps_that_end_half_way_leave_nothing_that_is_in_the_way(tmp_path, monkeypatch):
    with monkeypatch.context() as change:
        change.setattr(making, "trace", lambda *_: (_ for _ in ()).throw(BadInput("too many levels")))
        with pytest.raises(BadInput, match="too many levels"):
            make_maps(MeshWithPhotos(hill(4.0), FRAME), replace(SETTINGS, products=("contours",)), tmp_path)
    assert not list(tmp_path.iterdir())


def test_a_record_names_no_file_outside(tmp_path):
    """maps.json lies in a folder that others may write to: what it names is deleted only if it is a map's name."""
    (tmp_path / "maps").mkdir()
    (tmp_path / "kept.txt").write_text("chapter 1")
    make_maps(MeshWithPhotos(hill(4.0), FRAME), SETTINGS, tmp_path / "maps")
    record = json.loads((tmp_path / "maps/maps.json").read_text())
    (tmp_path / "maps/maps.json").write_text(json.dumps(record | {"files": ["../kept.txt", *record["files"]]}))
    make_maps(MeshWithPhotos(hill(4.0), FRAME), replace(SETTINGS, products=()), tmp_path / "maps")
    assert (tmp_path / "kept.txt").read_text() == "chapter 1"
