"""The memory of a simulated GPU: what is held there is told, and a run goes on where it gives out."""

from dataclasses import replace

import pytest
import torch

from surfkit.core.check import BadInput
from surfkit.densify.adc import ADC
from surfkit.losses.photometric import L1, SSIM
from surfkit.raster.nvrtc.gpu_memory import peak_gpu_bytes
from surfkit.scene.cache import Cache
from surfkit.testing.simulated_gpu import GPU, OnSimulatedGpu, simulated_gpu
from surfkit.train.data_cache import TrainingData
from surfkit.train.memory_meter import MemoryMeter
from surfkit.train.stage import Stage
from surfkit.train.uploads import UploadedView, Uploads

STAGE = Stage(steps=14, losses={"l1": L1(), "ssim": SSIM()}, densify=ADC(start=2, until=12, every=5, threshold=1e-5))
BIG = 10**9


class Read(list):
    """Photographs that note when they are read."""

    def __init__(self, photos):
        super().__init__(photos)
        self.read = []

    def __getitem__(self, at):
        self.read.append(at)
        return super().__getitem__(at)


@pytest.fixture
def there(tiny, begin):
    """A function to a trainer on the simulated GPU and its first state."""

    def start(gpu_bytes=0, photos=None):
        trainer, state = begin(STAGE)
        masks = [torch.arange(28).expand(22, 28) > 3 for _ in tiny.views]
        on = OnSimulatedGpu(tiny.rasterizer)
        return replace(trainer, rasterizer=on, masks=masks, gpu_bytes=gpu_bytes, photos=photos or tiny.photos), state

    return start


def ends(trainer, state, at_step=None):
    """The raw parameters after all steps; `at_step` is called after each."""
    for done in trainer.run(state):
        if at_step is not None:
            at_step(done)
    return {name: value.cpu() for name, value in state.points.all_params().items()}


def assert_same(a, b):
    assert all(torch.equal(a[name], b[name]) for name in a | b)


def test_an_allocation_counts_once_and_until_it_is_freed():
    with simulated_gpu() as gpu:
        one = torch.zeros(1000, device=GPU)
        view = one[10:].view(2, -1)
        assert (gpu.held, gpu.peak, gpu.allocations) == (4000, 4000, 1)
        del one
        assert gpu.held == 4000, "a view holds it"
        del view
        assert (gpu.held, peak_gpu_bytes()) == (0, 4000)
        gpu.limit = 3999
        with pytest.raises(torch.cuda.OutOfMemoryError, match="Tried to allocate"):
            torch.zeros(1000).to(GPU)
        assert gpu.held == 0
        graph = torch.zeros(100, device=GPU).requires_grad_().exp().sum()
        assert gpu.held > 800, "a graph holds what it needs on the way back"
        del graph
        assert gpu.held == 0


def test_the_peak_is_told_by_part(there, tiny):
    with simulated_gpu() as gpu:
        trainer, state = there(BIG)
        meter, data, told = MemoryMeter(), TrainingData(Cache(tiny.photos.__getitem__, [1848] * 6)), []
        for _ in trainer.run(state):
            meter.step(state, data, trainer.uploads)
            told.append(peak_gpu_bytes())
        report = meter.gpu_report()
        held = state.points.nbytes
        assert report["peak"] == gpu.peak == told[-1] > told[0] > 0
        assert report["points"] == held and report["photographs"] == 6 * (3 + 1) * 22 * 28
        assert report["steps"] > 0 and sum(report.values()) == 2 * gpu.peak
        assert meter.parts["points"] == 0, "they are not on the CPU"
        before = gpu.peak
        MemoryMeter()
        assert gpu.peak == gpu.held < before, "each stage has its own peak"
    assert MemoryMeter().gpu_report() == {}


@pytest.mark.parametrize(("budget", "kept"), [(0, 0), (3 * 4 * 22 * 28, 3), (BIG, 6)])
def test_the_next_view_is_read_while_the_gpu_works_and_kept_if_it_fits(there, tiny, budget, kept):
    photos = Read(tiny.photos)
    with simulated_gpu():
        wanted = ends(*there())
        trainer, state = there(budget, photos)
        ahead = []
        found = ends(trainer, state, lambda done: ahead.append((state.order.at, len(photos.read))))
        assert trainer.uploads.bytes == kept * 4 * 22 * 28 <= budget
    assert_same(found, wanted)
    for at, read in ahead[:5]:
        assert read == at + 1, "one is read ahead of the step that shows it"
    rounds = -(-STAGE.steps // 6)
    shown = [*photos.read]
    assert sorted(set(shown)) == list(range(6)) and shown[:6] == list(dict.fromkeys(shown[:6]))
    again = len(shown) - 6
    assert again == 0 if kept == 6 else again <= (rounds - 1) * (6 - kept)


def test_a_view_that_is_kept_is_not_expected_from_the_cache(there, tiny):
    expected = []
    with simulated_gpu():
        trainer, state = there(3 * 4 * 22 * 28)
        ends(replace(trainer, expect=lambda coming: expected.append(list(coming))), state)
    assert [len(coming) for coming in expected] == [6, 3, 3], "the first round, and what is not kept of the others"


def test_a_damaged_photograph_is_passed_over_also_ahead(there, tiny):
    class Damaged(Read):
        def __getitem__(self, at):
            if at == 2:
                raise BadInput("2.png: damaged")
            return super().__getitem__(at)

    with simulated_gpu():
        trainer, state = there(BIG, Damaged(tiny.photos))
        ends(trainer, state)
    assert state.skipped == [2] and state.index == STAGE.steps


def test_on_a_cpu_nothing_is_kept_or_read_ahead(tiny):
    photos = Read(tiny.photos)
    uploads = Uploads(torch.device("cpu"), photos, None, None, BIG)
    order = type("Order", (), {"queue": torch.arange(6), "at": 0})()
    uploads.ahead(order, ())
    found = uploads.get(1)
    assert (
        isinstance(found, UploadedView) and found.photo is tiny.photos[1] and photos.read == [1] and uploads.bytes == 0
    )


@pytest.mark.parametrize("within", [1, 30, 60])
@pytest.mark.parametrize("step", [3, 6, 11])
def test_a_step_is_repeated_where_memory_gives_out_once(there, warned, step, within):
    """Also where one that begins a new order, or an edit, does."""
    with simulated_gpu() as gpu:
        wanted = ends(*there(BIG))
        trainer, state = there(BIG)

        def fail(done):
            if done.index == step:
                gpu.refused = {gpu.allocations + within}

        found = ends(trainer, state, fail)
        assert gpu.allocations > max(gpu.refused)
        assert trainer.uploads.bytes == 6 * 4 * 22 * 28, "once does not cost the photographs"
    assert_same(found, wanted)
    assert warned == ["the memory of the GPU gave out; the step is repeated after torch has handed back its reserve"]
