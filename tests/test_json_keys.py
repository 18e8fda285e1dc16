"""Contract: keys that `--json` prints are only ever added."""

import json
from pathlib import Path

import pytest
from json_answers import KEPT, answers, keys_of

pytestmark = pytest.mark.contract

NAMED = {  # the keys that other programs are known to read
    "merge --frames": {
        "quality.frames[].file",
        "quality.neighbours[].long",
        "quality.neighbours[].short",
        "quality.neighbours[].residual_percent",
        "quality.neighbours[].pixels",
    },
    "glare": {"views[].dgp", "views[].ev_lx"},
    "train": {"models[].log10_mse_weighted", "models[].paper_rer", "chosen"},
}


def test_keys_of_nested_answers() -> None:
    assert keys_of({"a": [{"b": 1}, {"c": {"d": 2}}]}) == ["a", "a[].b", "a[].c", "a[].c.d"]


@pytest.mark.slow
def test_no_key_is_lost(tmp_path: Path) -> None:
    kept = json.loads(KEPT.read_text(encoding="utf-8"))
    found = answers(tmp_path)
    lost = {name: sorted(set(keys) - set(found[name])) for name, keys in kept.items()}
    assert not {name: keys for name, keys in lost.items() if keys}
    assert all(NAMED[name] <= set(found[name]) for name in NAMED)
