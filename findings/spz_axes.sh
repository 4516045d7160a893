#!/usr/bin/env bash
# Two writers, and two versions of one, put the same splats into .spz in different axes, and the file does not say which.
#
# @playcanvas/splat-transform 2.7.1 and 3.7.0, gsply 0.4.6. The reference library of SPZ keeps
# right-up-back inside the file, and PLY files of splats are right-down-front by habit. From one PLY file 2.7.1 writes
# positions with y and z negated; 3.7.0 and gsply write them as they are. A reader that goes by either habit has half a
# turn about x for the files of the other.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet gsply==0.4.6 numpy==2.4.6 zstandard==0.25.0
for version in 2.7.1 3.7.0; do
    mkdir -p "$folder/$version"
    (cd "$folder/$version" && npm init -y >/dev/null && npm install --silent --no-audit --no-fund "@playcanvas/splat-transform@$version" >/dev/null)
done
"$folder/venv/bin/python" - "$folder" <<'PYTHON'
import gzip
import struct
import subprocess
import sys
from pathlib import Path

import gsply
import numpy as np
import zstandard

folder = Path(sys.argv[1])
true = np.array([[1, 2, 3], [-4, 5, -6], [7, -8, 9], [0.5, 0.25, -0.125]], np.float32)
names = ["x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity", *(f"scale_{i}" for i in range(3))]
names += [f"rot_{i}" for i in range(4)]
rows = np.zeros(len(true), [(name, "<f4") for name in names])
for axis, values in zip("xyz", true.T):
    rows[axis] = values
rows["opacity"] = rows["rot_0"] = 1
for i in range(3):
    rows[f"scale_{i}"] = -3
head = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(rows)}\n"
head += "".join(f"property float {name}\n" for name in names) + "end_header\n"
(folder / "a.ply").write_bytes(head.encode() + rows.tobytes())


def positions(path):
    """Three whole numbers of 24 bits for each splat: after 16 bytes in SPZ 2 and 3, the first stream in SPZ 4."""
    data, start = path.read_bytes(), 16
    data = gzip.decompress(data) if data[:2] == b"\x1f\x8b" else data
    magic, version, count, degree, fraction = struct.unpack_from("<IIIBB", data)
    assert magic == 0x5053474E and version in (2, 3, 4), (hex(magic), version)
    if version == 4:
        streams, table = struct.unpack_from("<BI", data, 15)
        packed, size = struct.unpack_from("<QQ", data, table)
        begin = table + 16 * streams
        data, start = zstandard.decompress(data[begin : begin + packed], size), 0
    raw = np.frombuffer(data, np.uint8, 9 * count, start).reshape(count, 3, 3).astype(np.int64)
    whole = raw[..., 0] | raw[..., 1] << 8 | raw[..., 2] << 16
    found = np.where(whole >= 1 << 23, whole - (1 << 24), whole) / (1 << fraction)
    return version, found[np.argsort(np.abs(found[:, 0]))]


wanted, habit = true[np.argsort(np.abs(true[:, 0]))], {}
for version in ("2.7.1", "3.7.0"):
    out = folder / f"{version}.spz"
    tool = folder / version / "node_modules/.bin/splat-transform"
    subprocess.run([tool, folder / "a.ply", out], check=True, capture_output=True)
    habit[f"splat-transform {version}"] = out
gsply.write_spz(str(folder / "gsply.spz"), gsply.plyread(str(folder / "a.ply")))
habit["gsply 0.4.6"] = folder / "gsply.spz"
for name, path in habit.items():
    version, found = positions(path)
    signs = np.sign(found / wanted).mean(0)
    habit[name] = signs.tolist()
    print(f"{name}: SPZ {version}, x y z times {signs.tolist()}")
assert habit == {
    "splat-transform 2.7.1": [1, -1, -1], "splat-transform 3.7.0": [1, 1, 1], "gsply 0.4.6": [1, 1, 1]
}, "the behaviour has changed"
PYTHON
