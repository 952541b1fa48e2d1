"""Commands that are told of while they run."""

from __future__ import annotations

import io
import shlex
import sys
import textwrap
import time
from collections.abc import Callable, Sequence
from contextlib import nullcontext, redirect_stderr, redirect_stdout
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

WIDTH = 100


@dataclass
class Tour:
    """Runs commands, tells of them, and remembers what they said.

    Attributes:
        say: told every line.
        force: the commands overwrite what is there.
        steps: title, commands, result and seconds of every step.
    """

    say: Callable[[str], None]
    force: bool = False
    steps: list[dict[str, Any]] = field(default_factory=list)
    began: float = field(default_factory=time.perf_counter)

    def step(self, title: str) -> None:
        """Begin a step."""
        self.steps.append({"title": title, "commands": [], "began": time.perf_counter()})
        self.say(f"\n{len(self.steps)}. {title}")

    def steady(self, command: str, *, keep: str = "") -> str:
        """Run `steady COMMAND`; what it prints is returned, and written to the file `keep`."""
        overwrites = self.force and command.split()[0] in ("fit", "discover", "add")
        line = f"steady {command}{' --force' * overwrites}"
        self.steps[-1]["commands"].append(line)
        self.say(f"   $ {line}")
        said = run(shlex.split(line)[1:])
        if keep:
            Path(keep).write_text(said, encoding="utf-8")
        return said

    def result(self, text: str) -> None:
        """End a step with what came out."""
        step = self.steps[-1]
        step["seconds"], step["result"] = round(time.perf_counter() - step.pop("began"), 1), text
        said = f"{text} ({step['seconds']:.0f} s)"
        self.say(textwrap.fill(said, WIDTH, initial_indent="   → ", subsequent_indent="     "))

    @property
    def seconds(self) -> float:
        """Since it began."""
        return time.perf_counter() - self.began


def run(arguments: Sequence[str]) -> str:
    """What the command `steady ARGUMENTS` prints; its bars are shown on a terminal only.

    Raises:
        KeyboardInterrupt: it was interrupted.
        SteadyError: as the command raises it.
    """
    import typer

    from steady_ppl.command_line import app

    said = io.StringIO()
    quiet = nullcontext() if sys.stderr.isatty() else redirect_stderr(io.StringIO())
    with redirect_stdout(said), quiet:
        code = typer.main.get_command(app).main(list(arguments), prog_name="steady", standalone_mode=False)
    if code:
        raise KeyboardInterrupt
    return said.getvalue()
