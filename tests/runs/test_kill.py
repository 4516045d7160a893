"""A training process that SIGKILL ends at random moments, also while it writes files, ends in the same bits."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from needs import needs_native

BENCH = Path(__file__).parents[2] / "bench" / "kill.py"


@needs_native
@pytest.mark.skipif(not hasattr(os, "fork"), reason="processes are forked, so that torch is loaded once")
def test_killed_runs_end_in_the_same_bits(tmp_path):
    words = [sys.executable, str(BENCH), "--kills", "6", "--seed", "1", "--out", str(tmp_path / "kill.json")]
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-2000:]
    report = json.loads((tmp_path / "kill.json").read_text())
    assert [kill["kind"] for kill in report["kills"]] == ["time", "operation", "torn"] * 2
    assert report["differing"] == [] and report["finished_runs"] >= 1
    assert {"points", "params.means", "second.means", "generator", "journal", "metrics"} <= set(report["compared"])
