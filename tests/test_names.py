"""The vocabulary: a name stands for one thing."""

import ast
from collections import Counter, defaultdict

from test_layering import FILES, ROOT

MAX_SHARING_CLASSES = 0.03
"""Share of the classes that have the name of another one."""
MAX_SHARED_FILE_NAMES = 10
BARE = {"MOST", "LEAST", "EACH", "ENOUGH", "HARDLY", "FEW", "FEWEST", "LONGEST", "SMALLEST", "LARGEST", "NEAR", "FAR"}
"""Constants so named do not say of what and in which unit."""


def constants(tree: ast.Module) -> set[str]:
    """Names of the module's constants, without a leading underscore."""
    found = set()
    for node in tree.body:
        targets = node.targets if isinstance(node, ast.Assign) else [getattr(node, "target", None)]
        found |= {name.id.lstrip("_") for one in filter(None, targets) for name in ast.walk(one) if is_constant(name)}
    return found


def is_constant(node: ast.AST) -> bool:
    return isinstance(node, ast.Name) and node.id.isupper()


def test_few_classes_share_a_name():
    bearers = Counter(
        node.name for path in FILES for node in ast.walk(ast.parse(path.read_text())) if isinstance(node, ast.ClassDef)
    )
    sharing = {name: count for name, count in bearers.items() if count > 1}
    assert len(bearers) > 500 and sum(sharing.values()) <= MAX_SHARING_CLASSES * bearers.total(), sharing


def test_few_file_names_stand_twice():
    places = defaultdict(list)
    for path in FILES:
        if path.name != "__init__.py":
            places[path.name].append(str(path.relative_to(ROOT)))
    twice = {name: where for name, where in places.items() if len(where) > 1}
    assert len(twice) <= MAX_SHARED_FILE_NAMES, twice


def test_a_constant_says_what_it_bounds():
    bare = {str(path.relative_to(ROOT)): constants(ast.parse(path.read_text())) & BARE for path in FILES}
    assert not {path: names for path, names in bare.items() if names}
    assert constants(ast.parse("MOST = 1\n_LEAST: int = 2\nA, B = 1, 2")) == {"MOST", "LEAST", "A", "B"}
