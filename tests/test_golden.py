"""The whole chain on twelve small brackets gives the stored results.

A change that only moves code leaves them equal. After an intended change, renew them:
`python tests/golden_chain.py`.
"""

import json
from pathlib import Path

import pytest
from golden_chain import STORED, differences, run_chain, summarise


@pytest.mark.slow
@pytest.mark.contract
def test_the_chain_gives_the_stored_results(tmp_path: Path) -> None:
    current = json.loads(json.dumps(summarise(run_chain(tmp_path))))
    stored = json.loads(STORED.read_text(encoding="utf-8"))
    assert differences(stored, current) == []


@pytest.mark.slow
@pytest.mark.analytic
def test_a_difference_is_reported_with_its_place() -> None:
    stored = {"pairs": [{"dni_wm2": 100.0, "ok": 1}], "chosen": "transport"}
    close = {"pairs": [{"dni_wm2": 100.2, "ok": 1}], "chosen": "transport"}
    assert differences(stored, close) == []
    other = {"pairs": [{"dni_wm2": 101.0, "ok": 1}], "chosen": "dense"}
    assert differences(stored, other) == [
        ".pairs[0].dni_wm2: 100.0 -> 101.0",
        ".chosen: transport -> dense",
    ]
    assert differences(stored, {"pairs": []})[1:] == [".chosen: transport -> None"]
