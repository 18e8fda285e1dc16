"""States of a room: their words, marks in the journal, and what a model learns of them."""

import subprocess
import sys
from dataclasses import replace
from datetime import UTC, datetime
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from learning_room import dataset, write_pairs
from test_transport import SETUP, TEST, TRAIN, log_mse, model_of_train

from fieldlum.cli import main
from fieldlum.core.errors import InputError, NotEnoughDataError
from fieldlum.core.records import Slot
from fieldlum.core.room_states import merged_state, parse_state
from fieldlum.learn import models
from fieldlum.learn.models.training_data import Dataset, in_usual_room, load_pairs
from fieldlum.learn.transport import fit
from fieldlum.session import Journal, Session, create_session, marks, read_journal


@cache
def clean_mse() -> float:
    return log_mse(model_of_train().predict(TEST.light, TEST.patch_cdm2).luminance_cdm2, TEST)


@pytest.mark.contract
def test_words_are_known_and_usual_values_are_not_written() -> None:
    assert parse_state("lamp=on; blind=half") == ("blind=half", "lamp=on")
    assert parse_state("lamp=off") == parse_state("") == ()
    assert merged_state("lamp=on;blind=down", "lamp=off") == "blind=down"
    for wrong in ("lamp", "lamp=dim", "door=open", "lamp=on;lamp=off"):
        with pytest.raises(ValueError, match="not a state of a room"):
            parse_state(wrong)


def lit(data: Dataset, on: np.ndarray) -> Dataset:
    """The room with a lamp in some hours: 40 cd/m2 more on every pixel, uneven."""
    lamp = 30.0 + 20.0 * np.random.default_rng(0).random(data.shape)
    maps = data.luminance_cdm2 + np.where(on, 1.0, 0.0)[:, None, None] * lamp
    return replace(data, luminance_cdm2=maps.astype(np.float32))


@pytest.mark.slow
@pytest.mark.property
def test_a_lamp_always_on_costs_nothing(tmp_path: Path) -> None:
    """Review, missing test 4: at most 1.2 times the error of the room without a lamp."""
    model = fit(lit(TRAIN, np.ones(len(TRAIN), bool)))
    test = lit(TEST, np.ones(len(TEST), bool))
    assert model.states.always and not model_of_train().states.always
    answer = model.predict(test.light, test.patch_cdm2).luminance_cdm2
    assert log_mse(answer, test) < 1.2 * clean_mse()
    models.save(tmp_path / "m", model, TRAIN)
    off = replace(TEST.light, states=("lamp=off",) * len(TEST))
    dark = models.load(tmp_path / "m").predict(off, TEST.patch_cdm2).luminance_cdm2
    assert log_mse(dark, TEST) < 10.0 * clean_mse()  # the room without its lamp was never captured


@pytest.mark.slow
@pytest.mark.property
def test_a_marked_lamp_is_learnt_and_can_be_switched() -> None:
    on = np.array([t.hour in (16, 17) for t in TRAIN.light.t_utc])
    states = tuple("lamp=on" if hour else "" for hour in on)
    model = fit(replace(lit(TRAIN, on), light=replace(TRAIN.light, states=states)))
    dark = model.predict(TEST.light, TEST.patch_cdm2).luminance_cdm2
    assert log_mse(dark, TEST) < 1.2 * clean_mse()
    test = lit(TEST, np.ones(len(TEST), bool))
    light = replace(TEST.light, states=("lamp=on",) * len(TEST))
    assert log_mse(model.predict(light, TEST.patch_cdm2).luminance_cdm2, test) < 1.2 * clean_mse()


@pytest.mark.analytic
def test_captures_of_a_marked_blind_are_not_learnt() -> None:
    """A blind of two afternoons made DGP of the other hours five times as wrong."""
    n = len(TRAIN)
    states = tuple("blind=half;lamp=on" if k < 4 else "" for k in range(n))
    marked = replace(TRAIN, light=replace(TRAIN.light, states=states))
    usual = in_usual_room(marked)
    assert len(usual) == len(TRAIN) - 4 and not any(usual.light.states or ())
    assert "not learnt: 4 captures marked blind=half; the year" in usual.notes[-1]
    left_out = tuple("use=no" if k < 4 else "" for k in range(len(TRAIN)))
    assert len(in_usual_room(replace(TRAIN, light=replace(TRAIN.light, states=left_out)))) == n - 4
    mostly = ("blind=half",) * (n - 5) + ("",) * 5
    few = in_usual_room(replace(TRAIN, light=replace(TRAIN.light, states=mostly)))
    assert few.notes[-1].startswith("WARNING")
    with pytest.raises(NotEnoughDataError, match="marked blind=half; 2 captures without such"):
        in_usual_room(
            replace(TRAIN, light=replace(TRAIN.light, states=("blind=half",) * (n - 2) + ("",) * 2))
        )
    lamps = replace(TRAIN, light=replace(TRAIN.light, states=("lamp=on",) * len(TRAIN)))
    assert in_usual_room(lamps) is lamps and in_usual_room(TRAIN) is TRAIN
    tinted = ("tint=full",) * (len(TRAIN) - 1) + ("tint=half",)
    most = in_usual_room(replace(TRAIN, light=replace(TRAIN.light, states=tinted)))
    assert len(most) == len(TRAIN) - 1 and most.notes[-1].endswith("in its tint=full")


@pytest.mark.contract
def test_the_column_and_the_marks_are_read_together(tmp_path: Path) -> None:
    data = dataset(("2027-03-20", "2027-06-20"))
    path = write_pairs(tmp_path, data)
    assert load_pairs(path).light.states is None
    lines = path.read_text().splitlines()
    states = ["state", "lamp=on", *[""] * (len(lines) - 2)]
    path.write_text("\n".join(f"{a},{b}" for a, b in zip(lines, states, strict=True)) + "\n")
    journal = Journal(Session(tmp_path))
    journal.append("marked", datetime(2027, 3, 20, tzinfo=UTC), slot="m1", state="blind=half")
    journal.close()
    assert (load_pairs(path).light.states or ())[:3] == ("lamp=on", "blind=half", "")
    path.write_text(path.read_text().replace("lamp=on", "lamp=dim"))
    with pytest.raises(InputError, match=r"line 2: .*lamp=dim.*lamp=off\|on"):
        load_pairs(path)


@pytest.mark.contract
def test_a_slot_is_marked_by_command(tmp_path: Path) -> None:
    slots = [Slot(datetime(2027, 3, 20, 15, tzinfo=UTC), 30.0, 120.0, ())]
    session = create_session(tmp_path / "s", SETUP, slots, {"set": "test"})
    slot = slots[0].id
    for state in ("lamp=on;blind=half", "lamp=off"):
        done = CliRunner().invoke(main, ["status", str(session.root), "--mark", slot, state])
        assert done.exit_code == 0, done.output
    assert marks(session) == {slot: "blind=half"}
    for wrong in ((slot, "lamp=dim"), ("20000101T000000Z", "lamp=on")):
        failed = CliRunner().invoke(main, ["status", str(session.root), "--mark", *wrong])
        assert failed.exit_code != 0 and failed.exception is not None


WRITER = """
import sys
from datetime import UTC, datetime
from functools import cache
from pathlib import Path
from fieldlum.session import Journal, Session
for k in range(60):
    journal = Journal(Session(Path(sys.argv[1])), flush=False)
    journal.append("note", datetime(2027, 1, 1, tzinfo=UTC), who=sys.argv[2], k=k, fill="x" * 3000)
    journal.close()
"""


@pytest.mark.slow
@pytest.mark.contract
def test_two_processes_append_to_one_journal(tmp_path: Path) -> None:
    """Each opens (and looks for a torn tail) while the other writes: no line is lost or cut."""
    writers = [
        subprocess.Popen([sys.executable, "-c", WRITER, str(tmp_path), name]) for name in "ab"
    ]
    assert [writer.wait(60) for writer in writers] == [0, 0]
    events = read_journal(Session(tmp_path))
    for name in "ab":
        assert [event["k"] for event in events if event["who"] == name] == list(range(60))
    assert not (tmp_path / "journal.jsonl.torn").exists()
