"""One printer of tables: numbers to the right, texts to the left, gaps as a dash."""

import pytest

from fieldlum.cli.terminal import table_lines


@pytest.mark.contract
def test_a_table_is_aligned_and_leaves_empty_columns_out() -> None:
    rows = [
        {"name": "mean", "error": 0.25, "n": 3, "ev_lx": 23456.7},
        {"name": "transport", "error": None, "n": 12, "ev_lx": 2.34567e-5},
    ]
    names = ("name", "error", "x", "n", "ev_lx")
    expected = [
        "  name       error   n     ev_lx",
        "  mean       0.250   3  2.35e+04",
        "  transport      -  12  2.35e-05",
    ]
    assert table_lines(rows, names, "  ") == expected
    assert table_lines(rows, indent="  ") == expected
    assert table_lines([]) == []


@pytest.mark.contract
def test_the_numbers_of_a_column_have_equal_decimals() -> None:
    for values, shown in (
        ([202.5, 180.0, 0.0], ["202.5", "180.0", "0.0"]),
        ([23456.7, 12.0], ["23457", "12"]),
        ([9.5, 0.25], ["9.50", "0.25"]),
        ([0.254, 0.25], ["0.254", "0.250"]),
        ([0.0463, 0.000579], ["0.0463", "0.000579"]),
    ):
        lines = table_lines([{"x": value} for value in values])[1:]
        assert [line.strip() for line in lines] == shown
