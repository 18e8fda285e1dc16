"""Training data: strict reading, the sun's disc by energy."""

import re
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import OpenEXR
import pytest
from learning_room import SITE_TOML, dataset, write_pairs

import fieldlum
from fieldlum.core.errors import Caution, InputError, NotEnoughDataError
from fieldlum.core.records import Flag, Panorama
from fieldlum.learn.models import training_data
from fieldlum.learn.models.training_data import _discs, load_pairs
from fieldlum.optics.images import write_panorama, write_radiance_hdr
from fieldlum.optics.projection import equirect_rays
from fieldlum.sky.picture_axes import sun_elsewhere, wrong_axes
from fieldlum.sky.sun import clearsky, horizontal_beam
from fieldlum.sky.sun_disc import add_disc

DATA = dataset(("2027-03-20", "2027-06-21"))


@pytest.fixture
def pairs(tmp_path: Path) -> Path:
    return write_pairs(tmp_path, DATA)


@pytest.mark.contract
def test_what_was_written_is_read(pairs: Path) -> None:
    data = load_pairs(pairs)
    assert data.slots == DATA.slots and data.heading_deg == 180.0
    np.testing.assert_allclose(data.luminance_cdm2, DATA.luminance_cdm2, rtol=1e-6)
    np.testing.assert_allclose(data.light.sun_azimuth_deg, DATA.light.sun_azimuth_deg, rtol=1e-8)
    assert [str(day) for day in np.unique(data.days)] == ["2027-03-20", "2027-06-21"]


@pytest.mark.contract
@pytest.mark.parametrize(
    ("column", "text", "said"),
    [
        ("dni_wm2", "much", "line 3: dni_wm2 = 'much', not a number"),
        ("dhi_wm2", "", "line 3: no entry 'dhi_wm2'"),
        ("dni_wm2", "5000", "line 3: dni_wm2 is '5000'"),
        ("dni_wm2", "nan", "line 3: dni_wm2 = nan, not finite"),
        ("t_utc", "2027-03-20 12:00", "line 3: time '2027-03-20 12:00' has no time zone"),
        ("panorama", "gone.exr", "line 3: no file"),
        ("sunpatch", "", "line 3: the cell of column sunpatch is empty, but not in other rows"),
    ],
)
def test_a_bad_cell_is_named_with_its_line(pairs: Path, column: str, text: str, said: str) -> None:
    lines = pairs.read_text().splitlines()
    cells = lines[2].split(",")
    cells[lines[0].split(",").index(column)] = text
    lines[2] = ",".join(cells)
    pairs.write_text("\n".join(lines))
    with pytest.raises(InputError) as caught:
        load_pairs(pairs)
    assert said in str(caught.value) and caught.value.exit_code == 3


@pytest.mark.contract
@pytest.mark.parametrize(
    ("column", "change", "said"),
    [
        ("panorama", lambda _: "m0.exr", "lines 2 and 3 have the same panorama"),
        (
            "t_utc",
            lambda text: text.replace("Z", "+01:00"),
            "line 3: sun at altitude",
        ),  # a clock in summer time
        ("sun_azimuth_deg", lambda text: str(float(text) + 15.0), "line 3: sun at altitude"),
        (
            "dhi_wm2",
            lambda _: "1200",
            "DHI 1200 W/m2 with the sun at 30 deg; expected possible irradiance in W/m2; check "
            "whether the column contains global",
        ),
        (
            "dni_wm2",
            lambda _: "1500",
            "line 3 has more direct light than above the atmosphere: DNI",
        ),
    ],
)
def test_rows_that_contradict_each_other_are_named(
    pairs: Path, column: str, change, said: str
) -> None:
    """What an edited or a joined table gets wrong would be learned without a word."""
    lines = pairs.read_text().splitlines()
    cells = lines[2].split(",")
    at = lines[0].split(",").index(column)
    cells[at] = change(cells[at])
    lines[2] = ",".join(cells)
    pairs.write_text("\n".join(lines))
    with pytest.raises(InputError) as caught:
        load_pairs(pairs)
    assert said in str(caught.value)


@pytest.mark.contract
@pytest.mark.parametrize(
    ("name", "said"), [("m3.exr", "merge all brackets at one size"), ("p3.exr", "pair again")]
)
def test_a_picture_of_another_size_says_what_to_do(pairs: Path, name: str, said: str) -> None:
    write_panorama(pairs.parent / name, Panorama(np.ones((24, 48), np.float32), 180.0))
    with pytest.raises(InputError, match=said):
        load_pairs(pairs)


@pytest.mark.contract
def test_a_row_twice_kilowatts_and_semicolons_are_refused(pairs: Path) -> None:
    text = pairs.read_text()
    pairs.write_text(text.rstrip() + "\n" + text.splitlines()[1] + "\n")
    with pytest.raises(InputError, match=f"lines 2 and {len(DATA) + 2} have the same t_utc"):
        load_pairs(pairs)
    rows = [line.split(",") for line in text.splitlines()]
    kilowatts = [
        [*row[:2], *(str(float(cell) / 1e3) for cell in row[2:4]), *row[4:]] for row in rows[1:]
    ]
    pairs.write_text("\n".join(",".join(row) for row in (rows[0], *kilowatts)))
    with pytest.raises(InputError, match="the column contains kW/m2"):
        load_pairs(pairs)
    pairs.write_text(text.replace(",", ";").replace(".", ","))
    with pytest.raises(InputError, match="separated by ';'; expected commas"):
        load_pairs(pairs)


@pytest.mark.contract
def test_what_spreadsheets_do_is_read(pairs: Path) -> None:
    """A BOM, Windows line ends, another order of rows and full paths change nothing."""
    before = load_pairs(pairs)
    head, *rows = pairs.read_text().splitlines()
    rows = [row.replace(",m", f",{pairs.parent}/m") for row in rows[::-1]]
    pairs.write_bytes(("\ufeff" + "\r\n".join([head, *rows]) + "\r\n").encode())
    after = load_pairs(pairs)
    assert after.slots == before.slots
    np.testing.assert_array_equal(after.luminance_cdm2, before.luminance_cdm2)


@pytest.mark.contract
def test_a_heading_in_a_radiance_picture_is_obeyed(pairs: Path) -> None:
    """A rendering that says where it faces is not turned to the site's heading."""
    for k in range(len(DATA)):
        write_radiance_hdr(pairs.parent / f"m{k}.hdr", DATA.luminance_cdm2[k], heading_deg=90.0)
    lines = [line.split(",") for line in pairs.read_text().splitlines()]
    at = lines[0].index("sunpatch")
    rows = [",".join(cells[:at] + cells[at + 1 :]).replace(".exr", ".hdr") for cells in lines]
    pairs.write_text("\n".join(rows))
    assert load_pairs(pairs).heading_deg == 90.0
    write_radiance_hdr(pairs.parent / "m3.hdr", DATA.luminance_cdm2[3])
    with pytest.raises(InputError, match=r"m3\.hdr: a heading of 180 deg; expected 90 deg"):
        load_pairs(pairs)


@pytest.mark.contract
def test_rows_that_are_not_ok_are_left_out_and_counted(pairs: Path) -> None:
    text = pairs.read_text().splitlines()
    pairs.write_text("\n".join([text[0], *(line[:-1] + "0" for line in text[1:3]), *text[3:]]))
    data = load_pairs(pairs)
    assert len(data) == len(DATA) - 2 and "2 rows with ok = 0" in data.notes[0]
    pairs.write_text("\n".join([text[0], *(line[:-1] + "0" for line in text[1:])]))
    with pytest.raises(NotEnoughDataError):
        load_pairs(pairs)


@pytest.mark.contract
def test_a_missing_column_a_missing_site_and_another_size_are_errors(pairs: Path) -> None:
    write_panorama(pairs.parent / "m3.exr", Panorama(np.ones((4, 8), np.float32), 180.0))
    with pytest.raises(InputError, match="8 x 4 pixels"):
        load_pairs(pairs)
    (pairs.parent / "site.toml").unlink()
    with pytest.raises(InputError, match="no site file belongs to this csv"):
        load_pairs(pairs)
    pairs.write_text("t_utc,dni_wm2\n")
    (pairs.parent / "site.toml").write_text(
        '[site]\nname = "x"\nlatitude_deg = 1\nlongitude_deg = 1\n'
    )
    with pytest.raises(InputError, match="no column panorama, dhi_wm2"):
        load_pairs(pairs)


@pytest.mark.contract
def test_pixels_that_no_lens_saw_are_not_learned_from(pairs: Path) -> None:
    for k in range(len(DATA)):
        flags = np.zeros(DATA.shape, np.uint16)
        flags[-2:] = Flag.OUTSIDE_LENS
        write_panorama(
            pairs.parent / f"m{k}.exr", Panorama(DATA.luminance_cdm2[k], 180.0, flags=flags)
        )
    data = load_pairs(pairs)
    assert not data.seen[-2:].any() and data.seen[:-2].all()
    assert data.weights[-2:].max() == 0.0 and data.weights[data.seen].mean() == pytest.approx(1.0)


@pytest.mark.analytic
def test_thin_maps_keep_pixels_where_they_were() -> None:
    """The centre of every third pixel is the centre of a pixel three times as large."""
    data = dataset(("2027-03-20",), height=12)
    small = data.thin(4)
    assert small.shape == (4, 8) and data.thin(12).shape == data.shape
    np.testing.assert_allclose(
        equirect_rays(12, 24, 180.0)[1::3, 1::3], equirect_rays(4, 8, 180.0), atol=1e-12
    )
    np.testing.assert_array_equal(small.luminance_cdm2, data.luminance_cdm2[:, 1::3, 1::3])


@pytest.mark.property
def test_discs_of_adjacent_days_in_the_same_pixel_count_once_for_the_pose() -> None:
    """They have the same error: three days leave a place as uncertain as one."""
    weights = []
    for days in (("2027-06-21",), ("2027-06-20", "2027-06-21", "2027-06-22")):
        data = dataset(days, height=36)
        shown = np.stack([data.light.apparent_altitude_deg, data.light.sun_azimuth_deg], axis=1)
        discs = _discs(replace(data, disc_deg=shown))
        assert len(discs) == len(data)
        weights.append((discs.sigma_deg**-2).sum())
    assert weights[1] == pytest.approx(weights[0], rel=0.02)


@pytest.mark.analytic
@pytest.mark.parametrize(
    ("change", "said"),
    [
        ("none", ""),
        (
            "turned",
            "turned by 7. degrees; expected .* the middle; set heading_deg = 10[789],",
        ),
        ("upside down", "that is upside down; expected the zenith on top"),
        ("about its axis", "that is turned about its axis by 180; expected the zenith on top"),
        ("mirrored", "WARNING: .* mirrored left to right: mirror the pictures"),
    ],
)
def test_pictures_with_other_axes_are_found_by_their_suns(
    tmp_path: Path, change: str, said: str
) -> None:
    """Panoramas of other programs may be mirrored, upside down, or begin elsewhere."""
    data = dataset(("2027-03-20", "2027-06-21"), height=48)
    light = data.light
    high = (light.apparent_altitude_deg > 15.0) & (light.direct_lx > 1e4)
    assert high.sum() > 3
    disc_lx = np.where(high, 0.7 * light.direct_lx, 0.0)
    maps = add_disc(data.luminance_cdm2, light, disc_lx, data.heading_deg)
    maps = {
        "none": maps,
        "turned": np.roll(maps, round(70 / 360 * 96), axis=2),
        "upside down": maps[:, ::-1],
        "about its axis": maps[:, ::-1, ::-1],
        "mirrored": maps[:, :, ::-1],
    }[change]
    path = write_pairs(tmp_path, replace(data, luminance_cdm2=maps), sun_in_map=True)
    if said.startswith("WARNING") or not said:
        notes = " ".join(load_pairs(path).notes)
        assert re.search(said, notes) if said else "the sun's disc in" not in notes
    else:
        with pytest.raises(InputError, match=said):
            load_pairs(path)


@pytest.mark.analytic
def test_a_single_clipped_spot_is_a_sun_elsewhere() -> None:
    """Without a filter the disc is clipped, and its energy is not known."""
    light, clipped = np.full((90, 180), 1e3, np.float32), np.zeros((90, 180), bool)
    light[29:31, 119:121], clipped[29:31, 119:121] = 1e5, True
    at = sun_elsewhere(light, 180.0, 8e4, clipped, 29.0)
    assert at == pytest.approx((30.0, 240.0), abs=1.0)
    assert sun_elsewhere(light[::-1], 180.0, 8e4, clipped[::-1], 29.0) is None  # in a desk
    clipped[40:60, 20:50] = True
    assert sun_elsewhere(light, 180.0, 8e4, clipped, 29.0) is None


@pytest.mark.contract
@pytest.mark.parametrize(
    ("dhi", "factor", "said"),
    [
        ("dhi_wm2", 1.0, ""),
        ("dhi_wm2", 1.4, "global is 1.40 times diffuse plus direct on the horizontal"),
        ("ghi_wm2", 1.0, "times the light above the atmosphere|global is 0"),
        ("ghi_wm2", np.nan, "times the light above the atmosphere"),
    ],
)
def test_exchanged_columns_of_irradiance_are_named(
    pairs: Path, dhi: str, factor: float, said: str
) -> None:
    """A global irradiance in the column of another component is a possible value of each."""
    light = DATA.light
    clear = clearsky(light.t_utc, DATA.setup.site)
    columns = {"dni_wm2": clear.dni_wm2, "dhi_wm2": clear.dhi_wm2}
    beam = horizontal_beam(clear.dni_wm2, light.sun_altitude_deg)
    columns["ghi_wm2"] = clear.dhi_wm2 + beam
    head, *rows = (line.split(",") for line in pairs.read_text().splitlines())
    for k, row in enumerate(rows):
        row[2:4] = f"{columns['dni_wm2'][k]:.1f}", f"{columns[dhi][k]:.1f}"
        row.append(f"{factor * columns['ghi_wm2'][k]:.1f}".replace("nan", ""))
    pairs.write_text("\n".join(",".join(row) for row in ([*head, "ghi_wm2"], *rows)))
    if said:
        with pytest.raises(InputError, match=said):
            load_pairs(pairs)
    else:
        assert len(load_pairs(pairs)) == len(DATA)


@pytest.mark.analytic
@pytest.mark.parametrize(("hours_deg", "sure"), [((0.0, 0.3), False), ((0.0, 30.0), True)])
def test_a_mirror_at_one_time_of_the_day_is_no_turn(
    hours_deg: tuple[float, ...], sure: bool
) -> None:
    """On consecutive days a mirror, a facade of glass or a lamp stands at the same place."""
    suns = np.array([(30.0, 150.0 + by) for by in hours_deg])
    wrong = wrong_axes(suns, suns + np.array([0.0, 60.0]), 180.0, 225)
    assert wrong is not None and wrong.sure is sure
    assert ("unless a mirror shows the sun" in wrong.remedy) is not sure
    in_mirror = np.array([(30.0, 350.0 - azimuth) for _, azimuth in suns])
    mirrored = wrong_axes(suns, in_mirror, 180.0, 225)
    assert mirrored is not None and not mirrored.sure


@pytest.mark.contract
def test_warnings_of_an_estimated_sky_view_are_those_of_the_captures(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    view = SimpleNamespace(notes=("WARNING: the sky in the window", "pose by 3 discs"))
    monkeypatch.setattr(training_data, "sky_view_of", lambda *_: view)
    data = training_data.with_sky_view(replace(DATA, sky_view=None))
    assert data.notes == (*DATA.notes, "WARNING: the sky in the window")


@pytest.mark.contract
@pytest.mark.parametrize("cdm2", [0.0, 0.05])
def test_pictures_without_light_are_named_and_not_learnt(tmp_path: Path, cdm2: float) -> None:
    """With a lens cap on throughout, train once ended in a LinAlgError."""
    capped = DATA.luminance_cdm2.copy()
    capped[1:3] = cdm2
    some = load_pairs(write_pairs(tmp_path, replace(DATA, luminance_cdm2=capped)))
    assert some.slots == DATA.slots[:1] + DATA.slots[3:]
    assert any(f"dark by day: {', '.join(DATA.slots[1:3])}: check" in n for n in some.notes)
    path = write_pairs(tmp_path, replace(DATA, luminance_cdm2=np.full_like(capped, cdm2)))
    with pytest.raises(InputError, match=f"no light in {len(DATA)} pictures; expected .*; check"):
        load_pairs(path)


@pytest.mark.contract
def test_a_marked_blackout_blind_is_no_lens_cap(tmp_path: Path) -> None:
    dark = DATA.luminance_cdm2.copy()
    dark[1:3] = 0.02
    path = write_pairs(tmp_path, replace(DATA, luminance_cdm2=dark))
    head, *rows = path.read_text().splitlines()
    marked = [f"{row},{'blind=down' if k in (1, 2) else ''}" for k, row in enumerate(rows)]
    path.write_text("\n".join([f"{head},state", *marked, ""]))
    some = load_pairs(path)
    assert some.slots == DATA.slots and not any("dark by day" in note for note in some.notes)


@pytest.mark.contract
def test_pictures_without_any_edge_are_no_room(tmp_path: Path) -> None:
    data = dataset(("2027-03-20",), height=40)
    flat = replace(data, luminance_cdm2=np.full_like(data.luminance_cdm2, 50.0))
    with pytest.raises(InputError, match="no two pictures have the same edges; expected one view"):
        load_pairs(write_pairs(tmp_path, flat))


@pytest.mark.contract
@pytest.mark.parametrize("glass", [0.7, 0.25])
def test_a_disc_that_the_csv_does_not_state_is_named(tmp_path: Path, glass: float) -> None:
    """Its light is learnt as sky: the model's own error grows, and no figure shows why."""
    data = dataset(("2027-03-20", "2027-06-21"), height=48)
    light = data.light
    high = (light.apparent_altitude_deg > 15.0) & (light.direct_lx > 1e4)
    maps = add_disc(
        data.luminance_cdm2, light, np.where(high, glass * light.direct_lx, 0.0), data.heading_deg
    )
    shown = replace(data, luminance_cdm2=maps)
    found = f"the sun's disc is learnt as sky in {high.sum()} pictures: write sun_in_map = 1"
    for made, stated, warns in ((shown, False, True), (shown, True, False), (data, False, False)):
        read = load_pairs(write_pairs(tmp_path, made, sun_in_map=stated))
        assert any(found in note for note in read.notes) is warns, read.notes
        if warns:  # in Python too
            with pytest.warns(Caution, match=found):
                fieldlum.fit(read, "mean")


@pytest.mark.contract
@pytest.mark.parametrize("suffix", [".exr", ".hdr"])
def test_a_picture_without_a_heading_has_that_of_the_site(pairs: Path, suffix: str) -> None:
    """Otherwise a csv of another program's .exr was learnt as facing south: a year turned round."""
    lines = [line.split(",") for line in pairs.read_text().splitlines()]
    at = lines[0].index("sunpatch")
    rows = [",".join(cells[:at] + cells[at + 1 :]).replace(".exr", suffix) for cells in lines]
    pairs.write_text("\n".join(rows))
    site = pairs.parent / "site.toml"
    site.write_text(SITE_TOML + "[camera]\nheading_deg = 0\n")
    for view, heading_deg in ((None, 0.0), ("equirect heading_deg=90", 90.0)):
        for k in range(len(DATA)):
            path, light = pairs.parent / f"m{k}{suffix}", DATA.luminance_cdm2[k]
            if suffix == ".hdr":
                write_radiance_hdr(path, light, heading_deg=heading_deg if view else None)
                continue
            header = {"type": OpenEXR.scanlineimage, **({"view": view} if view else {})}
            channels = dict.fromkeys("RGB", np.ascontiguousarray(light, np.float32))
            OpenEXR.File(header, channels).write(str(path))
        assert load_pairs(pairs).heading_deg == heading_deg
