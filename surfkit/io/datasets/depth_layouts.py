"""The layouts of depth maps of CityGaussianV2 and surfkit, hierarchical 3DGS, Nerfstudio and MatrixCity."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any, ClassVar

from surfkit.core.check import BadInput
from surfkit.core.codec import load, read_json
from surfkit.io.datasets.depth_files import DEPTH_FOLDER, EXR, DepthFile, map_path, read_record
from surfkit.io.datasets.depth_layout import DepthLayout, DepthQuery
from surfkit.scene.photo_names import name_below, named_file, safe_path

MILLIMETRE = 1e-3
"""Nerfstudio's `depth_unit_scale_factor`, where a data set does not say another."""
NERFSTUDIO_UNIT, NGP_UNIT = "depth_unit_scale_factor", "integer_depth_scale"
"""What stored depths are multiplied by, in the units of the poses."""
TRANSFORMS = ("transforms.json", *(f"transforms_{part}.json" for part in ("train", "val", "test")))
CENTIMETRE = 0.01
PHOTO_FOLDERS = ("rgb", "images", "input")
"""Folders of photographs inside a block of MatrixCity, which has none or one of them."""


@dataclass(frozen=True)
class EstimatedDepths(DepthLayout):
    """CityGaussianV2 and `surfkit prepare depth`: inverse depth in estimated_depths/a.jpg.npy for the photograph a.jpg.

    Relative, unless surfkit's estimated_depths/depth.json says that it is in units of the data set.
    """

    priority: ClassVar[int] = 1

    def find(self, query: DepthQuery) -> Mapping[str, DepthFile] | None:
        """See `DepthLayout.find`."""
        if not (query.root / DEPTH_FOLDER).is_dir():
            return None
        record = read_record(query.root)
        aligned, own = record.get("aligned") is True, "estimator" in record
        return {name: DepthFile(map_path(query.root, name), aligned, straight=own) for name in query.names}


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
    """Nerfstudio: `depth_file_path` of the frames in transforms.json, depth times depth_unit_scale_factor.

    Also `depth_path` of instant-ngp, depth times integer_depth_scale, unless enable_depth_loading is false; and both in
    transforms_train.json and its like.
    """

    priority: ClassVar[int] = -2

    def find(self, query: DepthQuery) -> Mapping[str, DepthFile] | None:
        """See `DepthLayout.find`."""
        depths: dict[str, DepthFile] = {}
        for path in (query.root / name for name in TRANSFORMS):
            if path.exists():
                depths |= _of_frames(path)
        own = {name: depths.get(_posix(name), depths.get(_bare(_posix(name)))) for name in query.names}
        return {name: file for name, file in own.items() if file is not None} if depths else None


def _of_frames(path: Path) -> dict[str, DepthFile]:
    """The depth maps that a file of transforms names, by the photographs' names, with and without their folder."""
    contents = read_json(path, Any)
    if not isinstance(contents, dict) or not isinstance(contents.get("frames"), list):
        return {}
    root, by_photo, below = path.parent, {}, {}
    unit = _number(path, NERFSTUDIO_UNIT, contents.get(NERFSTUDIO_UNIT, MILLIMETRE))
    ngp_unit = _number(path, NGP_UNIT, contents.get(NGP_UNIT, unit))
    ngp = contents.get("enable_depth_loading") is not False
    for frame in contents["frames"]:
        if not isinstance(frame, dict) or not frame.get("file_path"):
            continue
        named, scale = frame.get("depth_file_path"), unit
        if not named and ngp:
            named, scale = frame.get("depth_path"), ngp_unit
        if named:
            photo = name_below(root, named_file(root, str(frame["file_path"])))
            file = DepthFile(named_file(root, str(named)), True, scale, metric=True)
            by_photo[photo] = file
            below["/".join(photo.split("/")[1:])] = file
    return below | by_photo


def _bare(name: str) -> str:
    """A name without its ending, which frames may leave out."""
    return str(PurePosixPath(name).with_suffix("")) if name else name


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
    if block.name in PHOTO_FOLDERS or block.name == block.parent.name:
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
