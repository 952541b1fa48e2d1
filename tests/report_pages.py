"""A report of two runs on six drives, what is in a page, and a headless browser that opens it."""

from __future__ import annotations

import base64
import json
import re
import shutil
import signal
import subprocess
from dataclasses import replace
from functools import cache
from html import unescape
from html.parser import HTMLParser
from os import killpg
from pathlib import Path

import numpy as np
import pyro
import pyro.distributions as dist
import pytest
import torch
from examples import example
from small import simulated

import steady_ppl as st

EVIL = "</script><script>window.broken = 1</script>"
BROWSER = shutil.which("chromium") or shutil.which("chromium-browser")
in_a_browser = pytest.mark.skipif(BROWSER is None, reason="there is no chromium: apt-get install chromium")
FOUND = {
    "sentence": "The dynamics lack yaw_linear_drag = 0.05 1/s.",
    "doubts": [],
    "effects": [
        {
            "effect": "yaw_linear_drag",
            "kind": "dynamics",
            "class": ["yaw_linear_drag", EVIL],
            "confidence": 0.97,
            "coefficient": [0.05],
            "interval_90": [[0.04, 0.06]],
            "unit": "1/s",
            "text": "a_yaw = -c w",
            "heldout_gain": 12.0,
        }
    ],
    "candidates": [
        {
            "effect": "yaw_linear_drag",
            "kind": "dynamics",
            "p_value": 1e-9,
            "coefficient": 0.05,
            "sd": 0.005,
            "absent": 0.0,
            "unit": "1/s",
            "detection_limit": 0.02,
            "heldout_gain": 12.0,
            "heldout_gain_ci": [8.0, 16.0],
            "note": None,
        }
    ],
    "shape": None,
    "next_run": None,
    "notes": ["a note"],
}


class Elements(HTMLParser):
    """Tags and attributes of a page, and its identifiers."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict]] = []
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))

    def of(self, name: str) -> list[str]:
        return [attributes[name] for _, attributes in self.tags if attributes.get(name)]


def fit(name: str) -> st.Fit:
    return st.Fit(example(name, torch.float32).requires_grad_(False), "hand", known_start=True)


@cache
def two_runs() -> dict[str, st.Fit]:
    """Before and after, as they are declared."""
    return {"before": fit("hovercraft"), "after": fit("hovercraft.py:HovercraftTruth")}


@cache
def six_drives() -> st.Trajectories:
    """Six drives, one of which has a hostile name."""
    table = simulated(trajectories=6, rows=101)
    return replace(table, labels=("1", "2", EVIL, "4", "5", "6"))


@cache
def two_run_report() -> st.Report:
    """Of both runs on all drives."""
    return st.report(
        two_runs(), six_drives(), discovery=FOUND, simulations=20, draws=5, how=["steady report before after"]
    )


def content(page: Path) -> dict:
    return content_of(page.read_text())


def content_of(html: str) -> dict:
    (text,) = re.findall(r'<script id="data" type="application/json">(.*?)</script>', html, re.DOTALL)
    return json.loads(text, parse_constant=lambda name: pytest.fail(name))


class Motor(st.Program):
    """One state, one channel."""

    states = ("speed [rad/s]",)
    controls = ("voltage [V]",)
    measurements = ("speed [rad/s]",)
    channels = ("torque [rad/s²]",)
    motion = {"torque": ("", "speed")}

    def initial(self):
        return pyro.sample("start", dist.Normal(torch.zeros(1), torch.ones(1)).to_event(1))

    def transition(self, state, control, time, step):
        return state + step[..., None] * pyro.sample("torque", dist.Normal(control - state, 0.2).to_event(1))

    def observe(self, state):
        pyro.sample("speed", dist.Normal(state, 0.1).to_event(1))


def opened(page: Path, *options: str, anchor: str = "") -> tuple[str, str]:
    """What a headless browser prints on stdout and stderr; its whole process group is ended with it."""
    assert BROWSER is not None
    command = [BROWSER, "--headless", "--no-sandbox", "--disable-gpu", "--hide-scrollbars", "--enable-logging=stderr"]
    command += ["--virtual-time-budget=8000", f"--user-data-dir={page.parent / 'profile'}", *options]
    process = subprocess.Popen(
        [*command, f"file://{page}{anchor}"],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    try:
        return process.communicate(timeout=120)
    finally:
        if process.poll() is None:
            killpg(process.pid, signal.SIGKILL)
            process.wait()


def with_script(page: Path, script: str, name: str) -> Path:
    """The page with another script at its end."""
    file = page.with_name(name)
    file.write_text(page.read_text().replace("</body>", f"<script>{script}</script></body>"))
    return file


def lines_of(page: Path, script: str, name: str, *options: str, anchor: str = "") -> list[str]:
    """What a script in the page puts into its title, and no word on the console."""
    dom, log = opened(with_script(page, script, name), "--dump-dom", *options, anchor=anchor)
    assert "CONSOLE" not in log, log
    return unescape(re.findall("<title>(.*?)</title>", dom)[0]).split(" | ")


def unpacked(part: dict) -> np.ndarray:
    """Numbers as they were before they were packed; NaN where there are none."""
    codes = np.frombuffer(base64.b64decode(part["data"]), "<i2").reshape(part["shape"]).astype(float)
    return np.where(codes == -32768, np.nan, part["low"] + part["step"] * (codes + 32767))
