"""One printer of tables: numbers to the right, texts to the left, gaps as a dash."""

import pytest

from fieldlum.cli.terminal import table_lines


@pytest.mark.contract
def test_a_table_is_aligned_and_leaves_empty_columns_out() -> None:
    rows = [{"name": "mean", "error": 0.25, "n": 3}, {"name": "transport", "error": None, "n": 12}]
    columns = {"name": ("model", "<"), "error": ("error", ".2e"), "x": ("x", "d"), "n": ("n", "d")}
    assert table_lines(rows, columns, "  ") == [
        "  model         error   n",
        "  mean       2.50e-01   3",
        "  transport         -  12",
    ]
