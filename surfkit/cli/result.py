"""What a finished run shows on the screen."""

from __future__ import annotations

from typing import Any

from surfkit.cli.table import print_table
from surfkit.folder import Run


def show(this: Run, metrics: dict[str, Any]) -> None:
    """Print a table of the metrics, and the paths of what was written."""
    images = metrics["images"]
    rows = [("views held out", str(len(images["per_image"])))]
    if images["psnr"] is not None:
        rows += [("PSNR", f"{images['psnr']:.2f} dB"), ("SSIM", f"{images['ssim']:.3f}")]
    rows += [
        ("points", f"{metrics['points']:,}"),
        ("steps", f"{metrics['steps']:,}"),
        ("training", f"{metrics['seconds']:.0f} s ({metrics['cpu_seconds']:.0f} s of processor time)"),
    ]
    if metrics["peak_memory_bytes"]:
        rows.append(("peak memory", f"{metrics['peak_memory_bytes'] / 1e6:.0f} MB"))
    if metrics["fps"]:
        rows.append(("frames a second", f"{metrics['fps']:.1f}"))
    print_table(("metric", "value"), rows)
    print()
    written = [("metrics", this.metrics), ("points", this.cloud)]
    written += [("mesh", path) for path in sorted(this.out.glob("mesh.*")) if path.suffix in (".ply", ".obj", ".glb")]
    written += [("picture of the mesh", path) for path in sorted(this.mesh_pictures.glob("*.png"))]
    pictures = sorted(this.pictures.rglob("*.png")) if this.pictures.exists() else []
    written += [("picture", path) for path in pictures[:8]]
    print_table(("written", "path"), [(what, str(path)) for what, path in written])
    if len(pictures) > 8:
        print(f"... and {len(pictures) - 8} more pictures in {this.pictures}")
