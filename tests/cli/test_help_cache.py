"""Help is made once, and again when what it follows from changes."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from surfkit.cli import help_cache
from surfkit.cli.help_cache import MAX_TEXTS, keep, kept_help, show_kept


@pytest.fixture
def sources(tmp_path, monkeypatch):
    """One file that help follows from, and an empty cache."""
    monkeypatch.setenv("SURFKIT_CACHE", str(tmp_path / "cache"))
    file = tmp_path / "part.py"
    file.write_text("A = 1\n")
    monkeypatch.setattr(help_cache, "_sources", lambda: [f"{file} {file.stat().st_size}"])
    return file


def test_a_text_is_kept_until_a_source_the_words_or_the_terminal_change(sources, monkeypatch, capsys):
    first = kept_help(["train", "--help"])
    assert first is not None and not show_kept(first)
    keep(first, "text\n")
    assert show_kept(kept_help(["train", "--help"])) and capsys.readouterr().out == "text\n"
    assert kept_help(["train", "-h"]) != first
    monkeypatch.setenv("COLUMNS", "61")
    assert kept_help(["train", "--help"]) != first
    monkeypatch.delenv("COLUMNS")
    sources.write_text("A = 12\n")
    assert kept_help(["train", "--help"]) != first


def test_nothing_is_kept_without_help_or_where_a_file_decides(sources):
    assert kept_help(["train"]) is None
    assert kept_help(["mesh", str(sources.parent), "--help"]) is None
    assert kept_help(["train", f"recipe:{sources}", "--help"]) is None


def test_few_texts_are_kept_and_a_read_only_cache_is_no_error(sources):
    folder = kept_help(["train", "--help"]).parent
    for number in range(MAX_TEXTS + 3):
        keep(folder / f"{number}.txt", "text")
    assert len(list(folder.iterdir())) == MAX_TEXTS
    keep(sources / "no" / "folder.txt", "text")


def test_the_command_loads_no_torch_the_second_time(tmp_path):
    code = "import sys; from surfkit.cli import main; sys.argv[1:] = HELP; print(main(), 'torch' in sys.modules)"
    code = code.replace("HELP", "'help', 'train'")
    environment = os.environ | {"SURFKIT_CACHE": str(tmp_path)}
    first, second = (
        subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True) for _ in range(2)
    )
    assert first.stdout.endswith("0 True\n") and second.stdout.endswith("0 False\n")
    assert first.stdout.splitlines()[:-1] == second.stdout.splitlines()[:-1] and len(first.stdout) > 5_000
    assert Path(tmp_path / "help").is_dir()
