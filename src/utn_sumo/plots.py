"""Plots: how far a model is from its plant; what the links of a run held over time; correlations in space and time.

The one door to matplotlib.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from utn_sumo.contract import Network
from utn_sumo.mismatch import Errors, rmse
from utn_sumo.prediction import stacf, stpacf
from utn_sumo.prediction.weights import Weights
from utn_sumo.recording import Log

COLUMNS = 6
INK, MODEL, PERSISTENCE, HISTORY, FLOOR = "#333333", "#0b6fa4", "#c8553d", "#b08900", "#6b8e23"
ORDERS = (MODEL, PERSISTENCE, HISTORY, FLOOR)
LAG_TICKS = 25


def forecasts(result: dict[str, Any], folder: Path) -> None:
    """Write the error of each method by step ahead as `forecasts.png` into `folder`, but for the perfect one."""
    plt = _pyplot()
    ahead = np.arange(1, result["horizon"] + 1)
    figure, axes = plt.subplots(figsize=(6.4, 4.2), layout="constrained")
    styles = {"starima": (MODEL, "o-"), "arima": (FLOOR, "^-"), "profile": (INK, "s--"), "last": (PERSISTENCE, "v:")}
    for method, (color, style) in styles.items():
        found = result["methods"][method]
        axes.plot(ahead, found["rmse_veh_h"], style, color=color, label=method)
        axes.fill_between(ahead, found["low_veh_h"], found["high_veh_h"], color=color, alpha=0.2, linewidth=0)
    axes.set(xlabel="control steps ahead", ylabel="RMSE of a source's demand (veh/h)", xticks=ahead)
    axes.set_title("{net}, demand {demand:g}, noise {noise:g}, {runs} runs of {hours:g} h".format(**result))
    axes.legend(frameon=False)
    figure.savefig(folder / "forecasts.png", dpi=150)
    plt.close(figure)


def mismatch(result: dict[str, Any], network: Network, found: Errors, folder: Path) -> None:
    """Write three PNG files for one demand into `folder`."""
    plt = _pyplot()
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

    rows = int(np.ceil(len(network.links) / COLUMNS))
    figure, grid = plt.subplots(
        rows, COLUMNS, figsize=(13, 2.2 * rows), sharex=True, layout="constrained", squeeze=False
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


def trajectories(network: Network, log: Log, title: str, path: Path) -> None:
    """Write a PNG of one run: what each link held at the end of every cycle, and under it how long it had green.

    The scales are the same for all links. A line shows the smallest storage where anything comes near it.
    """
    plt = _pyplot()
    hours = np.arange(1, len(log.green_s) + 1) * network.control_step_s / 3600
    x, queue = log.true_x_veh[:, 0], log.true_queue_veh[:, 0]
    load = x + log.true_waiting_veh[:, 0]
    by_turn = log.green_s[:, 0] @ network.serves
    green = np.maximum.reduceat(by_turn, np.searchsorted(network.turn_link, np.arange(len(network.links))), axis=1)
    storage, most = network.storage_veh.min(), 1.05 * max(float(load.max()), 1.0)
    rows = int(np.ceil((len(network.links) + 1) / COLUMNS))
    figure, grid = plt.subplots(
        2 * rows,
        COLUMNS,
        figsize=(15, 3.4 * rows),
        sharex=True,
        squeeze=False,
        height_ratios=[2, 1] * rows,
        # By hand: the layout engine takes as long as all the drawing.
        gridspec_kw={"left": 0.045, "right": 0.99, "top": 0.93, "bottom": 0.055, "wspace": 0.1, "hspace": 0.32},
    )
    ticks_h = np.linspace(0, hours[-1], 3)
    grid[0, 0].set_xticks(ticks_h, [f"{tick_h:g}" for tick_h in ticks_h])
    held, shown = grid[::2].ravel(), grid[1::2].ravel()
    for index, link in enumerate(network.links):
        above, below = held[index], shown[index]
        above.fill_between(
            hours, x[:, index], load[:, index], color=INK, alpha=0.3, linewidth=0, label="waiting to enter it"
        )
        above.plot(hours, x[:, index], color=MODEL, linewidth=1.4, label="vehicles on the link")
        above.plot(hours, queue[:, index], color=PERSISTENCE, linewidth=1.2, label="of these, queued")
        if most > storage:
            above.axhline(storage, color=INK, linewidth=0.8, linestyle="--", label="storage")
        above.set_title(f"link {link.id}", fontsize=9)
        above.set(ylim=(0, most), xlim=(0, hours[-1]))
        below.plot(
            hours, green[:, index], color=FLOOR, linewidth=0.9, drawstyle="steps-pre", label="green in the cycle (s)"
        )
        below.set(ylim=(0, network.green_budget_s.max()), yticks=(0, 50, 100))
        below.tick_params(labelbottom=index + COLUMNS >= len(network.links))
        for axes in (above, below):
            axes.tick_params(labelsize=8, labelleft=index % COLUMNS == 0)
            axes.grid(visible=True, linewidth=0.3)
    for above, below in zip(held[::COLUMNS], shown[::COLUMNS], strict=True):
        above.set_ylabel("veh", fontsize=8)
        below.set_ylabel("s", fontsize=8)
    for axes in (*held[len(network.links) :], *shown[len(network.links) :]):
        axes.axis("off")
    lines = [pair for axes in (held[0], shown[0]) for pair in zip(*axes.get_legend_handles_labels(), strict=True)]
    held[len(network.links)].legend(*zip(*lines, strict=True), loc="center", frameon=False, fontsize=9)
    figure.suptitle(title, y=0.975)
    figure.supxlabel("time (h)", fontsize=10)
    figure.savefig(path, dpi=110)
    plt.close(figure)


def network_map(
    network: Network, shapes: Mapping[str, Sequence[tuple[float, float]]], refused: Collection[str], path: Path
) -> None:
    """Draw a net into a PNG file: its roads, its links by storage, its junctions; `refused` are those without a plan.

    `shapes` are the courses of all roads [m], by their edges.
    """
    plt = _pyplot()
    figure, axes = plt.subplots(figsize=(9, 7))
    member = {edge for link in network.links for edge in link.edges}
    for edge, course in shapes.items():
        if edge not in member:
            axes.plot(*np.array(course).T, color="#cccccc", linewidth=0.8, zorder=1)
    storage = network.storage_veh
    shade = plt.Normalize(0, storage.max())
    for link, capacity in zip(network.links, storage, strict=True):
        for edge in link.edges:
            axes.plot(*np.array(shapes[edge]).T, color=plt.cm.viridis_r(shade(capacity)), linewidth=2.2, zorder=2)
    for index, junction in enumerate(network.junctions):
        ends = np.array([shapes[network.links[link].edges[-1]][-1] for link in network.links_of[index]])
        x, y = ends.mean(axis=0)
        color = PERSISTENCE if junction.id in refused else INK
        axes.plot(x, y, "o", color=color, markersize=6, zorder=3)
        axes.annotate(junction.id, (x, y), (4, 4), textcoords="offset points", fontsize=7, color=color, zorder=4)
    figure.colorbar(plt.cm.ScalarMappable(shade, "viridis_r"), ax=axes, label="storage of a link (veh)", shrink=0.7)
    axes.set(aspect="equal", xlabel="m", ylabel="m", title=f"{network.name}: links and controlled junctions")
    figure.savefig(path, dpi=150, bbox_inches="tight")
    plt.close(figure)


def space_time_correlations(z: Any, weights: Weights, nlags: int, path: Path, title: str = "") -> None:
    """Write a PNG of the STACF and STPACF of z (T, N): the orders that a STARIMA of it needs, or its residuals miss.

    A stem per spatial order at each time lag. Within the grey band lie 95 % of white noise's, but for its STPACF of
    spatial orders above 0, which spread wider: sums over many neighbours vary little, so their coefficients vary more.
    """
    plt = _pyplot()
    lags = np.arange(1, nlags + 1)
    rows, sites = np.shape(z)
    spread = 1.96 / np.sqrt(sites * (rows - lags))
    ends, band = np.r_[0.5, lags, nlags + 0.5], np.r_[spread[0], spread, spread[-1]]
    figure, pair = plt.subplots(2, 1, figsize=(7.2, 5.6), sharex=True, sharey=True, layout="constrained")
    for axes, name, found in zip(pair, ("STACF", "STPACF"), (stacf, stpacf), strict=True):
        values = found(z, weights, nlags).T
        axes.fill_between(ends, -band, band, color=INK, alpha=0.15, linewidth=0)
        axes.axhline(0, color=INK, linewidth=0.6)
        shifts = (np.arange(len(values)) - (len(values) - 1) / 2) * 0.7 / max(len(values), 2)
        for order, (shift, heights) in enumerate(zip(shifts, values, strict=True)):
            color = ORDERS[order % len(ORDERS)]
            axes.vlines(lags + shift, 0, heights, color=color, linewidth=2)
            axes.plot(lags + shift, heights, "o", color=color, markersize=4, label=f"spatial order {order}")
        axes.set(ylabel=name, xlim=(0.5, nlags + 0.5))
        axes.grid(visible=True, axis="y", linewidth=0.3)
    pair[0].legend(frameon=False, ncols=3, fontsize=9)
    pair[1].set(xlabel="time lag (steps)", xticks=lags[:: -(-nlags // LAG_TICKS)])
    figure.suptitle(title)
    figure.savefig(path, dpi=130)
    plt.close(figure)


def _pyplot() -> Any:
    import matplotlib as mpl  # noqa: PLC0415 - heavy

    mpl.use("Agg")
    mpl.rcParams["text.parse_math"] = False  # names may have dollars in them
    from matplotlib import pyplot as plt  # noqa: PLC0415 - after the backend is chosen

    return plt
