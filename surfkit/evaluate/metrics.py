"""The measurements of a run, as metrics.json keeps them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from surfkit.core.check import BadInput
from surfkit.core.codec import read_json

OPTIONAL_NUMBERS = ("peak_memory_bytes", "peak_gpu_bytes", "fps")
"""Numbers that are there where they are known."""


def read_metrics(out: Path) -> dict[str, Any]:
    """The measurements of a finished run.

    Raises:
        BadInput: They are damaged.
    """
    path = out / "metrics.json"
    found = read_json(path, dict[str, Any])
    images = found.get("images")
    is_valid = isinstance(images, dict) and isinstance(images.get("per_image"), dict)
    is_valid = is_valid and all(_is_number(found.get(name)) for name in ("steps", "seconds", "cpu_seconds"))
    is_valid = is_valid and "points" in found and (found["points"] is None or _is_number(found["points"]))
    is_valid = is_valid and all(
        images.get(name, "") is None or _is_number(images.get(name)) for name in ("psnr", "ssim")
    )
    is_valid = is_valid and all(not found.get(name) or _is_number(found[name]) for name in OPTIONAL_NUMBERS)
    if not is_valid:
        raise BadInput(f"{path}: damaged; delete it, and the surfkit train command of the run measures again")
    return found


def _is_number(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool) and abs(value) < 1e30
