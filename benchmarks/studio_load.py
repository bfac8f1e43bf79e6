"""Measure the studio under load: many visitors who open and edit scenes, and some who generate.

    python benchmarks/studio_load.py --datasets DIR                     200 visitors, 5 minutes

The benchmark starts jobs/serve_studio.py and runs on the same machine. After each answer, a visitor waits 2 to 6 s. 5 %
of the operations generate a scene (20 steps); the visitor then asks for the progress once per second. Target on two
cores: no status but 200 and 429, a median time of at most 100 ms for requests that do not generate, and at most 3 GiB
of memory for all processes of the studio, Ray included.
"""

from __future__ import annotations

import asyncio
import os
import random
import statistics
import subprocess
import sys
import time
from collections import Counter, defaultdict
from dataclasses import dataclass, field
from pathlib import Path

import aiohttp
import psutil
import tyro
from common import describe_machine

ROOT = Path(__file__).parents[1]
KINDS = {"open": 30, "edit": 45, "undo": 10, "scenes": 10, "generate": 5}  # Percent of the operations.
PAUSE_S = (2.0, 6.0)


@dataclass(frozen=True)
class Config:
    datasets: str
    """Dataset directory whose scenes visitors open."""
    model: str = "town"
    """Model of the studio."""
    visitors: int = 200
    """Number of visitors."""
    seconds: float = 300.0
    """Duration (s)."""
    seed: int = 0
    """Random seed."""


@dataclass
class Record:
    times_s: defaultdict[str, list[float]] = field(default_factory=lambda: defaultdict(list))
    statuses: Counter[tuple[str, int]] = field(default_factory=Counter)
    tasks: Counter[str] = field(default_factory=Counter)
    memory_bytes: Counter[str] = field(default_factory=Counter)
    """Memory of the processes of each name at the moment of the largest sum."""


async def visit(number: int, config: Config, address: str, end: float, record: Record) -> None:
    """Act as one visitor until the time is over."""
    rng = random.Random(f"{config.seed} {number}")
    await asyncio.sleep(rng.uniform(0, 10))

    async with aiohttp.ClientSession(
        address, headers={"x-studio": "1"}, cookie_jar=aiohttp.CookieJar(unsafe=True)
    ) as http:

        async def ask(kind: str, method: str, path: str, body: dict | None = None) -> dict:
            start = time.monotonic()
            try:
                async with http.request(method, path, json=body) as answer:
                    content = await answer.json() if "json" in answer.content_type else {"": await answer.read()}
                    status = answer.status
            except (aiohttp.ClientError, TimeoutError):
                content, status = {}, 0
            record.times_s[kind].append(time.monotonic() - start)
            record.statuses[kind, status] += 1
            return content if status == 200 else {}

        await ask("page", "GET", "/")
        names = [one["scene_id"] for one in (await ask("scenes", "GET", "/api/scenes"))["scenes"]]
        count = 0
        while time.monotonic() < end:
            kind, state = rng.choices(list(KINDS), list(KINDS.values()))[0] if count else "open", {}
            if kind == "open":
                state = await ask(kind, "POST", "/api/open", {"scene_id": rng.choice(names)})
            elif kind == "edit":
                turn = {"edit": "rotate", "select": {"primitives": [rng.randrange(count)]}, "by_deg": 15}
                state = await ask(kind, "POST", "/api/edit", {"edits": [turn]})
            elif kind == "undo":
                state = await ask(kind, "POST", "/api/undo")
            elif kind == "scenes":
                await ask(kind, "GET", f"/api/scenes?start={24 * rng.randrange(4)}")
            elif await ask(kind, "POST", "/api/generate", {"seed": rng.randrange(10**6)}):
                work: dict = {}
                while not work.get("finished") and time.monotonic() < end:
                    await asyncio.sleep(1)
                    work = await ask("work", "GET", "/api/work")
                record.tasks["failed" if work.get("error") else "done" if work.get("finished") else "unfinished"] += 1
                state = await ask("state", "GET", "/api/state")
            if "scene" in state:
                count = len((state["scene"] or {}).get("primitives", ()))
            await asyncio.sleep(rng.uniform(*PAUSE_S))


async def watch_memory(process: psutil.Process, end: float, record: Record) -> None:
    """Record the largest memory of a process and its descendants; shared pages count once."""
    while time.monotonic() < end:
        now = Counter[str]()
        for one in [process, *process.children(recursive=True)]:
            try:
                name = " ".join(Path(word).name for word in one.cmdline()[:2]) if one.cmdline() else one.name()
                now[name] += one.memory_full_info().pss
            except psutil.Error:
                continue
        record.memory_bytes = max(record.memory_bytes, now, key=Counter.total)
        await asyncio.sleep(5)


async def load(config: Config, address: str, process: psutil.Process) -> Record:
    record, end = Record(), time.monotonic() + config.seconds
    visitors = [visit(number, config, address, end, record) for number in range(config.visitors)]
    await asyncio.gather(watch_memory(process, end, record), *visitors)
    return record


def main(config: Config) -> None:
    command = [sys.executable, str(ROOT / "jobs/serve_studio.py"), "--model", config.model, "--port", "0"]
    command += ["--datasets", config.datasets]
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    with subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, text=True) as job:
        try:
            assert job.stdout is not None
            address = job.stdout.readline().removeprefix("studio: ").strip()
            if not address:
                raise SystemExit("the studio did not start")
            record = asyncio.run(load(config, address, psutil.Process(job.pid)))
        finally:
            job.terminate()
    print(describe_machine())
    cheap = [s for kind, times in record.times_s.items() if kind != "generate" for s in times]
    print(f"{config.visitors} visitors, {config.seconds:.0f} s, {sum(record.statuses.values()):,} requests")
    for kind, times in [*sorted(record.times_s.items()), ("all but generate", cheap)]:
        ms = sorted(1000 * s for s in times)
        statuses = {status: n for (name, status), n in sorted(record.statuses.items()) if name == kind}
        print(
            f"{kind:17} {len(ms):6,} requests, median {statistics.median(ms):6.1f} ms,"
            f" 95 % {ms[int(0.95 * (len(ms) - 1))]:7.1f} ms, most {ms[-1]:7.1f} ms {statuses or ''}"
        )
    errors = sum(n for (_, status), n in record.statuses.items() if status not in (200, 429))
    print(f"tasks: {dict(record.tasks)}; answers other than 200 and 429: {errors}")
    print(f"memory of all processes of the studio: {record.memory_bytes.total() / 2**30:.2f} GiB")
    for name, size in record.memory_bytes.most_common(6):
        print(f"  {size / 2**20:6,.0f} MiB  {name[:80]}")


if __name__ == "__main__":
    main(tyro.cli(Config, description=__doc__))
