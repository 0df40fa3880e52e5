"""Ways to a Dask scheduler: one that runs, one of this machine's own, or one whose workers a batch system starts.

A cluster file is TOML:

    system = "slurm"          # or "pbs", "lsf", "sge"
    jobs = 10                 # how many are kept running
    queue = "normal"
    cores = 4                 # of a job, each for a worker
    memory = "4GiB"
    walltime = "02:00:00"     # of a job, hours:minutes:seconds
    margin = 120              # seconds before its end when it gives its case back
    account = "physics"       # this and what follows may be left out
    interface = "ib0"
    prologue = ["module load python"]
    directives = ["--constraint=avx2"]
    logs = "jobs"             # a folder for what jobs print; the batch system's own choice if not given
    python = "/home/me/env/bin/python"   # at the workers; this one if not given
"""

from __future__ import annotations

import importlib.util
import ipaddress
import logging
import re
import signal
import socket
import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal
from urllib.parse import urlsplit

import pydantic

from latticebench.bench.case import Settings
from latticebench.systems.errors import InputError, unknown
from latticebench.systems.toml import read_toml

# What `pip install latticebench[cluster]` brings.
NEEDED = ("dask", "distributed", "dask_jobqueue")
MOST_LOCAL = 1024
WALLTIME = re.compile(r"(?:(\d{1,3})-)?(\d{1,3}):([0-5]\d):([0-5]\d)")
# Seconds after which a worker that says nothing is taken to be lost; Dask's own is five minutes.
SILENCE = "60s"
# Milliseconds between two looks at whether a worker of this machine is to be replaced.
REPLACE = 2000.0


@dataclass(frozen=True)
class Connection:
    """Where a scheduler is, and what is needed to talk to it.

    Attributes:
        address: such as tcp://127.0.0.1:8786.
        security: of Dask's, with certificates; None for none.
        dashboard: the address of its dashboard; empty for none.
    """

    address: str
    security: Any = None
    dashboard: str = ""


def _seconds(text: str) -> str:
    if WALLTIME.fullmatch(text) is None:
        raise ValueError("write hours:minutes:seconds, such as 02:00:00, or days before them, such as 1-12:00:00")
    return text


class Jobs(Settings):
    """The content of a cluster file; see the head of this module."""

    system: Literal["slurm", "pbs", "lsf", "sge"]
    jobs: Annotated[int, pydantic.Field(ge=1, le=10_000)]
    cores: Annotated[int, pydantic.Field(ge=1, le=1024)] = 1
    memory: Annotated[str, pydantic.Field(pattern=r"^\d+(\.\d+)? ?[KMGT]i?B$")]
    walltime: Annotated[str, pydantic.AfterValidator(_seconds)]
    margin: Annotated[int, pydantic.Field(ge=1)] = 120
    queue: str | None = None
    account: str | None = None
    interface: str | None = None
    prologue: tuple[str, ...] = ()
    directives: tuple[str, ...] = ()
    logs: str | None = None
    python: str | None = None

    @pydantic.model_validator(mode="after")
    def _has_time(self) -> Jobs:
        if self.lifetime < 1:
            raise ValueError(f"a margin of {self.margin} s leaves nothing of a walltime of {self.walltime}")
        return self

    @property
    def lifetime(self) -> int:
        """Seconds after which a worker gives its case back and ends."""
        found = WALLTIME.fullmatch(self.walltime)
        assert found is not None
        days, hours, minutes, seconds = (int(part or 0) for part in found.groups())
        return ((24 * days + hours) * 60 + minutes) * 60 + seconds - self.margin


def read_jobs(path: Path) -> Jobs:
    """Read a cluster file.

    Raises:
        InputError: it cannot be read, or a key is wrong; the text names it.
    """
    try:
        return Jobs.of(read_toml(path))
    except pydantic.ValidationError as error:
        # A key that is misspelt is also missing; the misspelling is the better news.
        first = min(error.errors(), key=lambda one: one["type"] != "extra_forbidden")
        key = ".".join(str(part) for part in first["loc"])
        told = first["msg"].removeprefix("Value error, ")
        if first["type"] == "extra_forbidden":
            raise unknown("key", key, Jobs.model_fields, str(path)) from None
        raise InputError(f"{path}: {f'{key}: ' if key else ''}{told[0].lower()}{told[1:]}") from None


def check_installed() -> None:
    """Make sure that Dask is there.

    Raises:
        InputError: it is not.
    """
    if any(importlib.util.find_spec(name) is None for name in NEEDED):
        raise InputError("--executor dask needs packages that are not installed: pip install 'latticebench[cluster]'")


@dataclass(frozen=True)
class Place:
    """Which scheduler is asked for: one that runs, so many processes of this machine, or jobs of a batch system."""

    scheduler: str = ""
    local: int = 0
    jobs: Jobs | None = None

    @property
    def workers(self) -> int:
        """How many workers there will be, as far as one can know before; 1 where one cannot."""
        return self.jobs.jobs * self.jobs.cores if self.jobs is not None else max(self.local, 1)

    @contextmanager
    def connected(self) -> Iterator[Connection]:
        """Start what is to be started, and end it after the block, jobs of a batch system among it.

        Raises:
            InputError: it cannot be started.
        """
        check_installed()
        import dask

        _quiet()
        with ExitStack() as ends:
            # A user's recordings may be large, and are sent once.
            settings = {"distributed.admin.large-graph-warning-threshold": "1 TiB"}
            ends.enter_context(dask.config.set({**settings, "distributed.scheduler.worker-ttl": SILENCE}))
            if self.scheduler:
                yield Connection(self.scheduler, _security(self.scheduler))
                return
            cluster = ends.enter_context(_cluster(self))
            dashboard = cluster.dashboard_link if importlib.util.find_spec("bokeh") else ""
            yield Connection(cluster.scheduler_address, cluster.security, dashboard or "")


def place_of(scheduler: str | None, cluster: str | None) -> Place:
    """Read the options --scheduler and --cluster.

    Raises:
        InputError: neither or both are given, or one cannot be read.
    """
    if (scheduler is None) == (cluster is None):
        raise InputError(
            "--executor dask: give one of --scheduler tcp://HOST:PORT, --cluster local:N and --cluster FILE.toml"
        )
    if scheduler is not None:
        parts = urlsplit(scheduler)
        if parts.scheme not in ("tcp", "tls", "ws", "wss", "ucx") or not parts.hostname:
            raise InputError(f"--scheduler {scheduler}: write an address such as tcp://HOST:8786 or tls://HOST:8786")
        return Place(scheduler)
    assert cluster is not None
    if cluster.endswith(".toml"):
        return Place(jobs=read_jobs(Path(cluster)))
    found = re.fullmatch(r"local:(\d{1,4})", cluster)
    if found is None or not 1 <= int(found[1]) <= MOST_LOCAL:
        raise InputError(f"--cluster {cluster}: write local:N with N workers from 1 to {MOST_LOCAL}, or a .toml file")
    return Place(local=int(found[1]))


def _cluster(place: Place) -> Any:
    """Start a cluster of our own; a context that ends it."""
    if place.jobs is None:
        from distributed import LocalCluster

        # Each case has a process of its own with its limits: that of Dask's worker needs none.
        cluster = LocalCluster(
            n_workers=place.local, threads_per_worker=1, memory_limit=0, host="127.0.0.1", dashboard_address=":0",
            silence_logs=logging.CRITICAL,
            preload=["latticebench.bench.executors.station"],
        )  # fmt: skip
        _replace_lost(cluster, place.local)
        return cluster
    return _batch_system(place.jobs)


def _replace_lost(cluster: Any, count: int) -> None:
    """Have workers replaced that Dask gives up: those that die as they start, or take too long to come back."""
    from distributed import Status
    from tornado.ioloop import PeriodicCallback

    def look() -> None:
        for name, worker in list(cluster.workers.items()):
            if worker.status in (Status.failed, Status.closed):
                del cluster.workers[name]
        cluster.scale(count)

    # It ends with the loop, which is the cluster's own.
    cluster.loop.add_callback(PeriodicCallback(look, REPLACE).start)


def _quiet() -> None:
    """Let Dask not speak of workers that come and go, nor of connections: the run says what matters of them."""
    import distributed  # noqa: F401

    for name in ("distributed", "distributed.client", "distributed.nanny", "tornado.application"):
        logging.getLogger(name).setLevel(logging.CRITICAL)


def _batch_system(jobs: Jobs) -> Any:
    # Importing it takes Ctrl-C away from whoever has it.
    handlers = {one: signal.getsignal(one) for one in (signal.SIGINT, signal.SIGTERM)}
    import dask_jobqueue

    for one, handler in handlers.items():
        signal.signal(one, handler)
    name = {"slurm": "SLURMCluster", "pbs": "PBSCluster", "lsf": "LSFCluster", "sge": "SGECluster"}[jobs.system]
    given = {"queue": jobs.queue, "account": jobs.account, "interface": jobs.interface, "log_directory": jobs.logs}
    options = {
        "cores": jobs.cores,
        "processes": jobs.cores,
        "memory": jobs.memory,
        "walltime": jobs.walltime,
        "python": jobs.python or sys.executable,
        "job_script_prologue": list(jobs.prologue),
        "job_extra_directives": list(jobs.directives),
        "worker_extra_args": ["--lifetime", f"{jobs.lifetime}s"],
        **{key: value for key, value in given.items() if value is not None},
    }
    cluster = getattr(dask_jobqueue, name)(**options)
    # One that has ended, by its walltime for one, is replaced.
    cluster.adapt(minimum_jobs=jobs.jobs, maximum_jobs=jobs.jobs)
    return cluster


def _security(address: str) -> Any:
    """Return the certificates that Dask's configuration names, for an address with TLS.

    Raises:
        InputError: there are none.
    """
    if urlsplit(address).scheme not in ("tls", "wss"):
        return None
    from distributed.security import Security

    security = Security(require_encryption=True)
    if not (security.tls_ca_file and security.tls_client_cert):
        raise InputError(
            f"--scheduler {address}: no certificates; name them in Dask's configuration, such as "
            "DASK_DISTRIBUTED__COMM__TLS__CA_FILE and DASK_DISTRIBUTED__COMM__TLS__CLIENT__CERT (and CLIENT__KEY)"
        )
    return security


def is_open(address: str) -> bool:
    """Return whether others may reach a scheduler at an address that takes anybody's code: no TLS, and not loopback."""
    parts = urlsplit(address)
    if parts.scheme in ("tls", "wss", "inproc") or not parts.hostname:
        return False
    try:
        hosts = {str(one[4][0]).partition("%")[0] for one in socket.getaddrinfo(parts.hostname, None)}
    except OSError:
        return False
    return any(not ipaddress.ip_address(host).is_loopback for host in hosts)
