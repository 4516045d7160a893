"""Docstrings of functions of tensors name shapes."""

import ast
import re
from collections.abc import Iterator

import pytest
from test_layering import ROOT

SHAPE = re.compile(r"\([A-Zn\d][\w+\- ]*,|\((?:rows|codes|width), |[Ss]calars?\b")
"""(N,), (3, H, W), (n, 3), (codes, D), or scalars."""


def tensor_functions(tree: ast.AST) -> Iterator[ast.FunctionDef]:
    """Public functions and methods with a docstring of their own that take or give tensors or arrays."""
    for node in ast.iter_child_nodes(tree):
        if isinstance(node, ast.ClassDef):
            yield from tensor_functions(node)
        if not isinstance(node, ast.FunctionDef) or node.name.startswith("_"):
            continue
        hints = [arg.annotation for arg in (*node.args.args, *node.args.kwonlyargs)] + [node.returns]
        names = {leaf for hint in hints if hint for leaf in re.findall(r"\w+", ast.unparse(hint))}
        text = ast.get_docstring(node)
        if names & {"Tensor", "ndarray"} and text and not text.startswith("See `"):
            yield node


@pytest.mark.parametrize("folder", ["train", "raster", "runs", "compress"])
def test_docstrings_of_tensor_functions_name_shapes(folder):
    found, lacking = 0, []
    for path in (ROOT / folder).rglob("*.py"):
        for function in tensor_functions(ast.parse(path.read_text())):
            found += 1
            if not SHAPE.search(ast.get_docstring(function)):
                lacking.append(f"{path.relative_to(ROOT)} {function.name}")
    assert found > 5 and not lacking
