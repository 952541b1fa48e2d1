"""How large a report is and how long it takes to open: size, time until the page is there, and until all is drawn.

    python benchmarks/report_page.py out/demo/report.html       in headless Chromium, five times

The time counts from the start of the navigation in a browser that runs already, read from the page's own clock; what
is not on the screen is drawn when it comes near, or on paper, and is drawn here at once.
"""

from __future__ import annotations

import argparse
import json
import shutil
import signal
import statistics
import subprocess
import sys
import tempfile
import time
import urllib.request
from os import killpg
from pathlib import Path

TELL = """<script>
addEventListener("load", () => setTimeout(() => {
  const there = performance.now();
  Object.keys(DRAWN).filter(element).forEach(draw);
  document.title = `opened ${there} ${performance.now()} ${document.querySelectorAll(".js-plotly-plot").length}`;
}));
</script></body>"""


def opened(page: Path, times: int) -> list[list[float]]:
    """Of each opening: ms until the page is there, until all is drawn, and how many pictures that are."""
    browser = shutil.which("chromium") or shutil.which("chromium-browser")
    if browser is None:
        sys.exit("there is no chromium: apt-get install chromium")
    found = []
    with tempfile.TemporaryDirectory() as folder:
        told = Path(folder) / "page.html"
        before, _, after = page.read_text().rpartition("</body>")
        told.write_text(before + TELL + after)
        for number in range(times):
            found.append(_once(browser, told, Path(folder) / f"profile{number}"))
    return found


def _once(browser: str, page: Path, profile: Path) -> list[float]:
    command = [browser, "--headless", "--no-sandbox", "--disable-gpu", "--window-size=1280,900"]
    command += [f"--user-data-dir={profile}", "--remote-debugging-port=0", f"file://{page}"]
    process = subprocess.Popen(
        command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True, start_new_session=True
    )
    try:
        assert process.stderr is not None
        address = next(line.split("//")[1].split("/")[0] for line in process.stderr if line.startswith("DevTools"))
        for _ in range(300):
            with urllib.request.urlopen(f"http://{address}/json") as answer:
                titles = [tab["title"] for tab in json.load(answer)]
            for title in titles:
                if title.startswith("opened "):
                    return [float(word) for word in title.split()[1:]]
            time.sleep(0.1)
        sys.exit("the page did not open in half a minute")
    finally:
        killpg(process.pid, signal.SIGKILL)
        process.wait()


def main() -> None:
    """Measure the pages that are named."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("pages", nargs="+", type=Path)
    parser.add_argument("--times", type=int, default=5)
    asked = parser.parse_args()
    print(f"{'page':40} {'MB':>6} {'opened [s]':>16} {'all drawn [s]':>16} pictures")
    for page in asked.pages:
        rows = opened(page, asked.times)
        there, drawn = ([row[i] / 1000 for row in rows] for i in (0, 1))
        spread = [f"{statistics.mean(one):8.2f} ± {statistics.stdev(one):5.2f}" for one in (there, drawn)]
        print(f"{page!s:40} {page.stat().st_size / 1e6:6.2f} {spread[0]:>16} {spread[1]:>16} {rows[0][2]:.0f}")


if __name__ == "__main__":
    main()
