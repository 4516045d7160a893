"""What made a figure: the code, the machine, the data and the protocol."""

from __future__ import annotations

import platform
import subprocess
from dataclasses import dataclass
from pathlib import Path

import torch

from surfkit.core.version import own_version
from surfkit.raster.select import Device
from surfkit.runs.run_stage import select_rasterizer

PROVENANCE_FILE = "provenance.json"
"""In the folder of a benchmark: `Provenance` of each run, by its folder."""
GIT_TIMEOUT_S = 10


@dataclass(frozen=True)
class Provenance:
    """What made a run.

    Attributes:
        protocol: Digest of the declaration.
        data: Hash of the data.
        surfkit: Its version.
        commit: Of the source tree that surfkit runs from, marked where files differ; None where it is installed.
        torch: Its version.
        device: Rasterizer and machine.
    """

    protocol: str
    data: str
    surfkit: str
    commit: str | None
    torch: str
    device: str


def provenance_now(protocol: str, data: str, device: Device) -> Provenance:
    """What makes the runs of this process, by digest of the protocol and hash of the data."""
    return Provenance(protocol, data, own_version(), commit(), torch.__version__, device_name(device))


def commit() -> str | None:
    """The commit of the source tree that surfkit runs from; None where it does not run from one."""
    package = Path(__file__).resolve().parents[2]
    if not (package.parent / ".git").exists():  # else a folder that surfkit is installed below would count
        return None
    words = ["git", "describe", "--always", "--dirty", "--exclude=*"]
    try:
        done = subprocess.run(words, cwd=package, capture_output=True, text=True, timeout=GIT_TIMEOUT_S, check=True)
    except (OSError, subprocess.SubprocessError):
        return None
    return done.stdout.strip() or None


def device_name(device: Device) -> str:
    """Rasterizer, and GPU or processor, that a device stands for."""
    rasterizer, backend = select_rasterizer(device)
    place = rasterizer.where()
    return f"{backend} on {torch.cuda.get_device_name(place) if place.type == 'cuda' else processor()}"


def processor() -> str:
    """The name of the processor."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        lines = []
    found = next((line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")), "")
    return found or platform.processor() or platform.machine()
