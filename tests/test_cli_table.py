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
        "  mean       0.250   3     23457",
        "  transport      -  12  2.35e-05",
    ]
    assert table_lines(rows, names, "  ") == expected
    assert table_lines(rows, indent="  ") == expected
    assert table_lines([]) == []


@pytest.mark.contract
def test_an_angle_keeps_its_tenth() -> None:
    assert table_lines([{"azimuth_deg": 202.5}, {"azimuth_deg": 180.0}])[1:] == [
        "      202.5",
        "        180",
    ]
