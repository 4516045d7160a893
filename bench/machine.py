"""What a result was measured on, and how it is kept."""

from __future__ import annotations

import json
import subprocess
import time
from pathlib import Path

import torch

from surfkit.apps.benchmark.provenance import processor
from surfkit.core.codec import write_text
from surfkit.raster import native

RESULTS = Path(__file__).parent / "results"


def commit() -> str:
    """The commit that was measured, with a mark if files had changed."""
    words = ["git", "describe", "--always", "--dirty"]
    result = subprocess.run(words, cwd=RESULTS.parent, capture_output=True, text=True)
    return result.stdout.strip() or "unknown"


def save(name: str, figures: dict, folder: Path = RESULTS) -> Path:
    """Keep figures as NAME.json in a folder with the machine, the commit and the date; the file is always whole."""
    about = {
        "machine": f"{processor()}, {torch.get_num_threads()} threads",
        "kernels": native.module().kernels_in_use() if native.module() else "reference",
        "torch": torch.__version__,
        "commit": commit(),
        "date": time.strftime("%Y-%m-%d"),
    }
    path = folder / f"{name}.json"
    folder.mkdir(parents=True, exist_ok=True)
    write_text(path, json.dumps({**about, "figures": figures}, indent=2) + "\n")
    return path


def cpu_seconds(action, rounds: int, warm: int = 1) -> float:
    """Median process CPU seconds of calling `action`, all threads together, after a warm-up."""
    times = []
    for index in range(warm + rounds):
        began = time.process_time()
        action()
        if index >= warm:
            times.append(time.process_time() - began)
    return sorted(times)[len(times) // 2]
