"""Tables fit the terminal; numbers stay whole."""

import pytest
from rich.console import Console

from wlr_gym.cli.terminal import print_table

SCORES = ("0.276 ± 0.092", "0.578 ± 0.149", "12.3 ± 4.56")
NAMES = ("velocity_slip_aware", "slip_compensating_no_camera", "pid")


def lines(width, *arguments, **others):
    console = Console(width=width)
    with console.capture() as captured:
        print_table(console, *arguments, **others)
    return captured.get().splitlines()


@pytest.mark.parametrize("width", [60, 80, 100])
def test_numbers_stay_whole_in_any_width(width):
    rows = [("tracking_error_transient", "-", *SCORES), ("power", "W", *SCORES)]
    printed = lines(width, ("metric", "unit", *NAMES), rows, "scores")
    assert max(map(len, printed)) <= width
    assert all(sum(score in line for line in printed) == 2 for score in SCORES)


def test_what_does_not_fit_follows_below_with_the_first_column():
    printed = lines(60, ("metric", *NAMES, "blind"), [("tracking_error_transient", *SCORES, "0.1 ± 0.2")])
    starts = [line for line in printed if line.startswith("tracking_error_transient")]
    assert len(starts) == 2
    assert "0.1 ± 0.2" in starts[1]


def test_words_are_wrapped_and_a_number_keeps_its_unit():
    text = "78 rad/s of the wheel, error 0.5 ± 0.25 m beside [0.25, 0.75] and more words than fit in one line of 60"
    printed = lines(60, ("what", "why"), [("a name", text), ("another", "short")])
    assert max(map(len, printed)) <= 60
    assert all(any(kept in line for line in printed) for kept in ("78 rad/s", "0.5 ± 0.25 m", "[0.25, 0.75]"))


def test_a_narrow_table_is_as_wide_as_its_cells_and_aligns_numbers():
    printed = lines(80, ("name", "value"), [("a", "1.5 s"), ("b", "120 s"), ("c", "-")])
    assert printed == ["name  value", "a     1.5 s", "b     120 s", "c         -", ""]


@pytest.mark.parametrize("text", ["/a/folder/" + 12 * "long_name_" + "end.yaml", "[" + 30 * "word " + "end]"])
def test_nothing_is_cut_where_a_word_is_wider_than_the_terminal(text):
    printed = lines(40, ("what", "where"), [("one", text)])
    assert max(map(len, printed)) <= 40
    assert text.replace(" ", "") in "".join("".join(line[5:].split()) for line in printed)
