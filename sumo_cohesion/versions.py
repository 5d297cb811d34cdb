"""What results stand on."""

from __future__ import annotations

import platform
from importlib.metadata import version


def versions() -> dict[str, str]:
    """Versions of everything that can change a result."""
    packages = ("sumo-cohesion", "libsumo", "sumolib", "casadi", "numpy", "scipy", "pandas")
    return {"python": platform.python_version()} | {name: version(name) for name in packages}
