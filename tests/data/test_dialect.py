"""CSV as other programs write it: read with a warning, or refused with what to do."""

from __future__ import annotations

import json
import warnings
from pathlib import Path

import pytest
import torch
from small import steady
from small_studies import CART

import steady_ppl as st

PLAIN = "trajectory,time,u.push,y.position\na,0,1.5,2.25\na,0.5,,3\nb,0,0.5,-1e-3\nb,1,,\n"
SEMICOLONS = PLAIN.replace(",", ";")
UNITS = PLAIN.replace("position\n", "position\n-,s,N,m\n")


def write(folder: Path, text: str, encoding: str = "utf-8") -> Path:
    path = folder / "drives.csv"
    path.write_bytes(text.encode(encoding))
    return path


def same(read: st.Trajectories, plain: st.Trajectories) -> None:
    assert (read.labels, read.control_names, read.measurement_names) == (
        plain.labels,
        plain.control_names,
        plain.measurement_names,
    )
    for name in ("time", "controls", "measurements", "observed", "lengths"):
        assert torch.equal(getattr(read, name).nan_to_num(-7.0), getattr(plain, name).nan_to_num(-7.0)), name


HARMLESS = {
    "UTF-16": (PLAIN, "utf-16", "UTF-16"),
    "UTF-16, the other way round": ("\ufeff" + PLAIN, "utf-16-be", "UTF-16"),
    "semicolons": (SEMICOLONS, "utf-8", "semicolons between columns"),
    "tabs": (PLAIN.replace(",", "\t"), "utf-8", "tabs between columns"),
    "decimal commas": (
        SEMICOLONS.replace(".", ",").replace("u,", "u.").replace("y,", "y."),
        "utf-8",
        "semicolons between columns, decimal commas",
    ),
    "blanks": (PLAIN.replace(",time,u.push", ", time , u.push"), "utf-8", "blanks around column names"),
    "comments": ("# made by a logger\n\n% at 10 Hz, too\n" + PLAIN, "utf-8", "2 comment lines before the header"),
    "a last separator": (PLAIN.replace("\n", ",\n"), "utf-8", "a separator at the end of every row"),
    "a last separator of rows alone": (
        PLAIN.replace("\n", ",\n").replace("position,", "position"),
        "utf-8",
        "a separator at the end of every row",
    ),
    "several at once": (
        "#\r\n" + SEMICOLONS.replace("time", " time").replace("\n", ";\r\n"),
        "utf-16",
        "UTF-16, 1 comment line before the header, semicolons between columns, "
        "a separator at the end of every row, blanks around column names",
    ),
}


@pytest.mark.parametrize("name", list(HARMLESS))
def test_what_is_harmless_is_read_and_told(tmp_path: Path, name: str) -> None:
    text, encoding, told = HARMLESS[name]
    path = write(tmp_path, text, encoding)
    with pytest.warns(st.TableWarning) as caught:
        read = st.read_table(path)
    assert [str(one.message) for one in caught] == [f"drives.csv: read with {told}"]
    same(read, st.read_table(write(tmp_path, PLAIN)))


@pytest.mark.parametrize("text", [PLAIN, "\ufeff" + PLAIN, PLAIN.replace("\n", "\r\n"), PLAIN.replace("a,", "# a,")])
def test_of_what_is_as_it_should_be_nothing_is_said(tmp_path: Path, text: str) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert len(st.read_table(write(tmp_path, text))) == 2


def test_a_row_of_units_is_named_and_read_where_it_was_announced(tmp_path: Path) -> None:
    path = write(tmp_path, UNITS)
    with pytest.raises(st.DataError, match=r"row 1: it looks like a row of units \(-, s, N, m\).*--units-row"):
        st.read_table(path)
    with pytest.warns(st.TableWarning, match=r"read with a row of units \(-, s, N, m\)"):
        read = st.read_table(path, units_row=True)
    with pytest.raises(st.DataError, match="row 1 has no units"):
        st.read_table(write(tmp_path, PLAIN), units_row=True)
    same(read, st.read_table(path))


@pytest.mark.parametrize("text", [PLAIN.replace("a,0,1.5,2.25", "a,zero,1.5,2.25"), UNITS.partition("b,")[0][:60]])
def test_a_row_with_a_wrong_cell_is_no_row_of_units(tmp_path: Path, text: str) -> None:
    with pytest.raises(st.DataError) as caught:
        st.read_table(write(tmp_path, text))
    assert "row of units" not in str(caught.value)


def test_a_column_of_thousands_separators_is_refused(tmp_path: Path) -> None:
    """1.234,5 may be one number or another."""
    path = write(tmp_path, SEMICOLONS.replace("2.25", "1.234,5"))
    with pytest.raises(st.DataError, match="got '1.234,5', expected a finite number"):
        st.read_table(path)


def test_a_name_that_ends_with_a_blank_is_not_written_as_csv(tmp_path: Path) -> None:
    time = torch.arange(3.0)
    drives = st.from_arrays([{"time": time, "y.range ": time}])
    st.write_table(drives, tmp_path / "drives.parquet")
    with pytest.raises(st.DataError, match="column y.range : a name ends with a blank"):
        st.write_table(drives, tmp_path / "drives.csv")


def test_a_record_says_that_the_table_had_units(tmp_path: Path) -> None:
    """Else its command, typed again, is refused."""
    plain = st.simulate(st.load_program(CART), 2, seed=1)
    st.write_table(plain, tmp_path / "drives.csv")
    header, _, rest = (tmp_path / "drives.csv").read_text().partition("\n")
    names = header.split(",")
    (tmp_path / "drives.csv").write_text(f"{header}\n{','.join('s' for _ in names)}\n{rest}")
    words = ("fit", CART, tmp_path / "drives.csv", "--recipe", "hand", "--out", tmp_path / "run")
    assert steady(*words, "--units-row") == 0
    assert "--units-row" in json.loads((tmp_path / "run/run.json").read_text())["command"]


def test_the_command_line_says_once_how_a_table_was_read(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = write(tmp_path, UNITS.replace("time", " time"))
    words = ("data", "cut", path, "--seconds", "60", "--out", tmp_path / "pieces.csv")
    assert steady(*words) == 2
    assert "--units-row" in capsys.readouterr().err
    assert steady(*words, "--units-row") == 0
    told = capsys.readouterr().err
    assert told.count("read with blanks around column names, a row of units (-, s, N, m)") == 1
    assert steady(*words, "--units-row", "-q", "--force") in (0, 2) and "read with" not in capsys.readouterr().err
