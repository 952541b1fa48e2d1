"""Pieces of a long computation, kept so that it can go on."""

from __future__ import annotations

from pathlib import Path

import torch

from steady_ppl.utils.journal import close_journal, journal, journaled


def pieces(made: list[int], count: int, closed_after: int | None = None) -> list[float]:
    """So many pieces, and which were made anew."""
    found = []
    for number in range(count):
        if number == closed_after:
            close_journal()

        def compute(number: int = number):
            made.append(number)
            return {"value": torch.tensor(float(number))}, {}

        found.append(float(journaled(compute)[0]["value"]))
    return found


def test_a_journal_goes_when_all_went_well(tmp_path: Path) -> None:
    with journal(tmp_path / "journal"):
        assert pieces([], 2) == [0.0, 1.0]
        assert len(list((tmp_path / "journal").iterdir())) == 2
    assert not (tmp_path / "journal").exists()


def test_a_closed_journal_stays_as_it_is_and_is_gone_on_with(tmp_path: Path) -> None:
    with journal(tmp_path / "journal"):
        assert pieces([], 4, closed_after=2) == [0.0, 1.0, 2.0, 3.0]
    assert len(list((tmp_path / "journal").iterdir())) == 2
    made: list[int] = []
    with journal(tmp_path / "journal"):
        assert pieces(made, 4) == [0.0, 1.0, 2.0, 3.0]
    assert made == [2, 3] and not (tmp_path / "journal").exists()


def test_without_a_journal_nothing_is_closed() -> None:
    close_journal()
    assert pieces([], 1) == [0.0]
