"""Processes for runs: reused while healthy; one that crashes, hangs or eats memory costs one call.

Pools of the standard library and of joblib break as a whole when one of their processes dies, and
know no time limit. Here each process does one call at a time, for a thread that waits for it, so
that it is always known which call a lost process was doing.
"""

from __future__ import annotations

import contextlib
import errno
import importlib
import os
import pickle
import queue
import shutil
import signal
import struct
import subprocess
import sys
import tempfile
import threading
import traceback
from collections.abc import Callable, Sequence
from functools import lru_cache
from pathlib import Path
from types import FrameType
from typing import IO, Any, Literal, NamedTuple

from sumo_cohesion.errors import InputsChangedError, SimulationError, StorageError, UserError

Kind = Literal["crash", "timeout", "memory", "error"]
CALLS_PER_PROCESS = 500
"""A process is replaced after so many calls: native libraries leak."""
_SIZE = struct.Struct("<Q")
_NO_SPACE = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS}


class Limits(NamedTuple):
    """What one call may take: ``seconds`` of wall time, ``memory`` in GB."""

    seconds: float
    memory: float


NO_LIMITS = Limits(float("inf"), float("inf"))


class CallFailedError(Exception):
    """A call that gave no result: how it ended (``kind``) and one line that says why."""

    def __init__(self, kind: Kind, reason: str) -> None:
        super().__init__(reason)
        self.kind = kind
        self.reason = " ".join(reason.split())


class _Answer(NamedTuple):
    """What comes back from a process; ``error`` names the kind of exception, if one was raised."""

    value: Any
    error: str
    peak_memory: float  # GB


class Workers:
    """Calls one function, ``module:name``, in processes of their own.

    Safe to use from many threads: each call has a process to itself, made when none is idle.
    """

    def __init__(self, task: str, limits: Limits, paths: Sequence[str] = ()) -> None:
        self._task = task
        self._limits = limits
        self._paths = tuple(paths) or search_paths()
        self._idle: list[_Process] = []
        self._all: set[_Process] = set()
        self._lock = threading.Lock()
        self._closed = False

    def call(self, *arguments: Any) -> Any:
        """Call the function.

        Raises
        ------
        CallFailedError
            If the process died, took too long or too much memory, or the function raised.
        UserError, SimulationError
            As the function raised them.
        """
        process = self._take()
        try:
            answer = process.call(arguments, self._limits)
        except BaseException:
            self._drop(process)
            raise
        worn = process.calls >= CALLS_PER_PROCESS or answer.peak_memory > self._limits.memory / 2
        if answer.error == "memory" or worn or self._closed:
            self._drop(process)
        else:
            with self._lock:
                self._idle.append(process)
        return _value(answer, self._limits)

    def _take(self) -> _Process:
        with self._lock:
            while self._idle:
                process = self._idle.pop()
                if process.is_alive():
                    return process
                self._all.discard(process)
                process.kill()
            if self._closed:
                raise CallFailedError("crash", "the workers have been closed")
            # Known before it is ready, so that close() can end it while it starts.
            process = _Process(self._task, self._paths)
            self._all.add(process)
        try:
            process.wait_until_ready(self._limits.memory)
        except BaseException:
            self._drop(process)
            raise
        return process

    def _drop(self, process: _Process) -> None:
        with self._lock:
            self._all.discard(process)
        process.kill()

    def close(self) -> None:
        """End all processes, busy ones too."""
        self._closed = True
        with self._lock:
            processes, self._all, self._idle = list(self._all), set(), []
        for process in processes:
            process.kill()


def _value(answer: _Answer, limits: Limits) -> Any:
    if not answer.error:
        return answer.value
    if answer.error == "memory":
        raise CallFailedError("memory", f"needed more than {limits.memory:g} GB of memory")
    for kind in (InputsChangedError, StorageError, UserError, SimulationError):
        if answer.error == kind.__name__:
            raise kind(answer.value)
    raise CallFailedError("error", answer.value)


def search_paths() -> tuple[str, ...]:
    """Where this process finds modules, a user's planners among them: for processes elsewhere."""
    return tuple(path or str(Path.cwd()) for path in sys.path)


@lru_cache(maxsize=8)
def _workers_here(task: str, limits: Limits, paths: tuple[str, ...]) -> Workers:
    return Workers(task, limits, paths)


def call_here(task: str, limits: Limits, paths: tuple[str, ...], *arguments: Any) -> Any:
    """Call a task in a process below this one, which other calls use again.

    For engines that run functions in processes of their own, such as Dask's workers.
    """
    return _workers_here(task, limits, paths).call(*arguments)


class _Process:
    """One process and the two pipes to it."""

    def __init__(self, task: str, paths: Sequence[str]) -> None:
        self.calls = 0
        self._task = task
        # Appended to, so that what was said can be thrown away between calls.
        self._said = tempfile.TemporaryFile("a+b")  # noqa: SIM115 - closed in kill()
        # What a killed process leaves behind goes with this folder.
        self._folder = tempfile.mkdtemp(prefix="sumo-cohesion-")
        # The matrices here are tiny: threads of the linear algebra library only fight for cores.
        single = {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}
        own = {"PYTHONPATH": os.pathsep.join(paths), "TMPDIR": self._folder}
        self._process = subprocess.Popen(
            [sys.executable, "-c", f"from {__name__} import serve; serve()"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._said,
            env={**single, **os.environ, **own},
        )

    def wait_until_ready(self, memory: float) -> None:
        """Wait until the process has imported what it needs: no part of the first call's time."""
        try:
            _send(self._to, (self._task, memory))
            _receive(self._from)
        except (OSError, EOFError, ValueError):  # ValueError: killed by close() meanwhile
            reason = self._last_words() or "it ended at once"
            raise SimulationError(f"cannot start a worker process: {reason}") from None

    def is_alive(self) -> bool:
        """Tell whether the process can take a call."""
        return self._process.poll() is None

    @property
    def _to(self) -> IO[bytes]:
        assert self._process.stdin is not None
        return self._process.stdin

    @property
    def _from(self) -> IO[bytes]:
        assert self._process.stdout is not None
        return self._process.stdout

    def call(self, arguments: tuple[Any, ...], limits: Limits) -> _Answer:
        """Do one call; raises CallFailedError if the process dies or is too slow."""
        self.calls += 1
        expired = threading.Event()

        def expire() -> None:
            expired.set()
            self._process.kill()

        timer = threading.Timer(min(limits.seconds, threading.TIMEOUT_MAX), expire)
        timer.daemon = True
        timer.start()
        try:
            _send(self._to, arguments)
            answer: _Answer = _receive(self._from)
        except (OSError, EOFError, ValueError):  # ValueError: killed by close() meanwhile
            if expired.is_set():
                reason = f"no result after {limits.seconds:g} s"
                raise CallFailedError("timeout", reason) from None
            raise CallFailedError("crash", self._death()) from None
        finally:
            timer.cancel()
        if expired.is_set():  # in time, but killed all the same: not to be used again
            self._process.wait()
        self._said.truncate(0)
        return answer

    def _death(self) -> str:
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(timeout=10)
        status = self._process.returncode
        if status is not None and status < 0:
            name = signal.Signals(-status)
            how = f"killed by {name.name} ({(signal.strsignal(name) or '').lower()})"
        else:
            how = f"exit status {status}"
        words = self._last_words()
        return f"the worker process died: {how}" + (f"; it said {words!r}" if words else "")

    def _last_words(self) -> str:
        with contextlib.suppress(ValueError):  # closed by kill() meanwhile
            self._said.seek(0)
            lines = self._said.read().decode(errors="replace").strip().splitlines()
            return lines[-1].strip()[:200] if lines else ""
        return ""

    def kill(self) -> None:
        """End the process, whatever it does."""
        self._process.kill()
        self._process.wait()
        for pipe in (self._to, self._from, self._said):
            with contextlib.suppress(OSError, ValueError):  # ValueError: closed by another thread
                pipe.close()
        shutil.rmtree(self._folder, ignore_errors=True)


def _send(pipe: IO[bytes], message: Any) -> None:
    data = pickle.dumps(message)
    pipe.write(_SIZE.pack(len(data)) + data)
    pipe.flush()


def _receive_bytes(pipe: IO[bytes]) -> bytes:
    head = pipe.read(_SIZE.size)
    data = pipe.read(_SIZE.unpack(head)[0]) if len(head) == _SIZE.size else b""
    if not data:
        raise EOFError
    return data


def _receive(pipe: IO[bytes]) -> Any:
    return pickle.loads(_receive_bytes(pipe))


def serve() -> None:
    """Answer calls until the other side closes its pipe: the process's whole life."""
    calls, answers = os.fdopen(os.dup(0), "rb"), os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # what native libraries print must not mix with the answers
    for number in (signal.SIGINT, signal.SIGTERM):  # Ctrl-C and the like are the parent's to handle
        signal.signal(number, signal.SIG_IGN)
    task, memory = _receive(calls)
    _limit_memory(memory)
    module, _, name = task.partition(":")
    function = getattr(importlib.import_module(module), name)
    _send(answers, "ready")
    inbox: queue.SimpleQueue[bytes] = queue.SimpleQueue()

    def read() -> None:
        # In a thread of its own: it notices at once, amid a run, that nobody waits any more.
        with contextlib.suppress(OSError, EOFError):
            while True:
                inbox.put(_receive_bytes(calls))
        os._exit(0)

    threading.Thread(target=read, daemon=True).start()
    while True:
        answer = _answer(function, inbox.get())
        try:
            _send(answers, answer)
        except BrokenPipeError:
            os._exit(0)


def _answer(function: Callable[..., Any], call: bytes) -> _Answer:
    value: Any
    try:
        value, error = function(*pickle.loads(call)), ""
    except MemoryError:
        value, error = "", "memory"
    except (UserError, SimulationError) as raised:
        value, error = str(raised), type(raised).__name__
    except OSError as raised:
        full = raised.errno in _NO_SPACE
        value, error = _described(raised), StorageError.__name__ if full else "error"
    except Exception as raised:
        value, error = _described(raised), "error"
    return _Answer(value, error, _peak_memory())


def _described(error: Exception) -> str:
    """One line: the exception, and where in the code it was raised."""
    frames = traceback.extract_tb(error.__traceback__)
    where = f" ({Path(frames[-1].filename).name}:{frames[-1].lineno})" if frames else ""
    text = f"{type(error).__name__}: {error}{where}"
    return text.encode("utf-8", "replace").decode()  # file names need not be text


def _limit_memory(gigabytes: float) -> None:
    """Make allocations beyond the limit fail, where the system can (not on Windows, macOS)."""
    if gigabytes == float("inf"):
        return
    with contextlib.suppress(ImportError, AttributeError, ValueError, OSError):
        import resource

        limit = int(gigabytes * 1e9)
        # Private memory only: libraries map much more than they use.
        resource.setrlimit(resource.RLIMIT_DATA, (limit, limit))


def _peak_memory() -> float:
    """GB of memory that this process has held at most; 0 where the system does not say."""
    with contextlib.suppress(OSError):
        # Not getrusage: its peak begins with that of the process that started this one.
        status = Path("/proc/self/status").read_text()
        return int(status.partition("VmHWM:")[2].split()[0]) / 1e6
    return 0.0


def processors() -> int:
    """Processors that this process may use: a batch system gives fewer than there are."""
    try:
        return len(os.sched_getaffinity(0))
    except AttributeError:  # macOS, Windows
        return os.cpu_count() or 1


class stopped_by_signals:  # noqa: N801 - reads as a function where it is used
    """Context: SIGTERM, as batch systems send it, is a KeyboardInterrupt too."""

    def __enter__(self) -> None:
        self._old: Any = None
        if threading.current_thread() is threading.main_thread():
            self._old = signal.signal(signal.SIGTERM, self._interrupt)

    def __exit__(self, *_: object) -> None:
        if self._old is not None:
            signal.signal(signal.SIGTERM, self._old)

    @staticmethod
    def _interrupt(_number: int, _frame: FrameType | None) -> None:
        raise KeyboardInterrupt
