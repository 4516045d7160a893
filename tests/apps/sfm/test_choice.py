"""Features and matchers that do not go together, or that this machine lacks, are refused before any work."""

import re
import sys

import pytest

from surfkit.cli import main

from .pictures import arc, picture, save


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["features:disk"], "compares descriptors of SIFT only, not those of features:disk; add matcher:mutual or"),
        (
            ["features:kornia-sift"],
            r"features:kornia-sift needs the package kornia, .*pip install 'surfkit\[features\]'",
        ),
        (["matcher:lightglue"], r"matcher:lightglue needs the package kornia, .*pip install 'surfkit\[features\]'"),
        (["features:aliked", "matcher:mutual"], r"features:aliked needs the package kornia"),
        (["features:surf"], "no features named 'surf'; .*known: aliked, disk, kornia-sift, sift"),
        (
            ["--features", "1500"],
            "no features named '1500'; known: .*; how many are kept is --max-features 1500",
        ),
        (["matcher:mutual", "--matcher.ratio", "2"], "ratio is 2; it must lie between 0.1 and 1"),
        (["matcher:mutual", "--device", "cuda:77"], "--device cuda:77: torch finds"),
    ],
)
@pytest.mark.parametrize("command", ["photos", "points"])
def test_what_cannot_be_is_one_line(command, words, said, tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "kornia", None)
    if command == "photos":
        for at, pose in enumerate(arc(3)):
            save(tmp_path / f"p/{at}.jpg", picture(pose))
    else:
        (tmp_path / "p").mkdir()
        (tmp_path / "p/transforms.json").write_text('{"frames": []}')
    assert main(["prepare", command, str(tmp_path / "p"), "--out", str(tmp_path / "s"), *words]) == 2
    err = capsys.readouterr().err
    assert re.search(said, err) and err.count("\n") == 1, err
    assert not (tmp_path / "s/prepare/features").exists()
