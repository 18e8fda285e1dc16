"""A computer that only captures: its commands run without torch, pyradiance and numba."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import pytest

pytestmark = pytest.mark.contract

ROOT = Path(__file__).parents[1]
# A finder that knows no such package: an entry of None in sys.modules confuses scipy.
BLOCKED = """
import sys


class Blocked:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in ("numba", "torch", "pyradiance"):
            raise ModuleNotFoundError(f"No module named '{name}'", name=name)


sys.meta_path.insert(0, Blocked())
import json
from click.testing import CliRunner
from fieldlum.cli import main
answers = []
for words in json.loads(sys.argv[1]):
    shown = CliRunner().invoke(main, words, prog_name="fieldlum")
    error = shown.exception
    if error is not None and not isinstance(error, SystemExit):
        raise error
    answers.append((shown.exit_code, shown.stdout, shown.stderr))
print(json.dumps(answers))
"""


def _run(folder: Path, *commands: Sequence[str]) -> list[tuple[int, str, str]]:
    """Run commands in one process; return the exit code, stdout and stderr of each."""
    done = subprocess.run(
        [sys.executable, "-c", BLOCKED, json.dumps(commands)],
        cwd=folder,
        capture_output=True,
        text=True,
        check=False,
        timeout=300,
        env=dict(os.environ),
    )
    assert done.returncode == 0, done.stderr
    return [tuple(answer) for answer in json.loads(done.stdout)]


@pytest.mark.slow
def test_plan_to_status_without_torch_and_pyradiance(tmp_path: Path) -> None:
    """A midwinter day of few hours, and its card imported into a second session."""
    site = tmp_path / "site.toml"
    site.write_text(
        '[site]\nname = "north"\nlatitude_deg = 65.5\nlongitude_deg = 25.0\n'
        'timezone = "Europe/Helsinki"\n',
        encoding="utf-8",
    )
    day = ("--set", "month", "--start", "2027-12-21", "--days", "1")
    sim = "sim:office?seed=1"
    commands = (
        (("plan", str(site), *day, "--out", "s"), 0),
        (("plan", str(site), *day, "--out", "other"), 0),
        (("doctor", "s", "--camera", sim, "--pyranometer", sim), None),
        (("capture", "s", "--camera", sim, "--pyranometer", sim, "--clock", "fast"), 0),
        (("import", "other", "s/raw"), 0),
        (("plan", "s", "--replan"), 0),
        (("status", "s", "--json"), 0),
        (("status", "other"), 0),
        (("log", "--help"), 0),
        (("watch", "nowhere"), 3),
    )
    answers = _run(tmp_path, *(words for words, _ in commands))
    for (words, expected), (code, _, errors) in zip(commands, answers, strict=True):
        assert expected is None or code == expected, (words, errors)
    assert ", 0 to do" in answers[7][1]


@pytest.mark.slow
def test_a_command_that_needs_more_says_what_to_install(tmp_path: Path) -> None:
    site = ROOT / "capture_plans" / "seattle-office.toml"
    simulate = "simulate", str(site), "--out", "s", "--set", "4-day"
    ((code, _, errors),) = _run(tmp_path, simulate)
    assert code == 3 and "pip install '.[compute]'" in errors
    assert not (tmp_path / "s").exists()


@pytest.mark.slow
def test_modules_of_the_page_import_without_them() -> None:
    code = (
        "import sys\nfor n in ('numba', 'torch', 'pyradiance'): sys.modules[n] = None\n"
        "import fieldlum.web.server, fieldlum.devices.rpicam, fieldlum.capture.runner\n"
        "import fieldlum.capture.notify, fieldlum.capture.irradiance_log, fieldlum.plan\n"
        "import fieldlum.capture.doctor, fieldlum.capture.import_card\n"
        "import fieldlum.cli.watch_command, fieldlum.cli.log_command"
    )
    subprocess.run([sys.executable, "-c", code], check=True, timeout=120)


@pytest.mark.skipif(shutil.which("dpkg") is None, reason="a check of the marker's word")
def test_the_marker_names_the_small_computer() -> None:
    declared = (ROOT / "pyproject.toml").read_text("utf-8")
    for name in ("numba>=0.61", "torch>=2.6", "pyradiance>=1.2"):
        assert f"\"{name}; platform_machine != 'aarch64'\"" in declared
