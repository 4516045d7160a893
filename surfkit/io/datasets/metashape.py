"""Agisoft Metashape: the XML file of "Export Cameras", with sensors, cameras, and where the chunk lies.

A camera's transform brings its frame (x right, y down, z forward) to that of the chunk; the transform of the chunk, or
of a component of it, brings that to the Earth's centre, on the datum of the chunk's reference, or to local coordinates.
Lenses are those of the Metashape manual, appendix "Camera models".
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from surfkit.core.check import BadInput, leaving_out
from surfkit.core.events import Warned, emit
from surfkit.io.datasets.base import Reader
from surfkit.io.datasets.brown import Brown, LensTable
from surfkit.io.datasets.camera_files import leave_out, numbers, one_file, photographs, pose_at, read_text
from surfkit.io.datasets.data import Data
from surfkit.io.datasets.geocentric import place_of
from surfkit.io.datasets.panoramas import panorama
from surfkit.io.datasets.raw_dataset import RawDataset, RawImage
from surfkit.io.datasets.topocentric import Similarity
from surfkit.io.datasets.transforms import points

SNIFFED_BYTES = 4096
"""Bytes of a file that are looked at to recognise it."""
FISHEYE_SENSORS = {"frame": False, "fisheye": True, "equidistant_fisheye": True}
"""Kinds of sensors, and whether they are fisheyes."""
SPHERICAL = "spherical"
"""Kind of a sensor whose photographs are panoramas; it has no calibration."""
CALIBRATION_FIELDS = ("f", "cx", "cy", "b1", "b2", "k1", "k2", "k3", "k4", "p1", "p2", "p3", "p4")
FALSE_WORDS = ("false", "0")


@dataclass(frozen=True)
class Metashape(Reader):
    """Metashape: cameras exported as Agisoft XML, and images/; on the map where the chunk has a reference."""

    def recognises(self, root: Path) -> bool:
        return bool(_files(root))

    def read(self, data: Data) -> RawDataset:
        path = one_file(data.path, _files(data.path), "XML file of Metashape's cameras; export them as Agisoft XML")
        chunk = _chunk(path)
        cameras = _cameras(path, chunk)
        names = _names(chunk, cameras)
        found = photographs(data, names)
        sensors = {sensor.get("id"): sensor for sensor in chunk.findall("sensors/sensor")}
        lenses, known = LensTable(path), {}
        for number in dict.fromkeys(camera.get("sensor_id") for camera in cameras):
            with leaving_out():
                where = f"{path}: sensor {number}"
                sensor = sensors.get(number)
                if sensor is not None and sensor.get("type") == SPHERICAL:
                    known[number] = panorama(where, _size(where, sensor))
                else:
                    known[number] = lenses.camera(where, _lens(where, sensor))
        lenses.tell()
        shots = []
        for camera, name in zip(cameras, names, strict=True):
            number = camera.get("sensor_id")
            if name in found and number in known:
                with leaving_out():
                    pose = _pose(f"{path}: camera {name!r}", camera)
                    shots.append(RawImage(name, pose, known[number], found[name]))
        return _placed(path, chunk, cameras[0].get("component_id"), RawDataset(shots, *points(data.path, {})))


def _files(root: Path) -> list[Path]:
    """The XML files of a folder that begin as those of cameras do."""
    return sorted(path for path in root.glob("*.xml") if path.is_file() and _is_cameras(path))


def _is_cameras(path: Path) -> bool:
    try:
        with path.open("rb") as file:
            head = file.read(SNIFFED_BYTES)
    except OSError:
        return False
    return b"<document" in head and b"<chunk" in head


def _chunk(path: Path) -> ElementTree.Element:
    """The chunk of most cameras with a pose, or BadInput."""
    text = read_text(path)
    if "<!DOCTYPE" in text[:SNIFFED_BYTES] or "<!ENTITY" in text:
        raise BadInput(
            f"{path}: has definitions of its own, which cameras exported by Metashape have not; export again"
        )
    try:
        root = ElementTree.fromstring(text)
    except (ElementTree.ParseError, ValueError) as error:
        raise BadInput(f"{path}: not XML: {error}; export the cameras again") from error
    chunks = [chunk for chunk in root.iter("chunk") if chunk.find("cameras") is not None]
    if not chunks:
        raise BadInput(f"{path}: no chunk with cameras in it; export the cameras as Agisoft XML again")
    best = max(chunks, key=lambda chunk: len(chunk.findall("cameras//camera/transform")))
    if len(chunks) > 1:
        emit(Warned(f"{path} has {len(chunks)} chunks; {best.get('label', 'the one of most cameras')!r} is used"))
    return best


def _cameras(path: Path, chunk: ElementTree.Element) -> list[ElementTree.Element]:
    """Those of the largest component that are enabled and have a pose."""

    def keep(
        cameras: list[ElementTree.Element], good: Callable[[ElementTree.Element], bool], why: str
    ) -> list[ElementTree.Element]:
        leave_out(path, [camera.get("label", "") for camera in cameras if not good(camera)], len(cameras), why)
        return [camera for camera in cameras if good(camera)]

    listed = chunk.findall("cameras//camera")
    enabled = keep(listed, lambda camera: camera.get("enabled", "true").lower() not in FALSE_WORDS, "are disabled")
    why = "have no pose of their own (not aligned, or slaves of another camera)"
    posed = keep(enabled, lambda camera: camera.find("transform") is not None, why)
    if not posed:
        raise BadInput(f"{path}: no camera in it; align the photographs, and export the cameras again")
    largest = Counter(camera.get("component_id") for camera in posed).most_common(1)[0][0]
    why = "are in another component, not aligned with the largest"
    return keep(posed, lambda camera: camera.get("component_id") == largest, why)


def _names(chunk: ElementTree.Element, cameras: list[ElementTree.Element]) -> list[str]:
    """Names of the photographs of cameras: their labels; where several share one, with the label of their group before
    it, which is that of the folder that they were added from."""
    groups = {
        camera: group.get("label", "")
        for group in chunk.findall("cameras//group")
        for camera in group.findall("camera")
    }
    labels = [camera.get("label", "") for camera in cameras]
    count = Counter(labels)
    return [
        f"{groups[camera]}/{label}" if count[label] > 1 and groups.get(camera) else label
        for camera, label in zip(cameras, labels, strict=True)
    ]


def _pose(where: str, camera: ElementTree.Element) -> np.ndarray:
    """(4, 4) world_to_camera in the frame of the chunk."""
    matrix = numbers(where, camera.findtext("transform") or "", 16).reshape(4, 4)
    if any(matrix[3] != (0, 0, 0, 1)):
        raise BadInput(f"{where}: the last row of its transform is not 0 0 0 1; export the cameras again")
    return pose_at(where, matrix[:3, :3].T, matrix[:3, 3])


def _lens(where: str, sensor: ElementTree.Element | None) -> Brown:
    """The lens of a sensor: as adjusted, or as it was given."""
    if sensor is None or not (given := sensor.findall("calibration")):
        raise BadInput(f"{where}: no calibration of it; align the photographs, and export the cameras again")
    best = next((one for one in given if one.get("class") == "adjusted"), given[0])
    kind = best.get("type") or sensor.get("type", "")
    if kind not in FISHEYE_SENSORS:
        raise BadInput(f"{where}: of type {kind}; known: {', '.join((*FISHEYE_SENSORS, SPHERICAL))}")
    width, height = _size(where, best if best.find("resolution") is not None else sensor)
    if best.find("f") is None:
        raise BadInput(f"{where}: no f in its calibration; open the project in Metashape, and export the cameras again")
    value = {name: float(numbers(f"{where}: {name}", best.findtext(name) or "0", 1)[0]) for name in CALIBRATION_FIELDS}
    return Brown(
        size=(width, height),
        focal=(value["f"] + value["b1"], value["f"]),
        centre=(width / 2 + value["cx"], height / 2 + value["cy"]),
        radial=(value["k1"], value["k2"], value["k3"], value["k4"]),
        tangential=(value["p2"], value["p1"]),  # Metashape's p1 goes with r^2 + 2 x^2, OpenCV's with 2 x y
        higher=(value["p3"], value["p4"]),
        shear=value["b2"],
        fisheye=FISHEYE_SENSORS[kind],
    )


def _size(where: str, element: ElementTree.Element) -> tuple[int, int]:
    """Width and height of the photographs of a sensor, from it or from a calibration of it."""
    resolution = element.find("resolution")
    words = [resolution.get(side, "") if resolution is not None else "" for side in ("width", "height")]
    width, height = numbers(f"{where}: resolution", words, 2)
    return int(width), int(height)


def _placed(path: Path, chunk: ElementTree.Element, part: str | None, capture: RawDataset) -> RawDataset:
    """The capture where the chunk, or the component of its cameras, lies; as it is in the chunk if nowhere."""
    element = chunk.find("transform")
    for component in chunk.findall("components/component"):
        if component.get("id") == part and component.find("transform") is not None:
            element = component.find("transform")
    if element is None or not capture.shots:
        return capture
    move = _similarity(f"{path}: transform of the chunk", element)
    poses = [move.pose(shot.pose) for shot in capture.shots]
    centres = np.stack([-pose[:3, :3].T @ pose[:3, 3] for pose in poses])
    text = " ".join((chunk.findtext("reference") or "").split())
    place = place_of(f"{path}: reference", text, centres) if text else None
    if place is None:
        return _with_poses(capture, poses)
    moved = _with_poses(capture, [place.move.pose(pose) for pose in poses])
    return replace(moved, metres=place.metres, crs=place.crs)


def _with_poses(capture: RawDataset, poses: list[np.ndarray]) -> RawDataset:
    return replace(capture, shots=[replace(shot, pose=pose) for shot, pose in zip(capture.shots, poses, strict=True)])


def _similarity(where: str, element: ElementTree.Element) -> Similarity:
    """Of a transform with rotation, translation and scale, each of which may be missing."""
    turn = numbers(where, element.findtext("rotation") or "1 0 0 0 1 0 0 0 1", 9).reshape(3, 3)
    move = numbers(where, element.findtext("translation") or "0 0 0", 3)
    scale = float(numbers(where, element.findtext("scale") or "1", 1)[0])
    if not scale > 0:
        raise BadInput(f"{where}: its scale is {scale:g}; export the cameras again")
    return Similarity(pose_at(where, turn, np.zeros(3))[:3, :3], scale, move)
