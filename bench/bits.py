"""Hashes of what small runs of every recipe come to on the CPU: the same before and after a change of form.

python bench/bits.py before.json
python bench/bits.py after.json --against before.json
"""

from __future__ import annotations

import argparse
import hashlib
import json
import subprocess
import sys
import tempfile
from pathlib import Path

EXAMPLE = Path(__file__).parents[1] / "examples" / "boruszyn"
RUNS = {
    "2dgs": ["recipe:2dgs"],
    "3dgs": ["recipe:3dgs"],
    "flat3dgs": ["recipe:flat3dgs"],
    "absgs": ["recipe:absgs"],
    "trim2dgs": ["recipe:trim2dgs"],
    "lightgaussian": ["recipe:lightgaussian"],
    "mcmc": ["recipe:mcmc"],
    "citygs": ["recipe:citygs", "--min-views", "4"],
    "citygs2": ["recipe:citygs2", "--min-views", "4"],
    "citygs2-pool": ["recipe:citygs2-short", "--min-views", "4", "executor:pool"],
    "surface": ["recipe:surface"],
    "surface-blocks": ["recipe:surface-blocks", "--min-views", "4"],
}
RESULTS = ("point_cloud.ply", "mesh.ply", "cameras.json")


def hashes(words: list[str], steps: int) -> dict[str, str]:
    """Of the results of one run, by file; "-" for one that is not written."""
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, "-m", "surfkit.cli", "train", *words, "--data", str(EXAMPLE), "--scale", "6"]
        command += ["--test-every", "8", "--steps", str(steps), "--out", folder + "/run"]
        done = subprocess.run(command, capture_output=True, text=True)
        if done.returncode:
            return {"error": done.stderr.strip().splitlines()[-1]}
        paths = {name: Path(folder, "run", name) for name in RESULTS}
        return {
            name: hashlib.sha256(path.read_bytes()).hexdigest()[:16] if path.exists() else "-"
            for name, path in paths.items()
        }


def main() -> int:
    """Print a line for each run; 1 if any differs from `--against`."""
    words = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    words.add_argument("file", type=Path)
    words.add_argument("--against", type=Path)
    words.add_argument("--steps", type=int, default=120)
    words.add_argument("--only", nargs="*", choices=RUNS, default=list(RUNS))
    given = words.parse_args()
    before = json.loads(given.against.read_text()) if given.against else {}
    found: dict[str, dict[str, str]] = {}
    for name in given.only:
        found[name] = hashes(RUNS[name], given.steps)
        same = "" if name not in before else "  same" if before[name] == found[name] else "  DIFFERS"
        print(f"{name:16}{'  '.join(found[name].values())}{same}", flush=True)
        given.file.write_text(json.dumps(found, indent=2) + "\n")
    return int(any(name in before and before[name] != found[name] for name in found))


if __name__ == "__main__":
    raise SystemExit(main())
