"""Random streams keyed by what they are for."""

from __future__ import annotations

import pytest
import torch

from steady_ppl import seeded


def draw(*key: int | str) -> tuple[float, ...]:
    with seeded(*key):
        return tuple(torch.rand(4).tolist())


def test_equal_keys_give_equal_draws_whatever_was_drawn_before():
    first = draw(3, "estep", 17)
    torch.rand(11)
    assert draw(3, "estep", 17) == first


def test_every_part_of_a_key_and_their_order_matter():
    keys = [(0,), (1,), ("a",), ("b",), (0, "a"), (1, "a"), ("a", 1), ("a", 2), ("a", "b"), ("b", "a"), (2**40, "a")]
    assert len({draw(*key) for key in keys}) == len(keys)


def test_the_callers_generator_is_left_as_it_was():
    torch.manual_seed(5)
    expected = torch.rand(2)
    torch.manual_seed(5)
    with seeded("inner"):
        torch.rand(100)
    assert torch.equal(torch.rand(2), expected)


def test_the_callers_generator_is_left_as_it_was_after_an_error():
    before = torch.get_rng_state()
    with pytest.raises(RuntimeError, match="shape"), seeded("inner"):
        torch.rand(100).view(3, 3)
    assert torch.equal(torch.get_rng_state(), before)


def test_blocks_nest():
    outer = draw("outer")
    with seeded("outer"):
        start = torch.rand(2).tolist()
        assert draw("inner") == draw("inner")
        assert (*start, *torch.rand(2).tolist()) == outer
