"""Damage files of every format and count how the readers respond.

    python benchmarks/fuzz.py                              10,000 runs per format, 12 minutes on two cores
    python benchmarks/fuzz.py --formats tables --runs 500
    python benchmarks/fuzz.py --formats glb-own --first 1234 --runs 1 --keep DIR   writes the damaged files of a run

Each run has one of six verdicts. A run passes if it is `refused` (by a ValueError) or `accepted` and equal to what an
independent reader returns. `different`: accepted, but an invariant is violated or an independent reader returns another
result. `exception`: of another type, or the process ended. `hang`: over 10 s. `memory`: more than 2 GiB. The damage
depends only on the seed and the number of the run. Runs happen in child processes, which the parent watches.
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")

import multiprocessing
import random
import resource
import shutil
import signal
import tempfile
import time
import traceback
import warnings
from collections import Counter, defaultdict
from collections.abc import Iterator
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path

import tyro

HANG_S, LIMIT_BYTES, ADDRESS_SPACE_BYTES = 10.0, 2 * 2**30, 12 * 2**30
VERDICTS = ("refused", "accepted", "different", "exception", "hang", "memory")
NAMES = (
    "tables", "glb-own", "glb-foreign", "voxels", "adm", "kitti360", "argoverse2", "custom", "osm", "opendrive",
    "edits", "models",
)  # fmt: skip


@dataclass(frozen=True)
class Config:
    formats: tuple[str, ...] = NAMES
    """Formats to damage."""
    runs: int = 10_000
    """Number of runs per format."""
    first: int = 0
    """Number of the first run."""
    seed: int = 0
    """Random seed."""
    keep: str = ""
    """Directory for the damaged files of failed runs, or of all runs if there are at most ten (default: none)."""
    num_processes: int = 2
    """Number of processes."""


@dataclass(frozen=True)
class Run:
    """Result of one run."""

    number: int
    verdict: str
    reason: str = ""


def measure_peak_bytes() -> int:
    """Return the largest resident memory of this process since the last call of `reset_peak`."""
    text = Path("/proc/self/status").read_text()
    return 1024 * int(text.split("VmHWM:")[1].split()[0])


def reset_peak() -> None:
    Path("/proc/self/clear_refs").write_text("5")


def write_files(files: dict[str, bytes], folder: Path) -> None:
    for name, content in files.items():
        if not name.startswith("#"):
            path = folder / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(content)


class Hang(BaseException):
    """Raised by the alarm."""


def raise_hang(*_: object) -> None:
    raise Hang


def judge_run(form, number: int, seed: int, folder: Path, keep: Path | None) -> Run:
    """Carry out one run."""
    from fuzz_formats import Silent

    rng = random.Random(f"{seed} {form.name} {number}")
    files = form.damage(rng.choice(form.bases), rng)
    shutil.rmtree(folder, ignore_errors=True)
    write_files(files, folder)
    if keep:
        write_files(files, keep / f"{form.name}-{number}")
    reset_peak()
    before = measure_peak_bytes()
    signal.setitimer(signal.ITIMER_REAL, HANG_S)
    try:
        result = form.read(folder)
        verdict, reason = "accepted", ""
    except ValueError as error:
        verdict, reason = "refused", str(error)
    except Hang:
        verdict, reason = "hang", traceback.format_exc(limit=-3)
    except Exception:
        verdict, reason = "exception", traceback.format_exc(limit=-4)
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
    if (peak := measure_peak_bytes() - before) > LIMIT_BYTES:
        return Run(number, "memory", f"{peak / 2**30:.1f} GiB, {verdict}: {reason}")
    if verdict == "accepted":
        try:
            form.check(folder, result, files)
        except Silent as error:
            return Run(number, "different", str(error))
        except Exception:  # The independent reader refuses what the reader accepted.
            return Run(number, "different", traceback.format_exc(limit=-3))
    return Run(number, verdict, reason)


def run_child(name: str, first: int, stop: int, seed: int, keep: str, results: Connection) -> None:
    """Carry out runs in a child process; send the number of each run before and its result after it."""
    warnings.simplefilter("ignore")
    from fuzz_formats import FORMATS, make_town_drive

    resource.setrlimit(resource.RLIMIT_AS, (ADDRESS_SPACE_BYTES, ADDRESS_SPACE_BYTES))
    signal.signal(signal.SIGALRM, raise_hang)
    with tempfile.TemporaryDirectory() as temporary:
        (Path(temporary) / "base").mkdir()
        kind = next(kind for kind in FORMATS if kind.name == name)  # pyright: ignore[reportFunctionMemberAccess]
        form = kind(make_town_drive(), Path(temporary) / "base")
        assert form.read_bases(Path(temporary) / "valid")
        for number in range(first, stop):
            results.send(number)
            results.send(judge_run(form, number, seed, Path(temporary) / "damaged", Path(keep) if keep else None))
    results.send(None)


def watch_runs(name: str, first: int, stop: int, config: Config, keep: str) -> Iterator[Run]:
    """Yield the results of runs; a child process that ends or hangs is replaced."""
    context = multiprocessing.get_context("spawn")
    while first < stop:
        own, theirs = context.Pipe(duplex=False)
        child = context.Process(target=run_child, args=(name, first, stop, config.seed, keep, theirs), daemon=True)
        child.start()
        theirs.close()
        is_started = False
        while True:
            try:
                message = own.recv() if own.poll(3 * HANG_S if is_started else 300) else Hang
            except EOFError:
                message = None
            if isinstance(message, int):
                first, is_started = message, True
            elif isinstance(message, Run):
                first = message.number + 1
                yield message
            else:
                child.kill()
                child.join()
                if not is_started:
                    raise SystemExit(f"{name}: the process ended before its first run")
                if first < stop:
                    verdict = "hang" if message is Hang else "exception"
                    yield Run(first, verdict, f"the process ended with {child.exitcode}")
                    first += 1
                break


def fuzz_format(name: str, config: Config) -> list[Run]:
    """Carry out all runs of a format in this process's children."""
    keep = config.keep if config.runs <= 10 else ""
    return list(watch_runs(name, config.first, config.first + config.runs, config, keep))


def format_row(name: str, runs: list[Run]) -> str:
    counts = Counter(run.verdict for run in runs)
    return f"{name:12} {len(runs):6,} " + " ".join(f"{counts[verdict]:9,}" for verdict in VERDICTS)


def main(config: Config) -> None:
    from concurrent.futures import ThreadPoolExecutor

    from common import describe_machine

    print(describe_machine())
    print(f"{'format':12} {'runs':>6} " + " ".join(f"{verdict:>9}" for verdict in VERDICTS) + "   seconds")
    failed: dict[str, list[Run]] = defaultdict(list)

    def run(name: str) -> None:
        start = time.monotonic()
        runs = fuzz_format(name, config)
        failed[name] = [one for one in runs if one.verdict not in VERDICTS[:2]]
        print(f"{format_row(name, runs)} {time.monotonic() - start:9.0f}", flush=True)

    with ThreadPoolExecutor(config.num_processes) as pool:
        list(pool.map(run, config.formats))
    for name, runs in failed.items():
        for one in runs[:20]:
            print(f"\n{name} run {one.number}: {one.verdict}\n{one.reason}")
            if config.keep and config.runs > 10:
                fuzz_format(name, Config((name,), 1, one.number, config.seed, config.keep))
    if any(failed.values()):
        raise SystemExit(1)


if __name__ == "__main__":
    main(tyro.cli(Config, description=__doc__))
