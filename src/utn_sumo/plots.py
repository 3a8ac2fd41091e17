"""Plots of a mismatch: error against horizon, error by link, predicted against measured. The one door to matplotlib."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from utn_sumo.contract import Network
from utn_sumo.mismatch import Errors, rmse

INK, MODEL, PERSISTENCE, HISTORY, FLOOR = "#333333", "#0b6fa4", "#c8553d", "#b08900", "#6b8e23"


def mismatch(result: dict[str, Any], network: Network, found: Errors, folder: Path) -> None:
    """Write three PNG files for one demand into `folder`."""
    import matplotlib as mpl  # noqa: PLC0415 - heavy

    mpl.use("Agg")
    from matplotlib import pyplot as plt  # noqa: PLC0415 - after the backend is chosen

    name = f"demand{result['demand']:g}"
    ahead = np.arange(1, len(result["rmse_veh"]) + 1)

    figure, axes = plt.subplots(figsize=(6.4, 4.2), layout="constrained")
    axes.plot(ahead, result["rmse_veh"], "o-", color=MODEL, label=f"model, {result['step_s']:g} s steps")
    axes.plot(ahead, result["persistence_rmse_veh"], "s--", color=PERSISTENCE, label="persistence")
    if found.history_veh is not None:
        axes.plot(ahead, rmse(found.history_veh).mean(axis=1), "^:", color=HISTORY, label="historical mean")
    if "floor_veh" in result:
        axes.plot(ahead, result["floor_veh"], "-", color=FLOOR, label="floor: spread of SUMO itself")
    axes.set(xlabel="cycles ahead", ylabel="RMSE of x, mean over links (veh)", ylim=(0, None), xticks=ahead)
    axes.set_title(f"{result['net']}, {result['controller']}, demand {result['demand']:g}")
    axes.legend(frameon=False)
    figure.savefig(folder / f"{name}-horizon.png", dpi=150)
    plt.close(figure)

    columns = 6
    rows = int(np.ceil(len(network.links) / columns))
    figure, grid = plt.subplots(
        rows, columns, figsize=(13, 2.2 * rows), sharex=True, layout="constrained", squeeze=False
    )
    for index, (axes, link) in enumerate(zip(grid.flat, network.links, strict=False)):
        error = found.x_veh[:, :, index]
        low, middle, high = np.quantile(error, [0.1, 0.5, 0.9], axis=1)
        axes.fill_between(ahead, low, high, color=MODEL, alpha=0.25, linewidth=0)
        axes.plot(ahead, middle, color=MODEL)
        axes.axhline(0, color=INK, linewidth=0.6)
        axes.set_title(f"link {link.id}", fontsize=9)
        axes.tick_params(labelsize=8)
    for axes in grid.flat[len(network.links) :]:
        axes.set_visible(False)
    figure.suptitle("x predicted less measured (veh) by cycles ahead: median, 10 to 90 % of the starts")
    figure.savefig(folder / f"{name}-links.png", dpi=130)
    plt.close(figure)

    figure, pair = plt.subplots(1, 2, figsize=(9, 4.4), layout="constrained")
    for axes, step in zip(pair, (0, len(ahead) - 1), strict=True):
        measured = found.measured_veh[step].ravel()
        axes.plot(measured, measured + found.x_veh[step].ravel(), ".", color=MODEL, markersize=2, alpha=0.4)
        end = max(measured.max(), 1.0)
        axes.plot([0, end], [0, end], color=INK, linewidth=0.8)
        axes.set(xlabel="measured x (veh)", ylabel="predicted x (veh)", title=f"{step + 1} ahead", aspect="equal")
    figure.savefig(folder / f"{name}-scatter.png", dpi=130)
    plt.close(figure)
