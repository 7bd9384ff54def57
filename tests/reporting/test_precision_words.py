"""What is said of data cells that are to be known with a given precision."""

from ctid_cli.inference.monte_carlo import CellPrecision, Widest
from ctid_cli.reporting.precision_words import LISTED, block_sentence, precision_lines, precision_table


def percentage(half_width):
    return Widest("search", {}, "none", "percent", None, half_width, 1.0)


def cell(state="enough", level=5.0, needed=613, widest=None):
    return CellPrecision("c", {"snr_db": level}, state, needed if state != "open" else 490, needed, widest)


RMSE = Widest("search", {"order": 2}, "3", "rmse", "delay", 0.0812, 0.05)


def test_a_block_says_what_is_farthest_from_what_was_asked():
    cells = [cell(), cell("open", 15.0, widest=percentage(1.2)), cell("open", 20.0, widest=RMSE)]
    text = "2 of 3 data cells need more data sets, up to 613; widest interval: "
    assert (
        block_sentence(cells) == text + "snr_db = 20, rmse of delay (search, order = 2, start 3): ± 8.12 %, ± 5 % asked"
    )
    # A measure that is not known at all is farther than any other.
    unknown = cell("open", 1.0, widest=percentage(None))
    assert "snr_db = 1, percentage (search): not known, ± 1 points asked" in block_sentence([*cells, unknown])


def test_a_summary_names_the_cells_that_are_not_precise_enough():
    assert precision_lines([]) == precision_lines([cell(), cell("open")]) == []
    (line,) = precision_lines([cell(needed=200), cell()])
    assert line == "200 to 613 data sets in each data cell: all intervals are as narrow as asked for"
    missed = [cell("at_most", k, 5000, percentage(1.1 + k)) for k in range(LISTED + 2)]
    first, *listed, last = precision_lines([cell(), *missed])
    assert first == f"{LISTED + 2} of {LISTED + 3} data cells ended at 5000 data sets with wider intervals:"
    assert listed[0] == "  snr_db = 6, percentage (search): ± 7.1 points, ± 1 points asked"
    assert (len(listed), last) == (LISTED, "  and 2 more")


def test_the_table_shows_every_cell():
    cells = [cell(widest=percentage(0.9)), cell("open", 15.0), cell("at_most", 20.0, widest=RMSE)]
    lines = precision_table(cells).draw().splitlines()
    assert [line.rsplit("  ", 1)[1].strip() for line in lines[2:]] == ["precise enough", "goes on", "at_most reached"]
    assert lines[3].split()[:6] == ["15", "490", "613", "-", "-", "-"]
