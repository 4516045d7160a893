"""Starts, partitions, assignments and refinements that break their contract are named, with what is wrong."""

from dataclasses import dataclass, field, replace

import pytest
import torch

from surfkit.core.check import BadInput
from surfkit.partition.assign import Assign, PictureShare
from surfkit.partition.base import Cells, Ground, Partition
from surfkit.start.base import InitialModel, Start
from surfkit.start.simple_starts import SparseStart
from surfkit.testing import check_assign, check_partition, check_refine, check_start
from surfkit.train.refine import PruneAndRecover
from surfkit.train.refine.base import Refine
from surfkit.train.stage import Stage

FLAT = Ground((1.0, 0.0, 0.0), (0.0, 1.0, 0.0))


@dataclass(frozen=True)
class Sparse(Start):
    """The sparse points."""

    def cloud(self, known):
        return self.spoilt(SparseStart().cloud(known), known)

    def expected(self, sparse, pixels):
        return sparse

    def spoilt(self, cloud, known):
        return cloud


class Double(Sparse):
    def spoilt(self, cloud, known):
        return replace(cloud, xyz=cloud.xyz.double())


class Shades(Sparse):
    def spoilt(self, cloud, known):
        return replace(cloud, rgb=cloud.rgb / 255)


class Opaque(Sparse):
    def spoilt(self, cloud, known):
        return replace(cloud, opacity=torch.ones(len(cloud.xyz)))


class Long(Sparse):
    def spoilt(self, cloud, known):
        return replace(cloud, normals=2 * torch.ones_like(cloud.xyz))


class Tosses(Sparse):
    def spoilt(self, cloud, known):
        return replace(cloud, xyz=cloud.xyz + 0.01 * torch.randn(cloud.xyz.shape))


class Shifts(Sparse):
    def spoilt(self, cloud, known):
        known.scene.cloud.xyz.add_(1)
        return cloud


class Guesses(Sparse):
    def expected(self, sparse, pixels):
        return 100 * sparse


class Lacks(Sparse):
    def model(self, primitive, known, generator):
        params = primitive.init(self.cloud(known), generator)
        return InitialModel({key: value for key, value in params.items() if key != "quats"})


class Fewer(Sparse):
    def model(self, primitive, known, generator):
        params = primitive.init(self.cloud(known), generator)
        return InitialModel({key: value[1:] for key, value in params.items()})


class Learnt(Sparse):
    def model(self, primitive, known, generator):
        return InitialModel(primitive.init(self.cloud(known), generator), sh_degree=4)


class Rolls(Sparse):
    def model(self, primitive, known, generator):
        return InitialModel(primitive.init(self.cloud(known), torch.Generator().manual_seed(torch.seed() % 2**31)))


@pytest.mark.parametrize(
    ("start", "message"),
    [
        (Double(), r"Double: xyz is torch.float64 .*not torch.float32"),
        (Shades(), "Shades: rgb is torch.float32 of shape"),
        (Opaque(), "Opaque: opacity must lie between 0 and 1"),
        (Long(), "Long: a normal is not of length 1"),
        (Tosses(), "Tosses.cloud is not repeatable: xyz"),
        (Shifts(), "Shifts.cloud changed .*known.scene.cloud.xyz"),
        (Guesses(), "Guesses.expected is 40000, .* 400 "),
        (Lacks(), "Lacks.model has .*400 points .*quats"),
        (Fewer(), r"Fewer.model has the columns .*\(399, 3\)"),
        (Rolls(), r"Rolls.model is not repeatable: params\['quats'\]"),
    ],
)
def test_starts_that_are_wrong(start, message):
    check_start(Sparse())
    with pytest.raises(AssertionError, match=message):
        check_start(start)


def test_a_degree_that_no_model_has_is_refused_where_it_is_given():
    with pytest.raises(BadInput, match="begin with sh_degree 4"):
        check_start(Learnt())


@dataclass(frozen=True)
class Halves(Partition):
    """Two blocks, to both sides of a line, with a gap between them."""

    gap: float = 0.0

    def cells(self, sight):
        return Cells(FLAT, ((None, None, 0.0, None), (self.gap, None, None, None)), (0, 1))


class Random(Halves):
    def cells(self, sight):
        at = torch.rand(()).item()
        return Cells(FLAT, ((None, None, at, None), (at, None, None, None)), (0, 1))


@pytest.mark.parametrize(
    ("partition", "message"),
    [
        (Halves(gap=0.1), "Halves: a place has no owner"),
        (Halves(gap=-0.1), "Halves: a place has two owners"),
        (Random(), "Random: the same model gives other cells"),
    ],
)
def test_partitions_that_are_wrong(partition, message):
    check_partition(Halves())
    with pytest.raises(AssertionError, match=message):
        check_partition(partition)


@dataclass(frozen=True)
class Share(Assign):
    """The share of the picture."""

    threshold: float = 0.05

    def joins(self, sight, cells):
        owner = cells.owner(sight.splats.means)
        return self.spoilt(PictureShare().measure(sight, owner, cells.count) > self.threshold)

    def spoilt(self, joins):
        return joins


class Across(Share):
    def spoilt(self, joins):
        return joins.T


class All(Share):
    def spoilt(self, joins):
        return joins | True


class Floats(Share):
    def spoilt(self, joins):
        return joins.float()


class Chance(Share):
    def spoilt(self, joins):
        return joins & (torch.rand(joins.shape) < 0.5)


class Nobody(Share):
    @property
    def most_views(self):
        return 0


@pytest.mark.parametrize(
    ("assign", "message"),
    [
        (Across(), r"Across.joins has shape \(3, 30\), not \(30, 3\)"),
        (All(), "All: a view joins a block without points"),
        (Floats(), "Floats.joins is torch.float32, not bool"),
        (Chance(), "Chance.joins"),
        (Nobody(), "Nobody.most_views is 0"),
        (Share(threshold=0.999), "Share: no view joins block 0"),
    ],
)
def test_assignments_that_are_wrong(assign, message):
    check_assign(Share())
    with pytest.raises(AssertionError, match=message):
        check_assign(assign)


@dataclass(frozen=True)
class Same(Refine):
    """Goes on as before."""

    stage: Stage = field(default_factory=lambda: PruneAndRecover().stage)


class Whitens(Same):
    def params(self, params):
        params["sh0"].zero_()
        return params


class Narrows(Same):
    def params(self, params):
        return params | {"sh_rest": params["sh_rest"][:, :3]}


class Some(Same):
    def views(self, views, seed):
        return tuple(views[at] for at in torch.randperm(len(views)).tolist())


class Few(Same):
    def views(self, views, seed):
        return tuple(views[:2])


@pytest.mark.parametrize(
    ("refine", "message"),
    [
        (Whitens(), r"Whitens.begin changed .*params\['sh0'\]"),
        (Narrows(), "Narrows: .*'sh_rest' has shape .*declared"),
        (Some(), "Some: its views .*seed"),
        (Few(), "Few has photographs"),
    ],
)
def test_refinements_that_are_wrong(refine, message):
    check_refine(Same())
    with pytest.raises(AssertionError, match=message):
        check_refine(refine)
