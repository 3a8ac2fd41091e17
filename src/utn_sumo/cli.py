"""The `utn` command. Heavy imports happen inside the commands, so that `utn --help` answers at once."""

from __future__ import annotations

import importlib.util
import json
import math
import shlex
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import click
from click.core import ParameterSource

from utn_sumo import __version__
from utn_sumo.errors import SettingError, UtnError

MOST_DIGITS = 9
"""Of a count: nobody waits for more."""


@click.group(context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(__version__, prog_name="utn")
def cli() -> None:
    """Model-based traffic-signal control on the SUMO microsimulator."""


@cli.command()
@click.argument("case", required=False)
@click.option("--net", help="Shipped network, or a .net.xml file.  [utn17]")
@click.option("--controller", help="Registered controller, path.py:Class, or native: the net's own.  [dmpc]")
@click.option("--execution", help="How plans are carried out: exact, registered, path.py:Class.  [the controller's]")
@click.option("--hours", help="Simulated hours.  [4; of CASE its window]")
@click.option("--demand", help="Scale of the demand profile, or of the traffic of CASE.  [1.0]")
@click.option("--profile", help="Demand profile: peak, paper or constant.  [peak]")
@click.option("--noise", help="Relative standard deviation of correlated demand noise.  [0]")
@click.option("--disturbance", help="Vehicles an hour that come onto each link amid it, uncounted.  [0]")
@click.option("--seed", help="Seed of demand and SUMO.  [1]")
@click.option("--loop-error", help="Share of vehicles by which loops miscount, its spread over the loops.  [0]")
@click.option("--forecast", help="Forecasts: starima, arima, profile, last or perfect.  [starima]")
@click.option("--refit-steps", help="Control steps between two fits of the forecast's model.  [15]")
@click.option("--calibration", help="Calibration file for the model, or none.  [the one beside the net]")
@click.option("--horizon", help="Prediction horizon Kp of a predictive controller, in cycles.  [7]")
@click.option("--control-horizon", help="Control horizon Kc, in cycles.  [4]")
@click.option("--cost", help="Cost of a predictive controller: tts or paper.  [tts]")
@click.option(
    "--set", "pairs", multiple=True, metavar="NAME=VALUE", help="Any other setting; execution.NAME of the execution."
)
@click.option("--scenario", "file", type=click.Path(path_type=Path), help="TOML file with these settings.")
@click.option("--out", type=click.Path(path_type=Path), help="Folder for the results; must be new or empty.")
@click.option("--json", "as_json", is_flag=True, help="Print the measures as one JSON object, and nothing else.")
def run(pairs: tuple[str, ...], file: Path | None, out: Path | None, as_json: bool, **flags: str | None) -> None:
    """Run a controller on a network in SUMO and measure it.

    CASE is a .sumocfg of your own, with net and demand.
    """
    from utn_sumo import bridge, report  # noqa: PLC0415 - heavy
    from utn_sumo.scenario import nested, scenario  # noqa: PLC0415 - heavy

    named = {name: flags.pop(name) for name in ("horizon", "control_horizon", "cost")}
    settings: dict[str, Any] = {name: _number(value) for name, value in named.items() if value is not None}
    for pair in pairs:
        name, equals, value = pair.partition("=")
        if not equals:
            raise SettingError(f"--set {pair!r}: write it as NAME=VALUE")
        settings[name.strip()] = _number(value.strip())
    own = flags.pop("case")
    if own is not None and flags["net"] is not None:
        raise SettingError(f"setting 'net' is {flags['net']!r}, beside {own!r}: give one of them")
    flags["net"] = own if flags["net"] is None else flags["net"]
    given: dict[str, Any] = {name: value for name, value in flags.items() if value is not None}
    chosen = scenario(file, settings=nested(settings), **given)
    with report.progress(chosen) as on_cycle:
        result = bridge.run(chosen, out, on_cycle)
    click.echo(json.dumps(result)) if as_json else report.table(result)
    if result["interrupted"]:
        raise KeyboardInterrupt


def _study(command: Callable[..., None]) -> Callable[..., None]:
    """The options that studies over recorded runs have in common."""
    for option in (
        click.argument("case", required=False),
        click.option("--step", help="Model step in seconds, up to the whole cycle.  [10, or a little less]"),
        click.option("--hours", help="Simulated hours of each run.  [2; of CASE its window]"),
        click.option("--controller", default="dmpc", show_default=True, help="Controller of the recorded runs."),
        click.option("--net", help="Shipped network, or a .net.xml file.  [utn17]"),
    ):
        command = option(command)
    return command


@cli.command()
@_study
@click.option("--demand", help="Demands, separated by commas.  [0.6,1.0,1.3; of CASE 1.0]")
@click.option("--seeds", default="5", show_default=True, help="How many seeds, from 1 on.")
@click.option("--horizon", default="7", show_default=True, help="Control steps ahead.")
@click.option("--inputs", default="known", show_default=True, help="Demand of the predictions: known or forecast.")
@click.option("--turning", default="forecast", show_default=True, help="Turning fractions: known or forecast.")
@click.option("--calibration", help="Calibration file, or none.  [the one beside the net]")
@click.option("--floor/--no-floor", "with_floor", default=None, help="Measure SUMO's own spread too.  [not of CASE]")
@click.option("--out", type=click.Path(path_type=Path), help="Folder for the results; must be new or empty.")
@click.option("--json", "as_json", is_flag=True, help="Print a JSON list, an object a demand, and nothing else.")
def mismatch(out: Path | None, with_floor: bool | None, as_json: bool, demand: str | None, **flags: Any) -> None:
    """Measure how far the model is from the plant, in open loop, by horizon and link.

    CASE is a .sumocfg of your own; the seeds then are SUMO's alone.
    """
    from utn_sumo import campaign, recording, report, study  # noqa: PLC0415 - heavy

    own = flags["case"] is not None
    if own and with_floor:
        raise SettingError(f"the floor draws the future of a demand of ours: leave --floor out for {flags['case']!r}")
    with_floor = not own if with_floor is None else with_floor
    base = _base(flags) | ({} if flags["calibration"] is None else {"calibration": flags["calibration"]})
    demands = numbers("demand", demand or ("1.0" if own else "0.6,1.0,1.3"))
    seeds = campaign.seeds(f"1-{_whole('seeds', flags['seeds'])}")
    horizon, step_s = _whole("horizon", flags["horizon"]), _step_s(flags)
    name = f"mismatch-{Path(base['net']).name.partition('.')[0]}-{flags['controller']}"
    total = len(demands) * (len(seeds) + with_floor)
    with recording.results_in(out, name) as folder, report.counter("runs and replays", total) as tick:
        results = study.study_mismatch(
            base,
            demands,
            seeds,
            folder,
            step_s=step_s,
            horizon=horizon,
            inputs=flags["inputs"],
            turning=flags["turning"],
            with_floor=with_floor,
            tick=tick,
        )
    click.echo(json.dumps(recording.plain(results))) if as_json else report.mismatch_table(results, folder)


@cli.command("forecast-report")
@click.argument("folders", nargs=-1, type=click.Path(path_type=Path))
@click.option("--net", default="utn17", show_default=True, help="Shipped network, or a .net.xml file.")
@click.option("--controller", default="dmpc", show_default=True, help="Controller of the recorded runs.")
@click.option("--hours", default="4", show_default=True, help="Simulated hours of each run.")
@click.option("--demand", default="1.0", show_default=True, help="Scale of the demand profile.")
@click.option("--profile", default="peak", show_default=True, help="Demand profile: peak, paper or constant.")
@click.option("--noise", default="0.3", show_default=True, help="Standard deviation of the correlated demand noise.")
@click.option("--seeds", default="20", show_default=True, help="How many seeds, from 1 on.")
@click.option("--horizon", default="7", show_default=True, help="Control steps ahead.")
@click.option("--refit-steps", default="15", show_default=True, help="Control steps between two fits of a model.")
@click.option("--out", type=click.Path(path_type=Path), help="Folder for the results; must be new or empty.")
@click.option("--json", "as_json", is_flag=True, help="Print one JSON object, and nothing else.")
@click.pass_context
def forecast_report(
    context: click.Context, /, folders: tuple[Path, ...], seeds: str, out: Path | None, *, as_json: bool, **flags: Any
) -> None:
    """Measure the forecasts' errors by method on the recorded runs in FOLDERS, or on runs made for it.

    Runs in FOLDERS differ by their seeds alone.
    """
    from utn_sumo import campaign, recording, report, study  # noqa: PLC0415 - heavy
    from utn_sumo import forecast_report as judging  # noqa: PLC0415 - heavy
    from utn_sumo.scenario import scenario  # noqa: PLC0415 - heavy

    steps, refit_steps = (_whole(name, flags.pop(name)) for name in ("horizon", "refit_steps"))
    seed_list = campaign.seeds(f"1-{_whole('seeds', seeds)}")
    items = [] if folders else [scenario(**flags, seed=seed) for seed in seed_list]
    if folders:
        judging.check_alike(folders)
    if len(folders or items) < 2:  # noqa: PLR2004 - an interval needs two
        raise SettingError("forecasts are judged over runs: give two or more, as --seeds 2 or as folders")
    for name in (*flags, "seeds") if folders else ():
        if context.get_parameter_source(name) == ParameterSource.COMMANDLINE:
            raise SettingError(f"--{name} is of runs to be made, and {str(folders[0])!r} holds one: give one of them")
    if items and items[0].demand == 0:
        raise SettingError("setting 'demand' is 0: there is nothing to forecast, make it more")
    total = len(items) + len(folders or items)
    with (
        recording.results_in(out, "forecast-report") as folder,
        report.counter("runs and forecasts", total) as tick,
    ):
        runs = folders or study.record(items, folder, tick, judging.FIRST_STEP + steps + 1)
        result = study.study_forecasts(runs, folder, horizon=steps, refit_steps=refit_steps, tick=tick)
    recording.write_json(folder / "forecasts.json", result)
    click.echo(json.dumps(recording.plain(result))) if as_json else report.forecast_table(result, folder)


@cli.command()
@_study
@click.option("--demand", help="Demands, separated by commas.  [0.7,0.9,1.1,1.25; of CASE 1.0]")
@click.option("--seeds", default="201,202", show_default=True, help="Numbers and ranges, separated by commas.")
@click.option(
    "--out", required=True, type=click.Path(path_type=Path), help="Folder for the runs; must be new or empty."
)
def calibrate(out: Path, demand: str | None, seeds: str, **flags: Any) -> None:
    """Fit the model to recorded runs and write its parameters with their standard errors.

    CASE is a .sumocfg of your own; the seeds then are SUMO's alone.
    """
    from utn_sumo import campaign, recording, report, study  # noqa: PLC0415 - heavy

    demands = numbers("demand", demand or ("0.7,0.9,1.1,1.25" if flags["case"] is None else "1.0"))
    seed_list = campaign.seeds(seeds)
    base = _base(flags) | {"calibration": "none"}
    total = len(demands) * len(seed_list)
    with recording.results_in(out, "calibration") as folder, report.counter("runs", total) as tick:
        content = study.study_calibration(base, demands, seed_list, folder, step_s=_step_s(flags), tick=tick)
    path = folder / "calibration.json"
    recording.write_json(path, content)
    report.calibration_table(content)
    click.echo(f"wrote {path}: use it with  utn run --calibration {shlex.quote(str(path))}, or put it beside the net")


@cli.command()
@click.option("--hours", default="4", show_default=True, help="Simulated hours of each run.")
@click.option("--seed", default="1", show_default=True, help="Seed of demand and SUMO.")
@click.option("--demand", default="1.0,1.7", show_default=True, help="Scales of the paper's demand, with commas.")
@click.option("--sumo/--no-sumo", "in_sumo", default=True, help="Run in SUMO too: minutes, not seconds.")
@click.option("--out", type=click.Path(path_type=Path), help="Folder for the results; must be new or empty.")
@click.option("--json", "as_json", is_flag=True, help="Print a JSON list, an object a run, and nothing else.")
def paper(out: Path | None, as_json: bool, in_sumo: bool, demand: str, **flags: Any) -> None:
    """Repeat the paper's comparison of CMPC and DMPC, and show how its CMPC came to lose.

    The 4 h runs in SUMO take ten minutes on two free cores, and up to half an hour on busy ones.
    """
    from utn_sumo import paper as comparison  # noqa: PLC0415 - heavy
    from utn_sumo import recording, report  # noqa: PLC0415 - heavy

    runs = comparison.runs(numbers("demand", demand), in_sumo=in_sumo, **flags)
    folder = recording.new_folder(out, f"paper-seed{flags['seed']}")
    with report.counter("runs", len(runs)) as tick:
        results = comparison.study(runs, folder, tick)
    click.echo(json.dumps(recording.plain(results))) if as_json else report.paper_table(results, folder)


@cli.command()
@click.argument("controller")
@click.option("--execution", help="How its plans are carried out: exact, registered, path.py:Class.  [its own way]")
@click.option("--nets", default="utn17", show_default=True, help="Shipped nets, nets, .sumocfg files, with commas.")
@click.option("--demands", help="Demands, separated by commas.  [0.6,1.0,1.3; of a .sumocfg 1.0]")
@click.option("--seeds", default="1-3", show_default=True, help="Numbers and ranges, separated by commas.")
@click.option("--hours", help="Simulated hours of each run.  [2; of a .sumocfg its window]")
@click.option("--trials", default="40", show_default=True, help="Settings that are tried beside the defaults.")
@click.option(
    "--over",
    multiple=True,
    metavar="NAME[=WHERE]",
    help="A setting and where to search it: low:high, or values with commas, or by itself as far as it may go;"
    " execution.NAME of the execution."
    "  [every number that has both bounds, else every choice]",
)
@click.option("--seed", type=click.IntRange(0, 2**32 - 1), default=1, show_default=True, help="Seed of the search.")
@click.option("--out", type=click.Path(path_type=Path), help="Folder for the results; must be new or empty.")
def tune(
    controller: str, execution: str | None, over: tuple[str, ...], seed: int, out: Path | None, **flags: Any
) -> None:
    """Search settings of CONTROLLER that make least delay over nets, demands and seeds."""
    from utn_sumo import campaign, recording, report, search_space, tuning  # noqa: PLC0415 - heavy

    tuning.library()
    space = search_space.space(controller, over, execution)
    demands = None if flags["demands"] is None else numbers("demands", flags["demands"])
    bases = tuning.bases(words("nets", flags["nets"]), demands, flags["hours"])
    task = tuning.Task(controller, space, bases, campaign.seeds(flags["seeds"]), execution)
    task.check()
    trials = _whole("trials", flags["trials"])
    names = "-".join(Path(each.partition(":")[0]).stem for each in task.who.values())
    with recording.results_in(out, f"tune-{names}") as folder, report.counter("trials", trials + 1) as tick:
        result = tuning.tune(task, trials, seed, folder, tick)
    report.tuning_table(result)
    if result["interrupted"]:
        raise KeyboardInterrupt


@cli.command()
@click.argument("net")
@click.option("--out", type=click.Path(path_type=Path), help="Folder for the results; must be new or empty.")
@click.option("--json", "as_json", is_flag=True, help="Print one JSON object, and nothing else.")
def inspect(net: str, out: Path | None, as_json: bool) -> None:
    """Show what the bench makes of NET: links, stages, storage, what is controlled and what is left alone.

    NET is a shipped net, a .net.xml, or a .sumocfg, of which it takes the net and its programmes.
    """
    from utn_sumo import inspection, network, plots, recording, report, streets  # noqa: PLC0415 - heavy

    found = streets.named(net)
    result = inspection.inspect(found)
    folder = recording.new_folder(out, f"inspect-{found.name}")
    recording.write_json(folder / "inspection.json", result)
    refused = {each["id"] for each in result["junctions"] if each["refused"]}
    plots.network_map(found, network.shapes(found.net_file), refused, folder / "map.png")
    click.echo(json.dumps(recording.plain(result))) if as_json else report.inspection_table(result, folder)


@cli.command("import")
@click.argument("case", type=click.Path(path_type=Path))
@click.option("--out", required=True, type=click.Path(path_type=Path), help="Folder to write; must be new or empty.")
@click.option(
    "--calibrate", "calibrated", is_flag=True, help="Fit the model to runs of CASE too: minutes, not seconds."
)
@click.option("--seeds", default="201,202", show_default=True, help="Seeds of those runs: numbers and ranges.")
@click.option("--json", "as_json", is_flag=True, help="Print one JSON object, and nothing else.")
def import_(case: Path, out: Path, calibrated: bool, seeds: str, as_json: bool) -> None:
    """Make of CASE, a .sumocfg, a folder that is complete in itself, with what the bench makes of net and traffic."""
    from utn_sumo import campaign, importing, recording, report  # noqa: PLC0415 - heavy

    seed_list = campaign.seeds(seeds)
    found = importing.read(case)
    folder = recording.new_folder(out, "import")
    result = importing.write(found, folder)
    if calibrated:
        with report.counter("runs", len(seed_list)) as tick:
            result["calibration"] = str(importing.calibrate(folder, seed_list, tick))
    click.echo(json.dumps(recording.plain(result))) if as_json else report.import_table(result)


@cli.command()
@click.argument("folder", type=click.Path(path_type=Path))
def replay(folder: Path) -> None:
    """Write the signals of the run in FOLDER as plain SUMO files that the bare `sumo` replays."""
    from utn_sumo import replay as writer  # noqa: PLC0415 - heavy

    configuration = writer.write(folder)
    click.echo(f"wrote {configuration}: run it with  sumo -c {shlex.quote(str(configuration))}")


@cli.command()
@click.argument("name", required=False)
def controllers(name: str | None) -> None:
    """List the registered controllers and executions, or tell what the settings of NAME mean."""
    from utn_sumo import manual, report  # noqa: PLC0415 - heavy

    report.manual_tables(manual.entries(name), whole=name is not None)


@cli.group()
def net() -> None:
    """The shipped networks: build them anew, or check them."""


@net.command("build")
def net_build() -> None:
    """Write the shipped networks from their topology through netconvert."""
    builder = _builder()
    for path in builder.build(builder.ROOT):
        click.echo(path.relative_to(builder.ROOT.parent))


@net.command("check")
def net_check() -> None:
    """Rebuild the shipped networks aside and compare, byte for byte but for netconvert's header."""
    differing = _builder().check()
    if differing:
        raise UtnError(f"shipped networks differ from their topology: {', '.join(differing)}; run utn net build")
    click.echo("the shipped networks are what their topology gives")


def _builder() -> Any:
    import utn_network  # noqa: PLC0415

    path = Path(utn_network.__file__).resolve().parents[1] / "build.py"
    if not path.is_file():
        raise UtnError("networks are built from a checkout of the project: this is an installed package")
    spec = importlib.util.spec_from_file_location("utn_net_build", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def _base(flags: dict[str, Any]) -> dict[str, Any]:
    """What the runs of a study have in common: net or case, controller, hours."""
    own, net, hours = flags["case"], flags["net"], flags["hours"]
    if own is not None and net is not None:
        raise SettingError(f"setting 'net' is {net!r}, beside {own!r}: give one of them")
    if own is None and hours is None:
        hours = "2"
    return {
        "net": own or ("utn17" if net is None else net),
        "controller": flags["controller"],
        **({"hours": hours} if hours else {}),
    }


def _step_s(flags: dict[str, Any]) -> float | None:
    """The model step that is asked for, if any is. Raises SettingError."""
    if flags["step"] is None:
        return None
    step_s, *more = numbers("step", flags["step"])
    if more:
        raise SettingError(f"setting 'step' is {flags['step']!r}: it must be one number")
    return step_s


def words(name: str, text: str) -> list[str]:
    """Words separated by commas, each once. Raises SettingError."""
    found = [word.strip() for word in text.split(",")]
    if len(set(found)) < len(found):
        raise SettingError(f"setting {name!r} is {text!r}: give each word once")
    return found


def numbers(name: str, text: str) -> list[float]:
    """Numbers separated by commas, each once. Raises SettingError."""
    try:
        found = [float(word) for word in text.split(",")]
    except ValueError:
        found = []
    if not found or not all(map(math.isfinite, found)):
        raise SettingError(f"setting {name!r} is {text!r}: it must be numbers separated by commas")
    # Runs are called by six digits of them.
    if len({f"{number:g}" for number in found}) < len(found):
        raise SettingError(f"setting {name!r} is {text!r}: give each number once")
    return found


def _whole(name: str, text: str) -> int:
    """A whole number from 1 on. Raises SettingError."""
    if not text.isdecimal() or len(text) > MOST_DIGITS or int(text) == 0:
        raise SettingError(f"setting {name!r} is {text!r}: it must be a whole number from 1 on")
    return int(text)


def _number(text: str | None) -> Any:
    """The value that JSON reads in a flag's text, else the text: 7, 0.1, true, tts."""
    try:
        return json.loads(text or "")
    except ValueError:  # also of more digits than Python takes for a number
        return text


def main(arguments: list[str] | None = None) -> None:
    """Entry point."""
    with told("utn", "what was reached is on disk"):
        cli.main(args=arguments, prog_name="utn", standalone_mode=False)


@contextmanager
def told(program: str, after_stop: str) -> Iterator[None]:
    """Every error that is the user's to mend is one line and exit code 2; 130 after Ctrl-C, and what is left of it."""
    try:
        yield
    except UtnError as error:
        _fail(program, str(error))
    except click.exceptions.NoArgsIsHelpError as error:
        click.echo(error.format_message())
    except click.UsageError as error:
        _fail(program, f"{error.format_message().rstrip('.')}: see {program} --help")
    except (click.exceptions.Abort, KeyboardInterrupt):
        click.echo(f"{program}: stopped; {after_stop}", err=True)
        sys.exit(130)
    except OSError as error:
        # Of files that are ours to read all errors are told where they are read: this is a disk, or a pipe's end.
        what = str(error.filename or "output")
        _fail(program, f"{what!r} can't be used ({error.strerror}): free it, or name another")


def _fail(program: str, line: str) -> None:
    click.echo(f"{program}: {line}", err=True)
    sys.exit(2)
