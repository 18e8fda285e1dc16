"""A real Dask scheduler and workers as processes of their own, which may be killed."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

SOURCE = Path(__file__).parents[1]
START_S = 60.0  # for a scheduler to write its file on a busy computer


class Cluster:
    """A scheduler on loopback and its workers. shared: the folder that task paths start from."""

    def __init__(self, folder: Path, shared: Path) -> None:
        self.folder, self.shared = folder, shared
        self.file = folder / "scheduler.json"
        self.processes: dict[str, subprocess.Popen[bytes]] = {}

    def start(
        self,
        name: str,
        *arguments: str,
        source: Path = SOURCE,
        prefix: tuple[str, ...] = (),
    ) -> None:
        environment = os.environ | {
            "PYTHONPATH": os.pathsep.join((str(source), str(SOURCE / "tests"))),
            "FIELDLUM_SHARED": str(self.shared),
            "OMP_NUM_THREADS": "1",
            "OPENBLAS_NUM_THREADS": "1",
        }
        with (self.folder / f"{name}.log").open("wb") as log:
            self.processes[name] = subprocess.Popen(
                [*prefix, sys.executable, "-m", "dask", *arguments, "--no-dashboard"],
                stdout=log,
                stderr=log,
                cwd=self.folder,
                env=environment,
            )

    def scheduler(self) -> None:
        options = ("--host", "127.0.0.1", "--port", "0", "--scheduler-file", str(self.file))
        self.start("scheduler", "scheduler", *options)
        end_s = time.monotonic() + START_S
        while not self.file.is_file():
            if self.processes["scheduler"].poll() is not None or time.monotonic() > end_s:
                raise RuntimeError((self.folder / "scheduler.log").read_text())
            time.sleep(0.1)

    def worker(self, name: str, *, source: Path = SOURCE, prefix: tuple[str, ...] = ()) -> None:
        """Start a worker of one thread, without a nanny that would start it again."""
        scratch = self.folder / f"scratch-{name}"
        options = ("--scheduler-file", str(self.file), "--nthreads", "1", "--no-nanny")
        more = ("--local-directory", str(scratch))
        self.start(name, "worker", *options, *more, source=source, prefix=prefix)

    def signal(self, name: str, number: int = signal.SIGKILL) -> None:
        self.processes[name].send_signal(number)

    def stop(self) -> None:
        for process in reversed(self.processes.values()):
            process.kill()
            process.wait()


@contextmanager
def cluster(folder: Path, shared: Path, *workers: str) -> Iterator[Cluster]:
    """Yield a cluster; its processes end with the block."""
    folder.mkdir(parents=True, exist_ok=True)
    made = Cluster(folder, shared)
    try:
        made.scheduler()
        for name in workers:
            made.worker(name)
        yield made
    finally:
        made.stop()
