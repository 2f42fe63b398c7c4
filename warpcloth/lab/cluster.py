"""Measurements on a Dask cluster, whose machines need this package but no shared folder."""

import asyncio
import contextlib
import hashlib
import json
import logging
import os
import pickle
import threading
import warnings
from collections import Counter
from concurrent.futures import CancelledError, Executor, ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

from ..base.digest import package_digest
from ..base.extensions import extensions, load_only
from ..base.outputs import STAGE_ENDINGS
from ..base.quiet import initialise_warp
from ..run.listing import folders
from ..run.scene_files import find_source
from ..usd import flattened
from .machine import processor

# Time in which a scheduler and its first worker must answer [s].
_ANSWER = 5.0


class Cluster(Executor):
    """Runs tasks on the workers of a Dask client, and sends the files that they name, references or scenes, once each.

    Args:
        client: A `distributed.Client`.
    """

    folder = "dask"  # folder of its results in the cache folder

    def __init__(self, client):
        self._client, self._sent = client, {}
        # Not pure, so that equal measurements run twice.
        self._executor = client.get_executor(pure=False)

    def submit(self, function, task, *arguments):
        """Returns the future of ``function(task, *arguments)``."""
        files = {name: self._send(path) for name, path in files_of(task).items()}
        modules = {name: self._send(Path(name)) if name.endswith(".py") else None for name in extensions()}

        def measure(packed, files, modules):  # pickled by value, so that the scheduler does not need this package
            from warpcloth.lab.cluster import unpack

            return unpack(packed, files, modules)

        return self._executor.submit(measure, pickle.dumps((function, task, arguments)), files, modules)

    def _send(self, path):
        """Returns the name and content of a file, which each worker receives once."""
        if path not in self._sent:
            if path.suffix in STAGE_ENDINGS:
                name, content = f"{path.stem}.usda", flattened(path).encode()
            else:
                name, content = path.name, path.read_bytes()
            self._sent[path] = name, self._client.scatter(content, broadcast=True, hash=True)
        return self._sent[path]


@contextlib.contextmanager
def connect(address):
    """Yields the :class:`Cluster` at an address, for ``executor`` of a sweep, after checking its workers.

    Args:
        address: Address of a scheduler, such as tcp://host:8786, or its scheduler file.

    Warns:
        UserWarning: Processors differ, and so will times; or a worker has threads that will be idle.

    Raises:
        ImportError: Dask is not installed.
        ConnectionError: Nothing answers in time, there is no worker, or the cluster goes away during measurements.
        ValueError: The address is invalid, or a worker has no warpcloth, another version of it, or computes with threads.
    """
    try:
        from distributed import Client, KilledWorker
    except ImportError:
        raise ImportError("a Dask cluster needs dask and distributed: pip install -e '.[dask]' in the checkout") from None
    scheduler = _scheduler(address)
    log = logging.getLogger("distributed.client")  # logs tracebacks of errors that are raised below
    level = log.level
    log.setLevel(logging.CRITICAL)
    try:
        with Client(scheduler, timeout=_ANSWER, set_as_default=False) as client:
            _check(client, scheduler)
            yield Cluster(client)
    except CancelledError:
        raise ConnectionError(f"the Dask scheduler at {scheduler} went away; what is measured is kept") from None
    except KilledWorker as error:
        raise ConnectionError(f"a measurement ended several workers of the Dask cluster: {error}") from None
    finally:
        log.setLevel(level)


def _scheduler(address):
    """Returns the address of a scheduler that answers; see :func:`connect`. A `Client` would fail later and say less."""
    if os.path.isfile(address):
        try:
            address = json.loads(Path(address).read_text(encoding="utf-8"))["address"]
        except (ValueError, TypeError, KeyError):
            raise ValueError(f"{address}: is no scheduler file of Dask") from None

    async def identity():
        from distributed.core import rpc
        from distributed.security import Security

        async with rpc(address, timeout=_ANSWER, connection_args=Security().get_connection_args("client")) as scheduler:
            return await asyncio.wait_for(scheduler.identity(), _ANSWER)

    try:
        with ThreadPoolExecutor(1) as thread:  # in a notebook, this thread has an event loop already
            found = thread.submit(asyncio.run, identity()).result()
    except (OSError, asyncio.TimeoutError):
        raise ConnectionError(f"no Dask scheduler answers at {address} within {_ANSWER:g} s") from None
    except Exception as error:
        why = f": {error}" if isinstance(error, ValueError) else ""  # other errors come from a server that is not Dask
        raise ValueError(f"{address!r} is no address of a Dask scheduler, such as tcp://host:8786{why}") from None
    if found.get("type") != "Scheduler":
        raise ValueError(f"{address} is the address of a Dask {found.get('type')}; give that of the scheduler")
    return address


def _check(client, address):
    """Checks the workers; see :func:`connect`."""
    with contextlib.suppress(asyncio.TimeoutError):  # the built-in one since Python 3.11
        client.wait_for_workers(1, timeout=_ANSWER)
    found = client.run(_fitness, on_error="return")
    if not found:
        raise ConnectionError(
            f"the Dask scheduler at {address} has no workers; start some with dask worker {address} --nthreads 1"
        )
    for worker, facts in found.items():
        if isinstance(facts, Exception):
            raise ValueError(f"the Dask worker {worker} cannot import this warpcloth, install it there: {facts}")
        if facts["source"] != package_digest():
            raise ValueError(
                f"the Dask worker {worker} has code of warpcloth {facts['source']}, and this process {package_digest()}; "
                "install the same on all machines and start the workers again"
            )
        if facts["arithmetic"] != "1":
            raise ValueError(
                f"the Dask worker {worker} computes with several threads, which would take the cores of others; start it with "
                "OMP_NUM_THREADS=1, or with a nanny, which sets it"
            )
    if any(facts["threads"] > 1 for facts in found.values()):
        warnings.warn(
            "Dask workers measure one at a time whatever threads they have; --nthreads 1 and a worker a core use all",
            stacklevel=4,
        )
    processors = Counter(facts["processor"] for facts in found.values())
    if len(processors) > 1:
        names = ", ".join(f"{name} ({count})" for name, count in processors.items())
        warnings.warn(f"the Dask workers differ, and so will times: {names}", stacklevel=4)


def _fitness(dask_worker):
    """Runs in a worker, and returns the facts to check."""
    initialise_warp()
    return {
        "source": package_digest(),
        "arithmetic": os.environ.get("OMP_NUM_THREADS"),
        "threads": dask_worker.state.nthreads,
        "processor": processor(),
    }


def files_of(task):
    """Returns the files that the arguments of a task name, and that are not part of the package, by name."""
    scene, reference = task.arguments.get("scene"), task.arguments.get("reference")
    found = {}
    if scene:
        name = scene["name"]
        path = Path(name if Path(name).suffix else find_source(name).path).resolve()
        if Path(name).suffix or folders()[-1].resolve() not in path.parents:
            found[name] = path
    if isinstance(reference, str):
        found[reference] = Path(reference)
    return found


def unpack(packed, files, modules):
    """Runs in a worker, and calls what :meth:`Cluster.submit` packed, with local files and the extensions of the client."""
    load_only(name if sent is None else _kept(*sent) for name, sent in modules.items())
    function, task, arguments = pickle.loads(packed)
    here = {name: _kept(*sent) for name, sent in files.items()}
    return function(replace(task, arguments=_moved(task.arguments, here)), *arguments)


def _kept(file, content):
    """Returns the path of a local file of this worker with the given content."""
    from distributed import get_worker

    path = Path(get_worker().local_directory) / "warpcloth" / hashlib.sha256(content).hexdigest()[:24] / file
    if not path.exists():
        path.parent.mkdir(parents=True, exist_ok=True)
        part = path.with_name(f"{file}.{threading.get_ident()}")
        part.write_bytes(content)
        part.replace(path)
    return str(path)


def _moved(arguments, here):
    """Returns arguments with the names of files replaced by local paths."""
    moved = dict(arguments)
    if "scene" in moved:
        moved["scene"] = moved["scene"] | {"name": here.get(moved["scene"]["name"], moved["scene"]["name"])}
    if isinstance(moved.get("reference"), str):
        moved["reference"] = here[moved["reference"]]
    return moved
