"""What is wrong where: points coloured by their distance, as PLY and as pictures."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from surfkit.core.files import replacing
from surfkit.evaluate.geometry.point_visibility import nearest_rows, project, sides
from surfkit.io.splats.ply import write_points
from surfkit.scene.camera import Camera
from surfkit.scene.crop import PLANES, Axis, Crop

RAMP_STOPS = np.array([0.0, 1.0, 1.0001, 2.5, 5.0])
"""Distances, multiples of tau, at which the colours stand."""
ERROR_RAMP = np.array([[205, 222, 236], [52, 108, 186], [250, 190, 80], [214, 70, 40], [92, 6, 32]], float)
"""Pale to blue is right, orange to dark red is wrong: told apart by people who do not tell red from green, too."""
PICTURE_LONGEST_PX = 720
"""Of each part of a picture."""
PAPER_COLOR, INK_COLOR = (255, 255, 255), (40, 40, 40)
CAPTION_PX = 24
SHADE_PER_UNIT, MAX_SHADED_UNITS = 0.04, 3.0
"""How dark a neighbour that lies one unit nearer makes a pixel, and the most units that count."""


def error_colors(distances: np.ndarray, tau: float) -> np.ndarray:
    """(n, 3) uint8 of (n,) distances."""
    share = (distances / tau).clip(max=RAMP_STOPS[-1])
    return np.stack([np.interp(share, RAMP_STOPS, ERROR_RAMP[:, i]) for i in range(3)], axis=1).round().astype(np.uint8)


def write_cloud(path: Path, points: np.ndarray, distances: np.ndarray, tau: float) -> None:
    """Save (n, 3) points coloured by their (n,) distances; positions in float64, as maps need them."""
    write_points(path, np.asarray(points, np.float64), error_colors(distances, tau))


def draw_from_view(
    camera: Camera, pose: np.ndarray, points: np.ndarray, colors: np.ndarray, spacing: float
) -> np.ndarray:
    """(H, W, 3) uint8: points as a camera sees them, each a square as wide as they lie apart; white between them.

    Args:
        camera: Lens and size.
        pose: (4, 4) world_to_camera in the frame of the points.
        points: (n, 3).
        colors: (n, 3) uint8.
        spacing: Between neighbouring points.
    """
    at, x, y, z = project(points, camera, pose)
    focal = max(camera.fx, camera.fy)
    depth, rows = nearest_rows(x, y, z, sides(spacing * focal / z), (camera.height, camera.width))
    return shaded(np.concatenate([colors[at], [PAPER_COLOR]])[rows], depth, np.maximum(depth / focal, spacing))


def from_above(
    points: np.ndarray, colors: np.ndarray, box: tuple[np.ndarray, np.ndarray], up: Axis, spacing: float
) -> np.ndarray:
    """(H, W, 3) uint8: points seen along the axis that stands on the ground, white where there are none.

    Args:
        points: (n, 3).
        colors: (n, 3) uint8.
        box: (2,) least and (2,) greatest coordinates of the picture.
        up: The axis.
        spacing: Between neighbouring points.
    """
    low, high = box
    pixel = float((high - low).max()) / PICTURE_LONGEST_PX
    width, height = (np.ceil((high - low) / pixel).astype(int) + 1).clip(max=PICTURE_LONGEST_PX + 1)
    spots = (points[:, list(PLANES[up])] - low) / pixel
    inside = ((spots >= 0) & (spots < (width, height))).all(1)
    x, y = spots[inside].astype(np.int64).T
    side = sides(np.full(len(x), spacing / pixel))
    depth, rows = nearest_rows(x, y, -points[inside, "xyz".index(up)], side, (int(height), int(width)))
    picture = np.concatenate([colors[inside], [PAPER_COLOR]])[rows]
    return shaded(picture, depth, np.full(depth.shape, max(pixel, spacing)))[::-1]


def shaded(picture: np.ndarray, depth: np.ndarray, unit: np.ndarray) -> np.ndarray:
    """(H, W, 3) uint8: a picture of points, darker where neighbours lie nearer: shapes are seen without normals.

    Args:
        picture: (H, W, 3) colours.
        depth: (H, W), inf where nothing is.
        unit: (H, W) difference of depth that counts as one.
    """
    behind = np.zeros(depth.shape)
    there = np.isfinite(depth)
    for reach in (1, 3):
        for shift, axis in ((reach, 0), (-reach, 0), (reach, 1), (-reach, 1)):
            beside = np.roll(depth, shift, axis)
            known = there & np.isfinite(beside)
            step = np.where(known, depth, 0) - np.where(known, beside, 0)
            behind += np.where(known, step / np.where(there, unit, 1), 0).clip(0, MAX_SHADED_UNITS)
    return np.where(there[..., None], picture * np.exp(-SHADE_PER_UNIT * behind)[..., None], picture).astype(np.uint8)


def write_plan(
    path: Path, parts: list[tuple[str, np.ndarray, np.ndarray]], crop: Crop | None, up: Axis, spacing: float
) -> None:
    """Save a plan: clouds from above side by side, with the outline of the crop volume.

    Args:
        path: PNG.
        parts: Of each cloud its caption, (n, 3) points and (n, 3) colours.
        crop: Volume, or None.
        up: Axis that stands on the ground.
        spacing: Between neighbouring points.
    """
    corners = [points[:, list(PLANES[up])] for _, points, _ in parts]
    if crop is not None and crop.axis == up:
        corners.append(crop.polygon)
    low, high = np.min([c.min(0) for c in corners], 0), np.max([c.max(0) for c in corners], 0)
    room = 0.02 * (high - low).max() + 1e-12
    low, high = low - room, high + room
    images = []
    for _, points, colors in parts:
        image = Image.fromarray(from_above(points, colors, (low, high), up, spacing))
        if crop is not None and crop.axis == up:
            pixel = float((high - low).max()) / PICTURE_LONGEST_PX
            ring = [(x, image.height - 1 - y) for x, y in ((crop.polygon - low) / pixel).tolist()]
            ImageDraw.Draw(image).line([*ring, ring[0]], fill=INK_COLOR, width=2)
        images.append(np.asarray(image))
    write_row(path, [caption for caption, _, _ in parts], images)


def write_row(path: Path, captions: list[str], images: list[np.ndarray]) -> None:
    """Save (H, W, 3) uint8 images side by side as PNG, each under its caption."""
    height = max(image.shape[0] for image in images)
    width = sum(image.shape[1] for image in images) + CAPTION_PX // 2 * (len(images) - 1)
    sheet = Image.new("RGB", (width, height + CAPTION_PX), PAPER_COLOR)
    pen, left = ImageDraw.Draw(sheet), 0
    for caption, image in zip(captions, images, strict=True):
        pen.text((left + 4, 4), caption, INK_COLOR, ImageFont.load_default(14))
        sheet.paste(Image.fromarray(image), (left, CAPTION_PX))
        left += image.shape[1] + CAPTION_PX // 2
    with replacing(path) as file:
        sheet.save(file, "PNG")
