"""Controllers against each other: runs over nets, demands and seeds, and what they come to."""

from __future__ import annotations

import hashlib
import json
import statistics
from collections.abc import Callable, Sequence
from concurrent.futures import as_completed
from pathlib import Path
from typing import Any

import numpy as np
from scipy import stats

import utn_controllers
import utn_network
import utn_sumo
from utn_sumo import bridge, campaign, case, controllers, native, recording, streets
from utn_sumo.case import SUFFIX
from utn_sumo.errors import NetworkError, ResultError, SettingError
from utn_sumo.importing import FITTED, TURNS
from utn_sumo.scenario import EXACT, flat, scenario
from utn_sumo.xml_files import stem

SPENT = "total_time_spent_veh_h"
COUNTED = ("unsafe_signal_s", "fallbacks", "teleports")
"""Alarms: none of them may happen."""
WAITED = "longest_red_s"
"""Longest red while somebody waits; not known of signals that SUMO switches."""
SHARE = 0.95
KEY = ("net", "demand", "controller")
WHO = ("controller", "execution")
OPENING = '{"job": '
"""How every line of a record begins."""

Job = dict[str, Any]
Figures = dict[str, Any]


def measure(net: str) -> str:
    """The delay by which controllers on a net are judged: all of it, or that of a vehicle in somebody's scenario."""
    return "mean_delay_s" if net.endswith(SUFFIX) else "total_delay_veh_h"


def jobs(
    nets: Sequence[str],
    demands: Sequence[str] | None,
    names: Sequence[str],
    seeds: Sequence[int],
    hours: float | None,
) -> list[Job]:
    """Settings of every run, checked. Without `hours` they take two, and a .sumocfg its own window.

    Without `demands` it is 1.3, and a .sumocfg's own. A controller may be followed by the execution of its plans, as in
    dmpc/actuated, or be a TOML file that names it and its settings, as `utn tune` writes. Raises UtnError, for two
    names of the same controller too.
    """
    chosen = {name: _controller(name) for name in names}
    first: dict[str, str] = {}
    for name, said in chosen.items():
        if (other := first.setdefault(_key(said), name)) != name:
            raise SettingError(f"controller {name!r} is the same as {other!r}: name one of them")
    found = []
    for net in nets:
        try:
            streets.named(net)
        except NetworkError as error:  # which of several it is
            raise NetworkError(f"net {net!r}: {error}") from error
        own = net.endswith(SUFFIX)
        lasting = {"hours": 2.0 if hours is None else hours} if not own or hours is not None else {}
        for demand in demands or ["1.0" if own else "1.3"]:
            for name in names:
                shared = {"net": net, **lasting, **chosen[name]}
                checked = [scenario(**shared, demand=demand, seed=seed) for seed in seeds]
                found += [{**shared, "demand": each.demand, "seed": each.seed} for each in checked]
    # Runs that are the same would pass for runs that agree.
    return list({_key(job): job for job in found}.values())


def _controller(name: str) -> Job:
    """The settings of a run that say who controls it. Raises UtnError."""
    named = scenario(Path(name)) if name.endswith(".toml") else scenario(**_spelt(name))
    told = (*WHO, "settings")
    for key in sorted(named.model_fields_set.difference(told)):
        raise SettingError(
            f"file {name!r} has {key} = {getattr(named, key)!r}: of a controller's file a comparison takes "
            f"{', '.join(told)} alone, leave it out"
        )
    bridge.check_execution(named)
    if named.controller != native.NAME:
        controllers.maker(named.controller)
    if named.execution not in {None, EXACT}:
        controllers.maker(str(named.execution), controllers.EXECUTION)
    return named.model_dump(include=set(told if named.settings else WHO), exclude_none=True)


def _spelt(name: str) -> dict[str, Any]:
    """Controller, and execution if there is one, from CONTROLLER/EXECUTION; either may be path.py:Class."""
    controller, slash, execution = name.partition("/")
    if ".py:" in name and controller not in controllers.registered():
        path, colon, rest = name.partition(".py:")
        own, slash, execution = rest.partition("/")
        controller = path + colon + own
    return {"controller": controller, **({"execution": execution} if slash else {})}


def label(job: Job) -> str:
    """What a controller is called in figures: by its name, with its execution's and the settings that it was given."""
    given = ", ".join(f"{name}={value}" for name, value in flat(job.get("settings", {})).items())
    name = "/".join(job[each] for each in WHO if each in job)
    return f"{name} ({given})" if given else name


def results(wanted: Sequence[Job], workers: int | None, record: Path | None, tick: Callable[[], None]) -> list[Figures]:
    """Measures of every run, or why it has none; what `record` has of them is not run again. Raises ResultError.

    Each is a line of `record` as soon as it is there. A run that failed is tried again the next time, and so is one of
    which a file has changed since, whose old line stays.
    """
    known = {} if record is None else read(record)
    lines = opened(wanted)
    todo = [line for line in lines if campaign.FAILED in known.get(_key(line), {campaign.FAILED: ""})]
    for _ in range(len(wanted) - len(todo)):
        tick()
    with campaign.started(workers) as start:
        started = {start(line["job"]): line for line in todo}
        for future in as_completed(started):
            line, result = started[future], future.result()
            known[_key(line)] = result
            if record is not None:
                with record.open("a", encoding="utf-8") as file:
                    file.write(json.dumps({**line, "result": result}) + "\n")
            tick()
    return [known[_key(line)] for line in lines]


def opened(wanted: Sequence[Job]) -> list[dict[str, Any]]:
    """What the line of each run begins with: its settings, and what is in the files that they name, by SHA-256.

    Those are the net's with what goes with it beside it, the ones that a .sumocfg names, those of classes of one's own,
    not what such files read themselves; and the project's, with the versions of what it runs on.
    """
    code = _code()
    nets = {net: _digest(_net_files(net)) for net in {job["net"] for job in wanted}}
    named = {job[role] for job in wanted for role in WHO if role in job}
    own = {name: _digest([Path(name.rpartition(":")[0])]) for name in named if ".py:" in name}
    return [
        {
            "job": job,
            "inputs": {
                "net": nets[job["net"]],
                "code": code,
                **{role: own[job[role]] for role in WHO if job.get(role) in own},
            },
        }
        for job in wanted
    ]


def _code() -> str:
    """A digest of the project's packages and of the versions of what they run on."""
    roots = [Path(str(package.__file__)).parent for package in (utn_sumo, utn_controllers, utn_network)]
    sources = _digest([path for root in roots for path in sorted(root.rglob("*.py"))])
    return hashlib.sha256(f"{sources}{recording.versions('')}".encode()).hexdigest()


def _net_files(net: str) -> list[Path]:
    found, net_file = [], Path(net)
    if net.endswith(SUFFIX):
        chosen = case.read(Path(net))
        found, net_file = [chosen.file, *chosen.files], chosen.net_file
    elif net in utn_network.names():
        net_file = utn_network.net_file(net)
    beside = (net_file.with_name(stem(net_file) + ending) for ending in (TURNS, FITTED))
    return [*(found or [net_file]), *(path for path in beside if path.is_file())]


def _digest(files: Sequence[Path]) -> str:
    return hashlib.sha256("".join(map(case.digest, files)).encode()).hexdigest()


def read(record: Path) -> dict[str, Figures]:
    """Results by job and inputs from a record, the last one where there are several; a line that a halt cut short is
    taken off. Lines without inputs, as were written once, are of nobody knows which files, and match no run.

    Raises ResultError, and leaves a file alone that is something else.
    """
    try:
        record.touch()
        text = record.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise ResultError(f"record {str(record)!r} can't be used ({error}): name another with --out") from error
    whole, _, torn = text.rpartition("\n")
    known = {}
    try:
        for line in whole.splitlines():
            entry = json.loads(line)
            known[_key({"job": entry["job"], "inputs": entry.get("inputs")})] = entry["result"]
        if not (torn.startswith(OPENING) or OPENING.startswith(torn)):
            raise ValueError(torn)  # noqa: TRY301 - one remedy for all
    except (ValueError, KeyError, TypeError) as error:
        raise ResultError(f"record {str(record)!r} holds something else: name another with --out") from error
    if torn:
        record.write_text(whole + "\n" if whole else "", encoding="utf-8")
    return known


def _key(said: Any) -> str:
    return json.dumps(said, sort_keys=True)


def figures(wanted: Sequence[Job], found: Sequence[Figures]) -> list[Figures]:
    """For each net, demand and controller the means and their intervals, what must not happen, and what failed.

    The first controller has beside it the one of the others with the least mean delay, among those of which no run
    failed, and the ratio of its own delay to that one's over the seeds that both have.
    """
    groups: dict[tuple[Any, ...], list[tuple[Job, Figures]]] = {}
    for job, result in zip(wanted, found, strict=True):
        groups.setdefault((job["net"], job["demand"], label(job)), []).append((job, result))
    rows = [{**dict(zip(KEY, key, strict=True)), **_figures(key[0], runs)} for key, runs in groups.items()]
    leader = label(wanted[0])
    for row in rows:
        rivals = [other for other in rows if _place(other) == _place(row) and other["controller"] != leader]
        whole = [other for other in rivals if not other["failed"]]
        if row["controller"] == leader and row["mean"] is not None and whole:
            best = min(whole, key=lambda other: other["mean"])
            its = dict(zip(best["seeds"], best["delay"], strict=True))
            ends = ratio(row["delay"], [its[seed] for seed in row["seeds"]])
            row |= {"best_other": best["controller"], **_named("ratio ratio_low ratio_high", ends)}
    return rows


def _place(row: Figures) -> tuple[str, float]:
    return row["net"], row["demand"]


def _figures(net: str, runs: Sequence[tuple[Job, Figures]]) -> Figures:
    """Figures of one controller at one demand; `mean` to `median` are of the delay that `measure` names."""
    failed = {job["seed"]: result[campaign.FAILED] for job, result in runs if campaign.FAILED in result}
    done = [(job["seed"], result) for job, result in runs if campaign.FAILED not in result]
    given = [result for _, result in done]
    delay = [result[measure(net)] for result in given]
    waited = [result[WAITED] for result in given if result.get(WAITED) is not None]
    sumo_s = sum(result["sumo_time_s"] for result in given)
    return {
        "measure": measure(net),
        "seeds": [seed for seed, _ in done],
        "delay": delay,
        **_named("mean low high", interval(delay)),
        "median": statistics.median(delay) if delay else None,
        SPENT: [result[SPENT] for result in given],
        **_named("spent_mean spent_low spent_high", interval([result[SPENT] for result in given])),
        "gridlocked": _sum([result["gridlock"] for result in given]),
        **{name: _sum([result[name] for result in given]) for name in COUNTED},
        "unfinished": [result["unfinished"] for result in given],
        "control_over_sumo": sum(result["control_time_s"] for result in given) / sumo_s if sumo_s else None,
        **({WAITED: max(waited)} if waited else {}),
        "left_alone": given[0]["left_alone"] if given else {},
        "fallback_reasons": [reason for result in given for reason in result["fallback_reasons"]],
        "failed": failed,
    }


def _named(names: str, values: Sequence[float | None]) -> Figures:
    return dict(zip(names.split(), values, strict=True))


def _sum(counts: Sequence[int | None]) -> int | None:
    """None where one of them is not known, as under signals that nobody judges."""
    known = [count for count in counts if count is not None]
    return sum(known) if known and len(known) == len(counts) else None


def interval(values: Sequence[float]) -> tuple[float | None, float | None, float | None]:
    """Mean of runs over seeds, and the ends of Student's interval for it; None where there are too few."""
    if not values:
        return None, None, None
    mean = statistics.mean(values)
    if len(values) == 1:
        return mean, None, None
    half = float(stats.t.ppf((1 + SHARE) / 2, len(values) - 1)) * statistics.stdev(values) / len(values) ** 0.5
    return mean, mean - half, mean + half


def ratio(mine: Sequence[float], others: Sequence[float]) -> tuple[float | None, float | None, float | None]:
    """Ratio of the means of runs that belong together, and Fieller's interval for it.

    None where there are too few, or where the other mean may be 0 so that the interval has no ends.
    """
    a, b, n = statistics.mean(mine), statistics.mean(others), len(mine)
    if not b:
        return None, None, None
    if n == 1:
        return a / b, None, None
    # All r for which the mean of mine - r * others is within its own interval about 0: a quadratic in r.
    (aa, ab), (_, bb) = np.cov(mine, others) * float(stats.t.ppf((1 + SHARE) / 2, n - 1)) ** 2 / n
    lead = b * b - bb
    if lead <= 0:
        return a / b, None, None
    middle, half = (a * b - ab) / lead, max((a * b - ab) ** 2 - lead * (a * a - aa), 0.0) ** 0.5 / lead
    return a / b, float(middle - half), float(middle + half)
