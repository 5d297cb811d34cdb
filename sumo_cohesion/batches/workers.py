"""Processes for runs: reused while healthy; one that crashes, hangs or eats memory costs one call.

Pools of the standard library and of joblib break as a whole when one of their processes dies, and
know no time limit. Here each process does one call at a time, for a thread that waits for it, so
that it is always known which call a lost process was doing. pebble's ProcessPool has time limits
and survives lost processes, too; but it starts them by ``spawn``, which imports the user's main
script again, so that one without a ``__main__`` guard could not call compare().

A process and what it starts are a group of their own, and end together. A process finds the
standard library and what is installed before the user's own modules, whatever these are called.
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
import site
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
from typing import IO, Any, Literal, NamedTuple, NoReturn

import sumo_cohesion
from sumo_cohesion.errors import SimulationError, StorageError, UserError

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
    """A call that gave no result: how it ended (``kind``) and one line that says why.

    ``signal`` is the number of the one that ended the process; 0 if none did.
    """

    def __init__(self, kind: Kind, reason: str, signal: int = 0) -> None:
        super().__init__(kind, reason, signal)  # all of it, so that it can be sent elsewhere
        self.kind = kind
        self.reason = " ".join(reason.split())
        self.signal = signal

    def __str__(self) -> str:
        return self.reason


class _Answer(NamedTuple):
    """What comes back from a process: a value, or with ``error`` an exception or what it said."""

    value: Any
    error: str
    peak_memory: float  # GB


class Workers:
    """Calls one function, ``module:name``, in processes of their own.

    Safe to use from many threads: each call has a process to itself, made when none is idle.
    What the processes print is thrown away, but for the last words of those that die, unless they
    are ``heard``: then it goes where this process's errors go.
    """

    def __init__(
        self, task: str, limits: Limits, paths: Sequence[str] = (), *, heard: bool = False
    ) -> None:
        self._task = task
        self._limits = limits
        self._heard = heard
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
            process = _Process(self._task, self._paths, heard=self._heard)
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
        most = f"{limits.memory:g} GB of memory" if limits.memory < float("inf") else "there is"
        raise CallFailedError("memory", f"needed more than {most}")
    if isinstance(answer.value, UserError | SimulationError):
        raise answer.value
    raise CallFailedError("error", answer.value)


def call_apart(task: str, *arguments: Any) -> Any:
    """Call a task once, in a process of its own; what it prints is heard. Raises as Workers do."""
    workers = Workers(task, NO_LIMITS, heard=True)
    with stopped_by_signals():
        try:
            return workers.call(*arguments)
        finally:
            workers.close()


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


_START = """
import importlib.util, sys
spec = importlib.util.spec_from_file_location("sumo_cohesion", sys.argv[1])
sys.modules["sumo_cohesion"] = package = importlib.util.module_from_spec(spec)
spec.loader.exec_module(package)
from sumo_cohesion.batches.workers import serve
serve()
"""
"""A process's program. It takes this very package, wherever that lies, without its folder on the
path, where users may have modules of any name."""


class _Process:
    """One process, the two pipes to it, and whatever it starts."""

    def __init__(self, task: str, paths: Sequence[str], *, heard: bool) -> None:
        self.calls = 0
        self._task = task
        self._paths = tuple(paths)
        self._ending, self._ended = threading.Lock(), False
        # Appended to, so that what was said can be thrown away between calls.
        self._said = tempfile.TemporaryFile("a+b")  # noqa: SIM115 - closed in kill()
        # What a killed process leaves behind goes with this folder.
        self._folder = tempfile.mkdtemp(prefix="sumo-cohesion-")
        # The matrices here are tiny: threads of the linear algebra library only fight for cores.
        single = {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}
        self._process = subprocess.Popen(
            [sys.executable, "-P", "-c", _START, sumo_cohesion.__file__],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=None if heard else self._said,
            env={**single, **os.environ, "TMPDIR": self._folder},
            start_new_session=True,
        )

    def wait_until_ready(self, memory: float) -> None:
        """Wait until the process has imported what it needs: no part of the first call's time."""
        try:
            _send(self._to, (self._task, memory, self._paths))
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
            self._end_group()

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
            raise self._death() from None
        finally:
            timer.cancel()
        if expired.is_set():  # in time, but killed all the same: not to be used again
            self._process.wait()
        self._said.truncate(0)
        return answer

    def _death(self) -> CallFailedError:
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(timeout=10)
        status, number = self._process.returncode, 0
        if status is not None and status < 0:
            number = signal.Signals(-status)
            how = f"killed by {number.name} ({(signal.strsignal(number) or '').lower()})"
        else:
            how = f"exit status {status}"
        words = self._last_words()
        said = f"; it said {words!r}" if words else ""
        return CallFailedError("crash", f"the worker process died: {how}{said}", number)

    def _last_words(self) -> str:
        with contextlib.suppress(ValueError):  # closed by kill() meanwhile
            self._said.seek(0)
            lines = self._said.read().decode(errors="replace").strip().splitlines()
            return lines[-1].strip()[:200] if lines else ""
        return ""

    def _end_group(self) -> None:
        """End the process and all that it started, once: its number may then be another's."""
        with self._ending:
            if self._ended:
                return
            self._ended = True
            try:
                os.killpg(self._process.pid, signal.SIGKILL)
            except ProcessLookupError:  # all have ended
                pass
            except (AttributeError, PermissionError):  # Windows; macOS, if all are zombies
                self._process.kill()

    def kill(self) -> None:
        """End the process, whatever it does and has started."""
        self._end_group()
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
    nothing = os.open(os.devnull, os.O_RDWR)
    os.dup2(nothing, 0)  # what a run reads must not be the calls
    os.dup2(2, 1)  # what native libraries print must not mix with the answers
    _keep_from_children(nothing, calls.fileno(), answers.fileno())
    for number in (signal.SIGINT, signal.SIGTERM):  # Ctrl-C and the like are the parent's to handle
        signal.signal(number, signal.SIG_IGN)
    task, memory, paths = _receive(calls)
    sys.path[:] = _installed_first([*paths, *sys.path])
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
        _end()

    threading.Thread(target=read, daemon=True).start()
    while True:
        answer = _answer(function, inbox.get())
        try:
            _send(answers, answer)
        except BrokenPipeError:
            _end()


def _installed_first(paths: Sequence[str]) -> list[str]:
    """Put the standard library and what is installed first, and keep the order of the rest."""
    homes = [Path(p) for p in (sys.prefix, sys.base_prefix, site.getusersitepackages())]
    return sorted(
        dict.fromkeys(paths), key=lambda path: not any(Path(path).is_relative_to(h) for h in homes)
    )


def _end() -> NoReturn:
    """End this process and all that it started, with the files that it has left."""
    if "sumo-cohesion-" in os.environ.get("TMPDIR", ""):
        shutil.rmtree(os.environ["TMPDIR"], ignore_errors=True)
    with contextlib.suppress(AttributeError):  # Windows
        if os.getpgrp() == os.getpid():  # a group of its own
            os.killpg(0, signal.SIGKILL)
    os._exit(0)


def _keep_from_children(nothing: int, *pipes: int) -> None:
    """See to it that no forked child holds a pipe, so that its end is this process's end."""

    def let_go() -> None:
        for pipe in pipes:
            os.dup2(nothing, pipe)

    with contextlib.suppress(AttributeError):  # Windows
        os.register_at_fork(after_in_child=let_go)


def _answer(function: Callable[..., Any], call: bytes) -> _Answer:
    value: Any
    try:
        value, error = function(*pickle.loads(call)), ""
    except MemoryError:
        value, error = "", "memory"
    except (UserError, SimulationError) as raised:
        if raised.__cause__ is not None:  # which stays here: somebody's code that went wrong
            raised.add_note("".join(traceback.format_exception(raised.__cause__)))
        value, error = raised, "error"
    except OSError as raised:
        said = _described(raised)
        value, error = StorageError(said) if raised.errno in _NO_SPACE else said, "error"
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
