"""Write a model in every format: `python bench/readers/export.py MODEL.ply FOLDER`."""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

from surfkit.core.registry import components
from surfkit.io.splats.base import Format
from surfkit.io.splats.splat_files import read_splat_file


def variants() -> dict[str, Format]:
    """File name and settings of all that is written; formats that are not registered are left out."""
    found = components(Format)
    plain = {"model.compressed.ply": "compressed-ply", "model.splat": "splat", "model.sog": "sog", "model.ply": "ply"}
    made = {name: found[form]() for name, form in plain.items() if form in found}
    if "spz" in found:
        made |= {f"model.v{version}.spz": found["spz"](version=version) for version in (2, 3, 4)}
        made["model.v4.same.spz"] = found["spz"](version=4, axes="same")
    if "gltf" in found:
        made |= {"model.glb": found["gltf"](), "model.spz.glb": found["gltf"](compress="spz")}
        made["model.z.glb"] = replace(found["gltf"](), up="z")
    if "tiles3d" in found:
        made["model.tiles"] = found["tiles3d"](georeference=False, most_splats=8_000)
    if "streamed-sog" in found:
        made["model.stream"] = found["streamed-sog"](chunk_splats=8_000, leaf_splats=2_000)
    return made


def write_all(model: Path, folder: Path) -> None:
    """Write a model in all formats into a folder."""
    folder.mkdir(parents=True, exist_ok=True)
    table = read_splat_file(model)
    for name, form in variants().items():
        path = folder / name
        form.write(path, table)
        size = sum(file.stat().st_size for file in path.rglob("*")) if path.is_dir() else path.stat().st_size
        print(f"{name:24}{size:>12,} bytes")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("model", type=Path)
    parser.add_argument("folder", type=Path)
    options = parser.parse_args()
    write_all(options.model, options.folder)


if __name__ == "__main__":
    main()
