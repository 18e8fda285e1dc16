"""A model folder from a stranger: refused in one line, without much memory."""

from __future__ import annotations

import json
import shutil
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from learning_room import dataset

from fieldlum.core.errors import ChangedFileWarning, InputError
from fieldlum.learn import train
from fieldlum.learn.models import load, read_config
from fieldlum.session.codec import read_arrays

pytestmark = pytest.mark.contract


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("m") / "transport"
    data = dataset(("2027-03-20", "2027-06-21"), height=8)
    train.run(data, "transport", seed=1, out=folder)
    return folder


@pytest.fixture
def copy(model: Path, tmp_path: Path) -> Path:
    """Return a copy of the model without checksums, which its author could write again."""
    shutil.copytree(model, tmp_path, dirs_exist_ok=True, ignore=shutil.ignore_patterns("*.sha256"))
    load(tmp_path)
    return tmp_path


def _rewrite(folder: Path, change: Callable[[dict[str, np.ndarray]], object]) -> None:
    path = folder / "weights.npz"
    arrays = read_arrays(path)
    change(arrays)
    np.savez(path, **arrays)  # pyright: ignore[reportArgumentType]


def _first_pixels(arrays: dict[str, np.ndarray]) -> str:
    return next(name for name, a in arrays.items() if a.dtype.kind == "f" and a.size > 100)


@pytest.mark.slow
def test_a_changed_number_of_a_model_is_reported(model: Path, tmp_path: Path) -> None:
    path = shutil.copytree(model, tmp_path / "changed") / "config.json"
    load(path.parent)
    path.write_text(path.read_text().replace('"seed": 1', '"seed": 7'))
    with pytest.warns(ChangedFileWarning, match=r"config\.json: the content changed after"):
        load(path.parent)


@pytest.mark.slow
def test_weights_that_are_not_finite(copy: Path) -> None:
    _rewrite(copy, lambda arrays: arrays[_first_pixels(arrays)].fill(np.nan))
    with pytest.raises(InputError, match="not finite"):
        load(copy)


@pytest.mark.slow
def test_a_zip_bomb_is_not_unpacked(copy: Path) -> None:
    path = copy / "weights.npz"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("seen.npy", b"\0" * 50_000_000)
    with pytest.raises(InputError, match="is compressed"):
        load(copy)


@pytest.mark.parametrize("shape", ["(1000000000000000, 8)", "(-8,)", "(99999999999999999999,)"])
def test_a_shape_that_the_file_does_not_hold(copy: Path, shape: str) -> None:
    header = f"{{'descr': '<f4', 'fortran_order': False, 'shape': {shape}, }}".ljust(117) + "\n"
    data = b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header.encode()
    with zipfile.ZipFile(copy / "weights.npz", "w") as archive:
        archive.writestr("seen.npy", data + b"\0" * 64)
    with pytest.raises(InputError, match="weights that cannot be used"):
        load(copy)


@pytest.mark.parametrize("width", [10**9, -2, 3])
def test_a_size_that_no_model_has(copy: Path, width: int) -> None:
    path = copy / "config.json"
    table = json.loads(path.read_text(encoding="utf-8"))
    path.write_text(json.dumps(table | {"width": width}), encoding="utf-8")
    with pytest.raises(InputError, match="twice as wide as high"):
        read_config(copy)


def test_nested_brackets(copy: Path) -> None:
    (copy / "config.json").write_text("[" * 200_000 + "]" * 200_000, encoding="utf-8")
    with pytest.raises(InputError, match="recursion"):
        read_config(copy)


def test_arrays_of_another_model(copy: Path) -> None:
    _rewrite(copy, lambda arrays: arrays.pop(_first_pixels(arrays)))
    with pytest.raises(InputError, match="weights that cannot be used"):
        load(copy)
