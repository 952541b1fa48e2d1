"""Ready mappings and those of one's own, and one clear line for everything wrong with them."""

from __future__ import annotations

import tomllib
from pathlib import Path

import pytest
from rover_logs import ardupilot, px4, world
from small import steady

from steady_ppl import LogColumn, LogMapping, UsageError
from steady_ppl.data.logs.mapping import READY, READY_FOLDER

TRUTH = world(1.0)


@pytest.fixture
def log(tmp_path: Path) -> Path:
    (tmp_path / "drive.ulg").write_bytes(px4(TRUTH))
    return tmp_path / "drive.ulg"


@pytest.mark.parametrize("name", READY)
def test_a_ready_mapping_is_printed_and_reads_the_same_from_a_file(tmp_path: Path, capsys, name: str) -> None:
    assert steady("import-log", name) == 0
    (tmp_path / "mine.toml").write_text(capsys.readouterr().out)
    mapping = LogMapping.read(name)
    assert LogMapping.read(tmp_path / "mine.toml") == mapping
    assert {column.name for column in mapping.columns} >= {"y.gps_x", "y.gps_y", "y.compass", "y.gyro"}
    assert tomllib.loads((READY_FOLDER / f"{name}.toml").read_text())["step"] == 0.1


def test_the_help_names_the_ready_mappings(capsys) -> None:
    assert steady("import-log", "--help") == 0
    words = capsys.readouterr().out.replace(",", " ").replace(".", " ").split()
    assert set(READY) <= set(words)


def test_a_ready_mapping_with_other_words(tmp_path: Path, log: Path) -> None:
    words = ("--map", "y.height=vehicle_gps_position:fix_type,when=fix_type>=3", "--step", 0.2)
    assert steady("import-log", log, "px4-rover", *words, "--out", tmp_path / "t.csv") == 0
    assert "y.height" in (tmp_path / "t.csv").read_text().partition("\n")[0]


def test_the_list_is_a_mapping_to_start_from(tmp_path: Path, log: Path, capsys) -> None:
    (tmp_path / "drive.bin").write_bytes(ardupilot(TRUTH))
    assert steady("import-log", log, tmp_path / "drive.bin") == 0
    out = capsys.readouterr().out
    for says in (
        "# drive.ulg  PX4 ULog\n",
        "# vehicle_attitude  20 messages  ",
        "#     timestamp, timestamp_sample, q[0…3]\n",
        "# drive.bin  ArduPilot DataFlash\n",
        "# GPS[1]  10 messages  10 Hz\n",
        '# [columns."y.actuator_motors_control_0"]\n# topic = "actuator_motors"\n# field = "control[0]"\n',
    ):
        assert says in out
    assert tomllib.loads(out) == {"step": 0.1}


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("y.a=vehicle_attitud:q", "drive.ulg has no such topic; did you mean vehicle_attitude"),
        ("y.a=vehicle_gps_position[2]:lat", "did you mean vehicle_gps_position[1]"),
        ("y.a=vehicle_attitude:qq", "vehicle_attitude has no field qq; it has timestamp, timestamp_sample, q[0]"),
        ("y.a=vehicle_attitude:q", "vehicle_attitude has no field q; name an element, such as q[0]"),
        ("y.a=vehicle_gps_position:latitude_deg,as=east", "as east takes 2 fields, got 1"),
        ("y.a=vehicle_attitude:q q,as=yaw", "as yaw takes 1 or 4 fields, got 2"),
        ("y.a=vehicle_attitude:q[0] q[1]", "a number is 1 fields, got 2"),
        ("y.a=vehicle_attitude:q[0],clock=gps", 'it has no clock "gps"; expected "log" or "sample"'),
        ("y.a=vehicle_gps_position:lon,as=south", "as is 'south', expected \"angle\" or \"degrees\""),
        ("y.a=vehicle_gps_position:fix_type,when=fix_type", "when: 'fix_type' is no condition: expected FIELD"),
        ("y.a=vehicle_gps_position:fix_type,when=fix>=3", "there is no number fix; did you mean fix_type"),
        ("y.a=vehicle_gps_position:fix_type,when=fix_type>=e", "is no condition"),
        ("y.a=vehicle_gps_position:lat|", "is not spelt as one"),
    ],
)  # fmt: skip
def test_a_bad_column_is_refused(tmp_path: Path, log: Path, refused, text: str, says: str) -> None:
    refused(2, says, "import-log", log, "--map", text, "--step", 0.1, "--out", tmp_path / "t.csv")


def test_text_is_refused(tmp_path: Path, refused) -> None:
    (tmp_path / "drive.bin").write_bytes(ardupilot(TRUTH))
    words = ("--map", "y.a=MSG:Message", "--step", 0.1, "--out", tmp_path / "t.csv")
    refused(2, "expected a number, Message is text", "import-log", tmp_path / "drive.bin", *words)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("armed = 3", "armed is 3, expected text"),
        ("armed = 'ArmState == 1'", "armed: 'ArmState == 1': expected TOPIC: FIELD SIGN NUMBER"),
        ("armed = 'ARM: ArmState = 1'", "armed: ' ArmState = 1' is no condition"),
        ("origin = 47.0", "origin is 47.0, expected a latitude and a longitude in degrees"),
        ("origin = [97.0, 8.0]", "origin is [97.0, 8.0], expected a latitude"),
        ("messages = []", "unknown key messages; there are step, columns, armed, origin"),
    ],
)
def test_a_bad_file_is_refused(tmp_path: Path, log: Path, refused, text: str, says: str) -> None:
    mapping = f"step = 0.1\n{text}\n[columns.'y.a']\ntopic = 'vehicle_attitude'\nfield = 'q[0]'\n"
    (tmp_path / "mine.toml").write_text(mapping)
    refused(2, says, "import-log", log, tmp_path / "mine.toml", "--out", tmp_path / "t.csv")


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        ((), "Missing argument"),
        (
            ("px4-rover", "px4-boat"),
            "import-log needs at least one LOG and at most one mapping: a .toml, or a",
        ),
        (("drive.ulg", "px4-rover"), "name the table to write: --out TABLE"),
        (("drive.ulg", "--out", "t.csv"), "name what to take from the log, by a mapping or --map"),
        (("drive.ulg", "px4-plane", "--out", "t.csv"), "name what to take from the log"),
        (("drive.ulg", "mine.toml", "--out", "t.csv"), "mine.toml cannot be read: No such file"),
        (("drive.ulg", "drive.ulg", "px4-rover", "--out", "t.csv"), "two logs are named drive"),
        (
            ("drive.ulg", "ardupilot-rover", "--out", "t.csv"),
            "column u.throttle, topic RCOU, field C3: drive.ulg has",
        ),
    ],
)
def test_bad_usage_is_one_line(tmp_path: Path, monkeypatch, log: Path, refused, arguments, says: str) -> None:
    monkeypatch.chdir(tmp_path)
    refused(2, says, "import-log", *arguments)


def test_a_mapping_built_in_python_is_judged_like_a_file() -> None:
    with pytest.raises(UsageError, match="clock is 'bag'"):
        LogColumn("y.a", "a", "b", clock="bag")
    assert LogColumn("y.a", "a", "b").clock == "log"
    assert LogColumn("y.a", "a", "lat lon | a b", reading="east").choices == [["lat", "lon"], ["a", "b"]]
