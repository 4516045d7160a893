"""Memory that gives out on a thread of the compiled part is an error like any other."""

import subprocess
import sys

import pytest
from needs import needs_native

CODE = """
import re, resource
from pathlib import Path
import numpy as np
import torch
from surfkit.mesh.lattice import FusionImage, Lattice
from surfkit.mesh.native_grid import NativeGrid
from surfkit.scene.camera import Camera

torch.set_num_threads(2)

def picture(side):
    depth = np.random.default_rng(0).uniform(1, 500, (side, side)).astype(np.float32)
    camera = Camera(torch.eye(4, dtype=torch.float64), side, side, side / 2, side / 2, side, side)
    return FusionImage(depth, np.full(depth.shape, 32 << 24, np.uint32), camera)

small, large = picture(40), picture(2400)
assert NativeGrid(Lattice(0.01, 0.04)).fuse(small, False)  # begins the threads
held = int(re.search(r"VmSize:\\s*(\\d+)", Path("/proc/self/status").read_text())[1]) * 1024
resource.setrlimit(resource.RLIMIT_AS, (held + 20_000_000, -1))
for _ in range(5):
    try:
        NativeGrid(Lattice(0.01, 0.04)).fuse(large, False)
    except MemoryError:
        print("told", flush=True)
resource.setrlimit(resource.RLIMIT_AS, (-1, -1))
assert NativeGrid(Lattice(0.01, 0.04)).fuse(small, False)
print("goes on")
"""


@needs_native
@pytest.mark.skipif(sys.platform != "linux", reason="limits the memory of a process as Linux does")
def test_memory_that_gives_out_on_a_thread_ends_no_process():
    done = subprocess.run([sys.executable, "-c", CODE], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert done.stdout.split("\n") == ["told"] * 5 + ["goes on", ""]
