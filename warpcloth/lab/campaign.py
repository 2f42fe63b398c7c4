"""Runs measurements in parallel, stores results, and continues after an interruption."""

import contextlib
import json
import multiprocessing
import os
import time
from concurrent.futures import BrokenExecutor, ProcessPoolExecutor, ThreadPoolExecutor, as_completed
from pathlib import Path

from ..base.digest import source_digest
from ..base.extensions import extensions
from .measurements import run
from .worker import begin

_HEAD = b'{"key": "'  # of a line of results
# One thread per process, because more would take cores from the others, and Warp's CPU kernels use one.
_ONE_THREAD = {name: "1" for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMEXPR_NUM_THREADS")}


class Store:
    """Results by key in a file with a line of JSON for each, to which several processes may append at a time.

    A truncated line, after a crash or on a full disk, is ignored, and its result is measured again. The file is never
    rewritten.

    Args:
        path: The file, which is made with its folder if it does not exist; None keeps results in memory.

    Raises:
        ValueError: The path is not such a file.
    """

    def __init__(self, path=None):
        self.path, self._results, self._machines = None if path is None else Path(path), {}, {}
        if self.path is None:
            return
        self.path.parent.mkdir(parents=True, exist_ok=True)
        if not self.path.exists():
            return
        if not self.path.is_file():
            raise ValueError(f"{self.path}: is no file; it must be one of results, or free")
        # JSON text has no other line ends. After a crash, a file system may leave zeros in place of a line.
        for number, line in enumerate(self.path.read_bytes().split(b"\n"), 1):
            line = line.strip(b"\0\r ")
            try:
                entry = json.loads(line)
                self._results[entry["key"]], self._machines[entry["key"]] = entry["result"], entry.get("machine")
            except (ValueError, TypeError, KeyError):
                if not line.startswith(_HEAD) and not _HEAD.startswith(line):
                    raise ValueError(f"{self.path}, line {number}: is no result; remove the file or give another") from None

    def __contains__(self, task):
        return task.key in self._results

    def __getitem__(self, task):
        return self._results[task.key]

    def __len__(self):
        return len(self._results)

    def machine(self, task):
        """Returns the name of the machine that measured a task."""
        return self._machines[task.key]

    def keep(self, task, result, machine):
        """Adds a result and the name of its machine; they are on the disk when this returns."""
        self._results[task.key], self._machines[task.key] = result, machine
        if self.path is None:
            return
        asked = {"key": task.key, "function": task.function, "arguments": task.arguments}
        text = json.dumps(asked | {"machine": machine, "result": result}).encode() + b"\n"
        try:
            with self.path.open("ab+", buffering=0) as file:
                if file.seek(0, os.SEEK_END):
                    file.seek(-1, os.SEEK_END)
                    text = text if file.read(1) == b"\n" else b"\n" + text  # ends a truncated line
                while text:  # one atomic write, unless the disk is full
                    text = text[file.write(text) :]
                os.fsync(file.fileno())
        except OSError as error:
            raise OSError(error.errno, error.strerror, str(self.path)) from None


def sweep(tasks, executor=None, store=None, progress=None, workers=None):
    """Measures all tasks that are not in the store, and yields (task, result) in order of completion.

    Args:
        tasks: :class:`warpcloth.lab.measurements.Task`\\s.
        executor: Any `concurrent.futures.Executor`, such as that of a Dask client; by default, processes on this machine, for
            which a script needs ``if __name__ == "__main__":``. Its processes may have another working directory; they read
            scenes, references and extensions from the same absolute paths. Threads of one process measure one after another.
        store: A :class:`Store`; without one nothing is kept.
        progress: Function called with (finished, tasks, seconds left or None) first and after each; or None.
        workers: Number of parallel processes without an executor, by default that of cores. Measured times include the load
            of the others.

    Raises:
        Exception: The error of a task. Finished results are kept, tasks that have not begun are dropped.
        ChildProcessError: A process was killed.
    """
    tasks = list(tasks)
    store = Store() if store is None else store
    known = [task for task in tasks if task in store]
    left = list({task.key: task for task in tasks if task not in store}.values())
    finished, started = len(tasks) - len(left), time.perf_counter()
    say = progress or (lambda *_: None)
    say(finished, len(tasks), None)
    for task in known:
        yield task, store[task]
    if not left:
        return
    modules = tuple(extensions())
    with contextlib.ExitStack() as stack:
        if executor is None:
            executor = stack.enter_context(processes(min(workers or os.cpu_count() or 1, len(left))))
        futures = {}
        try:
            for task in left:
                futures[executor.submit(run, task.located(), source_digest(), modules)] = task
            for done, future in enumerate(as_completed(futures), 1):
                task = futures[future]
                try:
                    result, machine = future.result()
                except BrokenExecutor as error:
                    raise ChildProcessError(
                        "a process that measures ended: killed, as for want of memory, or begun by a script without "
                        'if __name__ == "__main__":; what is finished is kept, and with fewer workers it takes less memory'
                    ) from error
                store.keep(task, result, machine)
                seconds = (time.perf_counter() - started) / done * (len(left) - done)
                say(finished + done, len(tasks), seconds)
                yield task, result
        finally:
            for future, task in futures.items():
                if not future.cancel() and future.done() and future.exception() is None and task not in store:
                    store.keep(task, *future.result())  # finished, but not yielded yet


def collect(tasks, name, **run):
    """Measures all tasks and returns the (result, machine) of each in their order; ``run`` is that of :func:`sweep`.

    Args:
        tasks: As for :func:`sweep`.
        name: Name of the :func:`kept_store`, if ``run`` has no ``store``.
        **run: Arguments of :func:`sweep`.
    """
    if "store" not in run:
        run["store"] = kept_store(name, run.get("executor"))
    results = {task.key: result for task, result in sweep(tasks, **run)}
    return [(results[task.key], run["store"].machine(task)) for task in tasks]


@contextlib.contextmanager
def environment(values):
    """Sets environment variables inside the block, for processes that start there."""
    before = {name: os.environ.get(name) for name in values}
    os.environ.update(values)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


@contextlib.contextmanager
def processes(workers):
    """Yields an executor of fresh processes, each with one thread for arithmetic. They start with the first task."""
    context = multiprocessing.get_context("spawn")
    with environment(_ONE_THREAD), ProcessPoolExecutor(workers, context, initializer=begin) as pool:
        try:
            yield pool
        except BaseException:
            pool.shutdown(wait=True, cancel_futures=True)
            raise


def kept_store(name, executor=None):
    """Returns the :class:`Store` of a chart in the cache folder; another one for an executor that may be of other machines."""
    local = executor is None or isinstance(executor, ProcessPoolExecutor | ThreadPoolExecutor)
    return Store(cache_folder() / ("" if local else "elsewhere") / f"{name}.jsonl")


def cache_folder():
    """Returns the folder of results and reference solutions: ``WARPCLOTH_CACHE``, else warpcloth in the user's cache folder."""
    named = os.environ.get("WARPCLOTH_CACHE")
    return Path(named) if named else Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "warpcloth"
