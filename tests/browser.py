"""A page in headless Chromium: what it asks of the network, what its console says, how it looks."""

import asyncio
import json
import shutil
import subprocess
import tempfile
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest

NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
# Every image that is not loaded or of one colour, every drawing without a line in it.
EMPTY = """
[...document.images].filter(image => {
  const canvas = document.createElement('canvas');
  canvas.width = image.naturalWidth; canvas.height = image.naturalHeight;
  if (!canvas.width) return true;
  const context = canvas.getContext('2d');
  context.drawImage(image, 0, 0);
  const pixels = new Uint32Array(
    context.getImageData(0, 0, canvas.width, canvas.height).data.buffer);
  return new Set(pixels).size < 8;
}).length + [...document.querySelectorAll('figure svg')].filter(
  svg => [...svg.querySelectorAll('path')].filter(p => p.getBBox().width > 0).length < 8).length
"""


@dataclass
class Seen:
    """What a browser made of a page. wide: elements that reach beyond the screen and do not scroll.

    scroll_px: how wide the page is; empty: figures with nothing in them.
    """

    width_px: int
    scroll_px: int = 0
    empty: int = 0
    asked: list[str] = field(default_factory=list)
    console: list[str] = field(default_factory=list)
    answers: dict[str, Any] = field(default_factory=dict)


def browser() -> str:
    found = next((path for name in NAMES if (path := shutil.which(name))), None)
    if found is None:
        pytest.skip(f"no Chromium here: none of {', '.join(NAMES)} is on the path")
    return found


def seen(
    page: Path | str,
    width_px: int,
    *,
    questions: dict[str, str] | None = None,
) -> Seen:
    """Open a page, a file or an address, at this width.

    questions: expressions of JavaScript, by name.
    """
    pytest.importorskip("tornado", reason="talks to Chromium; comes with `ipykernel`")
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as profile:
        process = subprocess.Popen(
            [
                browser(), "--headless", "--no-sandbox", "--disable-gpu",
                "--remote-debugging-port=0", f"--user-data-dir={profile}", "about:blank",
            ],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )  # fmt: skip
        try:
            url = page if isinstance(page, str) else page.resolve().as_uri()
            return asyncio.run(_seen(process, Path(profile), url, width_px, questions or {}))
        finally:
            process.kill()
            process.wait()


async def _seen(
    process: subprocess.Popen,
    profile: Path,
    url: str,
    width_px: int,
    questions: dict[str, str],
) -> Seen:
    """It waits for what the browser says, however long that takes, until the browser ends."""
    from tornado.httpclient import AsyncHTTPClient
    from tornado.websocket import websocket_connect

    port_file = profile / "DevToolsActivePort"
    while not (port_file.is_file() and "\n" in port_file.read_text()):
        assert process.poll() is None, "the browser ended before it listened"
        await asyncio.sleep(0.1)
    port = port_file.read_text().splitlines()[0]
    listed = await AsyncHTTPClient().fetch(f"http://127.0.0.1:{port}/json/list")
    (target, *_) = [each for each in json.loads(listed.body) if each["type"] == "page"]
    socket = await websocket_connect(target["webSocketDebuggerUrl"], max_message_size=2**28)
    found, count = Seen(width_px), 0

    def note(message: dict[str, Any]) -> None:
        method, params = message.get("method"), message.get("params", {})
        if method == "Network.requestWillBeSent":
            found.asked.append(params["request"]["url"][:200])
        if method in ("Runtime.consoleAPICalled", "Runtime.exceptionThrown", "Log.entryAdded"):
            found.console.append(json.dumps(params)[:500])

    async def call(method: str, **arguments: Any) -> Any:
        nonlocal count
        count += 1
        await socket.write_message(json.dumps({"id": count, "method": method, "params": arguments}))
        while True:
            answer = await socket.read_message()
            assert answer is not None, "the browser ended"
            message = json.loads(answer)
            if message.get("id") == count:
                assert "error" not in message, message
                return message["result"]
            note(message)

    async def value(expression: str) -> Any:
        answer = await call("Runtime.evaluate", expression=expression, returnByValue=True)
        assert "exceptionDetails" not in answer, answer
        return answer["result"].get("value")

    for domain in ("Network", "Runtime", "Log", "Page"):
        await call(f"{domain}.enable")
    await call(
        "Emulation.setDeviceMetricsOverride",
        width=width_px, height=900, deviceScaleFactor=1, mobile=width_px < 700,
    )  # fmt: skip
    await call("Page.navigate", url=url)
    while not await value("location.href != 'about:blank' && document.readyState == 'complete'"):
        await asyncio.sleep(0.1)
    found.scroll_px = await value("document.documentElement.scrollWidth")
    found.empty = await value(EMPTY)
    found.answers = {name: await value(text) for name, text in questions.items()}
    socket.close()
    return found
