"""Runs the command line on damaged files, thousands of times, and tells what it must not do.

    python bench/fuzz.py [--cases 10000] [--targets colmap run ...] [--seed 0] [--out fuzz.json]

Every case copies a small data set or run folder, damages one to three places in it (`fuzzing/damage.py`), and gives a
command to `surfkit.cli.main` in this process. Whatever is damaged, the command must end within seconds with an exit
status of its own and at most one line of complaint: no exception, no warning of a library, no write outside the run
folder, no allocation after a number in a header. Settings, the output and the memory of a command are damaged likewise:
numbers that make no sense, a reader that has ended, memory that gives out. The cases run in processes of their own, so
that a crash and an endless loop are found too. Exits 1 if anything was found.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import time
from dataclasses import asdict
from pathlib import Path

from fuzzing.case import Finding
from fuzzing.chunk import chunk
from fuzzing.targets import TARGETS

CHUNK = 100
"""Cases in one process."""


def main() -> int:
    """Run it."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--cases", type=int, default=10_000)
    parser.add_argument("--targets", nargs="+", default=list(TARGETS), choices=list(TARGETS))
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path)
    chosen = parser.parse_args()
    os.environ.update(OMP_NUM_THREADS="1", OMP_WAIT_POLICY="PASSIVE", SURFKIT_PLUGINS="none")
    import torch.fx.experimental.symbolic_shapes  # noqa: F401  (slow ones, loaded once: processes are forked from here)

    from surfkit.cli.recipes import recipes
    from surfkit.io.datasets.raw_dataset import load_pycolmap

    recipes(), load_pycolmap()
    found: dict[tuple[str, str], Finding] = {}
    counts = dict.fromkeys(chosen.targets, 0)
    seed, start = chosen.seed * 1_000_003, time.monotonic()
    while sum(counts.values()) < chosen.cases:
        for name in chosen.targets:
            seed += 1
            made, findings = chunk(name, min(CHUNK, chosen.cases), seed)
            counts[name] += made
            for finding in findings:
                key = (finding.what, name)
                if key in found:
                    found[key].times += 1
                else:
                    found[key] = finding
                    print(f"{name}: {finding.what}\n    {finding.damages}\n    {finding.said[-600:]}", flush=True)
        print(f"{sum(counts.values())} cases, {time.monotonic() - start:.0f} s", file=sys.stderr, flush=True)
    report = {"cases": counts, "seconds": round(time.monotonic() - start), "found": [asdict(f) for f in found.values()]}
    for finding in found.values():
        print(f"{finding.times:5} x {finding.target}: {finding.what}")
    print(f"{sum(counts.values())} cases, {len(found)} kinds of findings, {report['seconds']} s")
    if chosen.out:
        chosen.out.write_text(json.dumps(report, indent=2) + "\n")
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(main())
