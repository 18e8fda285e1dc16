"""devices: what loggers leave behind, brought into a session."""

from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest
from click.testing import CliRunner

from fieldlum.cli import main
from fieldlum.core.errors import InputError
from fieldlum.core.records import Exposure, Site, SiteFile, Slot
from fieldlum.devices.logger_files import read_logger_file
from fieldlum.session import create_session, day_files, open_session, read_day

pytestmark = pytest.mark.contract

TOA5 = (
    '"TOA5","Roof","CR1000X","12345","OS","prog","9","T"\n"TIMESTAMP","RECORD","GHI_Avg"\n"TS","RN","W/m^2"\n'
    '"","","Avg"\n"2027-03-20 08:00:00",100,512.3\n"2027-03-20 08:01:00",102,513.1\n'
)
CSV = (
    "t_utc,ghi_wm2,dhi_wm2,note\n2027-03-20T16:01:00Z,510,88.5,a\n"
    "2027-03-20T08:00:00-08:00,509.5,,b\nx,1,2,c\n"
)


def test_toa5_and_csv_tell_the_same_moment(tmp_path: Path) -> None:
    (tmp_path / "a.dat").write_text(TOA5)
    (tmp_path / "b.csv").write_text(CSV)
    toa5 = read_logger_file(tmp_path / "a.dat", timedelta(hours=-8))
    plain = read_logger_file(tmp_path / "b.csv")
    assert toa5.samples[0].t_utc == plain.samples[0].t_utc == datetime(2027, 3, 20, 16, tzinfo=UTC)
    assert (plain.samples[0].ghi_wm2, plain.samples[0].dhi_wm2) == (509.5, None)
    assert toa5.left_out == ()
    assert len(plain.left_out) == 1 and plain.left_out[0].startswith("line 4")


@pytest.mark.parametrize("title", ["", "Stasie;UCT dak;;\n", "Stasie: UCT dak\n"])
@pytest.mark.parametrize("names", ["time;ghi_wm2;x;y", "Tyd (SAST);ghi_wm2;x;y"])
def test_a_padded_title_and_a_foreign_time_column_are_read(
    tmp_path: Path, title: str, names: str
) -> None:
    path = tmp_path / "a.csv"
    path.write_text(f"{title}{names}\n20/03/2027 12:00;800,5;1;2\n20/03/2027 12:01;801;1;2\n")
    asked = {"time": "Tyd (SAST)"} if "Tyd" in names else None
    read = read_logger_file(path, timedelta(hours=2), asked)
    assert read.samples[0].t_utc == datetime(2027, 3, 20, 10, tzinfo=UTC)
    assert [sample.ghi_wm2 for sample in read.samples] == [800.5, 801.0]
    with pytest.raises(InputError, match=r"no column Zeit.*after --column"):
        read_logger_file(path, timedelta(hours=2), {"time": "Zeit"})


@pytest.mark.parametrize(
    ("names", "asked", "hour"),
    [
        ("t_utc;x;ghi_wm2", "t_utc", 12),
        ("Tyd UTC;x;ghi_wm2", "Tyd UTC", 12),
        ("datetime;Tyd;ghi_wm2", "Tyd", 11),
        ("Begin Tyd;Tyd;ghi_wm2", "tyd", 11),
        ("Zeit;;\nx;Zeit;ghi_wm2", "Zeit", 11),
    ],
)
def test_the_named_time_column_is_used_with_its_zone(
    tmp_path: Path, names: str, asked: str, hour: int
) -> None:
    """The second column is an hour later than the first; the logger's clock is UTC+2."""
    path = tmp_path / "a.csv"
    path.write_text(f"{names}\n2027-03-20 12:00;2027-03-20 13:00;800\n")
    read = read_logger_file(path, timedelta(hours=2), {"time": asked})
    assert read.samples[0].t_utc == datetime(2027, 3, 20, hour, tzinfo=UTC)


@pytest.mark.parametrize(
    ("zone", "offset_min"),
    [("-08:00", -480), ("-0800", -480), ("+0530", 330), ("+530", 330), ("-8", -480), ("+10", 600)],
)
def test_the_zone_of_a_column_is_in_hours_and_minutes(
    tmp_path: Path, zone: str, offset_min: int
) -> None:
    path = tmp_path / "a.csv"
    path.write_text(f"time UTC{zone},ghi_wm2\n2027-06-20 12:00,800\n")
    noon = datetime(2027, 6, 20, 12, tzinfo=UTC)
    assert read_logger_file(path).samples[0].t_utc == noon - timedelta(minutes=offset_min)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("time UTC+1500,ghi_wm2\n2027-06-20 12:00,1\n", "the time zone .1500 in time UTC.1500"),
        (TOA5, "times without a time zone"),
        (CSV.replace("Z", "").replace("t_utc", "time"), "times without a time zone"),
        ("t_utc,volts\n1,2\n", "columns t_utc, volts"),
        (
            "t_utc,ghi_wm2\n2027-03-20T16:00:00Z,many\n",
            "no row could be read: line 2: ghi_wm2 is 'many'",
        ),
        ("", "an empty file"),
        (
            't_utc,ghi_wm2\n2027-03-20T16:00:00Z,"5,1"\n',
            "ghi_wm2 is '5,1', expected a number with a decimal point",
        ),
        (
            "time,ghi_wm2\n20.3.7 16:00,5.1\n",
            r"time '20.3.7 16:00', expected one like 2027-03-20T16:00:00Z",
        ),
        ("\0\0\0", "a binary file, or UTF-16 without its byte order mark"),
    ],
)
def test_bad_files_are_told(tmp_path: Path, text: str, said: str) -> None:
    (tmp_path / "f.csv").write_text(text)
    with pytest.raises(InputError, match=said):
        read_logger_file(tmp_path / "f.csv")
    (tmp_path / "f.csv").write_bytes(CSV.encode("utf-16"))
    (tmp_path / "g.csv").write_text(CSV)
    assert read_logger_file(tmp_path / "f.csv") == read_logger_file(tmp_path / "g.csv")
    with pytest.raises(InputError, match="No such file"):
        read_logger_file(tmp_path / "none.csv")


def test_import_puts_them_into_day_files_once(tmp_path: Path) -> None:
    slot = Slot(datetime(2027, 3, 20, 16, 30, tzinfo=UTC), 30.0, 180.0, (Exposure(0.01, 5.6),))
    create_session(tmp_path / "s", SiteFile(Site("x", 47.6, -122.3)), [slot], {"set": "test"})
    (tmp_path / "a.dat").write_text(TOA5)
    asked = [
        "import",
        str(tmp_path / "s"),
        "--irradiance",
        str(tmp_path / "a.dat"),
        "--utc-offset",
        "-08:00",
    ]
    for _ in range(2):
        done = CliRunner().invoke(main, asked)
        assert done.exit_code == 0, done.output
    samples, broken = read_day(day_files(open_session(tmp_path / "s"))[0])
    assert [s.ghi_wm2 for s in samples] == [512.3, 513.1] and not broken
    assert CliRunner().invoke(main, ["import", str(tmp_path / "s")]).exit_code == 2
