"""Formats of splats that break their contract are named, with what is wrong."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import ClassVar

import pytest
import torch

from surfkit.core.check import BadInput
from surfkit.io.splats.base import Format
from surfkit.io.splats.splat_table import SPLAT_COLUMNS
from surfkit.testing import check_format


@dataclass(frozen=True)
class Saved(Format):
    """What torch saves."""

    suffix: ClassVar[str] = ".pt"

    def write(self, path, table, frame=None, tree=None):
        table.refuse_unsound(path)
        table = self.spoilt(replace(table, means=table.file_means(frame)))
        values = [table.kind, *(getattr(table, name) for name in SPLAT_COLUMNS)]
        torch.save({"values": values}, path)

    def spoilt(self, table):
        return table

    def read(self, path):
        from surfkit.io.splats.splat_table import SplatTable

        try:
            return SplatTable(*torch.load(path)["values"])
        except Exception as error:
            raise BadInput(f"{path}: damaged") from error

    def knows(self, path, head):
        return head.startswith(b"PK")

    def rounding(self, table):
        return "nothing is rounded"


class Beside(Saved):
    def write(self, path, table, frame=None, tree=None):
        super().write(path, table, frame)
        Path(path).with_name("more.txt").touch()


class Moves(Saved):
    def spoilt(self, table):
        table.means.add_(1)
        return table


class Draws(Saved):
    def spoilt(self, table):
        return replace(table, sh0=table.sh0 + 1e-3 * torch.rand(len(table), 3))


class Forgets(Saved):
    def spoilt(self, table):
        return table.take(slice(1, None))


class Flat(Saved):
    def spoilt(self, table):
        return table if table.kind == "surfel" else table.as_surfels()


class Far(Saved):
    def spoilt(self, table):
        return replace(table, means=table.means.float() * 1.1)


class Turned(Saved):
    def spoilt(self, table):
        return replace(table, quats=table.quats.roll(1, 1))


class Grey(Saved):
    def spoilt(self, table):
        return replace(table, sh0=table.sh0.clamp(-0.5, 0.5))


class Strange(Saved):
    def knows(self, path, head):
        return False


class Everything(Saved):
    def knows(self, path, head):
        return True


class Talks(Saved):
    def rounding(self, table):
        return "one\ntwo"


class NoNumbers(Saved):
    def write(self, path, table, frame=None, tree=None):
        torch.save({"values": (table.kind, table.means, table.quats, table.log_scales, *self.rest(table))}, path)

    def rest(self, table):
        return table.opacity_logits, table.sh0, table.sh_rest


class Trusts(Saved):
    def read(self, path):
        from surfkit.io.splats.splat_table import SplatTable

        return SplatTable(*torch.load(path)["values"])


class Coarse(Saved):
    def spoilt(self, table):
        return replace(table, means=table.means.float())

    def write(self, path, table, frame=None, tree=None):
        super().write(path, table)


@pytest.mark.parametrize(
    ("form", "message"),
    [
        (Beside(), r"Beside, 0 splats \(gaussian\): wrote \['model.pt', 'more.txt'\] in place of model.pt"),
        (Moves(), r"Moves, 1 splats \(gaussian\): write changed .*table.means"),
        (Draws(), "Draws, 1 splats .gaussian.: the same splats give other bytes"),
        (Forgets(), "Forgets, 1 splats .gaussian.: 0 splats came back"),
        (Flat(), "Flat, 1 splats .gaussian.: they came back as surfel"),
        (Far(), "Far, .*: a position is .*away"),
        (Turned(), "Turned, .*: rotations came back"),
        (Grey(), "Grey, .*: sh0 came back"),
        (Strange(), "Strange, 0 splats .gaussian.: its own file is not known"),
        (Everything(), "Everything.knows a text file"),
        (Talks(), "Talks, .*: rounding .*one line.*'one.*two'"),
        (NoNumbers(), r"NoNumbers.write takes NaN; .*table.refuse_unsound"),
        (Coarse(), r"Coarse loses .*table.file_means"),
    ],
)
def test_formats_that_are_wrong(form, message):
    check_format(Saved())
    with pytest.raises(AssertionError, match=message):
        check_format(form)


def test_a_format_that_trusts_its_files():
    with pytest.raises(AssertionError, match="Trusts.read, .*cut off, .*BadInput"):
        check_format(Trusts())
