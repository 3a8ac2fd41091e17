"""How a comparison of controllers is shown: tables, what must be known besides, a picture a net."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np

from comparing import COUNTED, WAITED, Figures, measure

COLORS = ("#000000", "#0b6fa4", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#7b3294", "#8c6d31", "#999999")
MARKERS = ("o", "s", "^", "D", "v", "P", "X", "<", ">", "p", "h", "*", "d")
STYLES = ("-", "--", ":")


def tables(rows: Sequence[Figures]) -> list[tuple[str, list[str], list[list[str]]]]:
    """Title, heads and cells: for each net its figures, and the first controller against the best of the others."""
    found = []
    for net in dict.fromkeys(row["net"] for row in rows):
        own = [row for row in rows if row["net"] == net]
        waited = any(WAITED in row for row in own)
        unit = "s a vehicle" if measure(net).endswith("_s") else "veh h"
        heads = ["demand", "controller", f"delay ({unit})", "median", "time spent (veh h)", "gridlocked"]
        heads += ["unsafe s, fallbacks, teleports", "control / SUMO", *(["longest red (s)"] if waited else [])]
        cells = [
            [
                f"{row['demand']:g}",
                row["controller"],
                _amount(row["mean"], row["low"], row["high"]),
                _amount(row["median"]),
                _amount(row["spent_mean"], row["spent_low"], row["spent_high"]),
                _count(row["gridlocked"]),
                ", ".join("?" if row[name] is None else f"{row[name]:g}" for name in COUNTED),
                "" if row["control_over_sumo"] is None else f"{row['control_over_sumo']:.2f}",
                *([_count(row.get(WAITED))] if waited else []),
            ]
            for row in own
        ]
        found.append((f"{net}: mean of {_seeds(own)} (95 % intervals)", heads, cells))
        against = [
            [f"{row['demand']:g}", row["best_other"], _ratio(row["ratio"], row["ratio_low"], row["ratio_high"])]
            for row in own
            if "ratio" in row
        ]
        if against:
            title = f"{net}: delay under {own[0]['controller']} over that under the best other one, seed by seed"
            found.append((title, ["demand", "best other", "ratio (95 %)"], against))
    return found


def remarks(rows: Sequence[Figures]) -> list[str]:
    """What a reader of the tables must know besides: failures, fallbacks, signals left alone."""
    said: dict[str, None] = {}
    for row in rows:
        place = f"{row['net']}, demand {row['demand']:g}, {row['controller']}"
        for reason in dict.fromkeys(row["failed"].values()):
            seeds = ", ".join(str(seed) for seed, why in row["failed"].items() if why == reason)
            said[f"{place}: seeds {seeds} failed: {reason}"] = None
        said |= {f"{place}: fallback {reason}": None for reason in row["fallback_reasons"]}
        said |= {f"{row['net']}: {signal} left alone: {why}": None for signal, why in row["left_alone"].items()}
    return list(said)


def _seeds(rows: Sequence[Figures]) -> str:
    most = max(len(row["seeds"]) for row in rows)
    return f"{most} seeds" if most > 1 else "one seed"


def _amount(value: float | None, low: float | None = None, high: float | None = None) -> str:
    if value is None:
        return "failed"
    digits = 0 if value >= 100 else 1  # noqa: PLR2004 - three digits say enough
    return f"{value:.{digits}f}" + ("" if low is None else f" ({low:.{digits}f}-{high:.{digits}f})")


def _ratio(value: float | None, low: float | None, high: float | None) -> str:
    if value is None:
        return "not known"
    return f"{value:.3f} ({'no interval' if low is None else f'{low:.3f}-{high:.3f}'})"


def _count(value: float | None) -> str:
    return "not known" if value is None else f"{value:g}"


def draw(rows: Sequence[Figures], folder: Path) -> list[Path]:
    """A PNG for each net into `folder`: mean delay with its interval against demand, a line a controller."""
    import matplotlib as mpl  # noqa: PLC0415 - heavy

    mpl.use("Agg")
    mpl.rcParams["text.parse_math"] = False  # names may have dollars in them
    from matplotlib import pyplot as plt  # noqa: PLC0415 - heavy

    paths = []
    for net in dict.fromkeys(row["net"] for row in rows):
        own = [row for row in rows if row["net"] == net and row["mean"] is not None]
        names = list(dict.fromkeys(row["controller"] for row in own))
        demands = sorted({row["demand"] for row in own})
        if not own:
            continue
        # Side by side where they would hide each other, but by so little that steep lines don't seem to cross.
        span = demands[-1] - demands[0] or 0.2
        apart = min(0.7 * min(np.diff(demands), default=span) / len(names), 0.004 * span)
        aside = max(0.08 * span, 0.6 * apart * len(names))
        figure, axes = plt.subplots(figsize=(10.5, 5.6), layout="constrained")
        for index, name in enumerate(names):
            line = sorted((row for row in own if row["controller"] == name), key=lambda row: row["demand"])
            x = np.array([row["demand"] for row in line]) + apart * (index - (len(names) - 1) / 2)
            mean, low, high = (
                np.array([row["mean"] if row[end] is None else row[end] for row in line])
                for end in ("mean", "low", "high")
            )
            color, marker = COLORS[index % len(COLORS)], MARKERS[index % len(MARKERS)]
            shape: dict[str, Any] = {
                "color": color,
                "marker": marker,
                "linestyle": STYLES[index // len(COLORS) % len(STYLES)],
            }
            ends = [np.minimum(mean - low, 0.9 * mean), high - mean]
            axes.errorbar(
                x,
                mean,
                ends,
                **shape,
                markersize=5,
                linewidth=1.1,
                capsize=2,
                elinewidth=0.8,
                label=textwrap.fill(name, 30),
            )
            stuck = np.array([bool(row["gridlocked"]) for row in line])
            axes.plot(x[stuck], mean[stuck], marker, color=color, markerfacecolor="white", markersize=5, zorder=4)
        least, most = min(row["mean"] for row in own), max(row["high"] or row["mean"] for row in own)
        axes.set(yscale="log", ylim=(0.7 * least, 1.3 * most), xticks=demands, xlabel="demand")
        axes.set_xlim(demands[0] - aside, demands[-1] + aside)
        axes.set_xticks([], minor=True)
        formatter = mpl.ticker.FuncFormatter(lambda value, _: f"{value:g}")
        axes.yaxis.set_major_formatter(formatter)
        axes.yaxis.set_minor_formatter(mpl.ticker.LogFormatter(minor_thresholds=(1.5, 0.7)))
        axes.set_ylabel("mean delay (s a vehicle)" if measure(net).endswith("_s") else "total delay (veh h)")
        axes.set_title(
            f"{_short(net)}: mean of {_seeds(own)}, 95 % intervals; hollow: some seed gridlocked", fontsize=10
        )
        axes.grid(visible=True, which="both", linewidth=0.3)
        figure.legend(loc="outside right upper", frameon=False, fontsize=9)
        paths.append(_free(folder, _short(net)))
        figure.savefig(paths[-1], dpi=150)
        plt.close(figure)
    return paths


def _free(folder: Path, name: str) -> Path:
    """A picture's file that is not there yet: nets may be called alike."""
    named = (folder / f"{name}{f'-{number}' if number > 1 else ''}.png" for number in count(1))
    return next(path for path in named if not path.exists())


def _short(net: str) -> str:
    """A net's name for a file: a path's own name, after that of its folder."""
    path = Path(net)
    return f"{path.resolve().parent.name}-{path.name.partition('.')[0]}" if path.suffix else net
