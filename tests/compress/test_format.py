"""A reader written from docs/surfkit_file.md alone: nothing of it comes from surfkit."""

import json
import struct
import zlib

import numpy as np
import pytest
import torch
import zstandard

from surfkit.compress import container
from surfkit.compress.lossless import Float16, Lossless
from surfkit.compress.packed import Packed
from surfkit.compress.vectree import Vectree
from surfkit.primitives.gaussian3d import Gaussian3D
from surfkit.primitives.surfel2d import Surfel2D
from surfkit.testing.compressor_checks import splat_model


def read_file(data):
    """Index and columns of a file of surfels or ellipsoids."""
    assert data[:8] == bytes([0x89, 0x53, 0x52, 0x46, 0x4B, 0x0D, 0x0A, 0x1A])
    version, head_crc, start, length, size, crc, _ = struct.unpack("<IIQQQII", data[8:48])
    assert version == 1 and head_crc == zlib.crc32(data[16:44]) and size == len(data) == start + length
    assert crc == zlib.crc32(data[start:])
    index = json.loads(zstandard.ZstdDecompressor().decompress(data[start:]))
    tables = {name: read_table(data, entry) for name, entry in index["tables"].items()}
    parts = [read_leaf(data, index, tables, leaf) for leaf in index["leaves"]]
    return index, {name: np.concatenate([part[name] for part in parts]) for name in index["columns"]}


def read_block(data, block):
    part = data[block["offset"] : block["offset"] + block["length"]]
    assert zlib.crc32(part) == block["crc"]
    at, heads, streams = 1, [], {}
    for _ in range(part[0]):
        letters = part[at]
        name = part[at + 1 : at + 1 + letters].decode("utf-8")
        size, components, rows = struct.unpack_from("<BII", part, at + 1 + letters)
        at += 10 + letters
        heads.append((name, size, components, rows, struct.unpack_from(f"<{components * size}I", part, at)))
        at += 4 * components * size
    for name, size, components, rows, lengths in heads:
        numbers = np.zeros((rows, components), np.uint64)
        for plane, stored in enumerate(lengths):
            length = stored & 0x7FFFFFFF
            raw, at = part[at : at + length], at + length
            if not stored:
                continue
            plain = np.frombuffer(raw if stored >> 31 else zstandard.ZstdDecompressor().decompress(raw), np.uint8)
            numbers[:, plane // size] += plain.astype(np.uint64) << np.uint64(8 * (plane % size))
        streams[name] = (size, numbers)
    assert at == len(part)
    return streams


def read_table(data, entry):
    size, numbers = read_block(data, entry["block"])["table"]
    return np.frombuffer(numbers.astype(f"<u{size}").tobytes(), entry["dtype"]).reshape(entry["shape"])


def whole_numbers(streams, name):
    def signed(codes):
        return np.array([[u // 2 if u % 2 == 0 else -(u + 1) // 2 for u in row] for row in codes.tolist()], np.float64)

    middle, numbers = (signed(streams[key][1]) for key in (f"{name}.middle", name))
    return middle + numbers if len(numbers) else np.zeros((0, middle.shape[1]))


def read_leaf(data, index, tables, leaf):
    streams, n, found = read_block(data, leaf["block"]), leaf["points"], {}
    for encoding in index["encodings"]:
        column = encoding.get("column")
        use = encoding["use"]
        if use == "floats":
            size, bits = streams[column]
            assert size == int(encoding["kind"][5:]) // 8
            found[column] = np.frombuffer(bits.astype(f"<u{size}").tobytes(), encoding["kind"]).reshape(bits.shape)
        elif use == "cells":
            found[column] = positions(streams[column][1], encoding["exponent"], leaf)
        elif use == "log-steps":
            found[column] = whole_numbers(streams, column) * encoding["step"]
        elif use == "levels":
            share = (streams[column][1].astype(float) + 0.5) / encoding["levels"]
            found[column] = np.log(share / (1 - share))
        elif use == "smallest-three":
            rest, quats = whole_numbers(streams, column) * encoding["step"], np.zeros((n, 4))
            for row, largest in enumerate(streams[f"{column}.largest"][1][:, 0].tolist()):
                quats[row, [(largest + i) % 4 for i in (1, 2, 3)]] = rest[row]
                quats[row, largest] = max(0, 1 - (rest[row] ** 2).sum()) ** 0.5
            found[column] = quats
        else:
            steps = encoding.get("step")
            sh = colors(streams, tables, steps, n) if use == "principal-components" else coded(streams, tables, n)
            found["sh0"], found["sh_rest"] = sh[:, :3], sh[:, 3:]
    return {
        name: found[name].reshape(n, *entry["shape"]).astype(entry["dtype"]) for name, entry in index["columns"].items()
    }


def positions(differences, wanted, leaf):
    exponent, codes, total = leaf["exponent"], [], 0
    wanted = exponent - 16 if wanted is None else wanted
    side = max(min(max(wanted, exponent - 20), exponent - 2), leaf["finest"])
    for difference in differences[:, 0].tolist():
        total = (total + difference) % 2**64
        codes.append(total)
        assert total < 2 ** (3 * (exponent - side))
    cell = [[sum(((code >> (3 * i + axis)) & 1) << i for i in range(20)) for axis in range(3)] for code in codes]
    return np.array(leaf["corner"]) * 2.0 ** (exponent - 1) + (np.array(cell) + 0.5) * 2.0**side


def colors(streams, tables, step, n):
    basis, mean = tables["sh.basis"].astype(float), tables["sh.mean"].astype(float)
    return (basis @ (whole_numbers(streams, "sh") * step).T).T + mean


def coded(streams, tables, n):
    bits = "".join(f"{byte:08b}" for byte in streams["sh.chosen"][1][:, 0].tolist())[:n]
    plain, size = streams["sh"][1], [table.shape[1] for table in tables.values()]
    plain = iter(np.frombuffer(plain.astype("<u2").tobytes(), "float16").reshape(plain.shape).astype(float))
    codes = iter(zip(*[streams[f"sh.code.{at}"][1][:, 0].tolist() for at in range(len(size))], strict=True))
    rows = []
    for bit in bits:
        books = [tables[f"sh.codes.{at}"] for at in range(len(size))]
        row = np.concatenate([b[c] for b, c in zip(books, next(codes), strict=True)]) if bit == "1" else next(plain)
        rows.append(row)
    return np.array(rows, float)


@pytest.mark.parametrize(
    "compressor",
    [Lossless(), Float16(), Packed(), Vectree(codes=20, codebooks="by-degree")],
    ids=["lossless", "float16", "packed", "vectree"],
)
@pytest.mark.parametrize("primitive", [Surfel2D(sh_degree=2), Gaussian3D(sh_degree=0)], ids=["surfels", "ellipsoids"])
def test_the_documentation_is_enough(tmp_path, compressor, primitive):
    path, model = tmp_path / "m.surfkit", splat_model(primitive, 150)
    plan = compressor.plan(model, torch.linspace(0, 1, 150), 0)
    container.write_model(path, model, plan, compressor, most=40)
    index, columns = read_file(path.read_bytes())
    assert (
        index["points"] == 150 and len(index["leaves"]) > 3 and index["primitive"]["use"] in ("surfel2d", "gaussian3d")
    )
    back = container.ModelFile(path).read()[0]
    assert set(columns) == set(back.params)
    for name, value in back.params.items():
        assert np.allclose(columns[name], value.numpy(), rtol=1e-5, atol=2e-6), name
