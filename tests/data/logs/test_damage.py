"""Logs that are cut short or damaged are read as far as they are whole, or refused in a line."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from log_writing import Sent, ulog
from rover_logs import ardupilot, px4, world

from steady_ppl import DataError, LogColumn, LogMapping, SteadyError, Trajectories, read_logs
from steady_ppl.data.logs.log import entries
from steady_ppl.data.logs.read import open_log
from steady_ppl.data.recordings.listing import listing

TRUTH = world(2.0)
WHOLE = {"px4": px4(TRUTH), "ardupilot": ardupilot(TRUTH)}
NAMES = {"px4": "px4-rover", "ardupilot": "ardupilot-rover"}
FORMATS = pytest.mark.parametrize("kind", list(WHOLE))


def read(folder: Path, kind: str, content: bytes) -> tuple[Trajectories | None, list[str]]:
    """The table of a log, None where it is refused, and what was said."""
    file, said = folder / "drive", list[str]()
    file.write_bytes(content)
    try:
        return read_logs([file], LogMapping.read(NAMES[kind]), said.append), said
    except SteadyError as error:
        return None, [*said, str(error)]


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("logs")


@FORMATS
def test_a_log_that_is_cut_short_is_read_up_to_there(place: Path, kind: str) -> None:
    """What is left of it are rows of the whole one, and how many bytes were not read is said."""
    whole, said = read(place, kind, WHOLE[kind])
    assert whole is not None and not any("cut short" in line for line in said)
    cut, said = read(place, kind, WHOLE[kind][:-1500])
    assert cut is not None and 10 < cut.lengths[0] < whole.lengths[0]
    rows = int(cut.lengths[0]) - 1  # the last may have other neighbours
    both = cut.observed[:rows, 0] & whole.observed[:rows, 0]
    assert (cut.measurements[:rows, 0][both] == whole.measurements[:rows, 0][both]).all()
    (line,) = [line for line in said if "cut short" in line]
    assert re.fullmatch(r"drive: it is cut short.* after 1\.\d{3} s: the last \d+ bytes are not read", line)


@FORMATS
@pytest.mark.parametrize("behind", range(1, 34))
def test_the_bytes_of_a_message_that_is_cut_are_counted(place: Path, kind: str, behind: int) -> None:
    """Some bytes of another message, which has 34 or more, after the last."""
    more = (b"\x40\x00D" if kind == "px4" else b"\xa3\x95\x82") + bytes(40)
    whole, said = read(place, kind, WHOLE[kind] + more[:behind])
    expected = f"s: the last {behind} byte{'s' if behind > 1 else ''} are not read"
    (line,) = [line for line in said if "cut short" in line]
    assert whole is not None and line.endswith(expected) and "after 1.9" in line


@FORMATS
def test_damage_inside_is_said_and_the_rest_is_read(place: Path, kind: str) -> None:
    content = bytearray(WHOLE[kind])
    at = len(content) // 2
    content[at : at + 300] = bytes(300)
    data, said = read(place, kind, bytes(content))
    assert data is not None and (data.lengths[0] == 21 or kind == "px4")
    assert any("it is damaged" in line for line in said)


def test_the_bytes_that_are_no_message_are_counted(place: Path) -> None:
    content = WHOLE["ardupilot"]
    at = content.index(b"\xa3\x95\x82", len(content) // 2)
    data, said = read(place, "ardupilot", content[:at] + b"noise" + content[at:])
    assert data is not None and int(data.lengths[0]) == 21
    assert "drive: it is damaged in 1 place: 5 bytes there are no message and are not read" in said


@FORMATS
def test_a_log_cut_anywhere_is_a_table_or_a_line(place: Path, kind: str) -> None:
    """Every 13th of the first 300 bytes, and every 1999th of the others."""
    tables = 0
    for at in [*range(0, 300, 13), *range(300, len(WHOLE[kind]), 1999)]:
        data, said = read(place, kind, WHOLE[kind][:at])
        tables += data is not None
        assert data is not None or (said[-1].startswith("drive") and "\n" not in said[-1]), said
    assert tables > 3


@FORMATS
@settings(max_examples=60)
@given(data=st.data())
def test_a_damaged_log_is_a_table_or_a_line(place: Path, kind: str, data: st.DataObject) -> None:
    content = bytearray(WHOLE[kind])
    for bit in data.draw(st.lists(st.integers(0, 8 * len(content) - 1), min_size=1, max_size=40)):
        content[bit // 8] ^= 1 << bit % 8
    head = data.draw(st.integers(0, 2500))
    content[head : head + data.draw(st.integers(0, 4))] = data.draw(st.binary(max_size=4))
    found, said = read(place, kind, bytes(content))
    assert found is not None or ("\n" not in said[-1] and said[-1].startswith(("drive", "no trajectory"))), said
    try:
        log = open_log(place / "drive")
    except SteadyError:
        return
    assert listing([(log.name, entries(log))])


@pytest.mark.parametrize(
    ("content", "says"),
    [
        (b"", "drive: is no PX4 ULog (.ulg) and no binary ArduPilot DataFlash log (.bin): it is empty"),
        (b"FMT, 128, 89, FMT, BBnNZ", "it begins with 46 4d 54 2c 20 31 32"),
        (b"ULog\x01\x12\x35", "drive: cannot be read, is it damaged or cut short? (ULogException: Invalid file format"),
        (b"\xa3\x95\x80", "drive: cannot be read, it defines no message (FMT); is it damaged or cut short?"),
        (ulog([]), "drive: cannot be read, it has no message; is it damaged or cut short?"),
    ],
)
def test_what_is_no_log_is_refused(place: Path, content: bytes, says: str) -> None:
    data, said = read(place, "px4", content)
    assert data is None and len(said) == 1 and says in said[0]


def test_a_folder_and_a_missing_file_are_refused(tmp_path: Path) -> None:
    mapping = LogMapping((LogColumn("y.a", "a", "b"),), 0.1)
    with pytest.raises(DataError, match="is a folder: expected a file"):
        read_logs([tmp_path], mapping)
    with pytest.raises(DataError, match="nowhere.bin: cannot be read: No such file or directory"):
        read_logs([tmp_path / "nowhere.bin"], mapping)


def test_times_and_positions_that_cannot_be_are_left_out(tmp_path: Path) -> None:
    stamps = np.array([100_000, 2**60, 300_000, 400_000], dtype=np.uint64)
    place = {"lat": ("double", [47.0, 47.0, 1e9, 47.0]), "lon": ("double", [8.0] * 4)}
    (tmp_path / "d.ulg").write_bytes(ulog([Sent("gps", {"timestamp": ("uint64_t", stamps)} | place)]))
    said: list[str] = []
    north = LogColumn("y.n", "gps", "lat lon", reading="north")
    data = read_logs([tmp_path / "d.ulg"], LogMapping((north,), 0.1), said.append)
    assert data.lengths.tolist() == [4] and data.observed[:, 0, 0].tolist() == [True, False, False, True]
    assert "d.ulg: gps: 1 of 4 messages without a time on clock 'log' are left out" in said
