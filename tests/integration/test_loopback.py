"""A test that the Ray and the studio that a job starts listen on the loopback interface only."""

import os
import subprocess
import sys
import textwrap
import time
from pathlib import Path

import psutil
import requests

JOB = """
    import sys
    from jobs.support.cli import set_ray_environment
    set_ray_environment()
    from jobs.implementation.serve_studio import serve_studio
    from jobs.serve_studio import Config
    from jobs.support.ray_session import start_ray
    start_ray(training=True)  # also starts the dashboard
    print(serve_studio(Config(sys.argv[1], (sys.argv[2],), port=0)).address, flush=True)
    sys.stdin.read()
"""


def test_job_listens_on_loopback_only(studio_files):
    environment = {name: value for name, value in os.environ.items() if name not in ("RAY_ADDRESS",)}
    command = [sys.executable, "-c", textwrap.dedent(JOB), str(studio_files / "model"), str(studio_files / "tables")]
    with subprocess.Popen(
        command,
        env=environment,
        cwd=Path(__file__).parents[2],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    ) as job:
        try:
            assert job.stdout is not None
            address = job.stdout.readline().strip()
            assert requests.get(address, timeout=10).status_code == 200
            time.sleep(1)
            own = [psutil.Process(job.pid), *psutil.Process(job.pid).children(recursive=True)]
            listening = {
                (process.name(), one.laddr.ip)
                for process in own
                for one in process.net_connections("tcp")
                if one.status == psutil.CONN_LISTEN
            }
        finally:
            job.kill()
    names = {name for name, _ in listening}
    assert {"gcs_server", "raylet"} <= names and any("StudioActor" in name for name in names)
    assert {ip.removeprefix("::ffff:") for _, ip in listening} <= {"127.0.0.1", "::1"}, listening
