"""Training data in a bucket: what was written is read, an interrupted upload is not."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import fsspec
import pytest
from click.testing import CliRunner
from learning_room import dataset, write_pairs

from fieldlum.cli import main
from fieldlum.core.errors import InputError
from fieldlum.learn.models import pairs_bucket
from fieldlum.learn.models.data import load_pairs
from fieldlum.learn.models.pairs_bucket import BucketStore, check_url

pytestmark = pytest.mark.contract
DAYS = ("2027-03-20", "2027-06-21")


def test_an_azure_container_is_no_user_of_the_url() -> None:
    check_url("abfs://container@account.dfs.core.windows.net/folder", "--pairs-to", "omit it")
    for url in ("s3://me@bucket/folder", "abfs://container:secret@account/folder"):
        with pytest.raises(InputError, match="a URL with a user or password"):
            check_url(url, "--pairs-to", "omit it")


@pytest.mark.slow
def test_the_data_are_those_of_the_session_or_are_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    url = f"memory://bucket/{tmp_path.name}"
    data = load_pairs(write_pairs(tmp_path, dataset(DAYS, height=8)))
    states = ("lamp=on",) * len(data)
    data = replace(data, light=replace(data.light, states=states, refraction=False), notes=("a",))

    def killed(*_: Any) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr(BucketStore, "finish", killed)
        with pytest.raises(KeyboardInterrupt):
            pairs_bucket.write_pairs(data, url, tmp_path / "draft")
    with pytest.raises(InputError, match=r"no complete pairs\.zarr"):
        pairs_bucket.read_pairs(url)
    assert pairs_bucket.write_pairs(data, url, tmp_path / "draft")
    assert not pairs_bucket.write_pairs(data, url, tmp_path / "draft"), "unchanged"
    read = pairs_bucket.read_pairs(f"{url}/pairs.zarr")
    assert read.digest() == data.digest() and read.slots == data.slots
    assert not (tmp_path / "draft").exists()
    # one damaged object of the bucket
    store: Any = fsspec.filesystem("memory")
    (shard, *_) = [n for n in store.find(f"/bucket/{tmp_path.name}") if "dni_wm2/c/" in n]
    (other, *_) = [n for n in store.find(f"/bucket/{tmp_path.name}") if "dhi_wm2/c/" in n]
    store.pipe_file(shard, store.cat_file(other))
    with pytest.raises(InputError, match="content that was changed or damaged"):
        pairs_bucket.read_pairs(url)


@pytest.mark.slow
def test_a_model_of_the_bucket_is_that_of_the_session(tmp_path: Path) -> None:
    url = f"memory://bucket/{tmp_path.name}"
    pairs = write_pairs(tmp_path, dataset(DAYS, height=8))
    pairs_bucket.write_pairs(load_pairs(pairs), url, tmp_path / "draft")
    for source, out in ((str(pairs), "here"), (url, "there")):
        words = ["train", source, "--model", "nearest", "--out", str(tmp_path / out)]
        assert CliRunner().invoke(main, words).exit_code == 0
    weights = [(tmp_path / out / "weights.npz").read_bytes() for out in ("here", "there")]
    assert weights[0] == weights[1]
    assert CliRunner().invoke(main, ["train", url]).exit_code == 2, "no --out"


def test_pair_refuses_what_is_no_bucket(tmp_path: Path) -> None:
    for url in ("maps", "file:///tmp/pairs", "nonsense://bucket/pairs"):
        (tmp_path / "session.toml").write_text("")
        done = CliRunner().invoke(main, ["pair", str(tmp_path), "--pairs-to", url])
        assert done.exit_code == 3 and "Traceback" not in done.stderr and url in done.stderr
