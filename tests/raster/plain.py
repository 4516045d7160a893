"""Splats drawn pixel by pixel in plain Python, written from the papers and not from `surfkit.raster.reference`.

A ray meets a disc as a line meets a plane in space (no homography); an ellipsoid's depth comes from the inverse of its
covariance; distortion is a double loop over pairs; spherical harmonics come from Legendre functions.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np

from surfkit.raster.api import ALONG_RAYS, ALPHA_MAX, ALPHA_MIN, CUTOFF, T_MIN, Splats
from surfkit.raster.projection import EDGE_ON
from surfkit.scene.camera import Camera


@dataclass(frozen=True)
class Seen:
    """One splat in the camera's frame.

    `shape(x, y)` gives rho and depth at a pixel position, `density(p)` what it has at a place of that frame.
    """

    index: int
    opacity: float
    color: np.ndarray
    normal: Callable[[float, float], np.ndarray]
    z: float
    shape: Callable[[float, float], tuple[float, float]]
    density: Callable[[np.ndarray], float]


@dataclass(frozen=True)
class Plain:
    """Maps by name, and (row, column, splat, alpha, transmittance before) of everything blended."""

    maps: dict[str, np.ndarray]
    blended: list[tuple[int, int, int, float, float]]


def harmonics(direction: np.ndarray, degree: int) -> np.ndarray:
    """((degree + 1)^2,) real spherical harmonics with the Condon-Shortley phase."""
    from scipy.special import lpmv

    x, y, z = direction
    azimuth, values = math.atan2(y, x), []
    for n in range(degree + 1):
        for m in range(-n, n + 1):
            k = abs(m)
            size = math.sqrt((2 * n + 1) / (4 * math.pi) * math.factorial(n - k) / math.factorial(n + k))
            turn = math.sin(k * azimuth) if m < 0 else math.cos(k * azimuth)
            values.append(size * (math.sqrt(2) if m else 1) * turn * float(lpmv(k, n, z)))
    return np.array(values)


def rotation(quat: np.ndarray) -> np.ndarray:
    """(3, 3) from wxyz of any length, by Rodrigues' formula."""
    w, *axis = quat / np.linalg.norm(quat)
    x, y, z = axis
    across = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + 2 * w * across + 2 * across @ across


def clamp(value: float, low: float, high: float) -> float:
    return min(max(value, low), high)


def unit(vector: np.ndarray) -> np.ndarray:
    return vector / np.linalg.norm(vector)


def constant(value: np.ndarray, x: float, y: float) -> np.ndarray:
    return value


def across(precision: np.ndarray, camera: Camera, x: float, y: float) -> np.ndarray:
    return -unit(precision @ [(x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy, 1])


def see(splats: Splats, camera: Camera, near: float) -> list[Seen]:
    """The splats that are drawn, front to back."""
    means, quats, scales, opacities, *sh = (t.detach().double().numpy() for t in splats.tensors().values())
    sh = np.concatenate(sh, 1)
    pose = camera.world_to_camera.numpy()
    eye = -pose[:3, :3].T @ pose[:3, 3]
    found = []
    for i in range(len(means)):
        centre = pose[:3, :3] @ means[i] + pose[:3, 3]
        if not (centre[2] > near and opacities[i] > ALPHA_MIN):
            continue
        axes = pose[:3, :3] @ rotation(quats[i])
        away = means[i] - eye
        degree = math.isqrt(sh.shape[1]) - 1
        color = np.maximum(harmonics(away / np.linalg.norm(away), degree) @ sh[i] + 0.5, 0)
        if splats.kind == "surfel":
            made = surfel(centre, axes, scales[i], camera, near)
            opacity, normal = opacities[i], axes[:, 2]
        elif splats.geometry in ALONG_RAYS:
            made = ellipsoid(centre, axes, scales[i], camera, near)
            opacity, normal = opacities[i], None
        else:
            fade, made = gaussian(centre, axes, scales[i], camera, near, splats)
            opacity, normal = opacities[i] * fade, axes[:, np.argmin(scales[i])]
        if made is None:
            continue
        if splats.geometry == "axis":
            normal = -normal if normal @ centre > 0 else normal
            upright = partial(constant, normal)
        else:  # of the ellipsoid at the point of the ray with the largest density, or of the centre's ray
            precision = axes @ np.diag(scales[i] ** -2) @ axes.T
            middle = partial(constant, -unit(precision @ centre))
            upright = middle if splats.geometry == "plane" else partial(across, precision, camera)
        found.append(
            Seen(i, opacity, color, upright, centre[2], made, partial(density, centre, axes, scales[i], opacity))
        )
    return sorted(found, key=lambda s: s.z)


def density(centre, axes, scales, opacity, place: np.ndarray) -> float:
    apart = place - centre
    precision = axes @ np.diag(np.pad(scales, (0, 3 - len(scales)), constant_values=1) ** -2.0) @ axes.T
    return opacity * math.exp(-apart @ precision @ apart / 2)


def solid_depth(met: list[Seen], camera: Camera, x: float, y: float, start: float, near: float) -> float:
    """Where half of the light gets through solids, within 40 % of `start`; 0 if nowhere (GGGS, eq. 10 to 12)."""
    from scipy.optimize import brentq

    ray = np.array([(x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy, 1.0])

    def vacancy(s: Seen, t: float) -> float:
        return math.sqrt(1 - min(ALPHA_MAX, s.density(t * ray)))

    def more_than_half(t: float) -> float:
        left = 1.0
        for s in met:
            peak = s.shape(x, y)[1]
            left *= vacancy(s, t) if t <= peak else vacancy(s, peak) ** 2 / vacancy(s, t)
        return left - 0.5

    low, high = 0.6 * start, 1.4 * start
    if start == 0 or more_than_half(low) <= 0 or more_than_half(high) > 0:
        return 0.0
    found = float(brentq(more_than_half, low, high, xtol=1e-13, rtol=1e-13))
    return found if found >= near else 0.0


def surfel(centre, axes, scales, camera: Camera, near: float):
    """Shape of a disc, or None if it crosses the camera plane."""
    a, b = axes[:, 0] * scales[0], axes[:, 1] * scales[1]
    reach = CUTOFF * math.hypot(a[2], b[2])
    if reach >= centre[2]:
        return None
    lens = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]])
    disc = lens @ np.stack([a, b, centre], 1)
    dual = disc @ np.diag([9.0, 9.0, -1.0]) @ disc.T  # the dual conic of the 3 sigma contour's image
    mid_x, mid_y = (dual[:2, 2] / dual[2, 2]).tolist()
    nx, ny, nz = np.cross(axes[:, 0], axes[:, 1]).tolist()
    level = nx * centre[0] + ny * centre[1] + nz * centre[2]
    (ax, ay, az), (bx, by, bz) = (axes[:, 0] / scales[0]).tolist(), (axes[:, 1] / scales[1]).tolist()
    cx, cy, cz = centre.tolist()
    low, high = max(cz - reach, near), cz + reach
    edge_on = abs(level) < EDGE_ON * math.sqrt(cx * cx + cy * cy + cz * cz)

    def shape(x: float, y: float) -> tuple[float, float]:
        dx, dy = (x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy
        rho_low = 2 * ((x - mid_x) ** 2 + (y - mid_y) ** 2)
        steep = nx * dx + ny * dy + nz
        if steep == 0 or edge_on:  # the ray lies in the plane or never meets it
            return rho_low, low
        z = level / steep
        px, py, pz = z * dx - cx, z * dy - cy, z - cz
        rho = (px * ax + py * ay + pz * az) ** 2 + (px * bx + py * by + pz * bz) ** 2
        return min(rho, rho_low), clamp(z, low, high)

    return shape


def gaussian(centre, axes, scales, camera: Camera, near: float, splats: Splats):
    """Factor on the opacity and shape of an ellipsoid (EWA)."""
    z = centre[2]
    edge_x, edge_y = 0.15 * camera.width / camera.fx, 0.15 * camera.height / camera.fy
    tx = z * clamp(centre[0] / z, -camera.cx / camera.fx - edge_x, (camera.width - camera.cx) / camera.fx + edge_x)
    ty = z * clamp(centre[1] / z, -camera.cy / camera.fy - edge_y, (camera.height - camera.cy) / camera.fy + edge_y)
    jacobian = np.array([[camera.fx / z, 0, -camera.fx * tx / z**2], [0, camera.fy / z, -camera.fy * ty / z**2]])
    covariance = axes @ np.diag(scales**2) @ axes.T
    raw = jacobian @ covariance @ jacobian.T
    (xx, xy), (_, yy) = footprint = raw + splats.dilation * np.eye(2)
    det = xx * yy - xy * xy
    fade = math.sqrt(max(2.5e-5, np.linalg.det(raw) / np.linalg.det(footprint))) if splats.antialias else 1.0
    mid_x, mid_y = camera.fx * centre[0] / z + camera.cx, camera.fy * centre[1] / z + camera.cy
    pull = np.linalg.inv(covariance) @ (centre / z)
    slope_x, slope_y = (-z * pull[:2] / (pull @ centre / z) / [camera.fx, camera.fy]).tolist()
    reach = CUTOFF * scales.max()
    low, high = max(z - reach, near), z + reach

    def shape(x: float, y: float) -> tuple[float, float]:
        dx, dy = x - mid_x, y - mid_y
        rho = (yy * dx * dx - 2 * xy * dx * dy + xx * dy * dy) / det
        return rho, clamp(z + slope_x * dx + slope_y * dy, low, high)

    return fade, shape


def ellipsoid(centre, axes, scales, camera: Camera, near: float):
    """Shape of an ellipsoid along each ray, or None if it reaches the camera plane."""
    if CUTOFF * np.linalg.norm(axes[2] * scales) >= centre[2]:
        return None
    into = np.diag(1 / scales) @ axes.T
    origin = -into @ centre
    reach = CUTOFF * scales.max()
    low, high = max(centre[2] - reach, near), centre[2] + reach

    def shape(x: float, y: float) -> tuple[float, float]:
        ray = into @ [(x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy, 1]
        a, b, c = ray @ ray, 2 * ray @ origin, origin @ origin
        return c - b * b / (4 * a), clamp(-b / (2 * a), low, high)

    return shape


def evaluate(splats: Splats, camera: Camera, near: float) -> Plain:
    """Every splat at every pixel."""
    size = (camera.height, camera.width)
    maps = {name: np.zeros(size) for name in ("alpha", "depth", "median", "distortion")}
    maps |= {name: np.zeros((3, *size)) for name in ("color", "normal")}
    ordered, blended = see(splats, camera, near), []
    for i, j in np.ndindex(*size):
        open_, pairs = 1.0, []
        for s in ordered:
            rho, z = s.shape(j + 0.5, i + 0.5)
            alpha = min(ALPHA_MAX, s.opacity * math.exp(-rho / 2))
            if alpha < ALPHA_MIN:
                continue
            if open_ * (1 - alpha) < T_MIN:
                break
            weight = alpha * open_
            maps["color"][:, i, j] += weight * s.color
            maps["normal"][:, i, j] += weight * s.normal(j + 0.5, i + 0.5)
            maps["alpha"][i, j] += weight
            maps["depth"][i, j] += weight * z
            if open_ > 0.5:
                maps["median"][i, j] = z
            maps["distortion"][i, j] += sum(weight * w * (1 / z - 1 / before) ** 2 for w, before in pairs)
            pairs.append((weight, z))
            blended.append((i, j, s.index, alpha, open_))
            open_ *= 1 - alpha
        if open_ > 0.5:
            maps["median"][i, j] = 0
        if splats.geometry == "solid":
            x, y = j + 0.5, i + 0.5
            met = [s for s in ordered if s.opacity * math.exp(-s.shape(x, y)[0] / 2) >= ALPHA_MIN]
            maps["median"][i, j] = solid_depth(met, camera, x, y, maps["median"][i, j], near)
    return Plain(maps, blended)
