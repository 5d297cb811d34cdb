"""What was learned: weights, how sure they are, and of what."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from html import escape
from math import isnan
from pathlib import Path
from typing import Any

import pandas as pd

from sumo_cohesion.errors import UserError
from sumo_cohesion.planning.reward import RewardWeights

DIGITS = 4
"""Significant digits of a weight."""


@dataclass(frozen=True, repr=False)
class Learned:
    """Weights theta that were learned from driving.

    Attributes
    ----------
    reward : the weights, for ``overrides={"planner.reward": ...}`` or a file.
    temperature : how far from optimal the driving was; the weights' scale is its inverse.
    weights : one row per term: default, learned, low, high (90 % interval of a bootstrap over
        runs), identified, why not, share of the reward's curvature.
    segments : one row per segment: run, vehicle, time, log-likelihood, misfit q / f (about one
        where the reward fits), kept, and the reason if not.
    fit : models beside one another on runs that they were not fitted to: median log-likelihood per
        second, and how far predictions are off after 1, 2 and 3 s.
    predictions : every such prediction: run, model, horizon (s), how far it is off (m).
    warnings : what to mind before using the weights.
    about : how it was learned: source, steps, counts, digest of the demonstrations, versions.
    anchor : the term that all weights are relative to.
    """

    reward: RewardWeights
    temperature: float
    weights: pd.DataFrame
    segments: pd.DataFrame
    fit: pd.DataFrame
    predictions: pd.DataFrame
    warnings: Sequence[str] = ()
    about: Mapping[str, Any] = field(default_factory=dict)
    anchor: str = "lane"

    def __repr__(self) -> str:
        names = self.weights.loc[self.weights["identified"], "term"]
        kept = f"{int(self.segments['kept'].sum())} of {len(self.segments)} segments"
        return f"<Learned {', '.join(names)} from {kept}>"

    def _repr_html_(self) -> str:
        return f"<p>{escape(repr(self))}</p>{self.weights.to_html(index=False)}"

    def write(self, path: str | Path) -> Path:
        """Write the weights as TOML, for ``--set planner.reward=@path``.

        Raises
        ------
        UserError
            If a file that is none of ours is there, or it cannot be written.
        """
        path = Path(path)
        require_writable(path)
        new = path.with_name(f".{path.name}.new")
        try:
            new.write_text(self.to_toml(), encoding="utf-8")
            new.replace(path)
        except OSError as error:
            raise _cannot_write(path, error) from None
        return path

    def summary(self) -> str:
        """Weights, and models on held-out runs, as text."""
        lines = [f"{'term':20}{'default':>12}{'learned':>12}  90 % of a bootstrap over runs"]
        for row in self.weights.to_dict(orient="records"):
            said = row["kept_default"] or self._interval(row)
            lines.append(f"{row['term']:20}{row['default']:12.4g}{row['learned']:12.4g}  {said}")
        lines.append(f"temperature {self.temperature:.3g}")
        if len(self.fit):
            lines += ["", "on runs held out: log-likelihood (nats/s), m off after 1, 2, 3 s"]
        for row in self.fit.to_dict(orient="records"):
            numbers = [row["log_likelihood"], *[row[f"off_{h}s"] for h in (1, 2, 3)]]
            cells = ["-" if isnan(n) else f"{n:.3g}" for n in numbers]
            lines.append(f"{row['model']:30}" + "".join(f"{cell:>9}" for cell in cells))
        return "\n".join(lines)

    def _interval(self, row: Mapping[Any, Any]) -> str:
        """Say how sure a weight is."""
        if row["term"] == self.anchor:
            return "what the others are relative to"
        known = not isnan(row["low"])
        return f"{row['low']:.3g} to {row['high']:.3g}" if known else "not worked out"

    def to_toml(self) -> str:
        """Return the weights and how they were learned, as TOML."""
        lines = [_FIRST_LINE, "# Use it: --set planner.reward=@FILE, anywhere.", ""]
        lines += ["[planner.reward]"]
        for row in self.weights.to_dict(orient="records"):
            value = f"{row['term']} = {row['learned']:.{DIGITS}g}"
            if row["kept_default"]:
                lines.append(f"{value}  # not learned: {row['kept_default']}")
            elif row["term"] == self.anchor:
                lines.append(f"{value}  # {self._interval(row)}")
            else:
                lines.append(f"{value}  # 90 %: {self._interval(row)}")
        lines += ["", "[learned]", f"temperature = {self.temperature:.{DIGITS}g}"]
        lines += [f"{key} = {_toml(value)}" for key, value in self.about.items()]
        lines += [f"warnings = {_toml(list(self.warnings))}", ""]
        return "\n".join(lines)


_FIRST_LINE = "# Reward weights learned from driving by sumo-cohesion learn."


def require_writable(path: Path) -> None:
    """Raise UserError unless weights can be written there: over none or earlier ones of ours."""
    try:
        if path.is_dir():
            raise UserError(f"{path}: is a folder; name a file with --out, e.g. theta.toml")
        if path.exists() and not path.read_bytes().startswith(_FIRST_LINE.encode()):
            raise UserError(f"{path}: was not written by learn and stays; name another --out")
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise _cannot_write(path, error) from None


def _cannot_write(path: Path, error: OSError) -> UserError:
    said = error.strerror or error
    return UserError(f"{path}: cannot be written ({said}); choose another --out")


def _toml(value: Any) -> str:
    if isinstance(value, Mapping):
        return "{ " + ", ".join(f"{_toml(str(k))} = {_toml(v)}" for k, v in value.items()) + " }"
    if isinstance(value, list | tuple):
        return "[" + ", ".join(_toml(v) for v in value) + "]"
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, int | float):
        return repr(value if isinstance(value, int) else float(value))
    quoted = str(value).replace("\\", "\\\\").replace('"', '\\"')
    return '"' + "".join(c if c.isprintable() else " " for c in quoted) + '"'
