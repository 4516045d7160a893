#!/usr/bin/env bash
# pluggy tells plugins apart by equality, not by identity: a second one that equals the first cannot be registered.
#
# pluggy 1.7.0. `PluginManager.register` refuses an object if it is equal to one that is registered, and says that it is
# registered "under a different name", though it is another object. Listeners that are lists, or dataclasses with the same
# values, are equal: two empty lists that are to collect events cannot listen at the same time. `is_registered` says True of
# the one that is not. What helps is a class that keeps the equality of `object`, such as `@dataclass(eq=False)`.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet pluggy==1.7.0
"$folder/venv/bin/python" - <<'PYTHON'
from dataclasses import dataclass

import pluggy


@dataclass
class ByValue:
    level: int = 0


@dataclass(eq=False)
class ByIdentity:
    level: int = 0


class Collected(list):
    pass


def second(kind):
    """What comes of registering a second object of a kind, and whether it counts as registered before that."""
    manager, first, other = pluggy.PluginManager("trial"), kind(), kind()
    manager.register(first)
    counts = manager.is_registered(other)
    try:
        manager.register(other)
    except ValueError as error:
        found = str(error).splitlines()[0][:60]
    else:
        found = "registered"
    print(f"{kind.__name__}: is_registered {counts}; {found}")
    return counts, found.startswith("Plugin already registered under a different name")


assert second(Collected) == (True, True), "the behaviour has changed"
assert second(ByValue) == (True, True), "the behaviour has changed"
assert second(ByIdentity) == (False, False)
PYTHON
