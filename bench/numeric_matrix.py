"""Run the tests under the arithmetic of other processors: BLAS kernels, torch kernels, threads.

    make matrix                             # the complete suite under every setting
    python bench/numeric_matrix.py --short  # the numeric tests under three settings, as in .ci/run
    python bench/numeric_matrix.py -m numeric tests/test_simulate.py  # what pytest understands

A processor without AVX-512 is imitated by OPENBLAS_CORETYPE (kernels of OpenBLAS),
NPY_DISABLE_CPU_FEATURES (numpy's own loops) and ATEN_CPU_CAPABILITY (torch). They are read when
the libraries are loaded, so each setting is a process of its own. Exit code 1 when a test fails.
"""

from __future__ import annotations

import argparse
import os
import re
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).parents[1]
NO_AVX512 = "X86_V4 AVX512_ICL AVX512_SPR"
NO_AVX2 = f"X86_V3 {NO_AVX512}"
SHORT = {("Haswell", 1), ("Zen", 2), ("Prescott", 1)}  # kernels and threads
HEAD = ("OpenBLAS kernels", "torch", "numpy without", "threads", "tests", "s")


@dataclass(frozen=True, slots=True)
class Setting:
    """One processor as the libraries see it.

    core: kernels of OpenBLAS; aten: of torch ("": torch decides); disabled: features of numpy.
    """

    core: str
    aten: str
    threads: int
    disabled: str = ""

    def environment(self) -> dict[str, str]:
        """Return the variables of a process under this setting."""
        found = dict(os.environ)
        found |= {"OPENBLAS_CORETYPE": self.core, "ATEN_CPU_CAPABILITY": self.aten}
        found |= {"OPENBLAS_NUM_THREADS": str(self.threads), "OMP_NUM_THREADS": str(self.threads)}
        found["NPY_DISABLE_CPU_FEATURES"] = _present(self.disabled)
        return {name: value for name, value in found.items() if value}


def _present(features: str) -> str:
    """Return those of the features that numpy found here; it warns of others."""
    from numpy._core._multiarray_umath import __cpu_features__

    return " ".join(name for name in features.split() if __cpu_features__.get(name))


def settings() -> list[Setting]:
    """Return all settings that this machine can run: each kernel with one and two threads."""
    kinds = [("Haswell", "avx2", NO_AVX512), ("Zen", "avx2", NO_AVX512)]
    kinds += [("Prescott", "default", NO_AVX2)]
    if _present("X86_V4"):
        kinds += [("SkylakeX", "", "")]
    return [
        Setting(core, aten, threads, disabled)
        for core, aten, disabled in kinds
        for threads in (1, 2)
    ]


def run(setting: Setting, arguments: list[str]) -> tuple[str, float, str]:
    """Return pytest's last line, the seconds it took, and all that it printed."""
    started = time.monotonic()
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", *arguments]
    done = subprocess.run(
        command, cwd=ROOT, env=setting.environment(), capture_output=True, text=True, check=False
    )
    printed = done.stdout + done.stderr
    lines = [line for line in printed.splitlines() if re.search(r"\d+ (passed|failed|error)", line)]
    last = lines[-1] if lines else f"exit code {done.returncode}"
    if done.returncode and "failed" not in last and "error" not in last:
        last = f"exit code {done.returncode}"
    return last.split(" in ")[0].strip("= "), time.monotonic() - started, printed


def numeric_files() -> list[str]:
    """Return the test files that have numeric tests: collecting all of them takes long."""
    files = sorted((ROOT / "tests").glob("test_*.py"))
    return [str(path) for path in files if "mark.numeric" in path.read_text(encoding="utf-8")]


def main() -> None:
    """Run the matrix and print it as a table of Markdown."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--short", action="store_true", help="numeric tests, three settings")
    parser.add_argument("--jobs", type=int, default=1, help="settings at a time")
    options, arguments = parser.parse_known_args()
    chosen = settings()
    if options.short:
        chosen = [s for s in chosen if (s.core, s.threads) in SHORT]
        arguments += ["-m", "numeric", *numeric_files()]
    print(f"| {' | '.join(HEAD)} |\n{'|---' * len(HEAD)}|")
    failed = False
    with ThreadPoolExecutor(options.jobs) as pool:
        for setting, (last, seconds, printed) in zip(
            chosen, pool.map(lambda s: run(s, arguments), chosen), strict=True
        ):
            cells = setting.core, setting.aten or "own", _present(setting.disabled) or "-"
            cells += str(setting.threads), last, f"{seconds:.0f}"
            print(f"| {' | '.join(cells)} |", flush=True)
            if "failed" in last or "error" in last or "exit" in last:
                failed = True
                print(printed[-6000:], file=sys.stderr)
    sys.exit(failed)


if __name__ == "__main__":
    main()
