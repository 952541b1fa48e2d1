"""Progress adds up, and costs nothing where nobody listens."""

from __future__ import annotations

import pytest

from steady_ppl.utils.progress import listening, stages


def test_stages_inside_a_stage_divide_its_share() -> None:
    heard: list[tuple[str, float]] = []
    with listening(lambda doing, share: heard.append((doing, share))):
        with stages(("a", 1), ("b", 3)) as begin:
            begin()
            begin()
            with stages(("c", 1), ("d", 1)) as inner:
                inner()
                inner()
        with stages(("e", 1)) as begin:
            begin()
    assert heard == [("a", 0.0), ("b", 0.25), ("b: c", 0.25), ("b: d", 0.625), ("", 1.0), ("e", 0.0), ("", 1.0)]


def broken() -> None:
    with stages(("x", 1)) as begin:
        begin()
        raise ValueError("broken")


def test_a_stage_that_fails_leaves_the_outer_one_as_it_was() -> None:
    heard: list[tuple[str, float]] = []
    with listening(lambda doing, share: heard.append((doing, share))), stages(("a", 1), ("b", 1)) as begin:
        begin()
        with pytest.raises(ValueError, match="broken"):
            broken()
        begin()
    assert heard == [("a", 0.0), ("a: x", 0.0), ("b", 0.5), ("", 1.0)]


def test_a_stage_without_a_name_is_no_end() -> None:
    heard: list[tuple[str, float]] = []
    with listening(lambda doing, share: heard.append((doing, share))), stages(("", 1), ("b", 1)) as begin:
        begin()
        with stages(("a", 1)) as inner:
            inner()
        begin()
    assert heard == [("", 0.0), ("a", 0.0), ("b", 0.5), ("", 1.0)]


def test_nobody_need_listen() -> None:
    with stages(("a", 1)) as begin:
        begin()
