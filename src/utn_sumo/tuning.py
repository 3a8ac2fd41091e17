"""Tuning: which settings of a controller make least delay over given nets, demands and seeds.

optuna's TPE proposes settings. A trial's value is the mean, over the scenarios, of the logarithm of its delay over that
under the defaults: a scenario counts the same whether its traffic is light or heavy.

trials.jsonl   a line a trial as soon as it is judged, the first the defaults themselves
trials.csv     the same as a table, the best first
best.toml      the best so far, as `utn run --scenario` takes it
"""

from __future__ import annotations

import csv
import json
import math
import statistics
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from scipy import stats

from utn_sumo import bridge, campaign, streets
from utn_sumo.campaign import FAILED
from utn_sumo.case import SUFFIX
from utn_sumo.errors import SettingError, UtnError
from utn_sumo.scenario import nested, scenario
from utn_sumo.search_space import Settings, Space

TRIALS, TABLE, BEST = "trials.jsonl", "trials.csv", "best.toml"
DELAY = "total_delay_veh_h"
ALARMS = ("unsafe_signal_s", "fallbacks", "teleports")
AT_ONCE = 4
"""Trials under way at the same time, whatever the machine: what is proposed depends on how many have been judged."""
CUT_PERCENTILE = 75.0
"""Trials that are among the worst quarter after their first seed get no other."""
LEAST_H = 1e-6
"""Delays below it count as it, so that they have a logarithm [veh h]."""
WHOLE, CUT = "whole", "cut"

Start = Callable[[campaign.Job], Future[dict[str, Any]]]


@dataclass
class Trial:
    """Settings that were tried, and what came of them."""

    number: int
    settings: Settings
    logs: dict[int, list[float]] = field(default_factory=dict)
    """By seed, for each net and demand the logarithm of its delay over that under the defaults."""
    alarms: int = 0
    state: str = WHOLE
    """`whole`, `cut` after its first seed, or the line that says why it failed."""

    @property
    def value(self) -> float:
        """The mean of the logarithms."""
        return statistics.mean(log for logs in self.logs.values() for log in logs)

    def record(self) -> dict[str, Any]:
        """A line of trials.jsonl."""
        ratio = {"ratio": math.exp(self.value)} if self.logs else {}
        by_seed = {str(seed): math.exp(statistics.mean(logs)) for seed, logs in self.logs.items()}
        more = {"ratio_by_seed": by_seed, "alarms": self.alarms, "state": self.state}
        return {"trial": self.number, "settings": self.settings, **ratio, **more}


@dataclass(frozen=True)
class Task:
    """What is tuned, and for what."""

    controller: str
    space: Space
    bases: Sequence[Mapping[str, Any]]
    """Net, demand and duration of each scenario, as `scenario` takes them."""
    seeds: Sequence[int]
    execution: str | None = None

    @property
    def who(self) -> dict[str, Any]:
        """The settings of a run that say who controls it."""
        return {"controller": self.controller} | ({} if self.execution is None else {"execution": self.execution})

    def check(self) -> None:
        """Raises UtnError for a scenario that can't be."""
        settings = nested(self.space.defaults)
        for base in self.bases:
            for seed in self.seeds:
                bridge.check_execution(scenario(**base, **self.who, settings=settings, seed=seed))

    def runs(self, start: Start, settings: Settings, seed: int) -> list[Future[dict[str, Any]]]:
        """A run of every scenario with a seed."""
        own = {**self.who, "settings": nested(settings), "seed": seed}
        return [start({**base, **own}) for base in self.bases]


def bases(nets: Sequence[str], demands: Sequence[float] | None, hours: str | None) -> list[dict[str, Any]]:
    """What the scenarios of a task have of their own; what is not given is as the command says. Raises UtnError."""
    found = []
    for net in nets:
        streets.named(net)
        own = net.endswith(SUFFIX)
        lasting = {} if own and hours is None else {"hours": hours or 2.0}
        found += [
            {"net": net, "demand": demand, **lasting} for demand in demands or ([1.0] if own else [0.6, 1.0, 1.3])
        ]
    return found


def tune(task: Task, trials: int, seed: int, folder: Path, tick: Callable[[], None]) -> dict[str, Any]:
    """Search; what was found, also if a KeyboardInterrupt ended it, and in `folder` as it comes.

    The same task and seed propose the same settings on any machine. Raises UtnError.
    """
    optuna = library()
    study = optuna.create_study(
        sampler=optuna.samplers.TPESampler(seed=seed, multivariate=True, n_startup_trials=max(1, min(10, trials // 4))),
        pruner=optuna.pruners.PercentilePruner(CUT_PERCENTILE, n_startup_trials=AT_ONCE),
    )
    tried: list[Trial] = []
    interrupted = False
    with campaign.started() as start:
        try:
            for trial in _judged(task, study, trials, start):
                tried.append(trial)
                with (folder / TRIALS).open("a", encoding="utf-8") as file:
                    file.write(json.dumps(trial.record()) + "\n")
                if trial is best(tried):
                    (folder / BEST).write_text(toml(task, trial), encoding="utf-8")
                tick()
        except KeyboardInterrupt:
            interrupted = True
    if not tried:
        raise KeyboardInterrupt
    found = best(tried)
    ratio, low, high = over_defaults(found)
    _write_table(folder / TABLE, task, tried)
    return {
        "controller": "/".join(task.who.values()),
        "scenarios": len(task.bases),
        "seeds": len(task.seeds),
        "trials": [trial.record() for trial in tried],
        "defaults": task.space.defaults,
        "left": task.space.left,
        "best": {**found.record(), "ratio": ratio, "low": low, "high": high},
        "interrupted": interrupted,
        "out": str(folder),
    }


def library() -> Any:
    """Optuna, silent. Raises SettingError where it is not installed."""
    try:
        import optuna  # noqa: PLC0415 - an extra
    except ImportError as error:
        raise SettingError("utn tune needs optuna: pip install 'utn-sumo[tune]'") from error
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    return optuna


def best(tried: Sequence[Trial]) -> Trial:
    """The one with least delay among those that were run on every scenario; the first of equals."""
    return min((trial for trial in tried if trial.state == WHOLE), key=lambda trial: trial.value)


def over_defaults(trial: Trial) -> tuple[float, float | None, float | None]:
    """Ratio of a trial's delay to the defaults', geometric mean, and Student's 95 % interval over the seeds."""
    logs = [statistics.mean(each) for each in trial.logs.values()]
    mean = statistics.mean(logs)
    if len(logs) == 1:
        return math.exp(mean), None, None
    half = float(stats.t.ppf(0.975, len(logs) - 1)) * statistics.stdev(logs) / math.sqrt(len(logs))
    return math.exp(mean), math.exp(mean - half), math.exp(mean + half)


def toml(task: Task, trial: Trial) -> str:
    """A scenario file of a controller with a trial's settings."""
    nets = ", ".join(dict.fromkeys(str(base["net"]) for base in task.bases))
    demands = ", ".join(dict.fromkeys(f"{base['demand']:g}" for base in task.bases))
    seeds = ", ".join(map(str, task.seeds))
    lines = [
        f"# Trial {trial.number} of utn tune: {math.exp(trial.value):.3f} times the delay under the defaults.",
        f"# Nets {json.dumps(nets)[1:-1]}; demands {demands}; seeds {seeds}.",
        *(f"{name} = {json.dumps(value)}" for name, value in task.who.items()),
        "",
        "[settings]",
        *(f"{name} = {json.dumps(value)}" for name, value in trial.settings.items() if value is not None),
    ]
    return "\n".join(lines) + "\n"


def _judged(task: Task, study: Any, trials: int, start: Start) -> Iterator[Trial]:
    """The defaults, and then every trial in its order, each once it is known what it is worth."""
    defaults = Trial(0, {})
    runs = {seed: task.runs(start, {}, seed) for seed in task.seeds}
    default_h: dict[int, list[float]] = {}
    for seed, futures in runs.items():
        default_h[seed] = _delays_h(futures, defaults)
        if defaults.state != WHOLE:
            raise UtnError(f"{'/'.join(task.who.values())} fails with its defaults: {defaults.state}")
        defaults.logs[seed] = [0.0] * len(futures)
    task.space.tell_defaults(study)
    yield defaults

    under_way: deque[tuple[Any, Trial, list[Future[dict[str, Any]]]]] = deque()
    asked = 0
    while asked < trials or under_way:
        while asked < trials and len(under_way) < AT_ONCE:
            asked += 1
            proposal = study.ask(task.space.distributions)
            trial = Trial(asked, task.space.settings(proposal.params))
            trial.state = task.space.refusal(trial.settings) or WHOLE
            futures = task.runs(start, trial.settings, task.seeds[0]) if trial.state == WHOLE else []
            under_way.append((proposal, trial, futures))
        # Judged in order, and only then is another one proposed: so a seed always gives the same search.
        proposal, trial, futures = under_way.popleft()
        if trial.state == WHOLE:
            _judge(task, proposal, trial, futures, default_h, start=start)
        _tell(study, proposal, trial)
        yield trial


def _judge(
    task: Task,
    proposal: Any,
    trial: Trial,
    futures: Sequence[Future[dict[str, Any]]],
    default_h: Mapping[int, Sequence[float]],
    *,
    start: Start,
) -> None:
    """Wait for a trial's runs with the first seed, and, if it is none of the worst, for those with the others."""
    pending = {task.seeds[0]: futures}
    while pending:
        for seed, each in pending.items():
            delays_h = _delays_h(each, trial)
            if trial.state != WHOLE:
                return
            logs = [math.log(mine / base) for mine, base in zip(delays_h, default_h[seed], strict=True)]
            trial.logs[seed] = logs
        others = [seed for seed in task.seeds if seed not in trial.logs]
        if others:
            proposal.report(trial.value, 0)
            if proposal.should_prune():
                trial.state = CUT
                return
        pending = {seed: task.runs(start, trial.settings, seed) for seed in others}


def _delays_h(futures: Sequence[Future[dict[str, Any]]], trial: Trial) -> list[float]:
    """Delay of each run [veh h]; the trial learns of alarms, and of what failed."""
    delays_h = []
    for future in futures:
        result = future.result()
        if FAILED in result:
            trial.state = result[FAILED]
            return []
        trial.alarms += sum(result[name] or 0 for name in ALARMS)
        delays_h.append(max(result[DELAY], LEAST_H))
    return delays_h


def _tell(study: Any, proposal: Any, trial: Trial) -> None:
    """What a study learns of a trial."""
    from optuna.trial import TrialState  # noqa: PLC0415 - an extra

    if trial.state == WHOLE:
        study.tell(proposal, trial.value)
    else:
        study.tell(proposal, state=TrialState.PRUNED if trial.state == CUT else TrialState.FAIL)


def _write_table(path: Path, task: Task, tried: Sequence[Trial]) -> None:
    """All trials, the best first; what was not run on every scenario comes last."""
    ranked = sorted(tried, key=lambda trial: (trial.state != WHOLE, trial.value if trial.logs else math.inf))
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(["trial", "ratio", *task.space.searched, "alarms", "state"])
        for trial in ranked:
            settings = task.space.defaults | trial.settings
            ratio = f"{math.exp(trial.value):.4f}" if trial.logs else ""
            writer.writerow([trial.number, ratio, *settings.values(), trial.alarms, trial.state])
