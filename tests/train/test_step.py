"""The step reads from top to bottom, and can be repeated where the memory of a GPU gives out."""

import ast
import inspect
import re

import torch

from surfkit.densify import ADC
from surfkit.losses import L1, SSIM
from surfkit.train import step
from surfkit.train.stage import Stage

STAGE = Stage(steps=8, losses={"l1": L1(), "ssim": SSIM()}, densify=ADC(start=1, until=8, every=2, threshold=1e-9))


def held(state):
    """All that a step may change, but the order of views."""
    groups = (state.points.params, state.points.exp_avg, state.points.exp_avg_sq, state.points.stats)
    return [value.clone() for group in groups for value in group.values()], state.index, state.reset_at, state.whole


def same(a, b):
    return len(a[0]) == len(b[0]) and all(map(torch.equal, a[0], b[0])) and a[1:] == b[1:]


def test_a_step_is_five_blocks_in_at_most_60_lines():
    source = inspect.getsource(step)
    functions = [node for node in ast.parse(source).body if isinstance(node, ast.FunctionDef)]
    lines = [line for node in functions for line in range(node.body[1].lineno, node.end_lineno + 1)]
    code = [text for line in lines if (text := source.splitlines()[line - 1].strip()) and not text.startswith("#")]
    assert len(code) + len(functions) <= 60
    assert re.findall(r"# (\w+): ", source) == ["Render", "Losses", "Backward", "Update", "Densify"]


def test_gradients_change_nothing_and_are_the_same_again(begin):
    """What is repeated where memory gives out: only the order of views goes on, and that is set back."""
    trainer, state = begin(STAGE)
    trainer.step(state)
    before, order, draws = held(state), (state.order.queue, state.order.at), state.generator.get_state()
    one = step.view_gradients(trainer, state)
    assert same(held(state), before)
    (state.order.queue, state.order.at), _ = order, state.generator.set_state(draws)
    two = step.view_gradients(trainer, state)
    assert one.target.view is two.target.view and one.losses == two.losses
    assert all(map(torch.equal, one.gradients.tensors().values(), two.gradients.tensors().values()))


def test_a_state_is_not_whole_between_update_and_densify(begin):
    """What is saved then would be half a step. All is done by the edit in one piece, which can be repeated."""
    trainer, state = begin(STAGE)
    result = step.view_gradients(trainer, state)
    points = len(state.points)
    edit = step.update(trainer, state, result)
    assert not state.whole and state.index == 0 and len(state.points) == points == 40
    while edit is None:
        state.index, state.whole = state.index + 1, True
        edit = step.update(trainer, state, step.view_gradients(trainer, state))
    dropped, cloned, split = edit.counts
    step.densify(trainer, state, edit)
    assert len(state.points) == 40 - dropped + cloned + split > 40 and not state.whole
