"""Passes of PatchMatch by the kernel: what the compiled ones of the CPU find, which tests/depth checks."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from needs import needs_native

from surfkit.depth.cuda.passes import SOURCE_BY_SAMPLES, GpuPasses
from surfkit.depth.native_patch_match import GreyImage, MatchingSettings, Planes, improve
from surfkit.raster.nvrtc.emulated import Emulated, KernelError
from surfkit.scene.camera import Camera

from .sources import changed

pytestmark = needs_native
TERMS = MatchingSettings(0.2, 2, 14, 0.5, 0.015, 0.2, 15, 2.5, samples=32, best=2, window=7, survey=False)


def pictures(count: int, seed: int = 0) -> list[GreyImage]:
    """Of one textured plane with a step in it, by cameras beside each other, of several sizes."""
    draw = np.random.default_rng(seed)
    texture = draw.normal(128, 40, (40, 52)).repeat(3, 0).repeat(3, 1)
    found = []
    for at in range(count):
        width, height = 44 + 3 * (at % 3), 30 + 2 * (at % 2)
        pose = torch.eye(4, dtype=torch.float64)
        pose[0, 3], pose[1, 3] = -0.15 * at, 0.1 * (at % 2)
        y, x = np.mgrid[:height, :width]
        shift = 40 * 0.15 * at * np.where(x > 25, 0.9, 0.6)
        shown = texture[(y + 10 - round(4 * (at % 2))) % 120, (x + 10 + np.rint(shift).astype(int)) % 156]
        shown = shown + draw.normal(0, 2, shown.shape)
        camera = Camera(pose, 40.0, 41.0, 22.0, 15.0, width, height)
        found.append(GreyImage(camera, shown.clip(0, 255).astype(np.uint8)))
    return found


def begun(grey: GreyImage, views: int, seed: int = 1) -> Planes:
    """Slanted planes and costs by view, drawn."""
    draw = np.random.default_rng(seed)
    planes = Planes.at(draw.uniform(0.3, 1.5, grey.value.shape).astype(np.float32), views)
    planes.value[..., 1:] = draw.normal(0, 0.01, (*grey.value.shape, 2))
    planes.cost[:] = draw.uniform(0, 1, grey.value.shape)
    planes.each[:] = draw.integers(0, 256, planes.each.shape)
    return planes


def copied(planes: Planes) -> Planes:
    return Planes(planes.value.copy(), planes.cost.copy(), planes.each.copy())


def known(seen: list[GreyImage], seed: int = 2) -> list[torch.Tensor | None]:
    """Maps of half the size; one is missing, and one has holes."""
    draw = np.random.default_rng(seed)
    maps = [
        torch.from_numpy(draw.uniform(0.4, 1.2, np.array(each.value.shape) // 2).astype(np.float32)) for each in seen
    ]
    maps[0][::3] = 0
    return [None if at == 1 else each for at, each in enumerate(maps)]


def differing(found: Planes, true: Planes) -> float:
    """Share of the pixels with another plane, or the same at another cost: of two that cost the same to five digits,
    either may be taken, and pixels of the second colour go on from it."""
    same = np.isclose(found.value, true.value, rtol=1e-4, atol=1e-6).all(2)
    same &= np.isclose(found.cost, true.cost, atol=1e-3)
    same &= (np.abs(found.each.astype(int) - true.each) <= 1).all(2)
    return 1 - float(same.mean())


CASES = {
    "few samples": {"samples": 16},
    "many": {},
    "all views first": {"survey": True},
    "no maps": {"consistency": 0.0},
    "brightness does not count": {"brightness": 0.0},
    "one view counts": {"best": 1},
    "all views count": {"best": 5},
    "the largest window": {"window": 17},
    "the smallest": {"window": 3, "samples": 16},
    "a narrow spread": {"spread": 3.0},
    "hardly a plane in range": {"low": 0.8, "high": 0.82},
    "large changes": {"jitter_px": 4.0},
}


@pytest.mark.parametrize("name", CASES)
def test_planes_of_the_cpu(load, name):
    here, *others = pictures(6)
    terms = replace(TERMS, **CASES[name])
    maps = known(others) if terms.consistency else None
    true = begun(here, len(others))
    found, before = copied(true), copied(true)
    improve(here, others, true, terms, seed=3, known=maps)
    passes = GpuPasses(load(SOURCE_BY_SAMPLES[16]).device, load)
    passes.improve(here, others, found, terms, seed=3, known=maps)
    assert differing(found, true) < 0.01
    assert differing(before, true) > 0.8
    assert {*passes.uploaded} == {here, *others}


def test_several_passes_find_what_those_of_the_cpu_find(load):
    here, *others = pictures(4)
    true = begun(here, len(others))
    found = copied(true)
    passes = GpuPasses(load(SOURCE_BY_SAMPLES[16]).device, load)
    for index in range(4):
        terms = replace(TERMS, samples=32 if index == 3 else 16, survey=index == 0, consistency=0.0)
        improve(here, others, true, terms, seed=index)
        passes.improve(here, others, found, terms, seed=index)
    exact = np.where(np.arange(here.camera.width) > 25, 0.9, 0.6)
    inner = slice(6, -6), slice(6, -12)
    right = [np.abs(planes.value[..., 0] / exact - 1)[inner] < 0.05 for planes in (found, true)]
    assert right[1].mean() > 0.5 and abs(right[0].mean() - right[1].mean()) < 0.03


def test_the_same_bits_twice_in_any_order():
    here, *others = pictures(4)
    results = []
    for seed in (0, 3, 8):
        planes = begun(here, len(others))
        GpuPasses(torch.device("cpu"), lambda source, seed=seed: Emulated(source, seed=seed)).improve(
            here, others, planes, TERMS, seed=1, known=known(others)
        )
        results.append(planes)
    for other in results[1:]:
        for a, b in zip(vars(results[0]).values(), vars(other).values(), strict=True):
            assert np.array_equal(a, b)


@pytest.mark.parametrize("shape", [(1, 40), (40, 1), (3, 3), (1, 1)])
def test_pictures_of_a_few_pixels(load, shape):
    camera = Camera(torch.eye(4, dtype=torch.float64), 30.0, 30.0, shape[1] / 2, shape[0] / 2, shape[1], shape[0])
    grey = GreyImage(camera, np.full(shape, 128, np.uint8))  # and without texture
    true = Planes.at(np.full(shape, 0.5, np.float32), 2)
    found = copied(true)
    terms = replace(TERMS, survey=True, samples=16)
    improve(grey, [grey, grey], true, terms, seed=1)
    GpuPasses(load(SOURCE_BY_SAMPLES[16]).device, load).improve(grey, [grey, grey], found, terms, seed=1)
    assert differing(found, true) == 0


def test_pictures_leave_the_gpu_with_what_keeps_them():
    here, *others = pictures(3)
    passes = GpuPasses(torch.device("cpu"))
    passes.improve(here, others, begun(here, 2), replace(TERMS, samples=16), seed=0)
    assert len(passes.uploaded) == 3
    del others
    assert list(passes.uploaded) == [here]


MISTAKES = {
    "no border": ("(long long)(y + kBorder)", "(long long)(y)"),
    "the other colour": ("(y + colour) & 1", "(y + colour + 1) & 1"),
    "pixels across": ("four >> 8 & 255u", "four >> 16 & 255u"),
    "half as smooth": ("job.smoothness / 4", "job.smoothness / 8"),
    "no kind of plane is dropped": ("fits = false", "fits = fits"),
    "the worst are kept": ("better >= kKept", "better < 2"),
    "the mean of the views": ("- __logf(sum / used) * kHidden", "+ 0.1f"),
    "nothing from far away": ("if (best) trials", "if (false) trials"),
    "nothing by chance": ("dw = by * draw.next()", "dw = 0"),
    "the reprojection error is not bounded": ("fminf(kMostError, sqrtf(", "fminf(9.0f, sqrtf("),
    "one vote of its own": ("2 * (int)each", "1 * (int)each"),
    "the place in the map": ("s.first_inverse + ", ""),
}


@pytest.mark.parametrize("name", MISTAKES)
def test_mistakes_are_seen(name):
    here, *others = pictures(6)
    true = begun(here, len(others))
    found, maps, terms = copied(true), known(others), replace(TERMS, samples=16)
    improve(here, others, true, terms, seed=3, known=maps)
    wrong = Emulated(changed(SOURCE_BY_SAMPLES[16], *MISTAKES[name]))
    with pytest.raises(KernelError, match=r"index -\d+ of here|other planes"):
        GpuPasses(torch.device("cpu"), lambda source: wrong).improve(here, others, found, terms, seed=3, known=maps)
        if differing(found, true) > 0.012:
            raise KernelError("other planes")
