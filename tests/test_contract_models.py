"""Contract: a model is a module and one entry of the registry; every stage finds it there."""

from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from learning_room import dataset

from fieldlum.cli import main
from fieldlum.learn import models
from fieldlum.learn.model_kinds import MODELS

pytestmark = pytest.mark.contract

DAYS = ("2027-03-20", "2027-06-21", "2027-12-21")
QUICK = [name for name, kind in MODELS.items() if not kind.slow]


@pytest.mark.parametrize("name", QUICK)
def test_a_model_comes_back_from_its_folder(name: str, tmp_path: Path) -> None:
    data = dataset(DAYS, height=6)
    fitted = models.fit(name, data, patch="absolute", seed=0)
    models.save(tmp_path, fitted, data, patch="absolute")
    again = models.load(tmp_path)
    assert again.name == fitted.name == name
    maps = [model.predict(data.light, data.patch_cdm2).luminance_cdm2 for model in (fitted, again)]
    assert maps[0].shape == (len(data), 6, 12)
    np.testing.assert_array_equal(maps[0], maps[1])
    assert isinstance(models.read_config(tmp_path).state["with_patch"], bool)


def test_the_baselines_are_tried_first() -> None:
    assert [kind.baseline for kind in MODELS.values()] == [True, True, False, False]


def test_the_docs_have_a_section_and_a_row_for_every_model() -> None:
    text = (Path(__file__).parents[1] / "docs" / "models.md").read_text(encoding="utf-8")
    assert [name for name in MODELS if f"\n## {name}\n" not in text] == []
    assert [name for name in MODELS if f"\n| {name} |" not in text] == []


@pytest.mark.parametrize("command", ["train", "bench"])
def test_every_model_is_offered(command: str) -> None:
    text = CliRunner().invoke(main, [command, "--help"]).output
    assert not [name for name in MODELS if name not in text]
