"""The good files, one of which is spoiled at a time: tables, runs, a search, a fit that was stopped, bags, logs."""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import shutil
import stat
import time
from pathlib import Path

from bag_drives import drive
from bag_writing import KINDS, write_bag
from examples import MODELS
from rover_logs import ardupilot, px4, world
from small import simulated, steady, written
from small_studies import UNFITTED, written as write_study
from truck_logs import command_log, pose_log, write as write_logs

from steady_ppl.data.logs.mapping import READY_FOLDER

FEW = ("--guide", "bootstrap", "--particles", "20", "--draws", "3", "--steps", "4", "--set", "validate_every=2")
SEARCH = ("discover", "before", "t.csv", "--valid", "v.csv", "--simulations", "50", "--out")
CART, HOVER = "models/linear_gaussian.py", "models/hovercraft.py"
TRAINING = ("fit", CART, "t.csv", "--valid", "v.csv", *FEW, "--out")
MAPPING = """\
step = 0.1
messages = ["boat_msgs"]
[columns."u.speed"]
topic = "/cmd_vel"
field = "linear.x"
longest = 2.0
[columns."y.range"]
topic = "/scan"
field = "ranges[1]"
clock = "header"
[columns."y.heading"]
topic = "/odom"
field = "pose.pose.orientation"
as = "yaw"
clock = "aligned"
[columns."x.x"]
topic = "/odom"
field = "pose.pose.position.x"
"""


class Desk:
    """Good files, and a copy in which one is spoiled and commands run.

    A cart makes the tables `t.csv`, `t.parquet`, `v.csv`, the runs `before` and `after`, the fit `begun`, which has a
    checkpoint to go on from, and the stopped search `searched`; a hovercraft `h.csv`, `hover` and `hover_too`. A run
    of somebody else brings `payload.py` along.
    """

    def __init__(self, folder: Path) -> None:
        self.good, self.place = folder.resolve() / "good", folder.resolve() / "desk"
        self.good.mkdir()
        shutil.copytree(MODELS, self.good / "models", ignore=shutil.ignore_patterns("__pycache__"))
        for name, seed in (("t.csv", 0), ("t.parquet", 0), ("v.csv", 1)):
            written(self.good / name, simulated("linear_gaussian", 10, 9, seed))
        written(self.good / "h.csv", simulated(trajectories=5, rows=9))
        self._write_bags()
        self._write_autopilot_logs()
        (self.good / "logs").mkdir()
        write_logs(self.good / "logs", pose_log(), command_log())
        self.must("fit", CART, "t.csv", "--recipe", "hand", "--out", "before")
        self.must("fit", HOVER, "h.csv", "--recipe", "hand", "--known-start", "--out", "hover")
        self.must(*TRAINING, "after")
        shutil.copytree(self.good / "after", self.good / "begun")
        shutil.copytree(self.good / "hover", self.good / "hover_too")
        shutil.copy(MODELS / "linear_gaussian.py", self.good / "before" / "payload.py")
        self._stop_a_search()
        self.tidy()

    def must(self, *words: str) -> None:
        """Run a command that makes a good file."""
        with contextlib.chdir(self.good):
            assert steady(*words, "--quiet") == 0

    def add_searches(self) -> None:
        """The run `found` and its discovery, of drives with an effect; `study.toml`, and `studied`."""
        push = ("simulate", CART, "--effect", "acceleration_bias=3", "--trajectories", "10", "--out")
        self.must(*push, "pushed.csv")
        self.must(*push, "pushed_too.csv", "--seed", "1")
        wider = (*SEARCH[:2], "pushed.csv", "--valid", "pushed_too.csv", *SEARCH[5:])
        self.must(*wider, "found", "--json", "found.json")
        assert json.loads((self.good / "found.json").read_text())["effects"]
        write_study(self.good, UNFITTED, model=CART)  # without its sizes a study has 64 drives
        self.must("study", "study.toml", "--workers", "1", "--out", "studied")
        self.tidy()

    def _write_bags(self) -> None:
        """One of every kind, in which a type is its own, and a mapping."""
        for kind in KINDS:
            write_bag(self.good / kind.replace(" ", "_"), kind, drive(10))
        (self.good / "mapping.toml").write_text(MAPPING)
        (self.good / "boat_msgs" / "msg").mkdir(parents=True)
        (self.good / "boat_msgs" / "msg" / "Battery.msg").write_text("float64 volt\nstring name\nfloat32[3] gains\n")

    def _write_autopilot_logs(self) -> None:
        """One of each format, and a mapping."""
        (self.good / "px4.ulg").write_bytes(px4(world(1.0)))
        (self.good / "ardupilot.bin").write_bytes(ardupilot(world(1.0)))
        (self.good / "mine.toml").write_text((READY_FOLDER / "ardupilot-rover.toml").read_text())

    def _stop_a_search(self) -> None:
        """Kill it as soon as it has kept three pieces."""
        child = os.fork()
        if child == 0:
            with contextlib.suppress(BaseException):
                self.must(*SEARCH, "searched")
            os._exit(1)
        while not (self.good / "searched/journal/000003.safetensors").exists():
            assert os.waitpid(child, os.WNOHANG) == (0, 0)
            time.sleep(0.002)
        os.kill(child, 9)
        os.waitpid(child, 0)

    def tidy(self) -> None:
        """Make the copy as the good files are, whatever has taken their places."""
        self.place.mkdir(exist_ok=True)
        now, wanted = snapshot(self.place), snapshot(self.good)
        for name in sorted(now, reverse=True):
            path = self.place / name
            if now[name] != wanted.get(name):
                shutil.rmtree(path) if path.is_dir() and not path.is_symlink() else path.unlink(missing_ok=True)
        for name in sorted(wanted):
            if now.get(name) != wanted[name]:
                path = self.good / name
                (self.place / name).mkdir() if path.is_dir() else shutil.copyfile(path, self.place / name)
        (self.place / "out").mkdir()


def snapshot(folder: Path) -> dict[str, str]:
    """A hash of every file below a folder; folders, pipes and links by what they are."""
    found = {}
    for path in sorted(folder.rglob("*")):
        name, mode = str(path.relative_to(folder)), path.lstat().st_mode
        if "__pycache__" not in path.parts:
            regular, link = stat.S_ISREG(mode), stat.S_ISLNK(mode)
            digest = hashlib.blake2b(path.read_bytes()).hexdigest() if regular else str(stat.S_IFMT(mode))
            found[name] = os.readlink(path) if link else digest
    return found
