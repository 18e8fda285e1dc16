"""Training data and maps in an S3 stand-in, with uploads that are killed.

    python -m venv MOTO && MOTO/bin/pip install "moto[server]"
    python bench/bucket_faults.py SESSION WEATHER FOLDER --moto MOTO/bin/moto_server [--kills 5]

SESSION: a merged and paired session. Each upload is killed after some objects, which must leave
nothing that opens; then it runs to its end. Compares data, model and maps with those of the
session. Needs fieldlum[cloud]; moto does not install with fieldlum's pins.
"""

from __future__ import annotations

import argparse
import os
import random
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

from fieldlum.core.errors import InputError
from fieldlum.learn.models.data import load_pairs
from fieldlum.learn.models.pairs_bucket import BucketStore, read_pairs

PORT = 5117
URL = "s3://lab/office"
KEYS = {
    "AWS_ENDPOINT_URL": f"http://127.0.0.1:{PORT}",
    "AWS_ACCESS_KEY_ID": "stand-in",
    "AWS_SECRET_ACCESS_KEY": "stand-in",
    "AWS_DEFAULT_REGION": "us-east-1",
}


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("session", type=Path)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--moto", default="moto_server")
    parser.add_argument("--kills", type=int, default=5)
    asked = parser.parse_args()
    asked.folder.mkdir(parents=True, exist_ok=True)
    os.environ.update(KEYS)
    with (asked.folder / "moto.log").open("wb") as log:
        server = subprocess.Popen([asked.moto, "-p", str(PORT)], stdout=log, stderr=log)
    try:
        bucket = wait_for_bucket()
        pairs_in_bucket(asked, bucket)
    finally:
        server.terminate()
        server.wait()
    again = fieldlum("pair", str(asked.session), "--pairs-to", URL)
    print(f"without the server: exit {again.returncode}: {again.stderr.strip().splitlines()[-1]}")


def pairs_in_bucket(asked: argparse.Namespace, bucket: Any) -> None:
    words = ["pair", str(asked.session), "--pairs-to", URL]
    opened = killed_uploads(words, f"{URL}/pairs.zarr", bucket, asked.kills)
    start_s = time.monotonic()
    done = fieldlum(*words)
    print(
        f"pair: exit {done.returncode}, {time.monotonic() - start_s:.1f} s: {done.stdout.strip()}"
    )
    data, stored = load_pairs(asked.session), read_pairs(URL)
    print(f"  opened after a kill: {opened}; same data: {stored.digest() == data.digest()}")
    bucket.invalidate_cache()
    objects = bucket.find("lab/office", detail=True).values()
    print(f"  objects {len(objects)}, bytes {sum(found['size'] for found in objects)}")
    for source, name in ((str(asked.session), "here"), (URL, "there")):
        out = str(asked.folder / name)
        done = fieldlum("train", source, "--model", "transport", "--budget", "1", "--out", out)
        print(f"  train {name}: exit {done.returncode}")
    same = [(asked.folder / name / "weights.npz").read_bytes() for name in ("here", "there")]
    print(f"  same model: {same[0] == same[1]}", flush=True)


def killed_uploads(words: list[str], store: str, bucket: Any, kills: int) -> int:
    """Kill an upload after some objects, `kills` times; return how often the store opened."""
    rng, opened = random.Random(0), 0
    below = store.removeprefix("s3://")
    for _ in range(kills):
        if bucket.exists(below):
            bucket.rm(below, recursive=True)
        enough = rng.randint(1, 12)
        with subprocess.Popen(
            command(*words, "--force"), stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        ) as process:
            count = 0
            while process.poll() is None and count < enough:
                bucket.invalidate_cache()
                count = len(bucket.find(below)) if bucket.exists(below) else 0
            ended = process.poll()
            process.kill()
        bucket.invalidate_cache()
        count = len(bucket.find(below))
        state = "killed" if ended is None else "ended before it was killed"
        complete = BucketStore(store).attributes() is not None
        print(f"  {state} with {count} objects; can be opened: {complete}")
        opened += complete and ended is None
        try:
            if store.endswith("pairs.zarr") and not complete:
                read_pairs(store)
                opened += 1
        except InputError:
            pass
    return opened


def command(*words: str) -> list[str]:
    return [sys.executable, "-c", "from fieldlum.cli import main; main()", *words]


def fieldlum(*words: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(command(*words), capture_output=True, text=True, check=False)


def wait_for_bucket() -> Any:
    """Return the stand-in's file system with the bucket "lab" when it answers."""
    import s3fs  # pyright: ignore[reportMissingImports]

    end_s = time.monotonic() + 120.0
    while True:
        try:
            bucket = s3fs.S3FileSystem(skip_instance_cache=True)
            bucket.mkdir("lab")
            return bucket
        except Exception:  # of the client, while nothing answers
            if time.monotonic() > end_s:
                raise
            time.sleep(1.0)


if __name__ == "__main__":
    main()
