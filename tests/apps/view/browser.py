"""A browser without a screen, which speaks viser's protocol: it has a camera, clicks, and keeps what it is told."""

import http.client
import re
import time
from urllib.parse import urlencode, urlsplit

from needs import needs

PATIENCE_S = 240


def wait_until(what):
    """Until `what()` is true. The runner of the tests ends one that hangs; the machine may be busy with others."""
    while not what():
        time.sleep(0.01)


class Browser:
    """Connects to a page with the token of its address, and says where its camera is."""

    def __init__(self, url):
        viser, client = needs("viser"), needs("websockets.sync.client", "a websocket client")
        self.messages = needs("viser._messages")
        at = urlsplit(url)
        protocol = f"viser-v{viser.__version__}"
        settings = {"subprotocols": [protocol], "max_size": None, "open_timeout": None, "ping_timeout": None}
        self.socket = client.connect(f"ws://{at.netloc}/?{at.query}", **settings)
        self.told, self.gui = [], {}
        self.stand(0.0)

    def send(self, message):
        pack = needs("msgspec.msgpack")
        self.socket.send(pack.encode(message.as_serializable_dict()))

    def stand(self, z):
        """The camera at a height, looking up."""
        lens = (1.0, 0.01, 1e3, 600, 800)
        pose = ((1.0, 0.0, 0.0, 0.0), (0.0, 0.0, z), *lens, (0.0, 0.0, z + 1.0), (0.0, -1.0, 0.0))
        self.send(self.messages.ViewerCameraMessage(*pose))

    def click(self, origin, direction):
        """A click, of a ray in units of the page."""
        ray = tuple(map(float, origin)), tuple(map(float, direction))
        self.send(self.messages.ScenePointerMessage("click", *ray, ((0.5, 0.5),), None))

    def set(self, label, value):
        """What a user does to a part of the panel."""
        self.send(self.messages.GuiUpdateMessage(self.part(label), {"value": value}))

    def press(self, label):
        """A button."""
        self.send(self.messages.GuiUpdateMessage(self.part(label), {"value": True}))

    def part(self, label):
        return next(uuid for uuid, row in self.gui.items() if row.get("label") == label)

    def is_whole(self):
        """Whether the page of `surfkit view` is built: it asks for clicks at last."""
        return any(row["type"] == "ScenePointerEnableMessage" for row in self.told)

    def texts(self):
        """Of all parts of the panel."""
        return [row["_markdown"] for row in self.gui.values() if row.get("_markdown")]

    def wait_for(self, seen):
        """What `seen(self)` returns as soon as it is true, after messages that have come."""
        end = time.monotonic() + PATIENCE_S
        while not (found := seen(self)):
            assert time.monotonic() < end, f"not seen after {PATIENCE_S} s"
            try:
                self._take(self.socket.recv(timeout=0.2))
            except TimeoutError:
                continue
        return found

    def names(self):
        """Of the nodes of the scene, those that were removed left out."""
        found = {}
        for row in self.told:
            if row["type"].startswith("Remove"):
                found = {k: v for k, v in found.items() if not (k + "/").startswith(row.get("name", "?") + "/")}
            elif "props" in row and "name" in row:
                found[row["name"]] = row["props"]
        return found

    def _take(self, raw):
        pack, zstandard = needs("msgspec.msgpack"), needs("zstandard")
        size = int.from_bytes(raw[8:16], "little")
        inner = zstandard.ZstdDecompressor().decompress(raw[16 : 16 + size], int.from_bytes(raw[:8], "little"))
        for row in pack.decode(inner)["messages"]:
            self.told.append(row)
            if row["type"] == "GuiUpdateMessage":
                self.gui.setdefault(row["uuid"], {}).update(row["updates"])
            elif row["type"].startswith("Gui") and "props" in row:
                self.gui[row["uuid"]] = dict(row["props"])

    def close(self):
        self.socket.close()


def get(page, target, **headers):
    """Status, body and headers of the answer of a served page to a request."""
    at = urlsplit(page.url)
    connection = http.client.HTTPConnection(at.hostname, at.port)
    connection.request("GET", target, headers=headers)
    answer = connection.getresponse()
    return answer.status, answer.read(), answer.headers


def cookie(page):
    """That a browser has of a served page after its first visit."""
    at = urlsplit(page.url)
    return {"Cookie": f"surfkit-view-{at.port}={at.query.partition('=')[2]}"}


def ask(page, **asked):
    """Status and text of the answer to the script that follows the pointer."""
    status, body, _ = get(page, f"/surfkit/ask?{urlencode(asked)}", **cookie(page))
    return status, body.decode()


def tag(browser):
    """What that script finds in the panel: client and turn."""
    content = next(row["content"] for row in browser.gui.values() if "surfkit-cursor" in str(row.get("content")))
    return re.search(r'data-client="(\d*)" data-turn="(\d+)"', content).groups()
