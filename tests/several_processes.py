"""What two processes do in tests: functions that each of them calls, with what they came to."""

import os
import tempfile
from dataclasses import replace
from datetime import timedelta
from itertools import islice
from pathlib import Path

import torch
import torch.distributed as dist
import torch.multiprocessing as mp

from surfkit.core.check import Fault
from surfkit.primitives.points import Points
from surfkit.raster.api import Maps, Splats
from surfkit.raster.native_rasterizer import NativeRasterizer
from surfkit.scene.camera import Camera
from surfkit.train.divide import balanced, refuse_apart, share
from surfkit.train.exchange import DividedRasterizer
from surfkit.train.processes import Processes
from surfkit.train.shards import load_share, save_shares

COLUMNS = ("means", "quats", "scales", "opacities", "sh0", "sh_rest", "signal", "chosen")


def camera() -> Camera:
    return Camera(width=90, height=100, fx=100.0, fy=96.0, cx=44.0, cy=51.0, world_to_camera=torch.eye(4))


def crowd(kind: str, geometry: str = "axis") -> Splats:
    """Splats in front of the camera and beside it, each in several tiles."""
    draw, count = torch.Generator().manual_seed(3), 300
    means = torch.rand(count, 3, generator=draw) * torch.tensor([1.6, 1.8, 1.0]) + torch.tensor([-0.8, -0.9, 1.0])
    quats = torch.randn(count, 4, generator=draw)
    scales = torch.rand(count, 2 if kind == "surfel" else 3, generator=draw) * 0.08 + 0.01
    opacities, sh = torch.rand(count, generator=draw), torch.randn(count, 9, 3, generator=draw) * 0.3
    return Splats(
        kind=kind,
        means=means,
        quats=quats,
        scales=scales,
        opacities=opacities,
        sh0=sh[:, :1],
        sh_rest=sh[:, 1:],
        geometry=geometry,
    )


def cotangents(seed: int) -> Maps:
    draw = torch.Generator().manual_seed(seed)
    size = camera().height, camera().width

    def some(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, generator=draw)

    return Maps(some(3, *size), some(*size), some(*size), None, some(3, *size), some(*size))


def drawn(rasterizer, splats):
    """Maps, what is seen, gradients and contributions of a view."""
    found = {}
    for _ in range(2):  # the second time with strips that cost the same
        render = rasterizer.render(splats, camera(), 0.1)
        gradients = render.backward(cotangents(1), cotangents(2), absolute=True)
        contribution = rasterizer.contribution(splats, camera(), 0.1, 0.5, 0.5)
        found = {f"map {name}": value for name, value in render.maps.present().items()}
        found |= {"seen": render.seen, "radii": render.radii, "count": contribution[1]}
        found["leads"] = rasterizer.leading(splats, camera(), 0.1)
        found |= {f"by {name}": getattr(gradients, name) for name in COLUMNS} | {"by sum": contribution[0]}
    return found


def drawn_together(processes, splats):
    divided = DividedRasterizer(NativeRasterizer(), processes)
    equal = divided.strips(camera())
    found = drawn(divided, splats.take(torch.arange(len(splats))[share(len(splats), processes)]))
    return found, equal, divided.strips(camera())


def shrunk(processes, splats):
    """The picture of the camera at a quarter of its size, after that of the same camera at its size."""
    divided = DividedRasterizer(NativeRasterizer(), processes)
    own = splats.take(torch.arange(len(splats))[share(len(splats), processes)])
    divided.render(own, camera(), 0.1)
    return divided.render(own, camera().resized(22, 25), 0.1).maps.color


def evened(processes, count):
    """Moments, some in 16 bits, of points that process 0 alone has, after they have moved on."""
    own = count if processes.rank == 0 else 0
    params = {"means": torch.arange(3.0 * count).view(count, 3)[:own], "opacities": torch.arange(1.0 * count)[:own]}
    short = {name: value.bfloat16() for name, value in params.items()}
    points = balanced(processes, Points(params, short, dict(short), {}))
    return points.params, points.exp_avg, points.exp_avg_sq


def apart(processes, at, skipped):
    """What is said where processes are at different views."""
    try:
        refuse_apart(processes, at[processes.rank], skipped[processes.rank])
    except Fault as error:
        return str(error)
    return ""


def trained(processes, trainer, path, steps, saved):
    """Losses and numbers of points of some steps from a checkpoint on, by processes together; the state is saved."""
    trainer = replace(trainer, rasterizer=DividedRasterizer(NativeRasterizer(), processes))
    state = load_share(path, processes)
    done = [(done.losses, done.points) for done in islice(trainer.run(state), steps)]
    save_shares(saved, state, processes)
    return done, len(state.points)


def in_processes(function, *given, count=2):
    """What `function(processes, *given)` gives in each of some processes, in their order."""
    with tempfile.TemporaryDirectory() as folder:
        mp.spawn(_worker, (count, folder, function, given), nprocs=count)
        return [torch.load(Path(folder) / f"{rank}.pt", weights_only=False) for rank in range(count)]


def _worker(rank, count, folder, function, given):
    torch.set_num_threads(1)
    os.environ.setdefault("GLOO_SOCKET_IFNAME", "lo")
    dist.init_process_group(
        "gloo", init_method=f"file://{folder}/store", rank=rank, world_size=count, timeout=timedelta(seconds=60)
    )
    torch.save(function(Processes(rank, count), *given), Path(folder) / f"{rank}.pt")
    dist.destroy_process_group()
