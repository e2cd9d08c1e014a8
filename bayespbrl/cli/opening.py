"""Where the page of a command is, and the browser that shows it."""

import os
import sys
import webbrowser
from collections.abc import Mapping
from dataclasses import dataclass

# Where one of these is set, nobody may be looking at this machine's screen: a remote shell, automation, a test.
ELSEWHERE = ("SSH_CONNECTION", "SSH_CLIENT", "SSH_TTY", "CI", "PYTEST_CURRENT_TEST")


@dataclass(frozen=True)
class Place:
    """Where a page listens, and whether it is opened.

    Attributes:
      host, port: port 0 for a free one.
      browser: whether the page is opened in the browser, where `somebody_looks`.
    """

    host: str = "127.0.0.1"
    port: int = 0
    browser: bool = True


def somebody_looks(environment: Mapping[str, str] = os.environ) -> bool:
    """Whether a person at this machine's screen started the command: standard output is a terminal, with a display."""
    if not sys.stdout.isatty() or any(environment.get(name) for name in ELSEWHERE):
        return False
    display = any(environment.get(name) for name in ("DISPLAY", "WAYLAND_DISPLAY"))
    return display or sys.platform in ("darwin", "win32")


def open_in_browser(address: str) -> bool:
    """Open an address in the browser and return whether one was found that does not need the terminal."""
    try:
        browser = webbrowser.get()
        if type(browser) is webbrowser.GenericBrowser:  # one for the terminal, where the program goes on
            return False
        return browser.open(address)
    except (webbrowser.Error, OSError):
        return False
