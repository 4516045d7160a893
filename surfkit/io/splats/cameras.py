"""The cameras of a scene as the cameras.json of 3DGS, which viewers of splats open beside the points."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from surfkit.core.codec import write_json
from surfkit.scene.scene import Frame, Scene, View


def write_cameras(path: Path, scene: Scene) -> None:
    """Save all cameras, those of held-out photographs too, in the coordinates of the PLY file beside it."""
    held = {view.name for view in scene.held_out}
    views = sorted([*scene.train, *scene.held_out], key=lambda view: view.name)
    rows = (_row(at, view, scene.frame) for at, view in enumerate(views))
    write_json(path, [row | {"held_out": row["img_name"] in held} for row in rows])


def _row(at: int, view: View, frame: Frame) -> dict[str, Any]:
    """Position and camera-to-world rotation with OpenCV axes; lengths in pixels."""
    camera = view.camera
    return {
        "id": at,
        "img_name": view.name,
        "width": camera.width,
        "height": camera.height,
        "position": frame.to_file(camera.centre.numpy()).tolist(),
        "rotation": camera.world_to_camera[:3, :3].T.tolist(),
        "fx": camera.fx,
        "fy": camera.fy,
        "cx": camera.cx,
        "cy": camera.cy,
    }
