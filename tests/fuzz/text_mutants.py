"""What can be wrong in a mapping, a study, a message definition, and in the words of a command."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from hypothesis import strategies as st
from mutants import Change, of_a_line, of_lines, of_text
from table_mutants import CELLS, NAMES

VALUES = (
    "0", "-1", "nan", "inf", "-inf", "1e300", "1e-300", "1e-9", "true", "''", "[]", "{}", "1979-05-27", "12:00:00",
    "'x'", "9223372036854775807", "99999999999999999999999", "[[[[1]]]]", "'\\u0000'", "'../../etc'", "'/dev/zero'",
    "'<script>'", "[1, 'a']", "{a = {b = {c = 1}}}", "0x7f", "'linear.x[99999999999999999999]'", "'yaw'", "'header'",
)  # fmt: skip
KEYS = ("late", "scale", "offset", "between", "longest", "clock", "as", "field", "step", "colour")
SECTIONS = (
    "[columns]", "[columns.u.speed]", '[columns."<script>"]', '[columns."y.\\u001b[2J"]', "[[columns]]", "[step]",
    '[columns."y."]', f'[columns."y.{"n" * 10_000}"]', '[columns.""]', '[columns."y.range"]', "[a.b.c.d]",
)  # fmt: skip
DEFINITIONS = (
    "boat_msgs/Battery self\n", "float64[99999999999] many\n", "float64[-1] none\n", "nowhere/Type a\n", "=\n",
    "float64 a\n" * 3, f"float64 a{'b' * 100_000}\n", "string<=5 s\nfloat64[<=3] v\n", "int8 X=300\n", "# nothing\n",
    "\n".join(f"float64 a{i}" for i in range(20_000)), "float64 \x1b[31m\n", "float64 class\n",
)  # fmt: skip
values = st.sampled_from(VALUES) | st.integers().map(str) | st.floats().map(str)


def _at(number: int, line: str) -> Change:
    return of_lines(lambda draw, lines: [*lines[:number], line, *lines[number + 1 :]])


def _behind(*more: str) -> Change:
    return of_lines(lambda draw, lines: [*lines, *more])


TOML: Mapping[str, Change] = {
    "another value": of_a_line(
        lambda draw, line: [f"{line.partition('=')[0]}= {draw(values)}"], lambda line: "=" in line
    ),
    "one more key": of_a_line(lambda draw, line: [f"{draw(st.sampled_from(KEYS))} = {draw(values)}", line]),
    "a line lost": of_a_line(lambda draw, line: []),
    "another section": of_a_line(
        lambda draw, line: [draw(st.sampled_from(SECTIONS))], lambda line: line.startswith("[")
    ),
    "lines shuffled": of_lines(lambda draw, lines: draw(st.permutations(lines))),
    "nested 10,000 deep": _at(0, f"step = {'[' * 10_000}{']' * 10_000}"),
    "tables 10,000 deep": _behind(f"[{'.'.join(['a'] * 10_000)}]"),
    "a number of 10,000 digits": _at(0, f"step = {'9' * 10_000}"),
    "10,000 columns": _behind(
        *(f'[columns."y.c{i}"]\ntopic = "/scan"\nfield = "ranges[0]"' for i in range(10_000)),
    ),
    "messages from the root": _at(1, 'messages = ["/proc/self"]'),
    "messages without end": _at(1, 'messages = ["/dev/zero"]'),
    "steps of a nanosecond": _at(0, "step = 1e-9"),
    "late by an age": _behind("late = 1e300"),
}
DEFINITION: Mapping[str, Change] = {
    "another definition": of_text(lambda draw, text: draw(st.sampled_from(DEFINITIONS)))
}

PLACES = ("--out", "--json", "--mask", "--picture")  # what follows is written to: a person means it
OPTIONS = ("--seed", "--simulations", "--draws", "--set", "--effect", "--map", "--step", "--valid", "--guide", "--x")
odd_words = st.one_of(
    st.sampled_from([word for word in (*CELLS, *NAMES) if "\0" not in word]),
    st.sampled_from(("wind=", "wind=nan", "=1", "wind=1,2,3,4", "stiffness=1e300", "stiffness==1", "a=b=c", "--", "-")),
    st.text(st.characters(exclude_characters="\0"), max_size=9).filter(lambda word: not word.isdecimal()),
)


@st.composite
def spellings(draw: st.DrawFn, words: Sequence[str]) -> tuple[str, ...]:
    """A command, one word of which is another one, lost or twice, or with an option more; what it writes to stays."""
    mine = [i for i in range(1, len(words)) if words[i] not in PLACES and words[i - 1] not in PLACES]
    at = draw(st.sampled_from(mine))
    now = draw(st.sampled_from(("another", "lost", "twice", "an option more")))
    put = {"another": (draw(odd_words),), "lost": (), "twice": (words[at],) * 2}
    if now == "an option more":
        return (*words, draw(st.sampled_from(OPTIONS)), draw(odd_words))
    return (*words[:at], *put[now], *words[at + 1 :])
