"""What the tests of evaluation share."""

import pytest

from surfkit.core.events import Warned
from surfkit.core.hooks import hookimpl
from surfkit.core.registry import plugins


@pytest.fixture
def told():
    """Texts of the warnings."""

    class Ears:
        @hookimpl
        def surfkit_event(self, event):
            if isinstance(event, Warned):
                self.texts.append(event.text)

    ears = Ears()
    ears.texts = []
    plugins().register(ears, "ears")
    yield ears.texts
    plugins().unregister(ears)
