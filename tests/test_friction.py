"""Small things that a trial by new users found: each stays fixed."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from click.testing import CliRunner
from tiny_field import make_session

from fieldlum.capture import import_card
from fieldlum.cli import main
from fieldlum.devices import CameraInfo
from fieldlum.doctor import judge_camera
from fieldlum.errors import InputError
from fieldlum.session import read_journal

pytestmark = pytest.mark.contract

PLANS = Path(__file__).parents[1] / "capture_plans"


@pytest.mark.parametrize("start", ["9999-12-25", "1850-01-01"])
def test_an_absurd_start_is_a_usage_error(start: str, tmp_path: Path) -> None:
    words = ["plan", str(PLANS / "template.toml"), "--set", "9-day", "--start", start]
    shown = CliRunner().invoke(main, [*words, "--out", str(tmp_path / "s")])
    assert shown.exit_code == 2 and "1950 to 2100" in shown.output


def test_info_goes_on_after_a_bad_file(tmp_path: Path) -> None:
    good = str(PLANS / "template.toml")
    shown = CliRunner().invoke(main, ["info", good, str(tmp_path / "missing"), good])
    assert shown.exit_code == 3
    assert shown.output.count("kind                     site") == 2
    assert "no such file" in shown.output


def test_info_of_a_predicted_year(tmp_path: Path) -> None:
    about = {"model": "transport", "hours": 4390, "protection": [{"class": "high"}] * 10}
    (tmp_path / "predict.json").write_text(json.dumps(about), encoding="utf-8")
    shown = CliRunner().invoke(main, ["info", str(tmp_path)])
    assert shown.exit_code == 0
    assert "predicted year" in shown.output and "10 entries" in shown.output


def test_a_maker_is_named_once() -> None:
    info = CameraInfo("gphoto", make="Canon", model="Canon EOS 5D Mark II", serial="7")
    assert judge_camera(info, "gphoto:", 1)[0].text.startswith("Canon EOS 5D Mark II 7 answers")


def test_a_bad_logger_file_is_refused_before_the_card_is_imported(tmp_path: Path) -> None:
    session = make_session(tmp_path / "s")
    card = tmp_path / "card"
    card.mkdir()
    bad = tmp_path / "logger.dat"
    bad.write_text("no logger's file\n1,2\n", encoding="utf-8")
    with pytest.raises(InputError) as caught:
        import_card.run(session, card, logger=bad)
    assert "logger.dat" in str(caught.value)  # and not the empty card, which comes after it
    assert read_journal(session) == []
