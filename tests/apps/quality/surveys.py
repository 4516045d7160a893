"""A prepared scene without photographs worth the name: its cameras, tie points and residuals are simulated."""

from dataclasses import replace

import numpy as np
from flight import FOCAL, HEIGHT, WIDTH, fly, reconstructed
from PIL import Image

from surfkit.apps.sfm.engine import load_engine
from surfkit.apps.sfm.sfm_report import model_facts
from surfkit.core.codec import write_json

OFFSET = (512_000.0, 5_800_000.0, 90.0)
POINTS = {"A1": (-60, -40, 1), "A2": (60, -40, 2), "A3": (0, 50, 3), "B1": (10, 5, 0)}
RESIDUALS = {"A1": [0.01, -0.02, 0.03], "A2": [-0.01, 0.02, -0.03], "A3": [0.0, 0.0, 0.01], "B1": [0.12, -0.05, 0.33]}
CONTROL = {
    "crs": "EPSG:32633",
    "offset": OFFSET,
    "control_rms_m": {"e": 0.008, "n": 0.016, "u": 0.025},
    "checkpoints_rms_m": {"e": 0.12, "n": 0.05, "u": 0.33},
    "residuals_m": RESIDUALS,
    "control": ["A1", "A2", "A3"],
    "checkpoints": ["B1"],
    "left_out": [],
    "in_too_few_photographs": [],
    "marks_px": {"A1": {"a.jpg": [0.3, 0.4], "b.jpg": [-0.3, 0.4], "c.jpg": [12.0, 5.0]}, "B1": {"a.jpg": [1.0, 0.0]}},
    "wrong_marks": [{"point": "A1", "photograph": "c.jpg", "pixels": 13.0, "certain": True}],
}


def prepared(folder):
    """What `surfkit prepare photos` leaves of a flight with 3 control points and a check point, but for 2 photographs
    that found no camera. Returns the model with its lens."""
    flight = fly(oblique=True)
    model = reconstructed(flight)
    (folder / "prepare/models/0").mkdir(parents=True)
    model.write_binary(folder / "prepare/models/0")
    straight = load_engine().Reconstruction(model)
    camera = straight.cameras[1]
    focal = camera.mean_focal_length()
    camera.model = load_engine().CameraModelId.PINHOLE
    camera.params = [focal, focal, WIDTH / 2, HEIGHT / 2]
    (folder / "sparse/0").mkdir(parents=True)
    straight.write_binary(folder / "sparse/0")
    write_json(folder / "sparse/0/georeference.json", {"crs": "EPSG:32633", "offset": OFFSET})
    (folder / "images").mkdir()
    for name in flight.names:
        Image.fromarray(np.full((HEIGHT, WIDTH, 3), 99, np.uint8)).save(folder / "images" / name)
    photos = []
    for at, photo in enumerate(flight.photos(FOCAL).values()):
        taken = f"2024:05:{2 + at // 20:02d} 12:{at:02d}:00"
        photos.append(replace(photo, exif=replace(photo.exif, taken=taken, camera="Acme <One>")))
    write_json(folder / "prepare/photographs.json", photos)
    listed = folder / "gcp_list.txt"
    rows = [
        f"{x + OFFSET[0]} {y + OFFSET[1]} {z + OFFSET[2]} 10 10 {photo} {name}"
        for name, (x, y, z) in POINTS.items()
        for photo in flight.names[: 2 + len(name)]
    ]
    listed.write_text("EPSG:32633\n" + "\n".join(rows) + "\n")
    facts = model_facts(model, None) | {"ground_control": CONTROL}
    why = {"lost.jpg": "matches no other photograph", "<b>dark.jpg": "12 features, 100 are needed"}
    report = {"photographs": len(photos) + 2, "registered": len(photos), "not_registered": why, "models": [facts]}
    write_json(folder / "report.json", report | {"seconds": {"features": 3.0}, "settings": {"gcp": str(listed)}})
    return model
