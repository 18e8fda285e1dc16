"""Small things that a trial by new users found: each stays fixed."""

from __future__ import annotations

import json
import os
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from tiny_field import make_session

from fieldlum.capture import import_card
from fieldlum.capture.doctor import judge_camera
from fieldlum.cli import main, terminal
from fieldlum.core.errors import InputError
from fieldlum.core.records import Panorama
from fieldlum.devices import CameraInfo
from fieldlum.optics.images import write_panorama, write_radiance_hdr
from fieldlum.session import read_journal, sole_user

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


def test_info_of_a_panorama_without_light_is_an_error(tmp_path: Path) -> None:
    path = tmp_path / "dark.exr"
    write_panorama(path, Panorama(np.full((8, 16), np.nan, np.float32), 0.0))
    shown = CliRunner().invoke(main, ["info", str(path)])
    assert shown.exit_code == 3 and "no finite luminance" in shown.output


def test_info_of_a_predicted_year(tmp_path: Path) -> None:
    about = {
        "model": "transport",
        "hours": 4390,
        "protection": [{"class": "high", "hours": 7}] * 10,
    }
    (tmp_path / "predict.json").write_text(json.dumps(about), encoding="utf-8")
    shown = CliRunner().invoke(main, ["info", str(tmp_path)])
    assert shown.exit_code == 0
    assert "predicted year" in shown.output and shown.output.count("class high, hours 7") == 10


def test_a_long_command_states_its_time_in_a_log(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    now = iter([0.0, 1.0, 30.0, 90.0, 100.0, 200.0, 300.0])
    monkeypatch.setattr(terminal.time, "monotonic", lambda: next(now))
    with terminal.progress("predict") as show:
        for done in (0, 1, 3, 4, 6, 2):
            show(done, 12, "next model")
    # analytic: after the first, two more in 60 s leave 270 s for nine, five in 170 s 204 s for six
    lines = capsys.readouterr().err.splitlines()
    assert lines == [
        "predict: 1 of 12 (next model)",  # its time has the start-up
        "predict: 3 of 12, about 4.5 min left",
        "predict: 6 of 12, about 3.4 min left",
        "predict: 2 of 12 (next model)",  # work of several parts has no known end
    ]


def test_a_second_capture_is_told_the_process_of_the_first(tmp_path: Path) -> None:
    session = make_session(tmp_path / "s")
    with (
        sole_user(session, "capture"),
        pytest.raises(
            InputError, match=rf"fieldlum \(process {os.getpid()}\) captures or imports into"
        ),
        sole_user(session, "capture"),
    ):
        pass


@pytest.mark.slow
def test_doctor_draws_the_room(tmp_path: Path) -> None:
    words = ["plan", str(PLANS / "seattle-office.toml"), "--set", "9-day"]
    planned = CliRunner().invoke(main, [*words, "--out", str(tmp_path / "s")])
    assert f"next: fieldlum doctor {tmp_path / 's'}" in planned.output
    assert "solar noon on the first day is at 1" in planned.output  # 12:18 PST or 13:17 PDT
    shown = CliRunner().invoke(main, ["doctor", str(tmp_path / "s")])
    assert "check windows, camera and north" in shown.output
    assert (tmp_path / "s" / "room.svg").read_text(encoding="utf-8").startswith("<svg")


def test_control_codes_of_a_file_name_do_not_reach_the_terminal(tmp_path: Path) -> None:
    name = str(tmp_path / "a\x1b]0;title\x07.toml")
    shown = CliRunner().invoke(main, ["info", name])
    assert shown.exit_code == 3
    assert shown.output.isprintable() or shown.output.rstrip("\n").isprintable()


def test_an_endless_file_is_refused(tmp_path: Path) -> None:
    endless = Path("/dev/zero")
    if not endless.exists():
        pytest.skip("no /dev/zero here")
    words = ["plan", str(endless), "--set", "9-day", "--out", str(tmp_path / "s")]
    shown = CliRunner().invoke(main, words)
    assert shown.exit_code == 3 and "a pipe, socket or device" in shown.output


def test_a_black_picture_is_doubted(tmp_path: Path) -> None:
    path = tmp_path / "black.hdr"
    view = "-vta -vd 0 -1 0 -vu 0 0 1 -vv 180 -vh 180"
    write_radiance_hdr(path, np.zeros((64, 64), np.float32), view=view)
    shown = CliRunner().invoke(main, ["glare", str(path)])
    assert "the picture has no light" in shown.output


def test_a_maker_is_named_once() -> None:
    info = CameraInfo("gphoto", make="Canon", model="Canon EOS 5D Mark II", serial="7")
    assert next(iter(judge_camera(info, "gphoto:", 1))).text.startswith(
        "Canon EOS 5D Mark II 7 answers"
    )


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
