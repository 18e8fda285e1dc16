"""Contract: the wheel holds what the tool needs at run time, and the project names no machine
and no package index.
"""

import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

pytestmark = pytest.mark.contract

ROOT = Path(__file__).parents[1]


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> list[str]:
    out = tmp_path_factory.mktemp("wheel")
    command = [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", str(out)]
    subprocess.run(command, cwd=ROOT, check=True, capture_output=True)
    with zipfile.ZipFile(next(out.glob("*.whl"))) as archive:
        return archive.namelist()


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["calibration", "capture_plans"])
def test_the_wheel_ships_every_profile_and_plan(wheel: list[str], kind: str) -> None:
    files = {p.relative_to(ROOT / kind).as_posix() for p in (ROOT / kind).rglob("*") if p.is_file()}
    assert files == {
        name.split(f"_shipped/{kind}/")[1] for name in wheel if f"_shipped/{kind}/" in name
    }


@pytest.mark.slow
def test_the_wheel_holds_every_module_and_the_report_page(wheel: list[str]) -> None:
    modules = {p.relative_to(ROOT).as_posix() for p in (ROOT / "fieldlum").rglob("*.py")}
    assert modules <= set(wheel)
    assert "fieldlum/report/page.html.j2" in wheel


def test_the_asked_for_packages_are_dependencies_and_pinned() -> None:
    asked = [
        "rawpy",
        "opencv-contrib-python-headless",
        "numpy",
        "torch",
        "pvlib",
        "OpenEXR",
        "scikit-image",
        "pyserial",
    ]
    declared = (ROOT / "pyproject.toml").read_text("utf-8")
    pinned = (ROOT / "constraints.txt").read_text("utf-8").lower()
    for name in asked:
        assert f'"{name}>=' in declared
        assert f"\n{name.lower()}==" in pinned
    assert "\ntorch==2.13.0\n" in pinned
