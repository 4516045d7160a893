from pathlib import Path

from surfkit.core.events import FileWritten, StepDone, Warned, emit
from surfkit.core.hooks import hookimpl


class Listener:
    def __init__(self):
        self.heard = []

    @hookimpl
    def surfkit_event(self, event):
        self.heard.append(event)


class Broken:
    calls = 0

    @hookimpl
    def surfkit_event(self, event):
        self.calls += 1
        raise RuntimeError("no\ndisk")


class Deaf:
    calls = 0

    @hookimpl
    def surfkit_event(self):
        self.calls += 1


def test_everyone_hears_and_a_broken_listener_is_left_out(bare, capsys):
    first, broken, deaf, last = Listener(), Broken(), Deaf(), Listener()
    for name, plugin in {"first": first, "broken": broken, "deaf": deaf, "last": last}.items():
        bare.plugins().register(plugin, name)
    events = [StepDone(1, 10, {"l1": 0.5}, 7), FileWritten(Path("a.ply"), "points"), Warned("x")]
    for event in events:
        emit(event)
    assert first.heard == last.heard == events
    assert (broken.calls, deaf.calls) == (1, 3)
    said = capsys.readouterr().err
    assert said.startswith("surfkit: plugin broken failed at StepDone") and said.endswith(": RuntimeError: no disk\n")
    assert said.count("\n") == 1
