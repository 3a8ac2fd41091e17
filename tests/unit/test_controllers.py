"""Controllers are found by name or in a user's file; what is wrong with them is said in one line."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from utn_controllers.fixed_time import FixedTime
from utn_controllers.mpc.distributed import DistributedMPC
from utn_sumo import controllers
from utn_sumo.contract import Network
from utn_sumo.errors import ControllerError, SettingError, UtnError

OWN = """
class Mine:
    horizon = 3
    def __init__(self, network, gain=1.0):
        self.gain, self.network = gain, network
    def plan(self, state, forecast):
        return self.network.equal_split()

class Needy(Mine):
    def __init__(self, network, gain):
        super().__init__(network, gain)

class Touchy(Mine):
    def __init__(self, network):
        raise RuntimeError("not today")

class Planless:
    horizon = 1
    def __init__(self, network):
        pass

number = 5
"""


@pytest.fixture
def own(tmp_path: Path) -> Path:
    path = tmp_path / "own.py"
    path.write_text(OWN, encoding="utf-8")
    return path


def complaint(net: Network, name: str, kind: type[UtnError] = ControllerError, **settings: Any) -> str:
    with pytest.raises(kind) as caught:
        controllers.build(name, net, settings)
    line = str(caught.value)
    assert "\n" not in line
    return line


def test_our_own_controllers_are_registered_by_name(utn17: Network) -> None:
    assert {"fixed", "dmpc", "tuc", "proportional", "cyclic_max_pressure"} <= set(controllers.registered())
    assert isinstance(controllers.build("fixed", utn17, {}), FixedTime)
    assert isinstance(controllers.build("dmpc", utn17, {"horizon": 5}), DistributedMPC)


def test_fixed_time_gives_the_equal_split(utn17: Network) -> None:
    plan = controllers.build("fixed", utn17, {}).plan(None, None)  # type: ignore[arg-type]
    assert plan.green_s.tolist() == utn17.equal_split().green_s.tolist()


def test_an_unknown_controller_is_answered_with_the_nearest_known_one(utn17: Network) -> None:
    line = complaint(utn17, "dmcp")
    assert "'dmcp' is unknown" in line
    assert "did you mean 'dmpc'?" in line
    assert "path.py:Class" in line


def test_a_class_in_a_file_is_a_controller(utn17: Network, own: Path) -> None:
    mine: Any = controllers.build(f"{own}:Mine", utn17, {"gain": 2.5})
    assert mine.gain == 2.5
    assert mine.horizon == 3
    assert np.isfinite(mine.plan(None, None).green_s).all()


def test_an_unknown_setting_is_named_beside_the_known_ones(utn17: Network, own: Path) -> None:
    line = complaint(utn17, "dmpc", SettingError, horizn=5)
    assert "'dmpc' has no setting 'horizn'" in line
    assert "did you mean 'horizon'?" in line
    assert "it takes none" in complaint(utn17, "fixed", SettingError, gain=1)
    assert "did you mean 'gain'?" in complaint(utn17, f"{own}:Mine", SettingError, gian=1)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("horizon", 0),
        ("horizon", "long"),
        ("control_horizon", 61),
        ("step_s", 0),
        ("step_s", -60),
        ("step_s", "short"),
        ("cost", "time"),
        ("q", -1),
        ("iterations", 0),
        ("rho", 0),
        ("relaxation", 2),
        ("tolerance_abs", 0),
    ],
)
def test_a_bad_setting_of_the_distributed_mpc_is_named_with_its_value(utn17: Network, name: str, value: Any) -> None:
    line = complaint(utn17, "dmpc", SettingError, **{name: value})
    assert "'dmpc'" in line
    assert f"setting {name!r} is {value!r}: it must be" in line


@pytest.mark.parametrize("value", [float("inf"), float("nan")])
@pytest.mark.parametrize(
    ("controller", "name"),
    [("max_wave", "every_s"), ("priced", "horizon_s"), ("priced", "crowding"), ("priced", "full"), ("tuc", "r")],
)
def test_a_setting_that_is_not_finite_is_named_with_its_value(
    utn17: Network, controller: str, name: str, value: float
) -> None:
    line = complaint(utn17, controller, SettingError, **{name: value})
    assert f"setting {name!r} is {value}: it must be" in line


@pytest.mark.parametrize(
    ("controller", "settings", "remedy"),
    [
        ("dmpc", {"q": 5.0}, "set cost to 'paper'"),
        ("cmpc", {"r": 5.0}, "set cost to 'paper'"),
        ("cmpc", {"crowding": 50.0, "cost": "paper"}, "set cost to 'tts'"),
        ("dmpc", {"terminal": 50.0, "cost": "paper"}, "set cost to 'tts'"),
        ("dmpc", {"scheduler": "tcp://nowhere:1"}, "set agents to 'dask'"),
        ("dmpc", {"iterations": 9, "coordination": "none"}, "set coordination to 'admm' or 'sensitivity'"),
        ("dmpc", {"rho": 9.0, "coordination": "none"}, "set coordination to 'admm' or 'sensitivity'"),
        ("dmpc", {"relaxation": 1.0, "coordination": "sensitivity"}, "set coordination to 'admm'"),
    ],
)
def test_a_setting_that_would_do_nothing_is_refused(
    utn17: Network, controller: str, settings: dict[str, Any], remedy: str
) -> None:
    line = complaint(utn17, controller, SettingError, **settings)
    assert f"{next(iter(settings))} does nothing where " in line
    assert f"leave it out, or {remedy}" in line


def test_a_control_horizon_beyond_the_horizon_is_refused(utn17: Network) -> None:
    line = complaint(utn17, "dmpc", SettingError, horizon=3, control_horizon=5)
    assert "control_horizon 5" in line
    assert "horizon 3" in line


@pytest.mark.parametrize("step_s", [7, 50.0, 90, 240])
def test_a_model_step_that_does_not_divide_the_control_step_is_refused(utn17: Network, step_s: float) -> None:
    line = complaint(utn17, "dmpc", SettingError, step_s=step_s)
    assert f"setting 'step_s' is {step_s:g}: it must divide" in line
    assert "120 s" in line


def test_a_missing_file_or_class_is_named(utn17: Network, own: Path) -> None:
    assert "there is no file 'nowhere.py'" in complaint(utn17, "nowhere.py:Mine")
    assert "has no class 'Yours'" in complaint(utn17, f"{own}:Yours")


def test_a_class_that_can_not_plan_is_refused(utn17: Network, own: Path) -> None:
    assert "lacks" in complaint(utn17, f"{own}:Planless")


@pytest.mark.parametrize("name", ["Needy", "Touchy", "number"])
def test_a_class_that_can_not_be_built_is_refused_in_one_line(utn17: Network, own: Path, name: str) -> None:
    assert name in complaint(utn17, f"{own}:{name}", UtnError)


@pytest.mark.parametrize(
    "content", ["class Mine(:", "import no_such_module", "1 / 0"], ids=["syntax", "import", "failure"]
)
def test_a_file_that_does_not_import_is_refused_in_one_line(utn17: Network, own: Path, content: str) -> None:
    own.write_text(content, encoding="utf-8")
    assert "own.py" in complaint(utn17, f"{own}:Mine")


ANNOTATED = """
from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Literal

from pydantic import BaseModel

class MineSettings(BaseModel):
    cost: Literal["tts", "paper"] = "tts"

@dataclass
class Part:
    many: ClassVar[int] = 2
    one: int = 1

class Mine:
    Settings = MineSettings
    horizon = 3
    def __init__(self, network, **settings):
        self.network, self.cost, self.part = network, MineSettings(**settings).cost, Part(4)
    def plan(self, state, forecast):
        return self.network.equal_split()
"""


def test_a_file_may_put_off_its_annotations(tmp_path: Path, utn17: Network) -> None:
    path = tmp_path / "json.py"
    path.write_text(ANNOTATED, encoding="utf-8")
    mine: Any = controllers.build(f"{path}:Mine", utn17, {"cost": "paper"})
    assert (mine.cost, mine.part.one) == ("paper", 4)
    assert "must be 'tts' or 'paper'" in complaint(utn17, f"{path}:Mine", SettingError, cost="money")
    assert sys.modules["json"].loads("1") == 1


def test_of_a_file_that_can_not_be_loaded_nothing_is_left(tmp_path: Path, utn17: Network) -> None:
    path = tmp_path / "own.py"
    path.write_text("raise RuntimeError('not today')", encoding="utf-8")
    before = set(sys.modules)
    assert "can't be loaded: RuntimeError: not today" in complaint(utn17, f"{path}:Mine")
    assert set(sys.modules) == before


@pytest.mark.parametrize("horizon", ["x", 0, 1.5, None, 10**7])
def test_a_horizon_that_is_no_number_of_cycles_is_named(utn17: Network, tmp_path: Path, horizon: object) -> None:
    file = tmp_path / "mine.py"
    file.write_text(OWN.replace("horizon = 3", f"horizon = {horizon!r}"), encoding="utf-8")
    assert f"has horizon {horizon!r}: make it a whole number from 1 on" in complaint(utn17, f"{file}:Mine")


def test_numpy_s_whole_numbers_are_horizons_too(utn17: Network, tmp_path: Path) -> None:
    file = tmp_path / "mine.py"
    file.write_text("import numpy as np\n" + OWN.replace("horizon = 3", "horizon = np.int64(2)"), encoding="utf-8")
    assert controllers.build(f"{file}:Mine", utn17, {}).horizon == 2


def test_a_class_that_takes_settings_of_whatever_name_is_given_them(utn17: Network, own: Path) -> None:
    anything = """
class Open(Mine):
    def __init__(self, network, gain=1.0, *rest, **settings):
        super().__init__(network, gain)
        self.settings = settings

class HandedOn(Mine):
    def __init__(self, network, **settings):
        super().__init__(network, **settings)
"""
    own.write_text(OWN + anything, encoding="utf-8")
    taken: Any = controllers.build(f"{own}:Open", utn17, {"gain": 2.0, "foo": 3})
    assert (taken.gain, taken.settings) == (2.0, {"foo": 3})
    assert controllers.settings_of(controllers.maker(f"{own}:Open")) == ["gain"]
    assert "can't be built: TypeError" in complaint(utn17, f"{own}:HandedOn", foo=3)


def test_a_file_that_ends_the_process_cannot_be_loaded(utn17: Network, tmp_path: Path) -> None:
    file = tmp_path / "mine.py"
    file.write_text("raise SystemExit(3)\n", encoding="utf-8")
    assert "can't be loaded: SystemExit: 3" in complaint(utn17, f"{file}:Mine")
