"""States whose points stay on disk: the same as those that are read whole, and refused for the same reasons."""

import errno

import pytest
import torch

from surfkit.core.check import BadInput
from surfkit.train import checkpoint, streaming
from surfkit.train.stage import Stage

from .test_checkpoint import small_files


@pytest.fixture
def path(begin, tmp_path, monkeypatch):
    """A state of 40 points after two steps in a file, to be read 7 points at a time."""
    monkeypatch.setattr(streaming, "PIECE_POINTS", 7)
    monkeypatch.setattr(streaming, "CHUNK_BYTES", 100)
    trainer, state = begin(Stage(steps=9))
    for _ in range(2):
        trainer.step(state)
    checkpoint.save(tmp_path / "c.safetensors", state)
    return tmp_path / "c.safetensors"


def whole(stored) -> dict[str, torch.Tensor]:
    parts = [piece.points.params for piece in stored.pieces()]
    assert [len(part["means"]) for part in parts] == [7] * (len(stored.state.points) // 7) + [5]
    return {name: torch.cat([part[name] for part in parts]) for name in parts[0]}


def test_pieces_are_the_whole(path):
    true, stored = checkpoint.load(path), streaming.opened(path)
    found = whole(stored)
    assert found.keys() == true.points.params.keys()
    assert all(torch.equal(found[name], value) for name, value in true.points.params.items())
    assert all(getattr(stored.state, name) == getattr(true, name) for name in checkpoint.SCALAR_FIELDS)
    assert torch.equal(stored.state.order.queue, true.order.queue)
    assert torch.equal(stored.state.generator.get_state(), true.generator.get_state())


def test_what_is_written_in_pieces_is_read_as_any_other(path):
    """Against the file that the whole state gives; moments are 0."""
    stored, true = streaming.opened(path), checkpoint.load(path)
    there = path.with_name("d.safetensors")
    streaming.save(there, stored.state, (piece.points.params for piece in stored.pieces()))
    found = checkpoint.load(there)
    assert all(torch.equal(found.points.params[name], value) for name, value in true.points.params.items())
    assert all(
        (value == 0).all() for group in (found.points.exp_avg, found.points.exp_avg_sq) for value in group.values()
    )
    checkpoint.save(path, found)
    with checkpoint.reading(path) as (_, one), checkpoint.reading(there) as (_, other):
        assert one == other, "digest and facts"


@pytest.mark.parametrize("where", [0.002, 0.1, 0.5, 0.999])
def test_a_flipped_bit_anywhere_is_noticed(path, where):
    checkpoint.save(path, checkpoint.load(path))
    content = bytearray(path.read_bytes())
    content[int(where * len(content))] ^= 4
    path.write_bytes(content)
    with pytest.raises(BadInput, match="c.safetensors"):
        streaming.opened(path)
    stored, damage = streaming.open_last(path)
    assert stored.path == checkpoint.before(path) and str(path) in damage


def test_files_that_are_no_checkpoint(path):
    assert streaming.open_last(path.with_name("none.safetensors")) is None
    path.write_bytes(path.read_bytes()[:-1])
    with pytest.raises(BadInput, match="no readable checkpoint"):
        streaming.opened(path)
    path.write_bytes(b"nonsense")
    with pytest.raises(BadInput, match="no readable checkpoint"):
        streaming.open_last(path)


def test_a_full_disk_leaves_what_was_there(path):
    stored, content = streaming.opened(path), path.read_bytes()
    parts = [piece.points.params for piece in stored.pieces()]
    with small_files(len(content) // 2), pytest.raises(OSError) as error:  # noqa: PT011
        streaming.save(path, stored.state, iter(parts))
    assert error.value.errno == errno.EFBIG and path.read_bytes() == content
    assert [file.name for file in path.parent.iterdir()] == [path.name]


def test_pieces_that_are_not_all_the_points_are_not_saved(path):
    stored, content = streaming.opened(path), path.read_bytes()
    with pytest.raises(AssertionError, match="not the points"):
        streaming.save(path, stored.state, [next(stored.pieces()).points.params])
    assert path.read_bytes() == content
