"""A simulated flight: what cameras over rolling ground see of it, without photographs."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from surfkit.apps.sfm.engine import load_engine
from surfkit.apps.sfm.exif import Exif
from surfkit.apps.sfm.inspect_photos import Photo

WIDTH, HEIGHT, FOCAL, ALTITUDE = 320, 240, 222.0, 60.0
NOISE_PX = 0.3


@dataclass(frozen=True)
class Flight:
    """Ground points (P, 3), world_to_camera turns and centres (V, 3), and which point each camera sees where."""

    points: np.ndarray
    turns: list
    centres: np.ndarray
    seen: list

    @property
    def names(self):
        return [f"{at:03}.jpg" for at in range(len(self.turns))]

    def photos(self, focal_px):
        return {name: Photo(name, (0, 0), exif=Exif(focal_px=focal_px)) for name in self.names}

    def rows(self, model):
        """The ground point of each point of a model."""
        found = []
        for point in model.points3D.values():
            element = point.track.elements[0]
            found.append(self.seen[element.image_id - 1][0][element.point2D_idx])
        return np.array(found)


def fly(tilt_deg=0.0, oblique=False, climb=0.0, bent=0.0, seed=0):
    """Five strips of six photographs over ground of +- 5 m.

    Args:
        tilt_deg: Standard deviation of roll and pitch.
        oblique: Every second photograph looks 35 degrees off the vertical.
        climb: Standard deviation of the altitudes, metres.
        bent: A term of the lens, r^4, that SIMPLE_RADIAL does not have.
        seed: Of all that is drawn.
    """
    rng = np.random.default_rng(seed)
    points = np.column_stack([rng.uniform(-100, 100, 900), rng.uniform(-90, 90, 900), np.zeros(900)])
    points[:, 2] = 5 * np.sin(points[:, 0] / 25) * np.cos(points[:, 1] / 20)
    turns, centres, seen = [], [], []
    for strip, y in enumerate(np.linspace(-50, 50, 5)):
        for at, x in enumerate(np.linspace(-55, 55, 6)):
            heading = Rotation.from_euler("z", 180 * (strip % 2), degrees=True).as_matrix() @ np.diag([1, -1, -1.0])
            lean = rng.normal(0, tilt_deg, 3) + (35 * (oblique and (strip + at) % 2), 0, 0)
            turn = Rotation.from_euler("xyz", lean, degrees=True).as_matrix() @ heading
            centre = np.array([x, y, ALTITUDE + rng.normal(0, climb)])
            ray = (points - centre) @ turn.T
            flat = ray[:, :2] / np.maximum(ray[:, 2:], 1e-9)
            pixels = FOCAL * flat * (1 + bent * (flat**2).sum(1, keepdims=True) ** 2) + (WIDTH / 2, HEIGHT / 2)
            inside = (ray[:, 2] > 5) & (pixels >= 0).all(1) & (pixels < (WIDTH, HEIGHT)).all(1)
            turns.append(turn)
            centres.append(centre)
            seen.append((np.flatnonzero(inside), (pixels + rng.normal(0, NOISE_PX, pixels.shape))[inside]))
    return Flight(points, turns, np.array(centres), seen)


def reconstructed(flight, lens="SIMPLE_RADIAL"):
    """The flight as structure from motion finds it without EXIF: adjusted from the truth, with a free focal length."""
    engine = load_engine()
    model, config = engine.Reconstruction(), engine.BundleAdjustmentConfig()
    focals = [FOCAL] * (1 if lens.endswith("RADIAL") else 2)
    extra = {"SIMPLE_RADIAL": 1, "OPENCV": 4, "OPENCV_FISHEYE": 4}[lens]
    params = [*focals, WIDTH / 2, HEIGHT / 2, *[0.0] * extra]
    model.add_camera_with_trivial_rig(engine.Camera(model=lens, width=WIDTH, height=HEIGHT, params=params, camera_id=1))
    tracks = {}
    for number, (turn, centre, (rows, pixels)) in enumerate(
        zip(flight.turns, flight.centres, flight.seen, strict=True), 1
    ):
        image = engine.Image(name=flight.names[number - 1], keypoints=pixels, camera_id=1, image_id=number)
        model.add_image_with_trivial_frame(image, engine.Rigid3d(np.column_stack([turn, -turn @ centre])))
        config.add_image(number)
        for at, row in enumerate(rows):
            tracks.setdefault(int(row), engine.Track()).add_element(number, at)
    for row, track in sorted(tracks.items()):
        if track.length() > 2:
            model.add_point3D(flight.points[row], track, np.zeros(3, np.uint8))
    options = engine.BundleAdjustmentOptions()
    options.print_summary = False
    config.fix_gauge(engine.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    engine.create_default_bundle_adjuster(options, config, model).solve()
    model.update_point_3d_errors()
    return model
