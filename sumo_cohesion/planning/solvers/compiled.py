"""CasADi Functions as machine code, where a C compiler is found; never needed.

The C code is CasADi's own. The library is kept under a digest of that code, the compiler and its
options, in the user's cache folder ($XDG_CACHE_HOME, ~/.cache): it is made once per machine.
Floating point is strict: compiled functions return what CasADi's virtual machine returns, bit for
bit, so that results do not depend on whether there is a compiler.
"""

from __future__ import annotations

import hashlib
import os
import platform
import shutil
import signal
import subprocess
import tempfile
import threading
from array import array
from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any, TypeAlias

import casadi as ca
import numpy as np

from sumo_cohesion.locks import alone
from sumo_cohesion.state import FloatArray

SWITCH = "SUMO_COHESION_COMPILE"
"""Environment variable; 0 keeps CasADi's virtual machine."""
OPTIONS = (
    "-O2",
    "-ffp-contract=off",
    "-fno-math-errno",
    "-fno-trapping-math",
    "-fno-semantic-interposition",
    "-fPIC",
    "-shared",
)
"""The three -fno- let calls be inlined that C's rules forbid to inline; no result changes."""
BUILDING = threading.RLock()
"""Held while expressions are built: CasADi counts who uses a symbol, and threads miscount."""
_PATIENCE = 300.0
"""Seconds after which a compiler is given up."""


def compiled(functions: Sequence[Any]) -> tuple[list[Any], str]:
    """Return the same functions compiled, and "compiled"; or as they are, and why."""
    if os.environ.get(SWITCH) == "0":
        return list(functions), f"not compiled: {SWITCH} is 0"
    compiler = find_compiler()
    if compiler is None:
        return list(functions), "not compiled: no C compiler (cc, gcc or clang) found"
    try:
        library = _library(functions, compiler)
        try:
            return [ca.external(f.name(), str(library)) for f in functions], "compiled"
        except RuntimeError:  # damaged, or made for another machine: make it again, once
            library.unlink(missing_ok=True)
            library = _library(functions, compiler)
            return [ca.external(f.name(), str(library)) for f in functions], "compiled"
    except (OSError, subprocess.SubprocessError, RuntimeError) as error:
        said = " ".join(str(error).split())[:200]
        return list(functions), f"not compiled: {said}"


def find_compiler() -> str | None:
    """Path of the C compiler that is used; None if there is none."""
    wanted = (os.environ.get("CC"), "cc", "gcc", "clang")
    return next((path for name in wanted if name and (path := shutil.which(name))), None)


def _library(functions: Sequence[Any], compiler: str) -> Path:
    """Path of the functions' library, made if it is not there."""
    code = _c_code(functions)
    stat, casadi = Path(compiler).resolve().stat(), version("casadi")
    machine = f"{platform.machine()} {platform.libc_ver()}"  # homes are shared between them
    about = f"{machine} {compiler} {stat.st_size} {stat.st_mtime_ns} {OPTIONS} {casadi}\n{code}"
    folder = cache_folder()
    folder.mkdir(parents=True, exist_ok=True)
    library = folder / f"{hashlib.sha256(about.encode()).hexdigest()[:32]}.so"
    if not library.exists():
        with alone(library.with_suffix(".lock")):  # one compiles, the others wait for it
            if not library.exists():
                _compile(code, compiler, library)
    return library


def cache_folder() -> Path:
    """Where compiled libraries are kept."""
    base = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(base) / "sumo-cohesion"


def _c_code(functions: Sequence[Any]) -> str:
    generator = ca.CodeGenerator("planner.c")
    for function in functions:
        generator.add(function)
    return str(generator.dump())


def _compile(code: str, compiler: str, library: Path) -> None:
    with tempfile.TemporaryDirectory(dir=library.parent) as folder:
        source, new = Path(folder) / "planner.c", Path(folder) / "planner.so"
        source.write_text(code)
        command = [compiler, *OPTIONS, str(source), "-o", str(new), "-lm"]
        try:
            failed, said = _call(command)
        except subprocess.TimeoutExpired:
            raise RuntimeError(f"{compiler} was given up after {_PATIENCE:g} s") from None
        if failed:
            raise RuntimeError(f"{compiler} failed: {said[-200:]}")
        new.replace(library)


def _call(command: Sequence[str]) -> tuple[int, str]:
    """Run a compiler: its exit status and what it said on standard error.

    What it starts is in its group, and ends with it if it is given up or interrupted.
    """
    with subprocess.Popen(
        command,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
        errors="replace",
        start_new_session=True,
    ) as process:
        try:
            _, said = process.communicate(timeout=_PATIENCE)
        except BaseException:
            try:
                os.killpg(process.pid, signal.SIGKILL)
            except ProcessLookupError:  # all have ended
                pass
            except (AttributeError, PermissionError):  # Windows; macOS, if all are zombies
                process.kill()
            raise
    return process.returncode, said


Numbers: TypeAlias = "FloatArray | array[float]"
"""What a function can read and write in place."""


class BoundCall:
    """A call without arguments that reads and writes arrays in place: nothing is converted."""

    def __init__(
        self, function: Any, inputs: Sequence[Numbers], outputs: Sequence[Numbers]
    ) -> None:
        self._keep = (function, inputs, outputs)  # CasADi keeps only their addresses
        self._buffer, self._run = function.buffer()
        for i, numbers in enumerate(inputs):
            self._buffer.set_arg(i, _flat(numbers))
        for i, numbers in enumerate(outputs):
            self._buffer.set_res(i, _flat(numbers))

    def __call__(self) -> None:
        """Read the inputs, write the outputs."""
        self._run()


def _flat(numbers: Numbers) -> memoryview:
    """Return the numbers' own memory; ValueError if they do not lie side by side in it."""
    array = np.asarray(numbers)
    if not array.flags.c_contiguous:
        raise ValueError("a function cannot read in place what does not lie side by side")
    return array.reshape(-1).data
