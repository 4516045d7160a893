#!/usr/bin/env bash
# tyro 1.0.17: a subcommand of a base class gives the default of the derived class, without a word.
#
# Where the members of a union are a class and one derived from it, and the default is of the derived class, the default
# is assigned to the first member that it is an instance of: the base class, if that comes first. Choosing the subcommand
# of the base class then gives the default back, of the other class; its help shows that one's settings. In the other
# order, the same words give an instance of the base class.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
python3 -m venv venv
venv/bin/pip install --quiet tyro==1.0.17
cat >choose.py <<'PYTHON'
from dataclasses import dataclass
from importlib.metadata import version
from typing import Annotated, Union

import tyro


@dataclass(frozen=True)
class Adam:
    beta: float = 0.9


@dataclass(frozen=True)
class MaskedAdam(Adam):
    mask: float = 0.5


base, derived = Annotated[Adam, tyro.conf.subcommand("adam")], Annotated[MaskedAdam, tyro.conf.subcommand("masked-adam")]
found = {}
for order, union in (("base first", Union[base, derived]), ("derived first", Union[derived, base])):

    @dataclass(frozen=True)
    class Settings:
        optimizer: union = MaskedAdam()

    found[order] = tyro.cli(Settings, args=["optimizer:adam"]).optimizer
    print(f"tyro {version('tyro')}, {order}: optimizer:adam gives {found[order]}")
assert found == {"base first": MaskedAdam(), "derived first": Adam()}, "the behaviour has changed"
PYTHON
venv/bin/python choose.py
