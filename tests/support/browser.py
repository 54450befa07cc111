"""A headless Chromium, driven through chromedriver (the W3C WebDriver protocol) with the standard library alone."""

from __future__ import annotations

import base64
import contextlib
import json
import re
import shutil
import subprocess
import tempfile
import urllib.error
import urllib.request
from collections.abc import Iterator
from pathlib import Path
from typing import Any

__all__ = ["Browser", "missing", "running"]

# Software rendering, so that the answers depend on no GPU, and no traffic of the browser's own.
OPTIONS = (
    "--headless", "--no-sandbox", "--disable-gpu", "--use-gl=angle", "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader", "--disable-background-networking", "--disable-component-update", "--disable-sync",
    "--no-first-run", "--hide-scrollbars", "--disable-dev-shm-usage",
)  # fmt: skip
SECONDS = 120
# Proxies are for other machines.
_DIRECT = urllib.request.build_opener(urllib.request.ProxyHandler({}))


def missing() -> str:
    """Why there is no browser here; "" if there is one."""
    lacks = [name for name in ("chromium", "chromedriver") if shutil.which(name) is None]
    return f"{' and '.join(lacks)} missing: apt install chromium chromium-driver" if lacks else ""


class Browser:
    """A session; ``errors`` lists what pages have logged as errors."""

    def __init__(self, address: str, profile: str) -> None:
        self._address = address
        binary = {"binary": shutil.which("chromium"), "args": [*OPTIONS, f"--user-data-dir={profile}"]}
        asked = {"browserName": "chrome", "goog:chromeOptions": binary, "goog:loggingPrefs": {"browser": "ALL"}}
        self._session = self._call("POST", "/session", {"capabilities": {"alwaysMatch": asked}})["sessionId"]

    def _call(self, method: str, path: str, body: Any = None) -> Any:
        data = None if body is None else json.dumps(body).encode()
        request = urllib.request.Request(
            self._address + path, data, {"Content-Type": "application/json"}, method=method
        )
        try:
            with _DIRECT.open(request, timeout=SECONDS) as answer:
                return json.load(answer)["value"]
        except urllib.error.HTTPError as error:
            raise RuntimeError(json.load(error)["value"]["message"]) from None

    def _ask(self, path: str, body: Any = None) -> Any:
        return self._call("GET" if body is None else "POST", f"/session/{self._session}/{path}", body)

    def devtools(self, command: str, **parameters: Any) -> Any:
        return self._ask("goog/cdp/execute", {"cmd": command, "params": parameters})

    def size(self, width: int, height: int, *, mobile: bool = False) -> None:
        """Size of the page [CSS pixels]; a mobile one has a touch screen and two pixels for one."""
        ratio = 2 if mobile else 1
        given = {"width": width, "height": height, "deviceScaleFactor": ratio, "mobile": mobile}
        self.devtools("Emulation.setDeviceMetricsOverride", **given)
        self.devtools("Emulation.setTouchEmulationEnabled", enabled=mobile)

    def scheme(self, name: str) -> None:
        """What the user prefers: "light" or "dark"."""
        self.devtools("Emulation.setEmulatedMedia", features=[{"name": "prefers-color-scheme", "value": name}])

    def open(self, page: Path) -> None:
        self._ask("url", {"url": page.resolve().as_uri()})

    def run(self, script: str, *arguments: Any) -> Any:
        """What a script, the body of a function of ``arguments``, returns; a promise is waited for."""
        return self._ask("execute/sync", {"script": script, "args": list(arguments)})

    def picture(self) -> bytes:
        """What the page looks like, as PNG."""
        return base64.b64decode(self._ask("screenshot"))

    def act(self, *steps: dict[str, Any], kind: str = "mouse") -> None:
        """Actions of one pointer, as WebDriver names them."""
        pointer = {"type": "pointer", "id": kind, "parameters": {"pointerType": kind}, "actions": list(steps)}
        self._ask("actions", {"actions": [pointer]})

    def click(self, x: float, y: float, *, kind: str = "mouse") -> None:
        down = {"type": "pointerDown", "button": 0}
        up = {"type": "pointerUp", "button": 0}
        self.act({"type": "pointerMove", "x": round(x), "y": round(y), "duration": 0}, down, up, kind=kind)

    def drag(self, start: tuple[float, float], end: tuple[float, float], *, button: int = 0) -> None:
        points = [{"type": "pointerMove", "x": round(x), "y": round(y), "duration": 50} for x, y in (start, end)]
        press, release = ({"type": kind, "button": button} for kind in ("pointerDown", "pointerUp"))
        self.act(points[0], press, points[1], release)

    def scroll(self, x: float, y: float, down: int) -> None:
        """Turn the wheel by ``down`` pixels."""
        step = {"type": "scroll", "x": round(x), "y": round(y), "deltaX": 0, "deltaY": down, "origin": "viewport"}
        self._ask("actions", {"actions": [{"type": "wheel", "id": "wheel", "actions": [{**step, "duration": 0}]}]})

    @property
    def errors(self) -> list[str]:
        """Messages of pages since the last look: errors, and warnings of WebGL."""
        found = self._ask("se/log", {"type": "browser"})
        said = [entry["message"] for entry in found if entry["level"] == "SEVERE" or "WebGL" in entry["message"]]
        # Pictures are read back, which takes time.
        return [message for message in said if "GPU stall" not in message]

    def close(self) -> None:
        self._call("DELETE", f"/session/{self._session}")


@contextlib.contextmanager
def running() -> Iterator[Browser]:
    """A browser with a profile of its own, which ends with the block."""
    with tempfile.TemporaryDirectory(prefix="geokit-browser-", ignore_cleanup_errors=True) as profile:
        driver = subprocess.Popen(["chromedriver", "--port=0"], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL)
        try:
            assert driver.stdout is not None
            port = next(
                found[1]
                for line in driver.stdout
                if (found := re.search(r"successfully on port (\d+)", line.decode("utf-8")))
            )
            browser = Browser(f"http://127.0.0.1:{port}", profile)
            try:
                yield browser
            finally:
                browser.close()
        finally:
            driver.terminate()
            driver.communicate()
