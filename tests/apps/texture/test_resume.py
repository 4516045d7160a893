"""Textures that are interrupted go on, and come to the same bytes."""

import json
import os
from dataclasses import replace

import pytest
from interrupted import digests, interrupted_often
from needs import needs
from town import town

from surfkit.apps.texture import find_candidates, texture_cache
from surfkit.apps.texture import texture_export as deliver
from surfkit.apps.texture import texture_mesh as make
from surfkit.apps.texture.texture_cache import TextureCache
from surfkit.apps.texture.texture_mesh import (
    TEXTURE_RECORD,
    UNFINISHED_SUFFIX,
    MeshWithPhotos,
    TextureSettings,
    make_texture,
)
from surfkit.core.check import BadInput
from surfkit.core.events import PhotoSkipped
from surfkit.core.lock import locked

needs("fast_simplification")
SETTINGS = TextureSettings(size=128)


@pytest.fixture
def scene(tmp_path, monkeypatch):
    """A town; what is seen is kept after every photograph."""
    monkeypatch.setattr(find_candidates, "PAUSE_S", 0.0)
    monkeypatch.setattr(find_candidates, "SAVE_PAUSE_FACTOR", 0.0)
    (tmp_path / "photographs").mkdir()
    return town(tmp_path / "photographs")


def made(scene, out, settings=SETTINGS):
    return make_texture(MeshWithPhotos(scene.surface, scene.frame, scene.views), settings, out, 10**8)


def counted(monkeypatch, module, name):
    """The calls of a function of a module, as a list that grows."""
    calls, function = [], getattr(module, name)
    monkeypatch.setattr(module, name, lambda *args, **more: calls.append(name) or function(*args, **more))
    return calls


def without_seconds(folder):
    """Digests of the files, and the record without the time that it took."""
    record = json.loads((folder / TEXTURE_RECORD).read_text())
    return {name: value for name, value in digests(folder).items() if name != TEXTURE_RECORD} | record | {"seconds": 0}


def test_the_same_bytes_after_an_interruption_anywhere(scene, tmp_path, monkeypatch):
    names = [(make, "sight"), (deliver, "paint")]
    with monkeypatch.context() as change:
        expected = [counted(change, *name) for name in names]
        record = made(scene, tmp_path / "whole")
        assert record["tiles"] > 2, "levels of detail"
    found = [counted(monkeypatch, *name) for name in names]
    assert interrupted_often(lambda: made(scene, tmp_path / "parts")) > 20
    assert without_seconds(tmp_path / "parts") == without_seconds(tmp_path / "whole")
    assert found == expected and len(found[0]) >= 3 * len(scene.views), "what is finished is not done again"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["parts", "photographs", "whole"]


def stopped(monkeypatch, scene, out, settings):
    """A texture that is interrupted when the photographs have been looked at."""
    with monkeypatch.context() as change:
        change.setattr(make, "level", lambda *_: (_ for _ in ()).throw(KeyboardInterrupt))
        with pytest.raises(KeyboardInterrupt):
            made(scene, out, settings)
    assert not out.exists() and (out.with_name(out.name + UNFINISHED_SUFFIX) / "chosen-0.npz").exists()


@pytest.mark.parametrize("what", ["nothing", "setting", "mesh", "photograph", "another way to choose", "damage"])
def test_only_what_is_the_same_goes_on(scene, tmp_path, monkeypatch, what):
    out, settings, said = tmp_path / "out", replace(SETTINGS, formats=("glb",)), []
    stopped(monkeypatch, scene, out, settings)
    if what == "setting":
        settings = replace(settings, size=256)
    elif what == "mesh":
        scene.surface.rows["z"][7] += 0.01
    elif what == "photograph":
        os.utime(scene.views[3].path, ns=(1, 1))
    elif what == "another way to choose":
        monkeypatch.setattr(texture_cache, "CHOICE_VERSION", texture_cache.CHOICE_VERSION + 1)
    elif what == "damage":
        file = out.with_name(out.name + UNFINISHED_SUFFIX) / "chosen-0.npz"
        file.write_bytes(file.read_bytes()[:-100])
    looks = counted(monkeypatch, make, "sight")
    monkeypatch.setattr("surfkit.core.stages.emit", said.append)
    made(scene, out, settings)
    assert len(looks) == (0 if what == "nothing" else len(scene.views))
    assert len(said) == (what not in ("nothing", "damage"))
    assert (out / TEXTURE_RECORD).exists() and not out.with_name(out.name + UNFINISHED_SUFFIX).exists()


def test_a_photograph_that_is_gone_is_passed_over(scene, tmp_path, monkeypatch):
    scene.views[3].path.unlink()
    said = []
    monkeypatch.setattr(find_candidates, "emit", said.append)
    made(scene, tmp_path / "out", replace(SETTINGS, formats=("glb",)))
    assert [event.name for event in said if isinstance(event, PhotoSkipped)] == [scene.views[3].name]


def test_a_second_process_is_refused(scene, tmp_path):
    with locked(tmp_path / f"out{UNFINISHED_SUFFIX}"), pytest.raises(BadInput, match="works in it"):
        made(scene, tmp_path / "out")


def test_arrays_are_kept_whole_or_not_at_all(tmp_path):
    kept = TextureCache(tmp_path)
    assert kept.read("a") is None and kept.once("a", lambda: {"x": [1, 2]})["x"].tolist() == [1, 2]
    assert kept.once("a", lambda: pytest.fail("it is there"))["x"].tolist() == [1, 2]
    assert kept.of(1).read("a") is None
    file = next(tmp_path.iterdir())
    content = bytearray(file.read_bytes())
    content[content.index(b"\x01\0\0\0\0\0\0\0\x02")] = 5
    file.write_bytes(content)
    assert kept.read("a") is None, "a digest in the file tells"
    assert TextureCache().once("a", lambda: {"x": [3]})["x"].tolist() == [3]
