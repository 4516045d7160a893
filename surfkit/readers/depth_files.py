"""Depth maps beside photographs, in the conventions of other programs: where they lie, and what their numbers mean."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from surfkit.core.check import BadInput
from surfkit.core.codec import load, read_json, write_json
from surfkit.core.files import replacing
from surfkit.core.optional import needed
from surfkit.scene.arrays import mapped
from surfkit.scene.photos import opened

EXR = ".exr"
NO_DEPTH = 65504.0
"""The largest half float: the sky in MatrixCity's depth maps."""
CENTIMETRE = 0.01
PHOTOS = ("rgb", "images", "input")
"""Folders of photographs inside a block of MatrixCity, which has none or one of them."""
FOLDER = "estimated_depths"
RECORD = "depth.json"
UNIT = 127
"""What a component of 1 of a normal is stored as."""
warnings.filterwarnings("ignore", r"Reading `\.npy`", UserWarning)  # of Python 2, whose arrays are as good
MILLIMETRE = 1e-3
"""Nerfstudio's `depth_unit_scale_factor`, where a data set does not say another."""


@dataclass(frozen=True)
class DepthFile:
    """A depth map on disk.

    Attributes:
        path: Of the map.
        aligned: Whether the values are inverse depths in input units as they are.
        scale: Multiplies the stored value; `metric` ones before they are inverted.
        offset: Is added then.
        metric: Whether the stored values are depths, not inverse depths.
    """

    path: Path
    aligned: bool
    scale: float = 1.0
    offset: float = 0.0
    metric: bool = False

    def read(self) -> np.ndarray:
        """(h, w) float32 inverse depth, up to an affine map unless `aligned`; NaN where there is none.

        Raises:
            BadInput: The file is not a map; says why in a few words.
        """
        stored = _stored(self.path)
        if stored.ndim == 3 and 1 in (stored.shape[0], stored.shape[-1]):
            stored = stored.reshape([size for size in stored.shape if size != 1] or [1, 1])
        if stored.ndim != 2:
            raise BadInput(f"has shape {stored.shape}, not (height, width)")
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            values = stored.astype(np.float32)
            if self.metric:
                return np.where(values > 0, 1 / (values * np.float32(self.scale)), np.nan)
            inverse = np.where(np.isfinite(values) & (values != 0), values * self.scale + self.offset, np.nan)
        return inverse.astype(np.float32)

    def read_confidence(self) -> np.ndarray | None:
        """(h, w) float32 in [0, 1] from the file `<image>.confidence.npy` beside the map; None where there is none."""
        path = confidence_path(self.path)
        if not path.exists():
            return None
        stored = _stored(path)
        if stored.ndim != 2:
            raise BadInput(f"confidence has shape {stored.shape}, not (height, width)")
        values = stored.astype(np.float32) / (255 if stored.dtype == np.uint8 else 1)
        return np.nan_to_num(values).clip(0, 1)

    def read_normal(self) -> np.ndarray | None:
        """(3, h, w) int8 from the file `<image>.normal.npy` beside the map; None where there is none.

        They are normals of the surface times 127, in the camera's axes and towards the camera; 0 where there is none.
        """
        path = normal_path(self.path)
        if not path.exists():
            return None
        stored = _stored(path)
        if stored.ndim != 3 or len(stored) != 3 or stored.dtype != np.int8:
            raise BadInput(f"normals are {stored.dtype} of shape {stored.shape}, not int8 of (3, height, width)")
        return stored


def find_maps(root: Path, model: Path, names: Sequence[str], metres: float | None = None) -> dict[str, DepthFile]:
    """The depth map of each photograph that has one; the first convention of which the data set has any files.

    Args:
        root: The data set.
        model: Its sparse model, beside which hierarchical 3DGS keeps depth_params.json.
        names: Of the photographs, as in the sparse model.
        metres: Metres per unit of the data set; without it, maps in centimetres are of no use.

    Raises:
        BadInput: A file that describes the maps is damaged.
    """
    for convention in (_estimated, _hierarchical, _nerfstudio):
        found = convention(root, model)
        if found is not None:
            maps = {name: found(name.replace("\\", "/")) for name in names}
            return {name: depth for name, depth in maps.items() if depth is not None and depth.path.is_file()}
    return matrixcity_maps(root, names, metres) if metres else {}


def map_path(root: Path, name: str) -> Path:
    """Where surfkit and CityGaussianV2 keep the inverse depth of a photograph."""
    path = root / FOLDER / name.replace("\\", "/")
    return path.with_name(f"{path.name}.npy")


def confidence_path(path: Path) -> Path:
    """The confidence that belongs to a map."""
    return path.with_name(f"{path.name.removesuffix('.npy')}.confidence.npy")


def normal_path(path: Path) -> Path:
    """The normals that belong to a map."""
    return path.with_name(f"{path.name.removesuffix('.npy')}.normal.npy")


def write_map(
    root: Path, name: str, inverse: np.ndarray, confidence: np.ndarray, normal: np.ndarray | None = None
) -> None:
    """Save a map and what belongs to it; the map comes last and is whole or not there, also when the process dies.

    Args:
        root: The data set.
        name: Of the photograph.
        inverse: (h, w) inverse depth; 0 where there is none.
        confidence: (h, w) in [0, 1].
        normal: (3, h, w) unit normals of the surface in the camera's axes, towards the camera; 0 where there is none.
    """
    path = map_path(root, name)
    save_array(confidence_path(path), (confidence.clip(0, 1) * 255).round().astype(np.uint8))
    if normal is None:
        normal_path(path).unlink(missing_ok=True)
    else:
        save_array(normal_path(path), (normal.clip(-1, 1) * UNIT).round().astype(np.int8))
    save_array(path, inverse.astype(np.float32))


def read_record(root: Path) -> Mapping[str, Any]:
    """What made the maps of a data set, from estimated_depths/depth.json; empty where other programs made them."""
    path = root / FOLDER / RECORD
    if not path.exists():
        return {}
    try:
        return read_json(path, dict[str, Any])
    except BadInput as error:
        raise BadInput(f"{error}; it tells what made the maps: delete it or make them again") from error


def write_record(root: Path, record: Mapping[str, Any]) -> None:
    """Say what made the maps."""
    write_json(root / FOLDER / RECORD, record)


def save_array(path: Path, values: np.ndarray) -> None:
    """Save numbers as .npy; the file is whole or not there."""
    with replacing(path) as file:
        np.save(file, values)


def _stored(path: Path) -> np.ndarray:
    """The numbers in a .npy file or in a picture of one channel."""
    if path.suffix.lower() == EXR:
        return _exr(path)
    if path.suffix.lower() == ".npy":
        return _array(path)
    try:
        return opened(path, np.array)
    except BadInput as error:
        raise BadInput(f"cannot be read: {str(error).removeprefix(f'{path}: ')}") from error


def _array(path: Path) -> np.ndarray:
    """The numbers in a .npy file, mapped from disk."""
    try:
        stored = mapped(path)
    except Exception as error:
        raise BadInput(f"cannot be read: {' '.join(str(error).split())}") from error
    if stored.dtype.kind not in "fiub" or not stored.size:
        raise BadInput(f"cannot be read: it holds {stored.size} times {stored.dtype}, not numbers")
    return stored


def _number(path: Path, at: str, value: Any) -> float:
    try:
        return load(float, value, at)
    except BadInput as error:
        raise BadInput(f"{path}: {error}") from error


def _exr(path: Path) -> np.ndarray:
    """(h, w) float32, the red or only channel of an OpenEXR file; 0 where that is the largest half float."""
    with needed("OpenEXR", "an .exr file"):
        import OpenEXR
    try:
        channels = OpenEXR.File(str(path), separate_channels=True).channels()
    except (RuntimeError, ValueError, OSError) as error:
        raise BadInput(f"cannot be read: {' '.join(str(error).split())}") from error
    first = next((channels[name] for name in ("R", "Y", "Z", "V") if name in channels), None)
    if first is None:
        raise BadInput(f"has channels {', '.join(channels)}, none of R, Y, Z, V")
    values = first.pixels.astype(np.float32)
    none = values >= NO_DEPTH if first.pixels.dtype == np.float16 else values == NO_DEPTH
    return np.where(none, 0, values)


Finder = Callable[[str], DepthFile | None]
"""From the name of a photograph to its map, which need not exist."""


def _estimated(root: Path, model: Path) -> Finder | None:
    """CityGaussianV2: estimated_depths/<image with extension>.npy, relative unless depth.json says otherwise."""
    if not (root / FOLDER).is_dir():
        return None
    aligned = read_record(root).get("aligned") is True
    return lambda name: DepthFile(map_path(root, name), aligned)


def _hierarchical(root: Path, model: Path) -> Finder | None:
    """Hierarchical 3DGS: depths/<stem>.png of 16 bits; value / 65536 x scale + offset from depth_params.json."""
    places = [path for path in (model / "depth_params.json", root / "depth_params.json") if path.exists()]
    if not (root / "depths").is_dir() or not places:
        return None
    params = read_json(places[0], dict[str, Any])

    def find(name: str) -> DepthFile | None:
        stem = str(PurePosixPath(name).with_suffix(""))
        entry = params.get(stem)
        if not isinstance(entry, dict) or not {"scale", "offset"} <= entry.keys():
            return None
        scale, offset = (_number(places[0], f"{stem}.{part}", entry[part]) for part in ("scale", "offset"))
        return DepthFile(root / "depths" / f"{stem}.png", True, scale / 65536, offset) if scale > 0 else None

    return find


def _nerfstudio(root: Path, model: Path) -> Finder | None:
    """Nerfstudio: `depth_file_path` of the frames in transforms.json, depth x depth_unit_scale_factor."""
    path = root / "transforms.json"
    if not path.exists():
        return None
    contents = read_json(path, Any)
    listed = contents.get("frames") if isinstance(contents, dict) else None
    frames = [frame for frame in listed if isinstance(frame, dict)] if isinstance(listed, list) else []
    depths = {
        str(f["file_path"]): str(f["depth_file_path"]) for f in frames if f.keys() >= {"file_path", "depth_file_path"}
    }
    if not depths:
        return None
    unit = _number(path, "depth_unit_scale_factor", contents.get("depth_unit_scale_factor", MILLIMETRE))
    by_name = {PurePosixPath(photo.removeprefix("./")): depth for photo, depth in depths.items()}
    by_name |= {PurePosixPath(*photo.parts[1:]): depth for photo, depth in list(by_name.items())}

    def find(name: str) -> DepthFile | None:
        depth = by_name.get(PurePosixPath(name))
        return None if depth is None else DepthFile(root / depth, True, unit, metric=True)

    return find


def matrixcity_maps(root: Path, names: Sequence[str], metres: float) -> dict[str, DepthFile]:
    """MatrixCity: centimetres in BLOCK/depth/0000.exr or BLOCK_depth/0000.exr, below the data set or CITY_depth/."""
    found = {}
    for name in names:
        block = PurePosixPath(name).parent
        if block.name in PHOTOS or block.name == block.parent.name:
            block = block.parent
        stem = f"{PurePosixPath(name).stem}{EXR}"
        depth = f"{block.name}_depth"
        below = (block / "depth" / stem, block.parent / depth / stem, block.parent / depth / depth / stem)
        places = (tree / place for tree in _trees(root.resolve()) for place in below)
        if path := next((place for place in places if place.is_file()), None):
            found[name] = DepthFile(path, True, CENTIMETRE / metres, metric=True)
    return found


def _trees(root: Path) -> list[Path]:
    """Where blocks with depth may lie for CITY/aerial or CITY/aerial/pose/BLOCK; whole floats first."""
    base = root.parents[1] if root.parent.name == "pose" else root
    city = base.parent
    return [
        base,
        *(city.with_name(f"{city.name}{end}") / base.name for end in ("_depth_float32", "_depth") if city.name),
    ]
