"""What a search has found, and what it could have been as well."""

from __future__ import annotations

from steady_ppl.discovery.search import Found


def test_a_class_begins_with_what_was_chosen():
    """Also where another gains more, whose own test says nothing."""

    class Stub:
        against_its_sign = False

        def __init__(self, total):
            self.total = total

    more, chosen, near, far = Stub(10.5), Stub(10.0), Stub(8.5), Stub(7.0)
    found = Found(chosen, [more, chosen, near, far], None)
    assert found.aliases == [chosen, more, near]
