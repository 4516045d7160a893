"""The layouts of depth maps of CityGaussianV2 and surfkit, hierarchical 3DGS, Nerfstudio and MatrixCity."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any, ClassVar

from surfkit.core.check import BadInput
from surfkit.core.codec import load, read_json
from surfkit.readers.depth_files import EXR, FOLDER, DepthFile, map_path, read_record
from surfkit.readers.depth_layout import DepthLayout, DepthQuery
from surfkit.scene.names import safe_path

MILLIMETRE = 1e-3
"""Nerfstudio's `depth_unit_scale_factor`, where a data set does not say another."""
CENTIMETRE = 0.01
PHOTOS = ("rgb", "images", "input")
"""Folders of photographs inside a block of MatrixCity, which has none or one of them."""


@dataclass(frozen=True)
class EstimatedDepths(DepthLayout):
    """CityGaussianV2 and `surfkit prepare depth`: inverse depth in estimated_depths/a.jpg.npy for the photograph a.jpg.

    Relative, unless surfkit's estimated_depths/depth.json says that it is in units of the data set.
    """

    priority: ClassVar[int] = 1

    def find(self, query: DepthQuery) -> Mapping[str, DepthFile] | None:
        """See `DepthLayout.find`."""
        if not (query.root / FOLDER).is_dir():
            return None
        aligned = read_record(query.root).get("aligned") is True
        return {name: DepthFile(map_path(query.root, name), aligned) for name in query.names}


@dataclass(frozen=True)
class HierarchicalDepths(DepthLayout):
    """Hierarchical 3DGS: depths/STEM.png of 16 bits; value / 65536 * scale + offset from depth_params.json."""

    priority: ClassVar[int] = -1

    def find(self, query: DepthQuery) -> Mapping[str, DepthFile] | None:
        """See `DepthLayout.find`."""
        places = (query.model / "depth_params.json", query.root / "depth_params.json")
        path = next((path for path in places if path.exists()), None)
        if path is None or not (query.root / "depths").is_dir():
            return None
        params, found = read_json(path, dict[str, Any]), {}
        for name in query.names:
            stem = str(safe_path(name).with_suffix(""))
            entry = params.get(stem)
            if isinstance(entry, dict) and {"scale", "offset"} <= entry.keys():
                scale, offset = (_number(path, f"{stem}.{part}", entry[part]) for part in ("scale", "offset"))
                if scale > 0:
                    found[name] = DepthFile(query.root / "depths" / f"{stem}.png", True, scale / 65536, offset)
        return found


@dataclass(frozen=True)
class NerfstudioDepths(DepthLayout):
    """Nerfstudio: `depth_file_path` of the frames in transforms.json, depth times depth_unit_scale_factor."""

    priority: ClassVar[int] = -2

    def find(self, query: DepthQuery) -> Mapping[str, DepthFile] | None:
        """See `DepthLayout.find`."""
        path = query.root / "transforms.json"
        if not path.exists():
            return None
        contents = read_json(path, Any)
        listed = contents.get("frames") if isinstance(contents, dict) else None
        frames = [frame for frame in listed if isinstance(frame, dict)] if isinstance(listed, list) else []
        depths = {
            str(f["file_path"]): str(f["depth_file_path"])
            for f in frames
            if f.keys() >= {"file_path", "depth_file_path"}
        }
        if not depths:
            return None
        unit = _number(path, "depth_unit_scale_factor", contents.get("depth_unit_scale_factor", MILLIMETRE))
        by_name = {PurePosixPath(photo.removeprefix("./")): depth for photo, depth in depths.items()}
        by_name |= {PurePosixPath(*photo.parts[1:]): depth for photo, depth in list(by_name.items())}
        own = {name: by_name.get(PurePosixPath(_posix(name))) for name in query.names}
        return {
            name: DepthFile(query.root / depth, True, unit, metric=True)
            for name, depth in own.items()
            if depth is not None
        }


@dataclass(frozen=True)
class MatrixCityDepths(DepthLayout):
    """MatrixCity: centimetres in BLOCK/depth/0000.exr or BLOCK_depth/0000.exr, below the data set or CITY_depth/.

    Used where it is known how many metres a unit of the data set is.
    """

    priority: ClassVar[int] = -3

    def find(self, query: DepthQuery) -> Mapping[str, DepthFile] | None:
        """See `DepthLayout.find`."""
        if not query.metres:
            return None
        found = {}
        for name in query.names:
            if path := next((place for place in _city_places(query.root, safe_path(name)) if place.is_file()), None):
                found[name] = DepthFile(path, True, CENTIMETRE / query.metres, metric=True)
        return found or None


def _posix(name: str) -> str:
    return name.replace("\\", "/")


def _number(path: Path, at: str, value: Any) -> float:
    try:
        return load(float, value, at)
    except BadInput as error:
        raise BadInput(f"{path}: {error}") from error


def _city_places(root: Path, photo: PurePosixPath) -> Iterator[Path]:
    """Where MatrixCity may have the depth of a photograph."""
    block = photo.parent
    if block.name in PHOTOS or block.name == block.parent.name:
        block = block.parent
    stem = f"{photo.stem}{EXR}"
    depth = f"{block.name}_depth"
    below = (block / "depth" / stem, block.parent / depth / stem, block.parent / depth / depth / stem)
    for tree in _city_trees(root.resolve()):
        yield from (tree / place for place in below)


def _city_trees(root: Path) -> list[Path]:
    """Where blocks with depth may lie for CITY/aerial or CITY/aerial/pose/BLOCK; whole floats first."""
    base = root.parents[1] if root.parent.name == "pose" else root
    city = base.parent
    return [
        base,
        *(city.with_name(f"{city.name}{end}") / base.name for end in ("_depth_float32", "_depth") if city.name),
    ]
