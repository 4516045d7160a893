"""Points that are kept elsewhere than where they are drawn: the same bits from files as from memory, and on a GPU the
same points from the host."""

import errno
import os
from dataclasses import dataclass, field, replace

import pytest
import torch

from surfkit.core.check import BadInput
from surfkit.core.schedule import LearningRate
from surfkit.densify import ADC, Trim
from surfkit.densify.base import Prune
from surfkit.losses.regularizers import MeanOpacity
from surfkit.losses.reprojection import Reprojection
from surfkit.primitives import Gaussian3D, Surfel2D
from surfkit.primitives.points import Points
from surfkit.primitives.storage import DiskStorage, Storage
from surfkit.testing.simulated_gpu import OnSimulatedGpu, is_there, simulated_gpu
from surfkit.train import checkpoint, in_view, point_blocks, points_on
from surfkit.train.adam import Adam, AdamInView
from surfkit.train.points_on import PointsOn
from surfkit.train.stage import Stage

from .conftest import looking_down

EDITS = Stage(
    steps=16,
    densify=ADC(start=2, every=4, threshold=1e-7, until=12, reset_every=8, recovery=1),
    prune=(Trim(start=5, every=6, recovery=1, ratio=0.1),),
    sh_every=4,
    optimizer=AdamInView(),
)


@pytest.fixture
def apart(begin, monkeypatch):
    """A trainer and the begin of its state, with views that do not show all points, small blocks, and points kept in a
    storage."""
    monkeypatch.setattr(point_blocks, "BLOCK_POINTS", 4)
    monkeypatch.setattr(point_blocks, "GROUP_BLOCKS", 2)
    monkeypatch.setattr(in_view, "SORTED_EVERY", 5)

    def start(home=None, stage=EDITS, primitive=None, rasterizer=None):
        trainer, state = begin(stage, primitive)
        params = state.points.params
        params["means"] = params["means"] * torch.tensor([2.0, 2.0, 1.0])
        params["scales"] = params["scales"] - 0.5
        cameras = [looking_down(x, y) for x in (-0.7, 0.0, 0.7) for y in (-0.4, 0.4)]
        views = tuple(replace(view, camera=camera) for view, camera in zip(trainer.views, cameras, strict=True))
        trainer = replace(trainer, views=views, home=home, rasterizer=rasterizer or trainer.rasterizer)
        return trainer, trainer.begin(Points.fresh(params, storage=home), state.generator)

    return start


def same(one, other):
    for a, b in zip(one.groups, other.groups, strict=True):
        assert a.keys() == b.keys() and all(torch.equal(a[name], b[name]) for name in a)


def mapped(points):
    """Whether all columns are files of no name that are mapped into memory."""
    maps = [line.split() for line in open("/proc/self/maps") if "(deleted)" in line]
    ranges = [tuple(int(end, 16) for end in line[0].split("-")) for line in maps]
    addresses = [value.data_ptr() for group in points.groups for value in group.values()]
    return all(any(low <= address < high for low, high in ranges) for address in addresses)


@pytest.mark.skipif(not os.path.exists("/proc/self/maps"), reason="this looks at what Linux has mapped")
@pytest.mark.parametrize("primitive", [Surfel2D(1), Gaussian3D(1, smoothing=0.2)], ids=lambda p: type(p).__name__)
def test_same_bits_on_the_disk_as_in_memory(apart, tmp_path, primitive):
    """Through steps, edits, resets, trims, spatial order, checkpoints and going on from one."""
    trainer, whole = apart(primitive=primitive)
    counts = torch.tensor([40, *(done.points for done in trainer.run(whole))])
    assert counts.max() > 60 and counts.diff().min() < 0, "points were added and dropped"
    disk = DiskStorage(folder=tmp_path)
    trainer, state = apart(disk, primitive=primitive)
    for done in trainer.run(state):
        assert mapped(state.points) and not os.listdir(tmp_path)
        if done.index == 7:
            break
    path = tmp_path / "saved" / "state.safetensors"
    checkpoint.save(path, state)
    del state
    state = checkpoint.load(path)
    for _ in trainer.run(state):
        assert mapped(state.points)
    same(whole.points, state.points)
    state.move(torch.device("cpu"))
    same(whole.points, state.points)


@dataclass(frozen=True)
class Tallies(Prune):
    """Keeps what policies are told of all views."""

    found: list = field(default_factory=list)

    def edit(self, points, step):
        tally = step.views.contributions(0.5, 0.5)
        self.found.append([tally.mean, tally.peak, tally.hits, tally.views])
        self.found[-1] += [value for each in step.views.each(1.0, 1.0) for value in each]
        self.found[-1] += [step.views.leading(), step.views.leading([0])]


def test_contributions_of_points_in_view_are_those_of_all(apart):
    """Also where frozen points are before them."""
    tallies = []
    for optimizer in (Adam(), AdamInView()):
        note = Tallies()
        trainer, state = apart(stage=replace(EDITS, densify=None, prune=(note,), optimizer=optimizer))
        point_blocks.put_in_order(state.points)
        state.frozen = {name: value[::3] + 0.05 * (name == "means") for name, value in state.points.params.items()}
        trainer.step(state)
        tallies += note.found
    assert all(torch.equal(a, b) and a.dtype == b.dtype for a, b in zip(*tallies, strict=True))
    assert (tallies[0][3] < 6).any() and tallies[0][3].any(), "no view shows all points"


def test_points_on_the_host_while_a_gpu_draws(apart):
    """As those on the GPU, but for the rounding of the two kernels of Adam; the GPU never holds all of them."""
    ends, peaks = [], []
    for home in (None, Storage(torch.device("cpu"))):
        with simulated_gpu() as gpu:
            trainer, state = apart(home, rasterizer=OnSimulatedGpu(apart()[0].rasterizer))
            for _ in trainer.run(state):
                places = [is_there(value) for group in state.points.groups for value in group.values()]
                assert all(places) if home is None else not any(places)
            peaks.append(gpu.peak)
            state.move(torch.device("cpu"))
        ends.append(state.points)
    assert len(ends[0]) == len(ends[1]) > 60 and peaks[1] < peaks[0]
    for name, value in ends[0].params.items():
        torch.testing.assert_close(ends[1].params[name], value, rtol=1e-3, atol=1e-4)


@pytest.mark.parametrize("within", [8, 14, 20])
def test_points_stay_in_one_order_where_the_gpu_is_full_while_they_are_put_in_order(apart, within):
    """Half of the columns in another order would be other points."""
    stage, ends = replace(EDITS, densify=None, prune=(), rates={"means": LearningRate(0.1)}), []
    for fails in (False, True):
        with simulated_gpu() as gpu:
            trainer, state = apart(stage=stage, rasterizer=OnSimulatedGpu(apart()[0].rasterizer))
            for done in trainer.run(state):
                if fails and done.index == 5:  # the next step puts them in order
                    gpu.refused = {gpu.allocations + within}
            assert not fails or gpu.allocations > max(gpu.refused)
            state.move(torch.device("cpu"))
        ends.append(state.points)
    same(*ends)


def test_a_full_disk_is_an_error_that_names_the_folder(apart, tmp_path, monkeypatch):
    trainer, state = apart(DiskStorage(folder=tmp_path))
    steps = trainer.run(state)
    next(steps)

    def full(*_):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "posix_fallocate", full)
    with pytest.raises(OSError, match="No space left") as caught:
        list(steps)
    assert caught.value.errno == errno.ENOSPC and caught.value.filename == str(tmp_path)
    assert not state.whole and not os.listdir(tmp_path)


@pytest.mark.skipif(not hasattr(os, "posix_fallocate"), reason="this system reserves by writing")
def test_room_is_reserved_before_it_is_used(tmp_path, monkeypatch):
    """A file with holes would end the process where the disk is full when it is written."""
    reserve, rooms = os.posix_fallocate, []

    def watched(file, *rest):
        reserve(file, *rest)
        rooms.append(os.fstat(file))

    monkeypatch.setattr(os, "posix_fallocate", watched)
    column = DiskStorage(folder=tmp_path).empty(1000, torch.zeros(2, 3, dtype=torch.float64))
    assert column.shape == (1000, 3) and column.dtype == torch.float64 and not column.any()
    (room,) = rooms
    assert room.st_size == 24_000 and room.st_blocks * 512 >= 24_000 and room.st_nlink == 0


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"optimizer": Adam()}, "pretrain.optimizer:adam is for all"),
        ({"regularizers": {"faint": MeanOpacity(weight=0.1)}}, "pretrain.regularizers.faint"),
        ({"losses": {"pair": Reprojection(weight=0.5, start=0)}}, "pretrain.losses.pair"),
    ],
)
@pytest.mark.parametrize("place", ["host", "disk"])
def test_stages_whose_steps_need_all_points_are_refused(change, named, place):
    stages = [("pretrain", replace(EDITS, **change), Surfel2D())]
    with pytest.raises(BadInput, match=f"^--points-on {place} .*{named}.*--points-on auto$"):
        PointsOn(place).refuse_unfit(stages)
    for fits in ("auto", "device"):
        PointsOn(fits).refuse_unfit(stages)
    PointsOn(place).refuse_unfit([("pretrain", EDITS, Surfel2D())])


def test_an_unknown_place_is_refused():
    """As from Python, where no command line is parsed."""
    with pytest.raises(BadInput, match="^points_on 'disc': give one of auto, device, host, disk$"):
        PointsOn("disc")


def test_scratch_needs_files_and_a_folder(tmp_path):
    for place in ("device", "host"):
        with pytest.raises(BadInput, match=f"^--scratch .*--points-on {place}"):
            PointsOn(place, tmp_path).refuse_unfit([])
    with pytest.raises(BadInput, match="^--scratch .*no such folder"):
        PointsOn("disk", tmp_path / "none").refuse_unfit([])
    PointsOn("disk", tmp_path).refuse_unfit([])


def test_files_that_take_memory_are_warned_of(tmp_path, monkeypatch):
    """The folder of a stage is made, and a disk is taken without a word."""
    told = []
    monkeypatch.setattr(points_on, "emit", lambda event: told.append(event.text))
    for kind, count in (("ext4", 0), ("tmpfs", 1)):
        monkeypatch.setattr(points_on, "_file_system", lambda folder, kind=kind: kind)
        assert PointsOn("disk").home(tmp_path / "stage") == DiskStorage(folder=tmp_path / "stage")
        assert len(told) == count
    assert "(tmpfs)" in told[0] and "--scratch" in told[0]
    assert PointsOn("auto").home(tmp_path) is None and PointsOn("device").home(tmp_path) is None
    assert PointsOn("host").home(tmp_path) == Storage(torch.device("cpu"))


def test_where_points_go_when_memory_is_full():
    """One place after the other, with auto alone, and where the steps of a stage are for points in view."""
    places = Storage(torch.device("cuda")), Storage(torch.device("cpu")), DiskStorage()
    given = EDITS, Surfel2D()
    assert [PointsOn("auto").next_place(each, *given) for each in places] == ["host", "disk", None]
    assert [PointsOn("device").next_place(each, *given) for each in places] == [None] * 3
    assert [PointsOn("auto").next_place(each, replace(EDITS, optimizer=Adam()), Surfel2D()) for each in places] == [
        None
    ] * 3
