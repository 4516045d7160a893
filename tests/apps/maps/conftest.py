"""What tests of maps share."""

import pytest

from surfkit.core.events import Warned
from surfkit.core.hooks import hookimpl
from surfkit.core.registry import plugins


class Heard:
    def __init__(self):
        self.texts = []

    @hookimpl
    def surfkit_event(self, event):
        if isinstance(event, Warned):
            self.texts.append(event.text)


@pytest.fixture
def heard():
    """What warnings said."""
    listener = Heard()
    plugins().register(listener)
    yield listener.texts
    plugins().unregister(listener)
