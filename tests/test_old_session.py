"""Contract: a session of 0.1.0 opens unchanged, and its suns count once.

tests/fixtures/session-0.1.0 was simulated, merged and paired by 0.1.0: seven hours, panoramas of
24 x 12, frames left out. Its `pair` wrote three suns into their panoramas; one stayed clipped.
"""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from fieldlum import pair
from fieldlum.cli import main
from fieldlum.learn.models.training_data import load_pairs
from fieldlum.session import Session, open_session
from fieldlum.year.glare.picture_glare import picture_glare

pytestmark = pytest.mark.contract

FIXTURE = Path(__file__).parent / "fixtures" / "session-0.1.0"
# What 0.1.0 trained on [lx]: discs of merge, then three completed by `pair`, then a clipped one.
DISC_LX = (535.884, 1055.7, 908.478, 9734.28, 28614.0, 8285.53, 408.911)


@pytest.fixture
def session(tmp_path: Path) -> Session:
    shutil.copytree(FIXTURE, tmp_path / "s")
    return open_session(tmp_path / "s")


def run(*arguments: object) -> str:
    result = CliRunner().invoke(main, [str(text) for text in arguments])
    assert result.exit_code == 0, result.output
    return result.stdout


def test_status_and_training_data_are_those_of_then(session: Session) -> None:
    status = json.loads(run("status", session.root, "--json"))
    assert (status["merge"]["done"], status["pair"]["usable"]) == (7, 7)
    data = load_pairs(session)
    assert data.disc_lx == pytest.approx(DISC_LX) and data.patch_cdm2 is not None
    assert data.slots == tuple(path.stem for path in session.panorama_files())  # as --mark expects
    assert [note for note in data.notes if "lower bound" in note]


@pytest.mark.slow
def test_pair_leaves_panoramas_and_counts_each_sun_once(session: Session) -> None:
    before = {path: path.read_bytes() for path in session.panorama_files()}
    run("pair", session.root)
    assert {path: path.read_bytes() for path in session.panorama_files()} == before
    assert load_pairs(session).disc_lx == pytest.approx(DISC_LX, rel=0.01)
    assert all(p.ok for p in pair.run(session))


@pytest.mark.slow
def test_glare_is_the_same_before_and_after_pair(session: Session) -> None:
    """The completed sun of 28 614 lx is in Ev once; a clipped one is labelled."""
    completed, clipped = (
        session.panorama(slot) for slot in ("20271221T193000Z", "20271222T203000Z")
    )
    ev = [picture_glare(completed)["views"][0]["ev_lx"]]
    run("pair", session.root)
    ev.append(picture_glare(completed)["views"][0]["ev_lx"])
    assert ev[0] == pytest.approx(ev[1], rel=0.01) and ev[0] > 15_000.0
    assert "lower bounds" in picture_glare(clipped)["warnings"][0]


@pytest.mark.slow
def test_train_learns_from_it(session: Session) -> None:
    answer = json.loads(run("train", session.root, "--model", "nearest", "--json"))
    assert answer["chosen"] == "nearest" and np.isfinite(answer["models"][0]["rer_weighted"])
    assert json.loads(run("train", session.root, "--model", "nearest", "--json"))["kept"]
