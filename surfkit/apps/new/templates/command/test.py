from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from surfkit import BadInput
from surfkit.cli import main
from surfkit.core.registry import offered

from new_plugin.new_part import NewPart


def test_it_is_offered():
    assert "new-part" in {name for _, name, _ in offered("surfkit_commands")}


def test_its_help(capsys):
    assert main(["new-part", "--help"]) == 0
    assert "Opacity below which a splat is faint" in " ".join(capsys.readouterr().out.split())


def test_it_counts(monkeypatch, capsys):
    run = SimpleNamespace(splats=SimpleNamespace(opacities=np.array([0.01, 0.2, 0.9])))
    monkeypatch.setattr("surfkit.api.open_run", lambda out: nullcontext(run))
    NewPart(Path("RUN")).run()
    assert capsys.readouterr().out == "3 splats, 1 of them faint\n"


def test_wrong_settings_are_one_line():
    with pytest.raises(BadInput, match="--faint"):
        NewPart(Path("RUN"), faint=2)
